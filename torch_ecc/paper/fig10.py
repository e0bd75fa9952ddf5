"""Fig. 10: mean errors, the results of each step minus their average, of CDS and ECC."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper.drawing import draw_box, draw_range, label_steps
from torch_ecc.paper.errors import box, largest, rms
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table
from torch_ecc.paper.steps import LEVELS_DEG, Staircase, staircase
from torch_ecc.plots.style import letter, new_figure

METHODS = ("CDS", "ECC")
MAIN_DEG = {"CDS": 0.002, "ECC": 0.005}  # the paper's: the boxes lie within +- this
EXTREME_DEG = {"CDS": 0.005, "ECC": 0.02}  # the paper's: the largest errors
REMARKS = (
    "The main errors are the boxes, from the first to the third quartile, as in the paper. They show repeatability; "
    "what the stage itself does within a dwell (creep, vibration) is in both methods.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """Deviations from the mean of each step, drawn as the paper's Fig. 10. ``quick``: dwells of 0.3 s."""
    found = staircase(quick, advance)
    errors = {name: errors_of(found, name) for name in METHODS}
    caption = (
        "Mean errors of theta of each step as boxes: quartiles, mean in red, whiskers of 1.5 box heights, outliers. "
        "(a) CDS, (b) ECC. Dotted: the paper's main errors."
    )
    records, rows = [], []
    for name, steps in errors.items():
        end, extreme, whole = max(map(box, steps)), float(largest(torch.cat(steps))), float(rms(torch.cat(steps)))
        limit, most = MAIN_DEG[name], EXTREME_DEG[name]
        records += [
            Number(f"fig10 {name}: end of the largest box", float(end), "deg", tolerance=limit, paper=limit),
            Number(f"fig10 {name}: largest error", extreme, "deg", tolerance=most, paper=most),
        ]
        rows.append((name, f"{whole:.5f}", f"{end:.5f}", f"{limit:g}", f"{extreme:.5f}", f"{most:g}"))
    header = ("", "rms", "largest box end", "paper", "largest error", "paper")
    tables, picture = [Table("Mean errors of theta, deg", header, rows)], Picture("fig10", draw(errors), caption)
    return Experiment("fig10", "Fig. 10: mean errors", [picture], tables, records, REMARKS)


def errors_of(found: Staircase, name: str) -> list[Tensor]:
    """Errors (N,) in deg of theta of each step."""
    dwells = found.dwells[name]
    return [dwells.errors[dwells.step == k, 2].rad2deg() for k in range(len(dwells.mean))]


def draw(errors: dict[str, list[Tensor]]) -> Figure:
    """(a) CDS, (b) ECC and what else there is, each with its own scale."""
    figure = new_figure(5.5 * len(errors), 4.4)
    for k, (axes, (name, steps)) in enumerate(zip(figure.subplots(1, len(errors)), errors.items(), strict=True)):
        for x, step in enumerate(steps, 1):
            draw_box(axes, x, step)
        if name in MAIN_DEG:
            draw_range(axes, MAIN_DEG[name])
        label_steps(axes, LEVELS_DEG, rotation=45)
        axes.set(title=letter(f"({'abc'[k]}) {name}"), xlabel="step (deg)", ylabel="mean error (deg)")
    return figure
