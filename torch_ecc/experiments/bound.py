"""The least scatter that any unbiased tracker can have on a scene: the Cramer-Rao bound."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

QUANTISATION = 1 / 12  # variance of rounding to whole grey levels


class AnalyticScene(Protocol):
    """A scene known exactly at every point, in template coordinates (..., 2) px."""

    def value(self, points: Tensor) -> Tensor: ...

    def gradient(self, points: Tensor) -> Tensor: ...


def cramer_rao(scene: AnalyticScene, size: tuple[int, int], variance: float) -> Tensor:
    """Bound (3,) px, px, rad on the standard deviation of x, y, theta of a template (h, w) at the scene's origin.

    ``variance`` of the white noise in squared grey levels: the frame's, and the template's too where it is as noisy and
    drawn anew each time. Gain and offset are unknown, so the Jacobian counts only off {1, t}:
    cov >= variance (J_p^T J_p)^-1.
    """
    h, w = size
    y, x = torch.meshgrid(torch.arange(h) - (h - 1) / 2, torch.arange(w) - (w - 1) / 2, indexing="ij")
    points = torch.stack((x.flatten(), y.flatten()), -1).double()
    t, (gx, gy) = scene.value(points), scene.gradient(points).unbind(-1)
    J = torch.stack((gx, gy, gx * points[:, 1] - gy * points[:, 0]), -1)
    span, _ = torch.linalg.qr(torch.stack((torch.ones_like(t), t), -1))
    J = J - span @ (span.mT @ J)
    covariance: Tensor = variance * torch.linalg.inv(J.mT @ J)
    return covariance.diagonal().sqrt()
