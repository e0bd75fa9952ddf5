"""comparison.png: two records of one motion on top of each other, and their differences."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from torch_ecc.plots.save import save
from torch_ecc.plots.style import styled

_TRACK, _SENSORS, _NEAREST = "#0072b2", "#d55e00", "#a8a8a8"
_NAMES = ("x", "y", r"$\theta$")
_UNITS = (("nm", 1e3), ("nm", 1e3), ("µrad", 1e6))
_LARGER = {"nm": "µm", "µm": "mm", "µrad": "mrad", "mrad": "rad"}
_NEEDED = ("time_s", "track", "sensor_time_s", "sensors", "errors", "nearest")
_MARGIN = 0.05  # of the track's time that the sensors' record is drawn before and after it
_GAP = 3.0  # median periods between samples that no line is drawn over

_Data = Mapping[str, NDArray[Any]]


@styled()
def plot_comparison(records: Mapping[str, ArrayLike], path: str | Path, *, title: str = "", dpi: int = 130) -> Path:
    """Draw two records and their differences into ``path`` (png, pdf or svg) and return that.

    ``records``: times ``time_s`` (T,) and ``sensor_time_s`` (S,) on one clock; ``track`` (T, 3) and ``sensors`` (S, 3)
    um, um, rad on the same axes; ``errors`` (T, 3) of everything estimated at once and ``nearest`` (T, 3) by the
    paper's nearest points. NaN is not drawn, nor is a component that is never anything else. ValueError if one is
    missing.
    """
    missing = [name for name in _NEEDED if name not in records]
    if missing:
        raise ValueError(f"plot_comparison: records must have {', '.join(_NEEDED)}; missing: {', '.join(missing)}")
    data = _around_the_track({name: np.asarray(records[name], dtype=np.float64) for name in _NEEDED})
    there = [k for k in range(3) if np.isfinite(data["errors"][:, k]).any()]
    figure = Figure(figsize=(12.5, 2.6 + 1.9 * max(len(there), 2)), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1, 1.35))
    left, right = halves
    _draw_motions(left, data, there)
    rows = np.atleast_1d(right.subplots(max(len(there), 1), 1, sharex=True))
    for axis, k in zip(rows, there, strict=False):
        _draw_errors(axis, data, k)
    rows[-1].set_xlabel("time of the track (s)")
    right.legend(*rows[0].get_legend_handles_labels(), ncols=2, loc="outside upper left")
    figure.suptitle(
        title or f"{len(data['time_s']):,} frames, {len(data['sensor_time_s']):,} sensor samples", parse_math=False
    )
    return save(figure, Path(path), dpi)


def _around_the_track(data: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The records without the part of the sensors' long before and after the track, and with a NaN in their gaps."""
    t, s = data["time_s"], data["sensor_time_s"]
    margin = _MARGIN * (t[-1] - t[0]) if len(t) else 0.0
    near = (s >= t[0] - margin) & (s <= t[-1] + margin) if len(t) else np.ones(len(s), bool)
    s, pose = s[near], data["sensors"][near]
    wide = np.flatnonzero(np.diff(s) > _GAP * np.median(np.diff(s))) + 1 if len(s) > 2 else np.zeros(0, int)
    s, pose = np.insert(s, wide, np.nan), np.insert(pose, wide, np.nan, axis=0)
    return data | {"sensor_time_s": s, "sensors": pose}


def _draw_motions(left: Any, data: _Data, there: list[int]) -> None:
    """The path in the plane where there are x and y, and what else there is over time."""
    alone = [k for k in there if not ({0, 1} <= set(there) and k < 2)]
    plane = {0, 1} <= set(there)
    heights = [2.2] * plane + [1.0] * len(alone)
    rows = list(np.atleast_1d(left.subplots(max(len(heights), 1), 1, height_ratios=heights or [1.0])))
    if plane:
        _draw_plane(rows[0], data)
    for axis, k in zip(rows[plane:], alone, strict=False):
        unit, scale = ("µrad", 1e6) if k == 2 else ("µm", 1.0)
        unit, scale = _larger(unit, scale, data["track"][:, k])
        axis.plot(data["sensor_time_s"], scale * data["sensors"][:, k], color=_SENSORS, lw=1.0, label="sensors")
        axis.plot(data["time_s"], scale * data["track"][:, k], ".", color=_TRACK, ms=2.5, label="track")
        axis.set(xlabel="time of the track (s)", ylabel=f"{_NAMES[k]} ({unit})")
    left.legend(*rows[0].get_legend_handles_labels(), ncols=2, loc="outside upper left", markerscale=3)


def _draw_plane(axis: Axes, data: _Data) -> None:
    unit, scale = _larger("µm", 1.0, data["track"][:, :2])
    axis.plot(*scale * data["sensors"][:, :2].T, color=_SENSORS, lw=1.0, label="sensors")
    axis.plot(*scale * data["track"][:, :2].T, ".", color=_TRACK, ms=2.5, label="track")
    axis.set_aspect("equal", "datalim")
    axis.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")


def _draw_errors(axis: Axes, data: _Data, k: int) -> None:
    """Errors of component ``k`` by both methods, with their rms."""
    unit, scale = _larger(*_UNITS[k], data["errors"][:, k])
    for at, name, colour, words in (
        (0.8, "nearest", _NEAREST, "nearest points"),
        (1.0, "errors", _TRACK, "estimated at once"),
    ):
        values = scale * data[name][:, k]
        axis.plot(data["time_s"], values, color=colour, lw=0.8, label=words)
        found = values[np.isfinite(values)]
        rms = f"rms {np.sqrt(np.mean(found**2)):.3g} {unit}" if len(found) else ""
        axis.text(at, 1.01, rms, color=colour, transform=axis.transAxes, ha="right", va="bottom", fontsize=9)
    axis.set_ylabel(f"{_NAMES[k]} error ({unit})")


def _larger(unit: str, scale: float, values: NDArray[Any]) -> tuple[str, float]:
    """The unit in which the largest of the values, times ``scale``, has at most four digits before the point."""
    found = np.abs(values[np.isfinite(values)])
    largest = scale * float(found.max()) if len(found) else 0.0
    while largest >= 1e4 and unit in _LARGER:
        unit, scale, largest = _LARGER[unit], 1e-3 * scale, 1e-3 * largest
    return unit, scale
