"""Fig. 10: mean errors, the results of each step minus their average, of CDS and ECC."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper.result import Advance, Outcome, Picture, Record, Table
from torch_ecc.paper.steps import Staircase, staircase
from torch_ecc.plots.style import letter, new_figure, styled

METHODS = ("CDS", "ECC")
MAIN_DEG = {"CDS": 0.002, "ECC": 0.005}  # the paper's: the boxes lie within +- this
EXTREME_DEG = {"CDS": 0.005, "ECC": 0.02}  # the paper's: the largest errors
REMARKS = (
    "The main errors are the boxes, from the first to the third quartile, as in the paper. They show repeatability; "
    "what the stage itself does within a dwell (creep, vibration) is in both methods.",
)


def run(quick: bool, advance: Advance) -> Outcome:
    """Deviations from the mean of each step, drawn as the paper's Fig. 10. ``quick``: dwells of 0.3 s."""
    found = staircase(quick, advance)
    errors = {name: errors_of(found, name) for name in METHODS}
    with styled():
        figure = draw(errors, found.levels_deg)
    caption = (
        "Mean errors of theta of each step as boxes: quartiles, mean in red, whiskers of 1.5 box heights, outliers. "
        "(a) CDS, (b) ECC. Dotted: the paper's main errors."
    )
    records, rows = [], []
    for name, steps in errors.items():
        box = max(float(e.quantile(e.new_tensor((0.25, 0.75))).abs().max()) for e in steps)
        extreme = max(float(e.abs().max()) for e in steps)
        rms = float(torch.cat(steps).square().mean().sqrt())
        limit, most = MAIN_DEG[name], EXTREME_DEG[name]
        records += [
            Record(f"fig10 {name}: end of the largest box", box, "deg", tolerance=limit, paper=limit),
            Record(f"fig10 {name}: largest error", extreme, "deg", tolerance=most, paper=most),
        ]
        rows.append((name, f"{rms:.5f}", f"{box:.5f}", f"{limit:g}", f"{extreme:.5f}", f"{most:g}"))
    header = ("", "rms", "largest box end", "paper", "largest error", "paper")
    tables = [Table("Mean errors of theta, deg", header, rows)]
    return Outcome("fig10", "Fig. 10: mean errors", [Picture("fig10", figure, caption)], tables, records, REMARKS)


def errors_of(found: Staircase, name: str) -> list[Tensor]:
    """Errors (N,) in deg of theta of each step."""
    dwells = found.dwells[name]
    return [dwells.errors[dwells.step == k, 2].rad2deg() for k in range(len(dwells.mean))]


def draw(errors: dict[str, list[Tensor]], levels_deg: Tensor) -> Figure:
    """(a) CDS and (b) ECC, each with its own scale."""
    figure = new_figure(11, 4.4)
    for k, (axes, (name, steps)) in enumerate(zip(figure.subplots(1, 2), errors.items(), strict=True)):
        _boxes(axes, steps)
        for limit in (-MAIN_DEG[name], MAIN_DEG[name]):
            axes.axhline(limit, color="0.4", lw=0.9, ls=":")
        axes.set_xticks(range(1, len(steps) + 1), [f"{level:.2f}" for level in levels_deg.tolist()], rotation=45)
        axes.set(xlabel="step (deg)", ylabel="mean error (deg)")
        letter(axes, f"({'ab'[k]}) {name}")
    return figure


def _boxes(axes: Axes, steps: list[Tensor]) -> None:
    axes.boxplot(
        [step.numpy() for step in steps],
        showmeans=True,
        meanline=True,
        meanprops={"color": "#c0392b", "ls": "-"},
        medianprops={"lw": 0},
        boxprops={"color": "#0072b2"},
        whiskerprops={"color": "#1b1b1b", "ls": "--", "lw": 0.8},
        flierprops={"marker": "+", "markersize": 3, "markeredgecolor": "#c0392b", "markeredgewidth": 0.5},
    )
