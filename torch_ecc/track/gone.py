"""Templates that are gone from where they are expected: they are searched for before it is tried what may cover them.

A trial of the robust solve (``core.robust``) costs as much as a search near, and of what has jumped it finds nothing.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torch_ecc.core.align import solve_again
from torch_ecc.core.estimate import Estimate, Origin, Reason
from torch_ecc.core.robust import Memory
from torch_ecc.track.doubt import Past
from torch_ecc.track.lined import lined
from torch_ecc.track.pinned import held
from torch_ecc.track.recover import Recovery


def searched_first(
    recovery: Recovery,
    images: list[Tensor],
    estimate: Estimate,
    start: Tensor,
    gone: Tensor,
    state: Mapping[str, Tensor],
) -> Estimate:
    """The ``estimate`` of a frame in which what is suspect has been searched for; those templates ``gone`` (R,) from
    their ``start`` (R, 3) that were not found are solved as if something covered them. ``images``: see ``Recovery``."""
    image, past = images[0], Past.of(state)
    found = recovery(images, recovery.not_misled(image, estimate, start, past), start, past)
    index = (gone & (found.origin == Origin.TRACKED)).nonzero()[:, 0]
    if len(index) == 0:
        return found
    again, reason = covered(recovery, image, start, index, state), found.reason[index]
    searched = ~again.ok & ((reason == Reason.AMBIGUOUS) | (reason == Reason.WAITING))
    return found.put(index, again._replace(reason=torch.where(searched, reason, again.reason)))


def covered(recovery: Recovery, image: Tensor, start: Tensor, index: Tensor, state: Mapping[str, Tensor]) -> Estimate:
    """Templates at ``index`` (n,) of a ``state``, solved robustly; what of them is believed goes into it."""
    part = {name: state[name][index] for name in ("score", "trust", "answered", "start", "fixed", "lines", "heed")}
    view, memory = image if len(image) == 1 else image[index], Memory(part["score"], part["trust"], part["answered"])
    reference = recovery.reference.select(index)
    estimate, found = solve_again(reference, view, start[index], recovery.as_tracked, part["start"], memory)
    if found.trust is not None:
        state["trust"].index_copy_(0, index, torch.where(estimate.ok[:, None], found.trust, 1.0))
    return lined(held(estimate, found, reference, part), found, reference, part)
