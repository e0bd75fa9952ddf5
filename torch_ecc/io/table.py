"""track.csv: one row per frame and template, the units in the header."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.frames import Frame
from torch_ecc.io.records import sigma

_XY, _ANGLE, _SHORT = "%.6f", "%.9f", "%.4g"  # 1e-6 px or um and 1e-9 rad are far below what light allows

_OF_POSES, _NOTHING = ("_px", "_rad", "_um"), "%.0s"


def _columns(*, timed: bool, named: bool, micrometres: bool) -> dict[str, str]:
    """Name and format of each column."""
    pose = {"x_px": _XY, "y_px": _XY, "theta_rad": _ANGLE}
    return (
        {"frame": "%d", "template": "%d"}
        | ({"file": "%s"} if named else {})
        | ({"time_s": "%s"} if timed else {})
        | pose
        | {f"d{name}": number for name, number in pose.items()}
        | ({"dx_um": _XY, "dy_um": _XY} if micrometres else {})
        | {f"sigma_{name}": _SHORT for name in pose}
        | {"score": "%.6f", "status": "%s", "reason": "%s", "origin": "%s", "iterations": "%d"}
        | {"residual_rms": _SHORT, "coverage": "%.3f", "damage": "%s"}
    )


class Table:
    """Turns records into the text of the table; ``timed``, ``named`` and ``micrometres`` say which optional columns
    there are. Every row is one line, whatever a file is called. Of a template that was lost no number about its pose is
    there, so that nothing draws one."""

    def __init__(self, *, timed: bool, named: bool = False, micrometres: bool = False) -> None:
        columns = _columns(timed=timed, named=named, micrometres=micrometres)
        self.header = ",".join(columns) + "\n"
        self._timed, self._named = timed, named
        self._row = ",".join(columns.values()) + "\n"
        own = {name: _NOTHING if name.endswith(_OF_POSES) else number for name, number in columns.items()}
        self._lost = ",".join(own.values()) + "\n"

    def rows(self, frame: Frame, arrays: Mapping[str, NDArray[Any]], *said: Sequence[str]) -> str:
        """The rows of one frame: R templates, those without a pose NaN; their words for status, reason and origin."""
        time = "" if frame.time_s is None else f"{frame.time_s:.9f}"
        own = [quoted(frame.name)] * self._named + [time] * self._timed
        um = (arrays["displacement_um"],) if "displacement_um" in arrays else ()
        numbers = np.hstack((arrays["pose"], arrays["displacement"], *um, sigma(arrays["covariance"]))).tolist()
        last = (arrays[name].tolist() for name in ("score", "iterations", "residual_rms", "coverage"))
        damage = quoted(frame.damage or "")
        return "".join(
            (self._lost if isnan(row[0]) else self._row) % (frame.number, k, *own, *row, score, *words, *tail, damage)
            for k, (row, words, score, *tail) in enumerate(zip(numbers, zip(*said, strict=True), *last, strict=True))
        )


def quoted(text: str) -> str:
    """A cell of a table: what cannot be printed, as a line's end, becomes a question mark."""
    if text.isalnum() or not text:
        return text
    cell = io.StringIO()
    csv.writer(cell, lineterminator="").writerow(("".join(c if c.isprintable() else "?" for c in text),))
    return cell.getvalue()
