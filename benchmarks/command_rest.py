"""``torch-ecc`` with a tracker that says of all frames what it has found in the first ones, at once.

``python command_rest.py track INPUT ...``: what ``command.py`` times as all that is not tracking, which no faster
tracker makes less: torch and PyAV are loaded, frames decoded, rows and pictures written.
"""

from __future__ import annotations

from torch import Tensor

from torch_ecc import Estimate, Tracker
from torch_ecc.__main__ import main

FIRST = 3  # frames

track = Tracker.forward
found: list[Estimate] = []


def known(tracker: Tracker, frame: Tensor) -> Estimate:
    """What was found, of the first few frames, or the last one of them."""
    if len(found) < FIRST:
        found.append(track(tracker, frame))
    return found[-1]


Tracker.forward = known  # type: ignore[method-assign]

if __name__ == "__main__":
    main()
