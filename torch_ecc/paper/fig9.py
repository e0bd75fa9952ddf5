"""Fig. 9: the parasitic translation of the template during the steps of theta."""

from __future__ import annotations

from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper import parasitic
from torch_ecc.paper.errors import rms
from torch_ecc.paper.parasitic import Deviations
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table, cells
from torch_ecc.paper.steps import HIGHEST, VIEW_UM, Staircase, staircase
from torch_ecc.plots.style import COMPONENTS, letter, new_figure

UP, DOWN, LAW = "#0072b2", "#d55e00", "#1b1b1b"
SETS = 200  # of sensors, against which the same track is held
REMARKS = (
    "The template lies 1.8 mm from the origin of the moving part, whose own x and y the sensors give: what it moves in "
    "addition is (R(theta) - 1) lever arm. The sensors' theta times the true lever arm is the line beside it.",
    "Most of the deviation in y is the sensors' theta: the non-linearity of one set of them bends it for all steps "
    "alike, so that the steps of one run are all too high or all too low together. Chi-square counts that once, by the "
    f"covariance of all steps; it is 1 per degree of freedom on average. {SETS} other sets of sensors along the same "
    "motion show that sigma is right.",
    "By the stage's true angle, which only a simulation knows, the tracker and the lens are left. Their error does not "
    "average out within a step: it is what the sampler's aliasing makes of the template's place between the pixels.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """x and y of ECC while theta steps, drawn as the paper's Fig. 9. ``quick``: dwells of 0.3 s."""
    found = staircase(quick, advance)
    by_sensors, by_truth = parasitic.deviations(found), parasitic.true_deviations(found)
    caption = (
        "Translation of ECC during the angular trajectory. (a) in the plane, ascent and descent; (b) its components "
        "over time. Black and grey: lever arm times the sensors' angle, which rings after each step. "
        "(c) means of the steps minus lever arm times angle, with their standard deviations."
    )
    lever, spread = parasitic.lever_arm(found, by_sensors.covariance)
    share = float(((lever - lever.new_tensor(VIEW_UM)).abs() / spread).max())
    others = torch.cat([(some.nm / some.sigma).flatten() for some in parasitic.other_sensors(found, SETS)])
    label = f"fig9 steps: rms deviation over sigma with {SETS} other sets of sensors"
    records = [
        Number("fig9 lever arm from the steps: error over its sigma", share, "", tolerance=3.0),
        Number("fig9 steps: rms deviation from lever arm times angle", by_sensors.rms, "nm"),
        Number("fig9 steps: chi-square per degree of freedom", by_sensors.chi_square, "", tolerance=2.0),
        Number("fig9 steps by the true angle: rms deviation", by_truth.rms, "nm"),
        Number("fig9 steps by the true angle: chi-square", by_truth.chi_square, "", tolerance=2.0),
        Number(label, float(rms(others)), "", tolerance=1.2),
    ]
    rows = [("true", *cells(VIEW_UM, ".2f")), ("from the steps", *cells(lever, ".2f", spread))]
    tables = [Table("Lever arm", ("", "x, um", "y, um"), rows), _table(found, by_sensors), _budget(found)]
    picture = Picture("fig9", draw(found, by_sensors, by_truth), caption)
    return Experiment("fig9", "Fig. 9: parasitic translation", [picture], tables, records, REMARKS)


def _table(found: Staircase, left: Deviations) -> Table:
    rows = []
    for k, (nm, sigma) in enumerate(zip(left.nm, left.sigma, strict=True), start=1):
        x, y, theta = found.dwells["ECC"].mean[k].tolist()
        rows.append((f"{k}", f"{1e6 * theta:.0f}", f"{x:.4f}", f"{y:.4f}", *cells(nm, ".1f", sigma)))
    header = ("step", "theta, urad", "x, um", "y, um", "x minus the law, nm", "y minus the law, nm")
    return Table("Translation of each step by ECC, and its deviation from lever arm times angle", header, rows)


def _budget(found: Staircase) -> Table:
    """What sigma is made of."""
    cds = found.dwells["CDS"].mean[1:]
    causes = {
        "scatter of the frames": parasitic.scattered(found)[1:] + parasitic.scattered(found)[0],
        "sampler's aliasing": parasitic.aliased(found)[1:].diagonal(dim1=1, dim2=2),
        "sensors' non-linearity": parasitic.sensed(cds).diagonal().reshape(-1, 2),
    }
    top = int(cds[:, 2].argmax())
    rows = [(name, *cells(variance[top].sqrt(), ".2f")) for name, variance in causes.items()]
    return Table("Sigma of the deviation at the highest step by its causes", ("", "x, nm", "y, nm"), rows)


def draw(found: Staircase, by_sensors: Deviations, by_truth: Deviations) -> Figure:
    """(a) in the plane, (b) over time, (c) means minus the law."""
    figure = new_figure(14, 4.4)
    plane, parts, left = figure.subplots(1, 3, width_ratios=(1, 1.35, 1.35))
    track, sensors = found.tracks["ECC"], found.sensors
    time = track.time_s + found.alignment.offset_s
    turning = float(found.windows_s[HIGHEST].mean())
    law = parasitic.predicted(sensors.pose)
    for rows, colour, words in ((time < turning, UP, "ascent"), (time >= turning, DOWN, "descent")):
        plane.plot(*track.pose[rows, :2].T, ".", ms=2, color=colour, label=words)
    plane.plot(*law[::16].T, color=LAW, lw=0.8, label=r"lever arm x $\theta$ of CDS")
    plane.set(title=letter("(a) in the plane"), xlabel="x (um)", ylabel="y (um)", aspect="equal", adjustable="datalim")
    plane.legend(loc="upper left", markerscale=3)
    _draw_parts(parts, time, track.pose, (sensors.time_s, law))
    _draw_left(left, by_sensors, by_truth)
    return figure


def _draw_parts(axes: Axes, time: Tensor, pose: Tensor, law: tuple[Tensor, Tensor]) -> None:
    for i, colour in enumerate((UP, DOWN)):
        axes.plot(law[0], law[1][:, i], color="0.6", lw=0.6)
        axes.plot(time, pose[:, i], color=colour, lw=0.9, label=COMPONENTS[i])
    axes.set(title=letter("(b) components"), xlabel="time (s)", ylabel="x, y (um)")
    axes.legend(loc="lower left")


def _draw_left(axes: Axes, by_sensors: Deviations, by_truth: Deviations) -> None:
    steps = torch.arange(1, len(by_sensors.nm) + 1)
    for some, words, mark, shift in ((by_sensors, "angle of CDS", "o", -0.15), (by_truth, "true angle", "s", 0.15)):
        for i, colour in enumerate((UP, DOWN)):
            look: Any = {"ls": "", "ms": 4, "capsize": 2, "lw": 1, "mfc": colour if some is by_sensors else "white"}
            look |= {"marker": mark, "color": colour, "label": f"{COMPONENTS[i]}, {words}"}
            axes.errorbar(steps + shift, some.nm[:, i], some.sigma[:, i], **look)
    axes.axhline(0, color="0.6", lw=0.8)
    axes.set(xlabel="step, up and down", ylabel=r"minus lever arm x $\theta$ (nm)", xticks=steps)
    low, high = axes.get_ylim()
    axes.set(title=letter("(c) deviation of the means"), ylim=(low, high + 0.2 * (high - low)))  # room for the legend
    axes.legend(fontsize=8, ncols=2, loc="upper center")
