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

_TRACK, _SENSORS, _NEAREST = "#0072b2", "#d55e00", "#b5b5b5"
_ERRORS = (("x error (nm)", 1e3), ("y error (nm)", 1e3), (r"$\theta$ error (µrad)", 1e6))
_NEEDED = ("time_s", "track", "sensor_time_s", "sensors", "errors", "nearest")


def plot_comparison(records: Mapping[str, ArrayLike], path: str | Path, *, title: str = "", dpi: int = 130) -> Path:
    """Draw two records and their differences into ``path`` (png, pdf or svg) and return that.

    ``records``: times ``time_s`` (T,) and ``sensor_time_s`` (S,) on one clock; ``track`` (T, 3) and ``sensors`` (S, 3)
    um, um, rad on the same axes; ``errors`` (T, 3) of everything estimated at once and ``nearest`` (T, 3) by the
    paper's nearest points. NaN is not drawn. ValueError if one is missing.
    """
    missing = [name for name in _NEEDED if name not in records]
    if missing:
        raise ValueError(f"plot_comparison: records must have {', '.join(_NEEDED)}; missing: {', '.join(missing)}")
    data = {name: np.asarray(records[name], dtype=np.float64) for name in _NEEDED}
    figure = Figure(figsize=(12.5, 8.2), layout="constrained")
    axes = figure.subplot_mosaic("pa;pb;tc", gridspec_kw={"width_ratios": (1, 1.35)})
    _draw_motion(axes["p"], axes["t"], data)
    for k, (label, scale) in enumerate(_ERRORS):
        _draw_errors(axes["abc"[k]], data, k, scale)
        axes["abc"[k]].set_ylabel(label)
    for name in "tc":
        axes[name].set_xlabel("time of the track (s)")
    for axis in axes.values():
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color="#dddddd", lw=0.6)
    axes["a"].legend(ncols=2, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
    figure.suptitle(
        title or f"{len(data['time_s']):,} frames, {len(data['sensor_time_s']):,} sensor samples", fontsize=13
    )
    return save(figure, Path(path), dpi)


def _draw_motion(plane: Axes, angle: Axes, data: Mapping[str, NDArray[Any]]) -> None:
    """The path in the plane, and theta over time."""
    plane.plot(*data["sensors"][:, :2].T, color=_SENSORS, lw=1.0, label="sensors")
    plane.plot(*data["track"][:, :2].T, ".", color=_TRACK, ms=2.5, label="track")
    plane.set_aspect("equal", "datalim")
    plane.set_xlabel("x (µm)")
    plane.set_ylabel("y (µm)")
    plane.legend(frameon=False, markerscale=4, loc="upper right")
    angle.plot(data["sensor_time_s"], 1e6 * data["sensors"][:, 2], color=_SENSORS, lw=1.0)
    angle.plot(data["time_s"], 1e6 * data["track"][:, 2], ".", color=_TRACK, ms=2.5)
    angle.set_ylabel(r"$\theta$ (µrad)")


def _draw_errors(axis: Axes, data: Mapping[str, NDArray[Any]], k: int, scale: float) -> None:
    """Errors of component ``k`` by both methods, each with its rms in the legend."""
    for name, colour, words in (("nearest", _NEAREST, "nearest points"), ("errors", _TRACK, "estimated at once")):
        values = scale * data[name][:, k]
        axis.plot(data["time_s"], values, color=colour, lw=0.8, label=words)
        found = values[np.isfinite(values)]
        rms = np.sqrt(np.mean(found**2)) if len(found) else np.nan
        at = 0.99 if name == "errors" else 0.8
        axis.text(
            at, 1.01, f"rms {rms:.3g}", color=colour, transform=axis.transAxes, ha="right", va="bottom", fontsize=9
        )
