"""track.csv: one row per frame and template, the units in the header."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.records import sigma

_XY, _ANGLE, _SHORT = "%.6f", "%.9f", "%.4g"  # 1e-6 px or um and 1e-9 rad are far below what light allows


def _columns(*, timed: bool, micrometres: bool) -> dict[str, str]:
    """Name and format of each column."""
    pose = {"x_px": _XY, "y_px": _XY, "theta_rad": _ANGLE}
    return (
        {"frame": "%d", "template": "%d"}
        | ({"time_s": "%.6f"} if timed else {})
        | pose
        | {f"d{name}": number for name, number in pose.items()}
        | ({"dx_um": _XY, "dy_um": _XY} if micrometres else {})
        | {f"sigma_{name}": _SHORT for name in pose}
        | {"score": "%.6f", "status": "%s", "iterations": "%d", "residual_rms": _SHORT}
    )


class Table:
    """Turns records into the text of the table; ``timed`` and ``micrometres`` say which optional columns there are."""

    def __init__(self, *, timed: bool, micrometres: bool) -> None:
        columns = _columns(timed=timed, micrometres=micrometres)
        self.header = ",".join(columns) + "\n"
        self._row = ",".join(columns.values()) + "\n"

    def rows(self, frame: int, time_s: float | None, arrays: Mapping[str, NDArray[Any]], status: Sequence[str]) -> str:
        """The rows of one frame: R templates."""
        count = len(status)
        index = np.stack((np.full(count, frame), np.arange(count)), -1)
        times = np.full((count, 0 if time_s is None else 1), time_s or 0.0)
        um = arrays.get("displacement_um", np.empty((count, 0)))
        deviations = sigma(arrays["covariance"])
        numbers = np.hstack((index, times, arrays["pose"], arrays["displacement"], um, deviations))
        last = zip(arrays["score"], status, arrays["iterations"], arrays["residual_rms"], strict=True)
        return "".join(self._row % (*row, *tail) for row, tail in zip(numbers.tolist(), last, strict=True))
