"""The files of a comparison: a track.csv and a sensors' log in, a table of errors out."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.columns import Column, choose, values
from torch_ecc.io.logs import Log, read_log
from torch_ecc.io.records import CONVERGED, DOUBTFUL

_DISPLACEMENT = ("dx_px", "dy_px", "dtheta_rad")
_AXES = ("x", "y", "theta")


class SensorTable(NamedTuple):
    """``time_s`` (S,), ``pose`` (S, 3) um, um, rad, NaN where a cell is empty and for a component that is not there,
    and in words from which columns they are."""

    time_s: NDArray[np.float64]
    pose: NDArray[np.float64]
    said: str


class TrackTable(NamedTuple):
    """One template of a track.csv: ``frame`` (T,), ``time_s`` (T,) if there are times, ``displacement`` (T, 3) px, px,
    rad, ``displacement_um`` (T, 2) if there are micrometres, and in which frames the template was ``found`` (T,)."""

    frame: NDArray[np.float64]
    time_s: NDArray[np.float64] | None
    displacement: NDArray[np.float64]
    displacement_um: NDArray[np.float64] | None
    found: NDArray[np.bool_]


def read_sensors(path: str | Path, columns: str | None = None, rate_hz: float | None = None) -> SensorTable:
    """A log with times and at least one of x, y and theta: see ``logs`` and, for ``columns``, ``columns.choose``.

    ``rate_hz``: samples per second, instead of a column of times. Rows in reverse order are turned round.
    FileNotFoundError; ValueError for missing columns (the message lists those found), for words among the numbers, and
    for times that go back, with the line.
    """
    log = read_log(path)
    chosen = choose(log, columns)
    if rate_hz is not None:
        chosen.pop("time", None)
        time, words = np.arange(len(log.lines)) / rate_hz, [f"time = rows at {rate_hz:g} Hz"]
    elif "time" in chosen:
        time, words = values(log, "time", chosen["time"]), [_words("time", chosen["time"])]
    else:
        raise ValueError(f"{path}: no column of times found, see --columns 'time=NAME' and --sensors-hz; {_found(log)}")
    axes = [role for role in _AXES if role in chosen]
    if not axes:
        raise ValueError(f"{path}: no column of x, y or theta found, see --columns 'x=NAME:UNIT, ...'; {_found(log)}")
    pose = np.full((len(time), 3), math.nan)
    for role in axes:
        pose[:, _AXES.index(role)] = values(log, role, chosen[role])
    if len(time) > 1 and (np.diff(time) <= 0).all() and time[-1] < time[0]:
        time, pose = time[::-1].copy(), pose[::-1].copy()
        words.append("last row first")
    else:
        _check_times(log, time)
    return SensorTable(time, pose, ", ".join([words[0], *(_words(role, chosen[role]) for role in axes), *words[1:]]))


def read_track(path: str | Path, template: int = 0) -> TrackTable:
    """One template of a track.csv. Errors as ``read_sensors``; ValueError if that template is not in it."""
    log = read_log(path)
    number = log.numbers("template")
    rows = number == template
    if not rows.any():
        known = ", ".join(f"{k:g}" for k in np.unique(number))
        raise ValueError(f"template: {path} has the templates {known}, got {template}")
    log = log.take(rows)
    time = log.numbers("time_s") if "time_s" in log.names else None
    if time is not None:
        _check_times(log, time)
    um = np.stack([log.numbers(name) for name in ("dx_um", "dy_um")], -1) if "dx_um" in log.names else None
    found = np.isin(log.column("status"), (CONVERGED, DOUBTFUL))
    displacement = np.stack([log.numbers(name) for name in _DISPLACEMENT], -1)
    return TrackTable(log.numbers("frame"), time, displacement, um, found)


def write_table(path: Path, columns: Mapping[str, Sequence[Any]], formats: Mapping[str, str]) -> None:
    """Columns of equal length as CSV, each by its format; what is not a finite number stays empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            cells = zip(row, (formats[name] for name in columns), strict=True)
            writer.writerow(["" if isinstance(v, float) and not math.isfinite(v) else form % v for v, form in cells])


def _check_times(log: Log, time: NDArray[np.float64]) -> None:
    """ValueError with the line for a time that is missing or goes back."""
    wrong = np.flatnonzero(~np.isfinite(time))
    if len(wrong):
        raise ValueError(f"{log.path}: line {log.lines[wrong[0]]}: time_s must be a finite number")
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        k = back[0] + 1
        raise ValueError(
            f"{log.path}: line {log.lines[k]}: times must increase, {time[k]:.9g} follows {time[k - 1]:.9g}"
        )


def _words(role: str, column: Column) -> str:
    return f"{role} = {column.name!r} in {column.unit}" if column.unit else f"{role} = {column.name!r}"


def _found(log: Log) -> str:
    return f"columns found: {', '.join(log.names)}"
