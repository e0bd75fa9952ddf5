"""The least scatter that any unbiased tracker can have on a scene: the Cramer-Rao bound."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation, transform
from torch_ecc.sim import Scene
from torch_ecc.sim.camera.sensor import WHITE


def jacobian(scene: Scene, size: tuple[int, int], at: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The template (N,) at the scene's origin, or ``at`` (3,) in it, and its Jacobian (N, 3) by x, y, theta."""
    h, w = size
    y, x = torch.meshgrid(torch.arange(h) - (h - 1) / 2, torch.arange(w) - (w - 1) / 2, indexing="ij")
    points = torch.stack((x.flatten(), y.flatten()), -1).double()
    place = points.new_zeros(3) if at is None else at
    there = transform(place, points)
    gx, gy = (scene.gradient(there) @ rotation(place[2])).unbind(-1)
    return scene.value(there), torch.stack((gx, gy, gx * points[:, 1] - gy * points[:, 0]), -1)


def cramer_rao(scene: Scene, size: tuple[int, int], variance: float, at: Tensor | None = None) -> Tensor:
    """Bound (3,) px, px, rad on the standard deviation of x, y, theta of a template (h, w) at the scene's origin.

    ``at`` (3,): the template's own pose in the scene; the bound is along its axes.

    ``variance`` of the white noise in squared grey levels: the frame's, and the template's too where it is as noisy and
    drawn anew each time. Gain and offset are unknown, so the Jacobian counts only off {1, t}:
    cov >= variance (J_p^T J_p)^-1.
    """
    t, J = jacobian(scene, size, at)
    span, _ = torch.linalg.qr(torch.stack((torch.ones_like(t), t), -1))
    J = J - span @ (span.mT @ J)
    covariance: Tensor = variance * torch.linalg.inv(J.mT @ J)
    return covariance.diagonal().sqrt()


def rounding(bits: int | None) -> float:
    """Variance of rounding to ``bits``, squared grey levels of 0..255; of None, no rounding, zero."""
    return 0.0 if bits is None else (WHITE / (2**bits - 1)) ** 2 / 12
