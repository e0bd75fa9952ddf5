"""The columns of templates, per pixel, rounded once and for all engines."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

LEVELS = 2**15 - 1  # a template is rounded to so many steps on either side: an engine may hold it in 16 bits


class Columns(NamedTuple):
    """Per pixel: ``signal`` and ``instrument`` (B, 4, N) = [G, t], raw and blurred, the blurred G times ``wiener``
    (B, N), see ``noise.wiener_weight``; ``weight`` (B, N). The slopes and t of the instrument and of the signal count
    in ``unit`` (B, 4) grey levels (per px), and t from ``level`` (B, 2): whole numbers of at most ``LEVELS``."""

    signal: Tensor
    instrument: Tensor
    wiener: Tensor
    weight: Tensor
    unit: Tensor
    level: Tensor


def columns_of(local: Tensor, images: tuple[Tensor, Tensor], wiener: Tensor, weight: Tensor) -> Columns:
    """Rounded columns from ``images`` [d/dx, d/dy, t] (B, 3, N), blurred and raw, at ``local`` (B, 2, N) about the
    centre."""
    columns, units, levels = [], [], []
    for image in images:
        level = image[:, 2:].mean(-1, keepdim=True)
        parts = image[:, :2], image[:, 2:] - level
        unit = [part.detach().abs().amax((1, 2), keepdim=True).clamp(min=1e-30) / LEVELS for part in parts]
        # Exactly unit * round(part / unit), with the gradient of the part.
        slopes, t = (p + (u * (p / u).round() - p).detach() for p, u in zip(parts, unit, strict=True))
        columns.append(_steepest_descent(torch.cat((slopes, t + level), 1), local))
        units += unit
        levels.append(level)
    instrument, signal = columns
    return Columns(signal, instrument, wiener, weight, torch.cat(units, 1)[..., 0], torch.cat(levels, 1)[..., 0])


def _steepest_descent(image: Tensor, local: Tensor) -> Tensor:
    """[G, t] (B, 4, N) from [d/dx, d/dy, t] (B, 3, N): eq. (8) at theta = 0 gives dW/dtheta = (y', -x')."""
    gx, gy, t = image.unbind(1)
    return torch.stack((gx, gy, gx * local[:, 1] - gy * local[:, 0], t), 1)
