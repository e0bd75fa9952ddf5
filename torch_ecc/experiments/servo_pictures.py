"""Pictures of an alignment: the three steps (Fig. 12), velocities (Fig. 13), and errors beside e^(-lambda t)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.experiments.style import COMPONENTS, UNITS, letter, new_figure, styled
from torch_ecc.servo.record import Log

COLOURS = ("#0072b2", "#d55e00", "#009e73")
LEAST = 1e-4  # px and deg: where the logarithmic axes of errors end


def draw_velocities(logs: Sequence[Log], titles: Sequence[str]) -> Figure:
    """Commanded velocities over time: one column per log, x and y above theta (if there is such an axis)."""
    with styled():
        turning = any(log.velocity.shape[1] > 2 for log in logs)
        figure = new_figure(4.6 * len(logs) + 0.4, 4.6 if turning else 2.8)
        rows = figure.subplots(2 if turning else 1, len(logs), squeeze=False, sharex="col")
        for column, (log, title) in enumerate(zip(logs, titles, strict=True)):
            linear = rows[0, column]
            _curves(linear, log.time, log.velocity[:, :2])
            linear.set_title(title, loc="left")
            linear.set_ylabel("velocity (µm/s)")
            if turning and log.velocity.shape[1] > 2:
                _curves(rows[1, column], log.time, log.velocity[:, 2:].rad2deg(), first=2)
                rows[1, column].set_ylabel("velocity (deg/s)")
            elif turning:
                rows[1, column].set_visible(False)
                linear.tick_params(labelbottom=True)
            last = rows[1, column] if turning and log.velocity.shape[1] > 2 else linear
            last.set_xlabel("time (s)")
    return figure


def draw_errors(logs: Sequence[Log], titles: Sequence[str], gain: float) -> Figure:
    """Absolute errors on a logarithmic axis, with the commanded decay of ``gain`` 1/s as a grey line."""
    with styled():
        figure = new_figure(4.6 * len(logs) + 0.4, 3.2)
        for axes, log, title in zip(figure.subplots(1, len(logs), squeeze=False)[0], logs, titles, strict=True):
            for k in range(min(log.velocity.shape[1], 3)):
                name, values = (
                    f"{COMPONENTS[k]} ({UNITS[k]})",
                    log.error[:, k].abs() * (math.degrees(1) if k == 2 else 1.0),
                )
                axes.semilogy(log.time, values.clamp(min=LEAST), color=COLOURS[k], label=name)
                law = values[0] * (-gain * log.time).exp()
                label = rf"$e_0\,e^{{-\lambda t}}$, $\lambda$ = {gain:g}/s" if k == 0 else None
                axes.semilogy(log.time, law.clamp(min=LEAST), color="0.55", lw=0.8, ls="--", zorder=1, label=label)
            axes.set(xlabel="time (s)", ylabel="|error|", ylim=(LEAST, None))
            axes.set_title(title, loc="left")
            axes.legend(loc="upper right")
    return figure


def draw_steps(frames: Sequence[Tensor], outlines: Sequence[Sequence[Tensor]], titles: Sequence[str]) -> Figure:
    """Frames (h, w) side by side, each with lines through points (N, 2) in colours of their own: Fig. 12 (b) to (d)."""
    with styled():
        h, w = frames[0].shape
        figure = new_figure(4.0 * len(frames), 4.0 * h / w + 0.35)
        for axes, frame, lines, title in zip(figure.subplots(1, len(frames)), frames, outlines, titles, strict=True):
            axes.imshow(frame.float().numpy(), cmap="gray", vmin=0, vmax=255)
            for line, colour in zip(lines, ("#19d38a", "#ffb000", "#ff4d4d"), strict=False):
                axes.plot(*line.T, color=colour, lw=1.4, marker="+" if len(line) == 1 else None, ms=11, mew=1.6)
            axes.set_axis_off()
            axes.set_xlim(-0.5, w - 0.5)
            axes.set_ylim(h - 0.5, -0.5)
            letter(axes, title)
    return figure


def _curves(axes: Axes, time: Tensor, values: Tensor, first: int = 0) -> None:
    names = ("$v_x$", "$v_y$", r"$\omega$")
    for k, column in enumerate(values.unbind(1), first):
        axes.step(time, column, where="post", color=COLOURS[k], label=names[k])
    axes.axhline(0, color="0.4", lw=0.7)
    axes.legend(loc="best")


def square(size: int) -> Tensor:
    """The outline (5, 2) of an upright square of ``size`` px about the origin."""
    half = size / 2
    return torch.tensor(
        [(-half, -half), (half, -half), (half, half), (-half, half), (-half, -half)], dtype=torch.float64
    )
