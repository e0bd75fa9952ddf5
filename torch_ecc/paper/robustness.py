"""Robustness beyond the paper: how often a template is found again, over what can go wrong between two frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper import trials
from torch_ecc.paper.methods import METHODS
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table, cells, counter
from torch_ecc.paper.scheme import SIZE
from torch_ecc.paper.trials import CAMERA, FOUND, JUMP, NOISE, TURN, UNNOTICED, Change, Found
from torch_ecc.plots.style import letter, new_figure
from torch_ecc.sim import Occluder

COUNT = 48  # templates
SAMPLERS = ("bilinear", "bspline3", "bspline5")
ENOUGH = 0.9  # share of the templates
MEAN = 128.0  # grey level that stays when contrast goes
LOOKS = {  # of curves that are no METHODS: colour and dashes
    "linear, 3 levels": ("#0b6e4f", "--"),
    "linear, search": ("#0b6e4f", ":"),
    UNNOTICED: ("#d62728", "-."),
    "bilinear": ("#e69f00", "-"),
    "bspline3": ("#0b6e4f", "-"),
    "bspline5": ("#56b4e9", "--"),
}


class Sweep(NamedTuple):
    """What is varied, from easy to hard."""

    label: str
    levels: Sequence[float]
    change: Callable[[float], Change]


class Panel(NamedTuple):
    """Curves y (n,) over x (n,) by name; ``log``: axes that are logarithmic, of "x" and "y"."""

    title: str
    labels: tuple[str, str]
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    log: str = ""


def covered(share: float) -> Change:
    """Something dark in front of the camera covers that share of the template from one side, up to the jump."""
    right = float(trials.MIDDLE[0]) - SIZE / 2 + share * SIZE
    occluder = Occluder(center=(right / 2 - 50, trials.FRAME[0] / 2), half_size=(right / 2 + 50, trials.FRAME[0]))
    return Change(camera=replace(CAMERA, occluders=(occluder,) if share else ()))


def dimmed(contrast: float) -> Change:
    """That share of the contrast is left; the noise stays."""
    return Change(camera=replace(CAMERA, gain=contrast, offset=MEAN * (1 - contrast)))


FAR = (1, 4, 8, 12, 18, 25, 35, 50)
SWEEPS = {
    "jump": Sweep("jump between frames (px)", FAR, lambda v: Change(jump=v, turn=0)),
    "turn": Sweep("turn between frames (deg)", FAR, lambda v: Change(jump=0, turn=v)),
    "blur": Sweep("blur of the frame, sigma (px)", range(7), lambda v: Change(camera=replace(CAMERA, blur_sigma=v))),
    "occlusion": Sweep("covered share of the template", (0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4), covered),
    "contrast": Sweep("contrast left in the frame", (1, 0.5, 0.2, 0.1, 0.05, 0.03, 0.02), dimmed),
    "size": Sweep("side of the template (px)", (121, 81, 51, 31, 21, 15, 11), lambda v: Change(size=int(v))),
}
BASIN = ("jump", "turn")  # which one picture shows together
REMARKS = (
    f"Templates of {SIZE} px at random places and angles of the default micrograph, some of them on little texture. "
    f"Where they are not varied: a jump of {JUMP:g} px in any direction, a turn of {TURN:g} deg, noise of {NOISE:g} "
    "grey levels in template and frame. Every method starts at the pose of the frame before.",
    f"Found: nearer than {FOUND:g} px to the truth at the template's corner. The red line counts what the default "
    "(over jumps and turns the tracker with its search) calls a good pose and is not: what its status does not tell.",
    "A jump or turn beyond the width of the texture leads into a neighbouring minimum, whatever the criterion, and on "
    "a circuit of many equal cells that minimum often looks good enough to be believed. What widens the basin is the "
    "pyramid. The tracker's search, its default, looks at the whole frame when a template is lost or looks less like "
    "itself than it did before. The columns for light cost some of the basin.",
    "Contrast is no failure to ECC, which fits a gain: it works until the noise is as large as what is left. SSD takes "
    "a change of contrast for motion. Blur mixes in what lies around the template, which no method here models.",
    "Nor does any model an occluder. A partly covered template is pulled aside and soon refused: below a correlation "
    "of 0.5 its status is LOST, and it counts as not found. Ref. 34 has no status and never refuses. A mask or a "
    "smaller template serves better.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """Sweep and draw. ``quick``: a sixth of the templates, every other level."""
    count, step = (COUNT // 6, 2) if quick else (COUNT, 1)
    sweeps = {name: s._replace(levels=s.levels[::step]) for name, s in SWEEPS.items()}
    tick = counter(sum(len(s.levels) for s in sweeps.values()) + 2, advance)
    changes = {name: [s.change(v) for v in s.levels] for name, s in sweeps.items()}
    found = {name: trials.sweep(c, count, tick, trackers=name in BASIN) for name, c in changes.items()}
    errors = {noise: trials.sampler_errors(noise, count, SAMPLERS, tick) for noise in (0.0, NOISE)}
    pictures = [*_pictures(sweeps, found), _samplers(errors)]
    tables = [_table(sweeps, found, count), _sampler_table(errors)]
    records = [
        Number(f"robustness {name}: {sweeps[name].label} up to which {ENOUGH:.0%} are found, {m}", limit, "1", better)
        for name in sweeps
        for m, limit in limits(sweeps[name], found[name]).items()
        for better in ["lower" if name in ("contrast", "size") else "higher"]
    ]
    return Experiment("robustness", "Robustness beyond the paper", pictures, tables, records, REMARKS, trials.SEED)


def limits(swept: Sweep, found: Found) -> dict[str, float]:
    """By method: the hardest level before the first at which fewer than ENOUGH are found; NaN if there is none."""
    result = {}
    for name, rate in found.rate.items():
        kept = next((k for k, r in enumerate(rate) if r < ENOUGH), len(rate))
        if name != UNNOTICED:
            result[name] = float(swept.levels[kept - 1]) if kept else math.nan
    return result


def _pictures(sweeps: Mapping[str, Sweep], found: Mapping[str, Found]) -> list[Picture]:
    """The basin, and of every other sweep how many are found and how exactly."""
    rates, errors = {}, {}
    for name, swept in sweeps.items():
        log, levels = "x" if name == "contrast" else "", swept.levels
        curves = {m: (levels, rate) for m, rate in found[name].rate.items()}
        rates[name] = Panel("templates found", (swept.label, "share of the templates"), curves, log)
        curves = {m: (levels, error) for m, error in found[name].error.items()}
        labels = (swept.label, "median error at the corner (px)")
        errors[name] = Panel("error of those found", labels, curves, log + "y")
    caption = (
        "Basin: how far the start may be from the answer, in (a) position and (b) angle. "
        '"3 levels" is a pyramid, "search" the tracker\'s default, which searches the frame.'
    )
    pictures = [Picture("basin", draw_panels([rates[name] for name in BASIN]), caption)]
    for name in [name for name in sweeps if name not in BASIN]:
        over = "template size" if name == "size" else name
        caption = f"Over {over}: (a) share of the templates found, (b) how exactly."
        pictures.append(Picture(name, draw_panels([rates[name], errors[name]]), caption))
    return pictures


def _samplers(errors: Mapping[float, Mapping[str, Tensor]]) -> Picture:
    panels = []
    for noise, by_sampler in errors.items():
        curves = {name: (e.tolist(), ((torch.arange(len(e)) + 1) / len(e)).tolist()) for name, e in by_sampler.items()}
        labels = ("error of x and y (px)", "share of the templates found")
        panels.append(Panel(f"noise of {noise:g} grey levels", labels, curves, "x"))
    return Picture("sampler", draw_panels(panels), "Errors of the default method by sampler: share below.")


def draw_panels(panels: Sequence[Panel]) -> Figure:
    """The panels side by side with one legend below."""
    figure = new_figure(11, 4.4)
    grid = figure.subplots(1, len(panels))
    handles = {}
    for k, (axes, panel) in enumerate(zip(grid, panels, strict=True)):
        for name, (x, y) in panel.curves.items():
            colour, dashes = (METHODS[name].colour, METHODS[name].dashes) if name in METHODS else LOOKS[name]
            marker = "." if len(x) < 20 else ""
            (handles[name],) = axes.plot(x, y, dashes, marker=marker, color=colour)
        axes.set(title=letter(f"({'ab'[k]}) {panel.title}"), xlabel=panel.labels[0], ylabel=panel.labels[1])
        axes.set(xscale="log" if "x" in panel.log else "linear")
        axes.set(**({"yscale": "log"} if "y" in panel.log else {"ylim": (-0.03, 1.03)}))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return figure


def _table(sweeps: Mapping[str, Sweep], found: Mapping[str, Found], count: int) -> Table:
    names = list(found["jump"].rate)[:-1]
    rows = []
    for name, swept in sweeps.items():
        words = {m: "none" if math.isnan(v) else f"{v:g}" for m, v in limits(swept, found[name]).items()}
        rows.append((swept.label, *(words.get(m, "") for m in names), f"{max(found[name].rate[UNNOTICED]):.0%}"))
    note = (
        f"{count} templates, levels as in the pictures. Last column: most, at any level, that the default method gave "
        "a wrong pose without noticing."
    )
    return Table(f"The hardest level up to which {ENOUGH:.0%} are found", ("", *names, "not noticed"), rows, note)


def _sampler_table(errors: Mapping[float, Mapping[str, Tensor]]) -> Table:
    rows = []
    for name in SAMPLERS:
        shares = torch.tensor((0.5, 0.9), dtype=torch.float64)
        rows.append((name, *cells(torch.cat([e[name].double().quantile(shares) for e in errors.values()]), ".4f")))
    header = ["sampler", *(f"{what}, noise {noise:g}" for noise in errors for what in ("median px", "9 of 10 below"))]
    return Table("Errors of x and y by sampler", header, rows, "Default method, position error.")
