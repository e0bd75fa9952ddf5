"""Pictures of Fig. 3."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper.methods import METHODS
from torch_ecc.plots.style import COMPONENTS, UNITS, letter, new_figure

ECC = ("gain", "ecc_paper", "linear", "quadratic")
SSD = ("ssd", "ref34")
PANELS = (
    ("(a) ECC, without uneven light", "without UI", ECC),
    ("(b) ECC, with uneven light", "with UI", ECC),
    ("(c) SSD, without uneven light", "without UI", SSD),
    ("(d) SSD, with uneven light", "with UI", SSD),
)


def draw_curves(found: Mapping[str, Mapping[str, Tensor]]) -> Figure:
    """Errors (F, 3) px, px, deg of every method: four panels of three components, laid out as the paper's Fig. 3."""
    figure = new_figure(11, 9)
    parts: Any = figure.subfigures(2, 2)
    for part, (title, camera, methods) in zip(parts.flat, PANELS, strict=True):
        rows = part.subplots(3, 1, sharex=True)
        letter(rows[0], title)
        for k, axes in enumerate(rows):
            _draw_component(axes, {m: found[camera][m][:, k] for m in methods})
            axes.set_ylabel(f"{COMPONENTS[k]} error ({UNITS[k]})")
            values = torch.stack([by_method[m][:, k] for by_method in found.values() for m in methods])
            low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
            axes.set_ylim(low - 0.15 * (high - low), high + 0.4 * (high - low))
        rows[-1].set_xlabel("frame j")
    return figure


def _draw_component(axes: Axes, curves: Mapping[str, Tensor]) -> None:
    """One component of some methods' errors (F,), each with its name and largest value above."""
    for k, (method, values) in enumerate(curves.items()):
        style = METHODS[method]
        axes.plot(range(1, len(values) + 1), values, style.dashes, color=style.colour)
        text = f"{method} {float(values.abs().max()):.4f}"
        axes.text(0.01 + 0.25 * k, 0.86, text, color=style.colour, transform=axes.transAxes, fontsize=8)


def draw_templates(panels: Mapping[str, Tensor], paper: Mapping[str, tuple[float, float]]) -> Figure:
    """Largest errors (P, methods, 2) px, deg of P templates, one column per method: the first as a diamond, the others
    as dots with their median."""
    figure = new_figure(11, 6)
    grid = figure.subplots(2, len(panels), sharex=True, sharey="row", squeeze=False)
    for column, (title, values) in zip(grid.T, panels.items(), strict=True):
        letter(column[0], title)
        for k, axes in enumerate(column):
            _dots(axes, values[..., k])
            for method, limits in paper.items():
                x = list(METHODS).index(method)
                axes.plot((x - 0.42, x + 0.42), (limits[k],) * 2, color="#d62728", lw=1.6, label="the paper's largest")
            axes.set_yscale("log")
            axes.set_xticks(range(len(METHODS)), METHODS)
    grid[0, 0].set_ylabel("largest error of x, y (px)")
    grid[1, 0].set_ylabel(r"largest error of $\theta$ (deg)")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=3)
    return figure


def _dots(axes: Axes, values: Tensor) -> None:
    """(P, methods) above each method's name, spread sideways in a fixed order."""
    side = torch.linspace(-0.25, 0.25, len(values) - 1)
    for x, method in enumerate(METHODS):
        colour, column = METHODS[method].colour, values[:, x]
        axes.plot(x + side, column[1:], "o", ms=4, alpha=0.7, color=colour, zorder=3)
        axes.plot(x, column[0], "D", ms=7, mfc="white", mew=1.6, color=colour, zorder=4)
        axes.plot((x - 0.35, x + 0.35), (column[1:].quantile(0.5),) * 2, color="black", label="median of the dots")
