"""Fig. 9: the parasitic translation of the template during the steps of theta."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.experiments.result import Advance, Outcome, Picture, Record, Table
from torch_ecc.experiments.steps import VIEW_UM, Staircase, staircase
from torch_ecc.experiments.style import COMPONENTS, letter, new_figure, styled
from torch_ecc.pose import rotation
from torch_ecc.sim.sensors import SensorSettings, error_budget

UP, DOWN, LAW = "#0072b2", "#d55e00", "#1b1b1b"
REMARKS = (
    "The template lies 1.8 mm from the origin of the moving part, whose own x and y the sensors give: what it moves in "
    "addition is (R(theta) - 1) lever arm. The sensors' theta times the true lever arm is the line beside it.",
    "Sigma of a step: the scatter of its frames, as if it were white, and the sensors' error budget.",
)


def run(quick: bool, advance: Advance) -> Outcome:
    """x and y of ECC while theta steps, drawn as the paper's Fig. 9. ``quick``: dwells of 0.3 s."""
    found = staircase(quick, advance)
    left, sigma = deviations(found)
    with styled():
        figure = draw(found)
    caption = (
        "Translation of ECC during the angular trajectory. (a) in the plane, ascent and descent; (b) its components "
        "over time. Black and grey: lever arm times the sensors' angle, which rings after each step."
    )
    lever, spread = lever_arm(found)
    share = float(((lever - lever.new_tensor(VIEW_UM)).abs() / spread).max())
    records = [
        Record("fig9 lever arm from the steps: error over its sigma", share, "", tolerance=3.0),
        Record("fig9 steps: rms deviation from lever arm times angle", 1e3 * _rms(left), "nm"),
        Record("fig9 steps: rms of that over its sigma", _rms(left / sigma), "", tolerance=2.0),
    ]
    rows = [
        ("true", *(f"{v:.2f}" for v in VIEW_UM)),
        ("from the steps", *(f"{v:.2f} +- {s:.2f}" for v, s in zip(lever.tolist(), spread.tolist(), strict=True))),
    ]
    tables = [Table("Lever arm", ("", "x, um", "y, um"), rows), _table(found, left, sigma)]
    return Outcome(
        "fig9", "Fig. 9: parasitic translation", [Picture("fig9", figure, caption)], tables, records, REMARKS
    )


def predicted(found: Staircase, pose: Tensor) -> Tensor:
    """x and y (..., 2) um of the template from the sensors' poses (..., 3) um, um, rad and the true lever arm."""
    arm = pose.new_tensor(VIEW_UM)
    moved: Tensor = pose[..., :2] + rotation(pose[..., 2]) @ arm - arm
    return moved


def deviations(found: Staircase) -> tuple[Tensor, Tensor]:
    """Mean x and y of every step but the first minus the law, and their standard deviations: two (K - 1, 2) um.

    Those are of the track's means and of the sensors' error budget.
    """
    ecc = found.dwells["ECC"]
    left = ecc.mean[:, :2] - predicted(found, found.dwells["CDS"].mean)
    variance = ecc.standard_error[:, :2] ** 2
    return left[1:] - left[0], (variance[1:] + variance[0] + sensed(found)[1:] ** 2).sqrt()


def sensed(found: Staircase) -> Tensor:
    """Error budget (K, 2) um of the law: the sensors' x and y, and their theta through the lever arm."""
    budget = error_budget(SensorSettings(), found.dwells["CDS"].mean).total
    through = budget.new_tensor(VIEW_UM[::-1]) * budget[:, 2:]
    return (budget[:, :2] ** 2 + through**2).sqrt()


def lever_arm(found: Staircase) -> tuple[Tensor, Tensor]:
    """Lever arm (2,) um that the means of the steps tell by least squares, and its standard deviations (2,).

    The tracker's errors of different steps are independent. The sensors' are not: their non-linearity bends all steps
    alike, and counts as it is at the highest one.
    """
    cds, scatter = found.dwells["CDS"].mean, found.dwells["ECC"].standard_error[:, :2]
    sigma = (scatter[1:] ** 2 + scatter[0] ** 2).sqrt()
    moved = found.dwells["ECC"].mean[:, :2] - cds[:, :2]
    rows = (rotation(cds[1:, 2]) - torch.eye(2, dtype=cds.dtype)) / sigma[..., None]
    A, b = rows.reshape(-1, 2), ((moved[1:] - moved[0]) / sigma).reshape(-1, 1)
    lever = torch.linalg.lstsq(A, b).solution[:, 0]
    top = int(cds[:, 2].argmax())
    bent = sensed(found)[top].flip(0) / cds[top, 2]  # x of the law is theta times y of the lever
    return lever, (torch.linalg.inv(A.mT @ A).diagonal() + bent**2).sqrt()


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def _table(found: Staircase, left: Tensor, sigma: Tensor) -> Table:
    rows = []
    for k, (d, s) in enumerate(zip(left.tolist(), sigma.tolist(), strict=True), start=1):
        x, y, theta = found.dwells["ECC"].mean[k].tolist()
        cells = (f"{1e3 * v:.1f} +- {1e3 * e:.1f}" for v, e in zip(d, s, strict=True))
        rows.append((f"{k}", f"{1e6 * theta:.0f}", f"{x:.4f}", f"{y:.4f}", *cells))
    header = ("step", "theta, urad", "x, um", "y, um", "x minus the law, nm", "y minus the law, nm")
    return Table("Translation of each step by ECC, and its deviation from lever arm times angle", header, rows)


def draw(found: Staircase) -> Figure:
    """(a) in the plane, (b) over time."""
    figure = new_figure(11, 4.6)
    plane, parts = figure.subplots(1, 2, width_ratios=(1, 1.35))
    track, sensors = found.tracks["ECC"], found.sensors
    time = track.time_s + found.alignment.offset_s
    top = int(found.levels_deg.argmax())
    turning = float(found.windows_s[top].mean())
    law = predicted(found, sensors.pose)
    for rows, colour, words in ((time < turning, UP, "ascent"), (time >= turning, DOWN, "descent")):
        plane.plot(*track.pose[rows, :2].T, ".", ms=2, color=colour, label=words)
    plane.plot(*law[::16].T, color=LAW, lw=0.8, label=r"lever arm x $\theta$ of CDS")
    plane.set(xlabel="x (um)", ylabel="y (um)")
    plane.set_aspect("equal", "datalim")
    plane.legend(loc="upper left", markerscale=3)
    letter(plane, "(a) in the plane")
    _draw_parts(parts, time, track.pose, (sensors.time_s, law))
    return figure


def _draw_parts(axes: Axes, time: Tensor, pose: Tensor, law: tuple[Tensor, Tensor]) -> None:
    for i, colour in enumerate((UP, DOWN)):
        axes.plot(law[0], law[1][:, i], color="0.6", lw=0.6)
        axes.plot(time, pose[:, i], color=colour, lw=0.9, label=COMPONENTS[i])
    axes.set(xlabel="time (s)", ylabel="x, y (um)")
    axes.legend(loc="lower left")
    letter(axes, "(b) components")
