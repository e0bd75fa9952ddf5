"""Lines, circles and ellipses through measured points (N, 2): what a planar path really was."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Line(NamedTuple):
    """Direction of a line as atan2(y, x) in rad, of its travel from the first half of the points to the second, and
    its standard deviation from the scatter across the line."""

    angle: float
    sigma: float


class Ellipse(NamedTuple):
    """Centre (2,), semi-axes (2,) major first, the direction of the major one as atan2(y, x) in (-pi/2, pi/2], and the
    rms distance of the points, to first order. Units of the points; angle in rad."""

    center: Tensor
    semi_axes: Tensor
    angle: float
    residual_rms: float


class Circle(NamedTuple):
    """Centre (2,), radius and the rms distance of the points from it, in units of the points."""

    center: Tensor
    radius: float
    residual_rms: float


def fit_line(points: Tensor) -> Line:
    """Total least squares. ValueError for fewer than 3 points or all in one place."""
    p = _checked("fit_line", points, 3)
    p = p - p.mean(0)
    values, vectors = torch.linalg.eigh(p.mT @ p)  # squares across the line, then along it
    if not float(values[1]) > 0:
        raise ValueError("fit_line: points must not all lie in one place")
    half = len(p) // 2
    along = vectors[:, 1] * torch.sign((p[half:].mean(0) - p[:half].mean(0)) @ vectors[:, 1] + 1e-300)
    sigma = (values[0] / max(len(p) - 2, 1) / values[1]).clamp(min=0).sqrt()
    return Line(float(torch.atan2(along[1], along[0])), float(sigma))


def fit_circle(points: Tensor) -> Circle:
    """Algebraic least squares (Kasa, IEEE Trans. Instrum. Meas. 25, 1976): |p|^2 = 2 c . p + r^2 - |c|^2, linear in c.

    ValueError for fewer than 3 points, or points on one line.
    """
    p, middle = _centred("fit_circle", points, 3)
    columns = torch.cat((2 * p, torch.ones_like(p[:, :1])), 1)
    *center, rest = torch.linalg.lstsq(columns, p.square().sum(1, keepdim=True)).solution[:, 0]
    c = torch.stack(center)
    radius = (rest + c @ c).sqrt()
    residual = torch.linalg.vector_norm(p - c, dim=1) - radius
    return Circle(c + middle, float(radius), float(residual.square().mean().sqrt()))


def fit_ellipse(points: Tensor) -> Ellipse:
    """Algebraic least squares, the conic's trace fixed to 2: turning the points turns the ellipse.

    (1 - a) x^2 + (1 + a) y^2 - 2 b x y - d x - e y = f is linear in (a, b, d, e, f), and an ellipse for a^2 + b^2 < 1.
    ValueError for fewer than 5 points, points on one line or on no ellipse.
    """
    p, middle = _centred("fit_ellipse", points, 5)
    x, y = p.unbind(1)
    columns = torch.stack((x * x - y * y, 2 * x * y, x, y, torch.ones_like(x)), 1)
    a, b, d, e, f = torch.linalg.lstsq(columns, p.square().sum(1, keepdim=True)).solution[:, 0]
    if not float(a * a + b * b) < 1:
        raise ValueError("fit_ellipse: points must lie around an ellipse, these fit another conic better")
    conic = torch.stack((1 - a, -b, -b, 1 + a)).reshape(2, 2)
    center = 0.5 * torch.linalg.solve(conic, torch.stack((d, e)))
    level = f + center @ conic @ center
    values, vectors = torch.linalg.eigh(conic / level)  # 1 / semi-axis^2, the major axis first
    major = vectors[:, 0] * torch.where(vectors[0, 0] < 0, -1.0, 1.0)
    away = p - center
    distance = ((away @ conic * away).sum(1) - level) / (2 * torch.linalg.vector_norm(away @ conic, dim=1))
    angle = float(torch.atan2(major[1], major[0]))
    return Ellipse(center + middle, values.rsqrt(), angle, float(distance.square().mean().sqrt()))


def _checked(who: str, points: Tensor, least: int) -> Tensor:
    if points.dim() != 2 or points.shape[1] != 2 or not bool(points.isfinite().all()):
        raise ValueError(f"{who}: points must be finite numbers (N, 2), got {tuple(points.shape)}")
    if len(points) < least:
        raise ValueError(f"{who}: points must be {least} or more, got {len(points)}")
    return points.double()


def _centred(who: str, points: Tensor, least: int) -> tuple[Tensor, Tensor]:
    """Points about their mean, and the mean; they must span the plane."""
    p = _checked(who, points, least)
    middle = p.mean(0)
    spread = torch.linalg.svdvals(p - middle)
    if not float(spread[1]) > 1e-9 * float(spread[0]):
        raise ValueError(f"{who}: points must not lie on one line")
    return p - middle, middle
