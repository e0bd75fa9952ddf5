"""The comparison as a table, as figures and as a picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import count

from adapters import Peer
from comparison import Result
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter
from rich.table import Table
from torch import Tensor
from work import Work

from torch_ecc.paper.result import Number
from torch_ecc.plots.style import new_figure, styled

YARDSTICK = "OpenCV ECC, fastest fair"
EXACT, TIMED = 0.15, 0.5  # tolerances of our errors and of our times: a shared machine is not quiet
SMALLEST_PX = 1e-5  # errors below are drawn here: whole-pixel shifts are found exactly
COLOURS = {
    "torch_ecc": "#0b6e4f",
    "torch_ecc, torch": "#7cc7a5",
    "OpenCV": "#c8553d",
    "pystackreg": "#7b4ea3",
    "SimpleITK": "#1f77b4",
    "kornia": "#e69f00",
}
MARKERS = "o^sDvPX*<>phd8H1234+x|_"
COLUMNS = ("tracker", "ms per frame (IQR)", "cpu ms", "rms px", "rms deg", "largest px", "deg", "of bound", "lost")


def table(work: Work, results: Mapping[str, Result]) -> Table:
    """Tracker by tracker: wall and processor time, errors, rms of x, y and theta over the bound, lost frames."""
    result = Table(title=f"{work.name}: {work.title}{_words(work.bound)}", title_justify="left")
    for column in COLUMNS:
        result.add_column(column, justify="left" if column == "tracker" else "right", no_wrap=True)
    for name, found in results.items():
        result.add_row(name, *_cells(found, work.bound))
    return result


def _words(bound: Tensor | None) -> str:
    if bound is None:
        return ""
    x, y, theta = bound.tolist()
    return f"; bound {max(x, y):.5f} px, {math.degrees(theta):.5f} deg"


def _cells(result: Result, bound: Tensor | None) -> tuple[str, ...]:
    """Time, errors, the rms errors of x, y and theta over the bound, and lost frames in words."""
    low, middle, high = result.ms()
    errors = (f"{v:.5f}" for v in (*result.rms(), *result.largest()))
    ratio = "" if bound is None else " ".join(f"{v:.2f}" for v in result.rms3() / _degrees(bound))
    cpu = f"{result.cpu_ms():.2f}"
    return (f"{middle:.2f} ({low:.2f}-{high:.2f})", cpu, *errors, ratio, f"{result.lost} of {len(result.error)}")


def _degrees(bound: Tensor) -> Tensor:
    return bound * bound.new_tensor((1.0, 1.0, math.degrees(1.0)))


def figures(work: str, results: Mapping[str, Result], peers: Mapping[str, Peer]) -> Iterator[Number]:
    """Ours with a tolerance, the peers' to be read; so are times, of which the multiple of OpenCV's is what is held."""
    for name, result in results.items():
        mine, key = peers[name].family == "torch_ecc", f"{work} / {name} /"
        exact, timed, never = (EXACT, TIMED, 0.0) if mine else (None, None, None)
        yield Number(f"{key} time", result.ms()[1], "ms")
        if mine and YARDSTICK in results:
            yield Number(
                f"{key} time over OpenCV's", result.cpu_ms() / results[YARDSTICK].cpu_ms(), "x", "lower", timed
            )
        px, deg = result.rms()
        yield Number(f"{key} rms", px, "px", "lower", exact)
        yield Number(f"{key} rms theta", deg, "deg", "lower", exact)
        yield Number(f"{key} largest", result.largest()[0], "px", "lower", exact)
        yield Number(f"{key} lost", float(result.lost), "frames", "lower", never)


def draw(works: Mapping[str, Work], found: Mapping[str, Mapping[str, Result]], peers: Mapping[str, Peer]) -> Figure:
    """Time against error, one panel per work, both axes logarithmic; the bound is the dashed line."""
    looks = _looks(peers)
    columns = min(len(works), 4)
    rows = -(-len(works) // columns)
    with styled():
        figure = new_figure(3.1 * columns + 0.5, 2.6 * rows + 1.4)
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True).flatten()
        for axes, (name, work) in zip(panels, works.items(), strict=False):
            _panel(axes, work, found[name], looks)
        for k, axes in enumerate(panels):
            axes.tick_params(labelbottom=k + columns >= len(works))
            axes.set_visible(k < len(works))
            if k + columns >= len(works):
                axes.set_xlabel("processor time per frame, ms")
        figure.supylabel("rms error of the worse of x and y, px", fontsize=9)
        marks = [_mark(name, colour, marker) for name, (colour, marker) in looks.items()]
        bound = Line2D([], [], ls="--", color="#333333", lw=1, label="Cramer-Rao bound")
        hollow = _mark("hollow: frames lost", "#777777", "o", hollow=True)
        figure.legend(handles=[*marks, hollow, bound], loc="outside lower center", ncols=min(columns + 1, 4))
    return figure


def _mark(label: str, colour: str, marker: str, hollow: bool = False) -> Line2D:
    return Line2D([], [], ls="", color=colour, marker=marker, mfc="none" if hollow else colour, label=label)


def _panel(axes: Axes, work: Work, results: Mapping[str, Result], looks: Mapping[str, tuple[str, str]]) -> None:
    """Marks are hollow where frames were lost; the errors are those of the others."""
    levels = [] if work.bound is None else [float(work.bound[:2].max())]
    for name, result in results.items():
        colour, marker = looks[name]
        y = max(result.rms()[0], SMALLEST_PX)
        if math.isfinite(y):
            levels.append(y)
            face = "none" if result.lost else colour
            axes.plot(result.cpu_ms(), y, marker, color=colour, mfc=face, ms=6, alpha=0.85)
    if work.bound is not None:
        axes.axhline(levels[0], color="#333333", ls="--", lw=1)
    low, high = (math.log10(f(levels)) for f in (min, max))
    axes.set(xscale="log", yscale="log", ylim=(10 ** math.floor(low - 0.05), 10 ** math.ceil(high + 0.05)))
    axes.set_title(work.title)
    axes.yaxis.set_minor_formatter(NullFormatter())


def _looks(peers: Mapping[str, Peer]) -> dict[str, tuple[str, str]]:
    """Colour by whose it is (greens are ours, the light one the torch backend), marker within."""
    families = {name: "torch_ecc, torch" if name.endswith(", torch") else peer.family for name, peer in peers.items()}
    counts = {family: count() for family in COLOURS}
    return {name: (COLOURS[family], MARKERS[next(counts[family])]) for name, family in families.items()}
