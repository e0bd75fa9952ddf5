"""Errors of poses, in px and degrees as the paper has them, and what is said of many of them: rms, largest, box."""

from __future__ import annotations

import math

from torch import Tensor


def in_degrees(pose: Tensor) -> Tensor:
    """(..., 3) px, px, rad -> px, px, deg."""
    return pose * pose.new_tensor((1.0, 1.0, math.degrees(1.0)))


def errors(pose: Tensor, truth: Tensor) -> Tensor:
    """Pose minus truth, (..., 3) px, px, rad -> px, px, deg."""
    return in_degrees(pose - truth)


def valid(error: Tensor) -> Tensor:
    """The rows of errors (n, 3) that are numbers: lost frames are left out."""
    return error[error.isfinite().all(1)]


def rms(error: Tensor) -> Tensor:
    """Root mean square of each component: (n, ...) -> (...)."""
    return error.square().mean(0).sqrt()


def largest(error: Tensor) -> Tensor:
    """Largest absolute value of each component: (n, ...) -> (...)."""
    return error.abs().amax(0)


def box(error: Tensor) -> Tensor:
    """The farther of both quartiles from zero, of each component: (n, ...) -> (...)."""
    return largest(error.quantile(error.new_tensor((0.25, 0.75)), dim=0))


def by_unit(error: Tensor) -> tuple[float, float]:
    """The larger of x and y, and theta, of (3,)."""
    x, y, theta = error.tolist()
    return max(x, y), theta
