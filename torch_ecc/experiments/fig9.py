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

UP, DOWN, LAW = "#0072b2", "#d55e00", "#1b1b1b"
REMARKS = (
    "The template lies 1.8 mm from the origin of the moving part, whose own x and y the sensors give: what it moves in "
    "addition is (R(theta) - 1) lever arm. The sensors' theta times the true lever arm is the line beside it.",
    "Standard errors of the steps hold for white noise; the lens' vibration is slower than the frames.",
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
    lever, arm = found.alignment.lever, torch.tensor(VIEW_UM, dtype=torch.float64)
    spread = [found.alignment.sigma[name] for name in ("lever_x_um", "lever_y_um")]
    share = float(((lever - arm).abs() / lever.new_tensor(spread)).max())
    records = [
        Record("fig9 lever arm by the joint estimate: error over its sigma", share, "", tolerance=3.0),
        Record("fig9 steps: rms deviation from lever arm times angle", 1e3 * _rms(left), "nm"),
        Record("fig9 steps: rms of that over its sigma", _rms(left / sigma), "", tolerance=2.0),
    ]
    rows = [
        ("true", *(f"{v:.2f}" for v in VIEW_UM)),
        ("joint estimate", *(f"{v:.2f} +- {s:.2f}" for v, s in zip(lever.tolist(), spread, strict=True))),
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
    """Mean x and y of every step but the first minus the law, and their standard errors: two (K - 1, 2) um."""
    ecc, cds = found.dwells["ECC"], found.dwells["CDS"]
    left = ecc.mean[:, :2] - predicted(found, cds.mean)
    variance = ecc.standard_error[:, :2] ** 2
    return left[1:] - left[0], (variance[1:] + variance[0]).sqrt()


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
