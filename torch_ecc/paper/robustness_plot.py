"""Pictures of the robustness experiments: two panels of curves each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure

from torch_ecc.paper.methods import METHODS
from torch_ecc.plots.style import letter, new_figure

LOOKS = {  # of curves that are no METHODS: colour and dashes
    "linear, 3 levels": ("#0b6e4f", "--"),
    "linear, search": ("#0b6e4f", ":"),
    "wrong, not noticed": ("#d62728", "-."),
    "bilinear": ("#e69f00", "-"),
    "bspline3": ("#0b6e4f", "-"),
    "bspline5": ("#56b4e9", "--"),
}


class Panel(NamedTuple):
    """Curves y (n,) over x (n,) by name; ``log``: axes that are logarithmic, of "x" and "y"."""

    title: str
    labels: tuple[str, str]
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    log: str = ""


def draw_panels(panels: Sequence[Panel]) -> Figure:
    """The panels side by side with one legend below."""
    figure = new_figure(11, 4.4)
    grid = figure.subplots(1, len(panels))
    handles = {}
    for axes, panel in zip(grid, panels, strict=True):
        for name, (x, y) in panel.curves.items():
            colour, dashes = (METHODS[name].colour, METHODS[name].dashes) if name in METHODS else LOOKS[name]
            marker = "." if len(x) < 20 else ""
            (handles[name],) = axes.plot(x, y, dashes, marker=marker, color=colour)
        axes.set(xlabel=panel.labels[0], ylabel=panel.labels[1])
        if "x" in panel.log:
            axes.set_xscale("log")
        if "y" in panel.log:
            axes.set_yscale("log")
        else:
            axes.set_ylim(-0.03, 1.03)
        letter(axes, panel.title)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return figure
