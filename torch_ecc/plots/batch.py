"""batch.png: small multiples, what moved in each of many recordings."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torch_ecc.plots.save import save

COLOURS = ("#0072b2", "#d55e00", "#009e73")  # of x, y, theta
POINTS = 240  # of a curve
_WIDTH, _HEIGHT = 2.3, 1.15  # inches of a panel
_MOST = 400  # inches of a picture


class Panel(NamedTuple):
    """A recording's ``title``, the displacements (F, R, 3) of its templates in px, px, rad, NaN where they were lost,
    or None if there are none, and ``words`` about it."""

    title: str
    displacement: NDArray[np.float64] | None
    words: str = ""


def plot_batch(panels: Iterable[Panel], path: str | Path, *, dpi: int = 100) -> Path:
    """Draw x, y (on one scale) and theta (on its own) of each recording, means of its templates, and return ``path``.
    Panels are drawn one after the other: an iterator need not hold all their tracks."""
    lines: list[list[Any]] = [[], [], []]
    texts: list[tuple[int, str, str, bool]] = []
    for number, panel in enumerate(panels):
        curves, scale = _curves(panel.displacement)
        for k, curve in enumerate(curves):
            lines[k].append((number, curve))
        texts.append((number, panel.title, ", ".join(filter(None, (scale, panel.words))), panel.displacement is None))
    return _draw(lines, texts, Path(path), dpi)


def _draw(lines: list[list[Any]], texts: list[tuple[int, str, str, bool]], path: Path, dpi: int) -> Path:
    columns = max(min(6, len(texts)), round(math.sqrt(len(texts) / 2)), 1)
    rows = -(-len(texts) // columns)
    figure = Figure(figsize=(min(columns * _WIDTH, _MOST), min(rows * _HEIGHT, _MOST) + 0.3))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1 - 0.3 / figure.get_figheight()))
    axes.set(xlim=(0, columns), ylim=(rows, 0))
    axes.axis("off")
    for own, colour in reversed(list(zip(lines, COLOURS, strict=True))):  # a theta that is only noise fills its cell
        placed = [np.add(curve, (n % columns, n // columns)) for n, curve in own]
        axes.add_collection(LineCollection(placed, colors=colour, linewidths=0.9))
    for number, title, words, failed in texts:
        x, y = number % columns + 0.04, number // columns
        plain: Any = {"parse_math": False}  # a name may hold dollars
        axes.text(x, y + 0.06, _short(title, 34), size=7.5, va="top", weight="bold", clip_on=False, **plain)
        colour = "#b02020" if failed else "#555555"
        axes.text(x, y + 0.98, _short(words, 46), size=6.2, va="bottom", color=colour, **plain)
    figure.text(0.01, 1 - 0.06 / figure.get_figheight(), "displacement: ", size=8, va="top")
    for k, name in enumerate(("x", "y", "θ")):
        figure.text(
            0.01 + (0.85 + 0.15 * k) / figure.get_figwidth(),
            1 - 0.06 / figure.get_figheight(),
            name,
            size=8,
            va="top",
            color=COLOURS[k],
        )
    return save(figure, path, dpi)


def _curves(displacement: NDArray[np.float64] | None) -> tuple[list[NDArray[np.float64]], str]:
    """Three curves (N, 2) in a cell of 1 x 1, y down, and what its height means."""
    if displacement is None or not len(displacement):
        return [], ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of frames in which all were lost
        mean = np.nanmean(displacement, 1)[:: max(len(displacement) // POINTS, 1)]
    time = np.linspace(0.04, 0.96, len(mean))
    curves, ranges = [], []
    for group in (slice(2), slice(2, 3)):
        values = mean[:, group]
        low, high = (np.nanmin(values), np.nanmax(values)) if np.isfinite(values).any() else (0.0, 0.0)
        ranges.append(high - low)
        height = 0.8 - 0.55 * (values - low) / (high - low or 1.0)
        curves += [np.column_stack((time, column)) for column in height.T]
    return curves, f"{ranges[0]:.3g} px, {math.degrees(ranges[1]):.3g}°"


def _short(text: str, most: int) -> str:
    plain = text.replace("$", r"\$")
    return plain if len(plain) <= most else f"{plain[: most - 1]}…"
