"""Fig. 2: the micrograph under uneven light, its Retinex components, and the motion of eq. (11)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper import scheme
from torch_ecc.paper.drawing import second_scale
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table, cells
from torch_ecc.plots.style import COMPONENTS, letter, new_figure
from torch_ecc.sim import Retinex

COLOURS = ("#0072b2", "#d55e00")
LINES = {scheme.CAPTION: ("-", "#1b1b1b"), scheme.TEXT: ("--", "#8a8a8a")}
REMARKS = (
    "The original (a) is the default micrograph of the simulator, an analytic scene, photographed under a modelled "
    "lamp: off the axis and behind a vignetting lens. The paper's own micrograph is not public.",
    "Single-scale Retinex takes it apart into (b) and (c), whose product is (a) again. The incident component (c) is "
    "the uneven light of Fig. 3. It stays with the camera while the surface moves under it.",
    "The paper warps (b) with an interpolator to make its sequences. Here the surface is the analytic scene itself, "
    "evaluated exactly at every pose, so that no error of an interpolator is in the truth.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """Decompose the original and draw the paper's Fig. 2; both sets of amplitudes. ``quick`` changes nothing here."""
    original, parts = scheme.original().float(), scheme.components()
    paths = {motion: motion.path() - torch.tensor((*scheme.CENTRE, 0.0)) for motion in LINES}
    advance(1, 2)
    error = float((parts.reflected * parts.incident - original).abs().max()) / 255
    slope = max(parts.incident.diff(dim=k).abs().max() for k in (-1, -2))
    rough = float(slope / parts.incident.mean())
    records = [
        Number("fig2 reflected x incident minus original, largest", error, "of full scale", tolerance=1e-5),
        Number("fig2 largest slope of the incident component", rough, "of its mean per px", tolerance=0.01),
    ]
    rows = [(_words(motion), f"{motion.points}", *cells(_fastest(path), ".2f")) for motion, path in paths.items()]
    table = Table("Motion, eq. (11)", ("amplitudes", "Nop", "fastest, px per frame", "fastest, deg per frame"), rows)
    caption = (
        "(a) the original micrograph under uneven light; (b), (c) its reflected and incident components (Retinex); "
        "(d) the motion as a trajectory; (e) its components. Solid: the caption's amplitudes, dashed: the text's."
    )
    picture = Picture("fig2", draw(original, parts, paths), caption)
    advance(2, 2)
    return Experiment("fig2", "Fig. 2: how the sequences are made", [picture], [table], records, REMARKS)


def _words(motion: scheme.Harmonic) -> str:
    where = "text" if motion == scheme.TEXT else "caption of Fig. 2"
    return f"{motion.amplitude:g} px, {motion.amplitude:g} px, {motion.degrees:g} deg ({where})"


def _fastest(path: Tensor) -> tuple[float, float]:
    """Largest motion from frame to frame, px and deg."""
    step = path.diff(dim=0)
    return float(step[:, :2].norm(dim=1).max()), math.degrees(float(step[:, 2].abs().max()))


def draw(original: Tensor, parts: Retinex, paths: Mapping[scheme.Harmonic, Tensor]) -> Figure:
    """Images (1, 1, h, w) above, motions (F, 3) below, laid out as the paper's Fig. 2."""
    figure = new_figure(11, 6.6)
    rows: Any = figure.subfigures(2, 1, height_ratios=(1, 1.15))
    images = {
        "(a) original": (original, 255),
        "(b) reflected component": (parts.surface(), 255),
        "(c) incident component": (parts.incident, None),
    }
    for axes, (title, (image, white)) in zip(rows[0].subplots(1, 3), images.items(), strict=True):
        axes.imshow(image[0, 0].numpy(), cmap="gray", vmin=0, vmax=white)
        axes.set_axis_off()
        axes.set_title(letter(title))
    left, right = rows[1].subfigures(1, 2, width_ratios=(1, 1.6))
    _draw_space(left.add_axes((0.0, 0.05, 0.86, 0.84), projection="3d"), paths)
    _draw_components(right.add_subplot(), paths)
    return figure


def _draw_space(axes: Any, paths: Mapping[scheme.Harmonic, Tensor]) -> None:  # matplotlib does not type its 3-D axes
    for motion, path in paths.items():
        dashes, colour = LINES[motion]
        label = f"{motion.degrees:.0f} deg, Nop {motion.points}"
        axes.plot(*path[:, :2].T, path[:, 2].rad2deg(), dashes, color=colour, label=label)
    axes.set(xlabel="x (px)", ylabel="y (px)", zlabel="theta (deg)")
    axes.set_title(letter("(d) trajectory"), loc="left")  # 3-D axes know no setting for that
    axes.view_init(elev=22, azim=-60)
    axes.legend(loc="upper left")


def _draw_components(axes: Axes, paths: Mapping[scheme.Harmonic, Tensor]) -> None:
    turn = second_scale(axes)
    for motion, path in paths.items():
        j, (dashes, _) = range(1, len(path) + 1), LINES[motion]
        axes.plot(j, path[:, 0], dashes, color=COLOURS[0], label=f"{COMPONENTS[0]} = {COMPONENTS[1]} (Nop {len(path)})")
        turn.plot(j, path[:, 2].rad2deg(), dashes, color=COLOURS[1], label=f"{COMPONENTS[2]} (Nop {len(path)})")
    axes.set(title=letter("(e) components"), xlabel="frame j", ylabel="x, y (px)", ylim=(-110, 135))
    turn.set_ylim(-27.5, 33.75)  # a scale of its own, so that no curve hides another
    turn.set_ylabel("theta (deg)", color=COLOURS[1])
    axes.legend(handles=[*axes.get_lines(), *turn.get_lines()], ncols=2, loc="upper center")
