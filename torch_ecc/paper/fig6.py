"""Fig. 6: circular trajectories of 8 and 12 um as the camera and the capacitive sensors (CDS) see them."""

from __future__ import annotations

import math
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from torch_ecc.paper.acquisition import times
from torch_ecc.paper.circles import Round, common_angle, rounds
from torch_ecc.paper.drawing import second_scale
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table
from torch_ecc.plots.style import COMPONENTS, letter, new_figure

VISION, CDS, FIT = ("#0072b2", "#56b4e9"), ("#d55e00", "#e69f00"), "#1b1b1b"
ANGLE_LIMIT = 0.01  # deg, of the straight lines against the true angle between image and stage
REMARKS = (
    "The radii come out smaller than commanded and the circles as ellipses, as in the paper: hysteresis, compliance "
    "and cross-coupling of the simulated stage. The fitted circles are those of the CDS data, as in the paper.",
    "The straight portions of the two records differ by the angle between image and stage. Its error is the lens' "
    "vibration: without it the lines give the angle to 0.002 deg.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """Both circles, drawn as the paper's Fig. 6. ``quick``: twice as fast."""
    found = rounds(quick, advance)
    caption = (
        "Results for circular trajectories. (a) in three dimensions; (b) in the plane, with circles fitted to the CDS "
        "data; (c) enlarged part of (b); (d) components of the vision method."
    )
    title, picture = "Fig. 6: circular trajectories", Picture("fig6", draw(found), caption)
    tables = [_table(found), times({f"{r.radius:g} um": r.acquired for r in found})]
    return Experiment("fig6", title, [picture], tables, _records(found), REMARKS)


def _records(found: list[Round]) -> list[Number]:
    true = found[0].axis_angle
    error = abs(math.degrees(common_angle(found) - true))
    records = [Number("fig6 angle of image and stage by straight lines, error", error, "deg", tolerance=ANGLE_LIMIT)]
    for r in found:
        name = f"fig6 {r.radius:g} um:"
        joint = abs(math.degrees(r.joint.axis_angle - true))
        major, minor = r.ellipse.semi_axes.tolist()
        oval = r.ellipse.residual_rms / r.circle.residual_rms
        lost = float((~r.track.pose.isfinite().all(1)).sum())
        records += [
            Number(f"{name} angle by the joint estimate, error", joint, "deg", tolerance=ANGLE_LIMIT),
            Number(f"{name} major semi-axis over the commanded radius", major / r.radius, "", tolerance=1.0),
            Number(f"{name} minor semi-axis over the commanded radius", minor / r.radius, "", tolerance=1.0),
            Number(f"{name} rms distance from an ellipse over that from a circle", oval, "", tolerance=1.0),
            Number(f"{name} lost frames", lost, "", tolerance=0.0),
        ]
    return records


def _table(found: list[Round]) -> Table:
    header = ("", *(f"{r.radius:g} um" for r in found))
    joint = [(r.joint.axis_angle, r.joint.sigma["axis_angle_rad"]) for r in found]
    lines = {
        "circle fitted to the CDS data: radius, um": [f"{r.circle.radius:.3f}" for r in found],
        "  rms distance from the circle, nm": [f"{1e3 * r.circle.residual_rms:.0f}" for r in found],
        "ellipse: semi-axes, um": ["{:.3f}, {:.3f}".format(*r.ellipse.semi_axes.tolist()) for r in found],
        "  rms distance from the ellipse, nm": [f"{1e3 * r.ellipse.residual_rms:.0f}" for r in found],
        "angle of image and stage, deg: straight lines": [f"{math.degrees(r.line_angle):.4f}" for r in found],
        "  joint estimate": [f"{math.degrees(a):.4f} +- {math.degrees(s):.4f}" for a, s in joint],
        "  true": [f"{math.degrees(r.axis_angle):.4f}" for r in found],
    }
    rows = [(name, *cells) for name, cells in lines.items()]
    note = "The angle by all straight lines together: " + f"{math.degrees(common_angle(found)):.4f} deg."
    return Table("What the trajectories were", header, rows, note)


def draw(found: list[Round]) -> Figure:
    """(a) to (d) of the paper's Fig. 6, both radii in each."""
    figure = new_figure(11, 8.6)
    rows: Any = figure.subfigures(2, 1, height_ratios=(1.25, 1))
    space = rows[0].add_axes((0.0, 0.03, 0.46, 0.9), projection="3d")
    _draw_space(space, found)
    plane = rows[0].add_axes((0.53, 0.12, 0.45, 0.8))
    _draw_plane(plane, found, legend=True)
    plane.set(title=letter("(b) in the plane"), aspect="equal", adjustable="datalim")
    close, parts = rows[1].subplots(1, 2, width_ratios=(1, 1.25))
    _draw_plane(close, found, legend=False)
    big = found[-1]
    middle = big.radius * 0.79
    close.set(title=letter("(c) enlarged part of (b)"), xlim=(middle - 1.6, middle + 0.9), ylim=(-1.1, 1.1))
    plane.add_patch(Rectangle((middle - 1.6, -1.1), 2.5, 2.2, fill=False, color="0.4", lw=0.8))
    _draw_parts(parts, found)
    return figure


def _draw_space(axes: Any, found: list[Round]) -> None:  # matplotlib does not type its 3-D axes
    for k, r in enumerate(found):
        axes.plot(*r.sensors.pose[::4, :2].T, r.sensors.pose[::4, 2].rad2deg(), color=CDS[k], lw=0.8)
        axes.plot(*r.track.pose[:, :2].T, r.track.pose[:, 2].rad2deg(), ".", ms=1.5, color=VISION[k])
    axes.set(xlabel="x (um)", ylabel="y (um)", zlabel=r"$\theta$ (deg)", zlim=(-0.12, 0.12))
    axes.view_init(elev=28, azim=-55)
    axes.set_title(letter("(a) in three dimensions"), loc="left")  # 3-D axes know no setting for that


def _draw_plane(axes: Axes, found: list[Round], *, legend: bool) -> None:
    turn = torch.linspace(0, math.tau, 200)
    for k, r in enumerate(found):
        x, y = r.circle.center.tolist()
        circle = (x + r.circle.radius * turn.cos(), y + r.circle.radius * turn.sin())
        axes.plot(*circle, "--", color=FIT, lw=0.8, label="circles fit to CDS" if k == 0 else None)
        axes.plot(*r.sensors.pose[:, :2].T, color=CDS[k], lw=2.2, label=f"CDS, {r.radius:g} um")
        axes.plot(*r.track.pose[:, :2].T, ".", ms=2, color=VISION[k], label=f"vision, {r.radius:g} um")
    axes.set(xlabel="x (um)", ylabel="y (um)")
    if legend:
        axes.legend(loc="center", bbox_to_anchor=(0.47, 0.63), fontsize=7)


def _draw_parts(axes: Axes, found: list[Round]) -> None:
    """x and y of the vision method; theta, which stays within its noise, on its own scale."""
    turn = second_scale(axes)
    for k, r in enumerate(found):
        for i, dashes in enumerate(("-", "--")):
            label = f"{COMPONENTS[i]}, {r.radius:g} um"
            axes.plot(r.track.time_s, r.track.pose[:, i], dashes, color=VISION[k], label=label)
        turn.plot(r.track.time_s, 1e6 * r.track.pose[:, 2], color="0.55", lw=0.5, alpha=0.7)
    reach = 1.25 * found[-1].radius
    title = letter("(d) components of the vision method")
    axes.set(title=title, xlabel="time (s)", ylabel="x, y (um)", ylim=(-reach, 1.4 * reach))
    turn.set(ylabel=r"$\theta$ (urad), grey", ylim=(-2400, 3360))
    axes.legend(ncols=4, loc="upper center", fontsize=8)
