"""How the pictures look."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

RC: Any = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
}
COMPONENTS = ("x", "y", r"$\theta$")
UNITS = ("px", "px", "deg")


@contextmanager
def styled() -> Iterator[None]:
    """The context in which a figure is drawn; a decorator too."""
    with mpl.rc_context(RC):
        yield


def new_figure(width: float, height: float) -> Figure:
    """A figure in inches that lays itself out."""
    return Figure(figsize=(width, height), layout="constrained")


def letter(text: str) -> str:
    """The title of a panel with its letter in bold, as in the paper's figures: "(a) ..."."""
    label, _, words = text.partition(" ")
    return rf"$\bf{{{label}}}$ {words}"
