"""Fig. 11: absolute errors of ECC and SSD for steps of theta under uneven light, the CDS being the reference."""

from __future__ import annotations

from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper.drawing import label_steps
from torch_ecc.paper.errors import largest
from torch_ecc.paper.result import Advance, Experiment, Number, Picture
from torch_ecc.paper.steps import LAMP, LEVELS_DEG, METHODS, staircase, step_table
from torch_ecc.plots.style import new_figure

STYLES = {
    "ECC": ("o-", "#0072b2"),
    "ECC, gain": ("s--", "#56b4e9"),
    "SSD": ("^-", "#d55e00"),
    "body": ("^-", "#009e73"),
}
REMARKS = (
    f"The light falls off across the frame, and the lamp gains {100 * LAMP:.0f} % while the staircase rises and loses "
    'them again. ECC is the default, whose light may vary across the template; "gain" is the paper\'s.',
    "What is left of ECC does not average out, and is in SSD as well: at the lowest zoom the optics blur edges by 0.6 "
    "px only, and those along the pixel rows are sampled alike. Without any camera noise the errors are the same.",
    "The first step, from which both records count, has no absolute error and is left out.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """Mean of each step minus that of the CDS, drawn as the paper's Fig. 11. ``quick``: dwells of 0.3 s."""
    found = staircase(quick, advance)
    errors = {name: (found.mean_deg(name) - found.mean_deg("CDS"))[1:] for name in METHODS}
    caption = (
        "Absolute measurement errors of theta, the average of each step minus that of the CDS, under uneven light."
    )
    records = [Number(f"fig11 {name}: largest absolute error", float(largest(e)), "deg") for name, e in errors.items()]
    for name in ("ECC", "ECC, gain"):
        worse = float((errors[name].abs() >= errors["SSD"].abs()).sum())
        limit = 0.0 if name == "ECC" else None
        records.append(Number(f"fig11 steps at which {name} is not better than SSD", worse, "", tolerance=limit))
    noise = found.dwells["ECC"].standard_error[1:, 2].rad2deg()
    table = step_table("Absolute errors of theta, deg", errors | {"standard error": noise}, first=1)
    picture = Picture("fig11", draw(errors), caption)
    return Experiment("fig11", "Fig. 11: absolute errors", [picture], [table], records, REMARKS)


def draw(errors: dict[str, Tensor]) -> Figure:
    """Errors over the steps."""
    figure = new_figure(8.5, 4.4)
    axes = figure.subplots()
    for name, values in errors.items():
        marks, colour = STYLES[name]
        axes.plot(range(1, len(values) + 1), values, marks, color=colour, ms=4, label=name)
    axes.axhline(0, color="0.6", lw=0.8)
    label_steps(axes, LEVELS_DEG[1:])
    axes.set(xlabel="step (deg), up and down", ylabel="absolute error (deg)")
    axes.legend()
    return figure
