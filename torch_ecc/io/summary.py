"""summary.json: how a run went, for people and for scripts."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ecc.io.output import append, create
from torch_ecc.io.records import CONVERGED, DAMAGED, DOUBTFUL

_CODES = 128  # that an int8 has for a status, a reason or an origin
_VALUES = 1 << 17  # of all templates: medians over more are taken of frames some apart
_NEVER = -1


class Tally:
    """What the records of ``frames`` frames of R ``templates`` come to; they are added some at a time, and memory does
    not grow with their number. ``names``: the words of their codes of status, reason and origin."""

    def __init__(self, templates: int, frames: int, names: Mapping[str, Mapping[int, str]]) -> None:
        self._names, self._frames = names, 0
        self._apart = max(frames * templates // _VALUES, 1)  # in frames, of those that the medians are of
        self._variances: list[NDArray[np.float64]] = []
        self._codes = {field: np.zeros((templates, _CODES), np.int64) for field in names}
        self._first, self._last = np.full((2, templates), _NEVER)
        self._score, self._coverage, self._found = np.zeros((3, templates))
        self._clock, self._back = -math.inf, 0
        self._least, self._drift = np.full(templates, math.inf), np.full((templates, 3), math.nan)

    def add(self, records: NDArray[Any]) -> None:
        """(F,) of them more, as they follow those before."""
        found = np.isin(records["status"], self._saying(CONVERGED, DOUBTFUL))
        for field, counts in self._codes.items():
            counted = found if field == "origin" else np.ones_like(found)  # what is lost was come by in no way
            each = zip(records[field].T, counted.T, strict=True)
            counts += [np.bincount(codes[there], minlength=_CODES) for codes, there in each]
        self._score += records["score"].sum(0)
        self._coverage += np.where(found, records["coverage"], 0.0).sum(0)
        self._least = np.minimum(self._least, np.where(found, records["coverage"], math.inf).min(0))
        self._found += found.sum(0)
        (first, last), (_, seen) = _ends(~found), _ends(found)
        self._first = np.where((self._first == _NEVER) & (first != _NEVER), self._frames + first, self._first)
        self._last = np.where(last != _NEVER, self._frames + last, self._last)
        moved = records["displacement"][seen, np.arange(len(seen))]
        self._drift = np.where((seen != _NEVER)[:, None], moved, self._drift)
        self._time(records)
        some = records["covariance"][-self._frames % self._apart :: self._apart]
        self._variances.append(np.diagonal(some, axis1=-2, axis2=-1).copy())
        self._frames += len(records)

    def _time(self, records: NDArray[Any]) -> None:
        """Count the times that are not later than the one before."""
        told = records["time_s"] if "time_s" in (records.dtype.names or ()) else np.empty(0)
        times = np.append(self._clock, told[np.isfinite(told)])
        self._back += int((np.diff(times) <= 0).sum())
        self._clock = times[-1]

    def summary(self, error: BaseException | None) -> dict[str, object]:
        """Of all that was added; ``error`` is what ended the run before its time, if anything did."""
        status = self._codes["status"]
        median = np.sqrt(np.median(np.concatenate(self._variances), 0))
        return {
            "complete": error is None,
            "reason": _describe(error),
            "frames": self._frames,
            "damaged_frames": int(status[0, self._saying(DAMAGED)].sum()),
            "times_that_do_not_go_on": self._back,
            "templates": len(status),
            "rows": self._frames * len(status),
            "reasons": self._counted("reason"),
            "origins": self._counted("origin"),
            "per_template": [self._of(index) | {"median_sigma": _named(median[index])} for index in range(len(status))],
            "versions": versions(),
        }

    def _of(self, template: int) -> dict[str, object]:
        found = int(self._found[template])
        lost_at = [int(each[template]) if each[template] != _NEVER else None for each in (self._first, self._last)]
        return {
            "status": self._counted("status", template),
            "reasons": self._counted("reason", template),
            "origins": self._counted("origin", template),
            "lost_frames": self._frames - found,
            "first_lost_frame": lost_at[0],
            "last_lost_frame": lost_at[1],
            "mean_score": float(self._score[template]) / self._frames,
            "mean_coverage": float(self._coverage[template]) / found if found else None,
            "least_coverage": float(self._least[template]) if found else None,
            "last_displacement": _named(self._drift[template]),
        }

    def _saying(self, *words: str) -> list[int]:
        """The codes of status with one of these ``words``."""
        return [code for code, word in self._names["status"].items() if word in words]

    def _counted(self, field: str, template: int | None = None) -> dict[str, int]:
        """How often each word of a ``field`` stands, of one template or of all, without those that never do."""
        counts = self._codes[field].sum(0) if template is None else self._codes[field][template]
        names = self._names[field]
        return {names[code]: int(counts[code]) for code in np.flatnonzero(counts).tolist() if names[code]}


def _ends(yes: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(R,) the first and the last index at which (F, R) is true, ``_NEVER`` where none is."""
    any_of = yes.any(0)
    first, last = yes.argmax(0), len(yes) - 1 - yes[::-1].argmax(0)
    return np.where(any_of, first, _NEVER), np.where(any_of, last, _NEVER)


def _named(values: NDArray[np.float64]) -> dict[str, float]:
    """(3,) of a pose, by what they are."""
    return dict(zip(("x_px", "y_px", "theta_rad"), values.tolist(), strict=True))


def write_json(path: Path, summary: dict[str, object]) -> None:
    """Strict JSON: what is not finite becomes null, what JSON does not know becomes its text."""
    with create(path) as file:
        append(file, (json.dumps(plain(summary), indent=2, allow_nan=False) + "\n").encode())


def _describe(error: BaseException | None) -> str | None:
    if error is None:
        return None
    if isinstance(error, KeyboardInterrupt):
        return "interrupted by the user"
    return f"{type(error).__name__}: {error}"


def versions() -> dict[str, str]:
    """Of what a result depends on."""
    try:
        package = version("torch-ecc")
    except PackageNotFoundError:
        package = "not installed"
    return {"torch_ecc": package, "torch": torch.__version__, "python": platform.python_version()}


def plain(value: Any) -> Any:
    """A value as JSON knows it: what is not finite is None, what is of another kind is its text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
