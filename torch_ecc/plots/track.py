"""track.png: displacement, uncertainty, score and status of every template over time, from track.npz."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from torch_ecc.plots.envelope import Drawn, thinned
from torch_ecc.plots.save import save
from torch_ecc.plots.style import drawn_with

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#8c6d31", "#5e4fa2", "#444444")
_STATUS = {"CONVERGED": "#58b98a", "MAX_ITERATIONS": "#f2a93b", "LOST": "#d6453d"}
_OTHER_STATUS = ("#8e3b6e", "#7a7a7a", "#3d3d3d")
_MOSAIC = "xa;yb;tc;sr;wr"  # x, y, theta beside their sigma a, b, c; score and status words beside the residual
_WIDTH, _TOP, _BOTTOM = 12.5, 0.8, 0.85  # inches: of all, and of what is above and below the curves


_RC: Any = {  # told beforehand: what is changed of axes that exist already is made twice
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "axes.xmargin": 0.01,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
}


@drawn_with(_RC)
def plot_track(
    track: str | Path | Mapping[str, ArrayLike], path: str | Path, *, title: str = "", dpi: int = 130
) -> Path:
    """Draw a track into ``path`` (png, or pdf or svg by its extension) and return that.

    ``track`` is a track.npz, or a mapping with its arrays: displacement (F, R, 3), covariance (F, R, 3, 3), score,
    status and residual_rms (F, R), status_codes and status_names (K,), and if there are any time_s (F,) and um_matrix
    (2, 2), which change the axes from frames to seconds and from px to um. Bands are +-3 sigma; frames in which a
    template was lost are left out of its curves. Long tracks are drawn as the envelope of what they pass through.

    Raises FileNotFoundError, or ValueError if arrays are missing or there is no frame.
    """
    with ExitStack() as stack:
        arrays = track if isinstance(track, Mapping) else stack.enter_context(np.load(track))
        data = thinned(arrays)
    templates = data.status.shape[1]
    height = 8.8 + 0.12 * min(templates, 16)
    figure = Figure(figsize=(_WIDTH, height))
    strip = 0.14 + 0.06 * min(templates, 16)
    room = {"left": 0.065, "right": 0.93 if templates > len(_COLOURS) else 0.985, "wspace": 0.23, "hspace": 0.13}
    # By hand: matplotlib's own layout draws everything twice.
    room |= {"top": 1 - _TOP / height, "bottom": _BOTTOM / height}
    ratios = {"width_ratios": (2.1, 1), "height_ratios": (1, 1, 1, 0.72, strip)}
    axes = figure.subplot_mosaic(_MOSAIC, sharex=True, gridspec_kw=ratios | room)
    colours = _choose_colours(templates)
    _draw_motion(axes, data, colours)
    _draw_quality(axes, data, colours)
    _draw_status(axes["w"], data)
    axes["x"].locator_params(axis="x", nbins=6)  # shared by all
    for name, axis in axes.items():
        axis.yaxis.set_label_coords(-0.085 if name in _MOSAIC[::3] else -0.17, 0.5)
        if name != "w":
            axis.locator_params(axis="y", nbins=5)
    for name in "wr":
        axes[name].set_xlabel(data.time_label)
    _annotate(figure, data, colours, title)
    return save(figure, Path(path), dpi)


def _choose_colours(count: int) -> list[Any]:
    if count <= len(_COLOURS):
        return list(_COLOURS[:count])
    return list(mpl.colormaps["viridis"](np.linspace(0, 1, count)))


def _draw_motion(axes: Mapping[str, Axes], data: Drawn, colours: list[Any]) -> None:
    """Left the displacement with its band, right the sigma, which is mostly too small to see on the left."""
    small = "nm" if data.unit == "µm" else "10⁻³ px"
    units = ((data.unit, small), (data.unit, small), ("deg", "10⁻³ deg"))
    for k, (symbol, (unit, sigma_unit)) in enumerate(zip("xyθ", units, strict=True)):
        left, right = axes["xyt"[k]], axes["abc"[k]]
        left.set_ylabel(f"{symbol} displacement ({unit})")
        right.set_ylabel(f"\u03c3 of {symbol} ({sigma_unit})")
        for r, colour in enumerate(colours):
            low, high = (side[:, r, k] for side in data.band)
            left.fill_between(data.time, low, high, color=colour, alpha=0.25, lw=0)
            _curve(left, data, [side[:, r, k] for side in data.displacement], colour)
            _curve(right, data, [1e3 * side[:, r, k] for side in data.sigma], colour)
        _limit(left, right, data, k)


def _limit(left: Axes, right: Axes, data: Drawn, k: int) -> None:
    """Axes that few frames of great uncertainty do not blow up."""
    usual, (lows, highs) = float(data.usual[k]), data.displacement
    if np.isnan(usual):
        return
    low, high = float(np.nanmin(lows[..., k])) - 3 * usual, float(np.nanmax(highs[..., k])) + 3 * usual
    if high > low:
        margin = 0.05 * (high - low)
        left.set_ylim(low - margin, high + margin)
        right.set_ylim(0, 1.25e3 * usual)


def _draw_quality(axes: Mapping[str, Axes], data: Drawn, colours: list[Any]) -> None:
    axes["s"].set_ylabel("score")
    axes["r"].set_ylabel("residual rms (grey levels)")
    for r, colour in enumerate(colours):
        _curve(axes["s"], data, [side[:, r] for side in data.score], colour)
        _curve(axes["r"], data, [side[:, r] for side in data.residual], colour)
    axes["r"].set_ylim(bottom=0)


def _draw_status(axis: Axes, data: Drawn) -> None:
    """One row per template; a bin of many frames shows the worst of them, which has the highest code."""
    templates = data.status.shape[1]
    shades = ListedColormap(list(_status_colours(data.words).values()))
    place: Any = {"extent": (*data.span, templates - 0.5, -0.5), "aspect": "auto", "interpolation": "nearest"}
    axis.imshow(data.status.T, cmap=shades, vmin=-0.5, vmax=len(data.words) - 0.5, **place)
    axis.set_yticks(range(0, templates, max(1, -(-templates // 8))))
    axis.grid(False)
    axis.set_ylabel("status")


def _status_colours(words: list[str]) -> dict[str, str]:
    others = [word for word in words if word not in _STATUS]
    return {word: _STATUS.get(word) or _OTHER_STATUS[others.index(word) % len(_OTHER_STATUS)] for word in words}


def _curve(axis: Axes, data: Drawn, sides: list[NDArray[np.float64]], colour: Any) -> None:
    """Through both ``sides`` of an envelope."""
    time, values = data.time, sides[0]
    if data.frames > len(time):
        time, values = np.repeat(time, 2), np.stack(sides, -1).ravel()
    # A point between two gaps makes no line: short tracks show their frames as dots, too.
    axis.plot(time, values, color=colour, lw=1.1, marker="." if len(time) <= 120 else None, ms=4)


def _annotate(figure: Figure, data: Drawn, colours: list[Any], title: str) -> None:
    """Title, what each colour is, and what each status is that occurs."""
    frames, templates = data.frames, data.status.shape[1]
    count = f"{frames:,} frame{'s' * (frames > 1)}, {templates} template{'s' * (templates > 1)}"
    _, height = figure.get_size_inches()
    figure.suptitle(
        f"{title}   ({count})" if title else count, fontsize=13, y=1 - 0.15 / height, va="top", parse_math=False
    )
    if templates > len(_COLOURS):
        norm = Normalize(0, templates - 1)
        bar = figure.add_axes((0.945, _BOTTOM / height, 0.01, 1 - (_BOTTOM + _TOP) / height))
        figure.colorbar(ScalarMappable(norm, "viridis"), cax=bar, label="template")
    elif templates > 1:
        handles = [Patch(color=colour, label=f"template {r}") for r, colour in enumerate(colours)]
        figure.axes[0].legend(handles=handles, ncols=templates, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
    shades, seen = _status_colours(data.words), np.unique(data.status)
    handles = [Patch(color=shades[data.words[k]], label=data.words[k].replace("_", " ").lower()) for k in seen]
    place = (0.5, 0.02 / height)
    figure.legend(handles=handles, ncols=len(handles), loc="lower center", bbox_to_anchor=place, frameon=False)
