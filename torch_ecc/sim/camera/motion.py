"""Motions: poses (F, 3) in px, px, rad, float64, one per frame, about the origin; ``placed`` moves them into a frame.

Angles are plain numbers: a motion that turns twice ends at 4 pi.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import tau

import torch
from torch import Tensor

Pose = tuple[float, float, float]  # px, px, rad


def harmonic(amplitudes: Pose = (20.0, 20.0, 0.1), points: int = 160, *, cycles: float = 1.0) -> Tensor:
    """Eq. (11): p_ij = A_i cos(2 pi j / points), j = 1, 2, ..., points x cycles. ``amplitudes`` in px, px, rad."""
    _check_points("harmonic", points)
    count = round(points * cycles)
    if count < 1:
        raise ValueError(f"harmonic: points x cycles must be at least 1, got {points} x {cycles}")
    j = torch.arange(1, count + 1, dtype=torch.float64)
    return (tau * j / points).cos()[:, None] * _row("harmonic: amplitudes", amplitudes)


def circle(radius: float, points: int = 160, *, turns: float = 1.0, spin: float = 0.0) -> Tensor:
    """``turns`` rounds of a circle in ``points`` frames, both ends included; theta grows evenly to ``spin`` rad."""
    _check_points("circle", points)
    if not radius >= 0:
        raise ValueError(f"circle: radius must be >= 0, got {radius}")
    s = torch.linspace(0, 1, points, dtype=torch.float64)
    angle = tau * turns * s
    return torch.stack((radius * angle.cos(), radius * angle.sin(), spin * s), 1)


def ramp(end: Pose, points: int = 160) -> Tensor:
    """A straight, even motion from rest at (0, 0, 0) in the first frame to ``end`` (px, px, rad) in the last."""
    _check_points("ramp", points)
    return torch.linspace(0, 1, points, dtype=torch.float64)[:, None] * _row("ramp: end", end)


def steps(step: Pose, count: int = 10, *, hold: int = 10) -> Tensor:
    """A staircase: ``count`` levels, each ``step`` (px, px, rad) further than the last and held for ``hold`` frames."""
    _check_points("steps", count)
    if hold < 1:
        raise ValueError(f"steps: hold must be at least 1 frame, got {hold}")
    level = torch.arange(count, dtype=torch.float64).repeat_interleave(hold)
    return level[:, None] * _row("steps: step", step)


def random_walk(sigmas: Pose, points: int = 160, *, seed: int = 0) -> Tensor:
    """A walk from (0, 0, 0) whose increments per frame are Gaussian with ``sigmas`` (px, px, rad)."""
    _check_points("random_walk", points)
    row = _row("random_walk: sigmas", sigmas)
    if bool((row < 0).any()):
        raise ValueError(f"random_walk: sigmas must be >= 0, got {tuple(sigmas)}")
    moves = torch.randn(points, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    moves[0] = 0
    return (moves * row).cumsum(0)


def table(rows: Sequence[Sequence[float]] | Tensor) -> Tensor:
    """Given poses as a motion: (F, 3) numbers in px, px, rad. ValueError for another shape or a number not finite."""
    poses = torch.as_tensor(rows, dtype=torch.float64)
    if poses.dim() != 2 or poses.shape[1] != 3 or len(poses) == 0:
        raise ValueError(f"table: rows must be (F, 3) with F >= 1, got {tuple(poses.shape)}")
    if not bool(poses.isfinite().all()):
        raise ValueError("table: rows must be finite numbers")
    return poses


def placed(poses: Tensor, center: tuple[float, float]) -> Tensor:
    """The motion (F, 3) with the origin moved to the pixel ``center`` = (x, y) of the frame."""
    return poses + poses.new_tensor((*center, 0.0))


def from_rest(poses: Tensor, frames: int) -> Tensor:
    """The motion (F, 3) after a lead-in from rest at (0, 0, 0) to its first pose: (``frames`` + F, 3).

    The lead-in starts and ends without speed, like a stage; a template marked in the first frame is upright there.
    """
    if frames < 0:
        raise ValueError(f"from_rest: frames must be >= 0, got {frames}")
    s = torch.arange(frames, dtype=poses.dtype, device=poses.device) / max(1, frames)
    return torch.cat(((0.5 - 0.5 * (tau / 2 * s).cos())[:, None] * poses[:1], poses))


def velocity(poses: Tensor) -> Tensor:
    """Change of pose per frame, by central differences: (F, 3) -> (F, 3); zero for a single frame."""
    return torch.gradient(poses, dim=0)[0] if len(poses) > 1 else torch.zeros_like(poses)


def _check_points(name: str, points: int) -> None:
    if points < 1:
        raise ValueError(f"{name}: the number of points must be at least 1, got {points}")


def _row(name: str, values: Pose) -> Tensor:
    row = torch.as_tensor(values, dtype=torch.float64)
    if row.shape != (3,) or not bool(row.isfinite().all()):
        raise ValueError(f"{name} must be three finite numbers (px, px, rad), got {values}")
    return row
