"""Pictures of an alignment: the three steps (Fig. 12), velocities (Fig. 13), and errors beside e^(-lambda t)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.plots.style import COMPONENTS, UNITS, letter, new_figure, styled
from torch_ecc.servo.record import Log

COLOURS = ("#0072b2", "#d55e00", "#009e73")
VELOCITIES = ("$v_x$", "$v_y$", r"$\omega$")
LEAST = 1e-3  # px and deg: where the logarithmic axes of errors end


@styled()
def draw_velocities(logs: Sequence[Log], titles: Sequence[str]) -> Figure:
    """Commanded velocities over time: a panel for x and y of each log, and one for theta if there is such an axis."""
    panels = [
        (log, f"{title}, {'theta' if k else 'x and y'}", k)
        for log, title in zip(logs, titles, strict=True)
        for k in (0, 2)[: log.velocity.shape[1] - 1]
    ]
    figure = new_figure(3.9 * len(panels), 3.0)
    for axes, (log, title, k) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        values = log.velocity[:, 2:].rad2deg() if k else log.velocity[:, :2]
        for column, values_of in enumerate(values.unbind(1), k):
            axes.step(log.time, values_of, where="post", color=COLOURS[column], label=VELOCITIES[column])
        axes.axhline(0, color="0.4", lw=0.7)
        axes.set(title=title, xlabel="time (s)", ylabel="velocity (deg/s)" if k else "velocity (µm/s)")
        axes.legend(loc="best")
    return figure


@styled()
def draw_errors(logs: Sequence[Log], titles: Sequence[str], gain: float) -> Figure:
    """Absolute errors on a logarithmic axis, each beside the decay that ``gain`` 1/s commands."""
    figure = new_figure(4.6 * len(logs) + 0.4, 3.2)
    for axes, log, title in zip(figure.subplots(1, len(logs), squeeze=False)[0], logs, titles, strict=True):
        for k in range(min(log.velocity.shape[1], 3)):
            name, scale = f"{COMPONENTS[k]} ({UNITS[k]})", math.degrees(1) if k == 2 else 1.0
            values = scale * log.error[:, k].abs()
            axes.semilogy(log.time, values.clamp(min=LEAST), color=COLOURS[k], label=name)
            law = values[0] * (-gain * log.time).exp()
            axes.semilogy(log.time, law.clamp(min=LEAST), color="0.55", lw=0.8, ls="--", zorder=1)
        axes.plot([], [], color="0.55", lw=0.8, ls="--", label=rf"$e_0\,e^{{-\lambda t}}$, $\lambda$ = {gain:g}/s")
        axes.set(title=title, xlabel="time (s)", ylabel="|error|", ylim=(LEAST, None))
        axes.legend(loc="upper right")
    return figure


@styled()
def draw_steps(frames: Sequence[Tensor], outlines: Sequence[Sequence[Tensor]], titles: Sequence[str]) -> Figure:
    """Frames (h, w) side by side, each with a template's outline (5, 2), the probe's tip (1, 2) and its landing (1, 2).

    The tip is a ring, the landing point a cross: Fig. 12 (b) to (d).
    """
    h, w = frames[0].shape
    figure = new_figure(4.0 * len(frames), 4.0 * h / w + 0.35)
    panels = figure.subplots(1, len(frames), squeeze=False)[0]
    for axes, frame, (box, tip, landing), title in zip(panels, frames, outlines, titles, strict=True):
        axes.imshow(frame.float().numpy(), cmap="gray", vmin=0, vmax=255)
        axes.plot(*box.T, color="#19d38a", lw=1.6)
        axes.plot(*tip.T, color="#ffb000", marker="o", mfc="none", ms=13, mew=1.8)
        axes.plot(*landing.T, color="#ff4d4d", marker="+", ms=13, mew=1.8)
        axes.set_axis_off()
        axes.set(title=letter(title), xlim=(-0.5, w - 0.5), ylim=(h - 0.5, -0.5))
    return figure


def square(size: int) -> Tensor:
    """The outline (5, 2) of an upright square of ``size`` px about the origin."""
    half = size / 2
    return torch.tensor(
        [(-half, -half), (half, -half), (half, half), (-half, half), (-half, -half)], dtype=torch.float64
    )
