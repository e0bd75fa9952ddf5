"""The files of a comparison: a track.csv and a sensors' CSV in, a table of errors out."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.records import CONVERGED, DOUBTFUL

_ANGLES = {"theta_rad": 1.0, "theta_urad": 1e-6, "theta_deg": math.pi / 180}
_DISPLACEMENT = ("dx_px", "dy_px", "dtheta_rad")


class SensorTable(NamedTuple):
    """``time_s`` (S,) and ``pose`` (S, 3) um, um, rad; NaN where a cell is empty."""

    time_s: NDArray[np.float64]
    pose: NDArray[np.float64]


class TrackTable(NamedTuple):
    """One template of a track.csv: ``frame`` (T,), ``time_s`` (T,) if there are times, ``displacement`` (T, 3) px, px,
    rad, ``displacement_um`` (T, 2) if there are micrometres, and in which frames the template was ``found`` (T,)."""

    frame: NDArray[np.float64]
    time_s: NDArray[np.float64] | None
    displacement: NDArray[np.float64]
    displacement_um: NDArray[np.float64] | None
    found: NDArray[np.bool_]


def read_sensors(path: str | Path) -> SensorTable:
    """Columns time_s, x_um, y_um and one of theta_rad, theta_urad, theta_deg, in any order among others.

    FileNotFoundError; ValueError for missing columns (the message lists those found), for words among the numbers, and
    for times that do not increase, with the line.
    """
    table = _Columns(path)
    angle = [name for name in _ANGLES if name in table.cells]
    if len(angle) != 1:
        raise ValueError(f"{path}: expected one column of {', '.join(_ANGLES)}; columns found: {table.names}")
    time = table.numbers("time_s")
    table.check_times(time)
    theta = _ANGLES[angle[0]] * table.numbers(angle[0])
    return SensorTable(time, np.stack((table.numbers("x_um"), table.numbers("y_um"), theta), -1))


def read_track(path: str | Path, template: int = 0) -> TrackTable:
    """One template of a track.csv. Errors as ``read_sensors``; ValueError if that template is not in it."""
    table = _Columns(path)
    number = table.numbers("template")
    rows = number == template
    if not rows.any():
        known = ", ".join(f"{k:g}" for k in np.unique(number))
        raise ValueError(f"template: {path} has the templates {known}, got {template}")
    table = table.take(rows)
    time = table.numbers("time_s") if "time_s" in table.cells else None
    if time is not None:
        table.check_times(time)
    um = np.stack([table.numbers(name) for name in ("dx_um", "dy_um")], -1) if "dx_um" in table.cells else None
    found = np.array([word in (CONVERGED, DOUBTFUL) for word in table.words("status")])
    displacement = np.stack([table.numbers(name) for name in _DISPLACEMENT], -1)
    return TrackTable(table.numbers("frame"), time, displacement, um, found)


def write_table(path: Path, columns: Mapping[str, Sequence[Any]], formats: Mapping[str, str]) -> None:
    """Columns of equal length as CSV, each by its format; what is not a finite number stays empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            cells = zip(row, (formats[name] for name in columns), strict=True)
            writer.writerow(["" if isinstance(v, float) and not math.isfinite(v) else form % v for v, form in cells])


class _Columns:
    """The cells of a CSV file by column, with the line that each row stands in."""

    def __init__(self, path: str | Path) -> None:
        self.path, self.cells, self.lines = path, {}, np.zeros(0, np.int64)
        if not Path(path).is_file():
            raise FileNotFoundError(f"no such file: {path}")
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            rows, lines = [], []
            for row in reader:
                if row and len(row) != len(header):
                    raise ValueError(f"{path}: line {reader.line_num} must have {len(header)} cells, got {len(row)}")
                if row:
                    rows.append(row)
                    lines.append(reader.line_num)
        if not rows:
            raise ValueError(f"{path}: expected a header and rows of numbers, got {len(header)} columns without a row")
        self.cells = {name: np.array(cells) for name, cells in zip(header, zip(*rows, strict=True), strict=True)}
        self.lines = np.array(lines)

    @property
    def names(self) -> str:
        """The columns, for messages."""
        return ", ".join(self.cells)

    def take(self, rows: NDArray[np.bool_]) -> _Columns:
        """The same columns with some of the rows."""
        part = object.__new__(_Columns)
        part.path, part.lines = self.path, self.lines[rows]
        part.cells = {name: cells[rows] for name, cells in self.cells.items()}
        return part

    def words(self, name: str) -> NDArray[np.str_]:
        """The cells of a column as text."""
        if name not in self.cells:
            raise ValueError(f"{self.path}: column {name} is missing; columns found: {self.names}")
        return self.cells[name]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The cells of a column as numbers, NaN where a cell is empty."""
        cells = np.char.strip(self.words(name))
        try:
            return np.where(cells == "", "nan", cells).astype(np.float64)
        except ValueError:
            wrong = next(k for k, cell in enumerate(cells) if cell and not _is_number(cell))
            place = f"{self.path}: line {self.lines[wrong]}, column {name}"
            raise ValueError(f"{place}: expected a number, got {str(cells[wrong])!r}") from None

    def check_times(self, time: NDArray[np.float64]) -> None:
        """ValueError with the line for a time that is missing or does not increase."""
        wrong = np.flatnonzero(~np.isfinite(time))
        if len(wrong):
            raise ValueError(f"{self.path}: line {self.lines[wrong[0]]}: time_s must be a finite number")
        back = np.flatnonzero(np.diff(time) <= 0)
        if len(back):
            k = back[0] + 1
            raise ValueError(
                f"{self.path}: line {self.lines[k]}: time_s must increase, {time[k]:g} follows {time[k - 1]:g}"
            )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
