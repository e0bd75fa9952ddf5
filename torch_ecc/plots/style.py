"""How the pictures look."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from threading import RLock
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


_ALONE = RLock()


@contextmanager
def drawn_with(settings: Any) -> Iterator[None]:
    """The context in which a figure is drawn; a decorator too. Matplotlib's settings are the whole process's: of two
    threads, one would draw with the other's, and leave them behind."""
    with _ALONE, mpl.rc_context(settings):
        yield


styled = partial(drawn_with, RC)


def new_figure(width: float, height: float) -> Figure:
    """A figure in inches that lays itself out."""
    return Figure(figsize=(width, height), layout="constrained")


def letter(text: str) -> str:
    """The title of a panel with its letter in bold, as in the paper's figures: "(a) ..."."""
    label, _, words = text.partition(" ")
    return rf"$\bf{{{label}}}$ {words}"
