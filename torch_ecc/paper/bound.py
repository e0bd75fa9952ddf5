"""The least scatter that any unbiased tracker can have on a scene: the Cramer-Rao bound, and what rounding leaves to
one that knows the scene."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.pose import inverse, rotation, transform
from torch_ecc.sim import Scene
from torch_ecc.sim.camera.sensor import WHITE

NUDGE = 1 / 64  # px: half the base of the difference quotients below
SETTLED = 1e-6  # px: the last step of an oracle that has its answer
STEPS = 30  # at most; it takes two or three from nearby


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


def oracle(scene: Scene, frame: Tensor, start: Tensor, size: tuple[int, int]) -> Tensor:
    """The pose (3,) px, px, rad at which ``scene``, known exactly, fits a ``frame`` (H, W) best: least squares.

    Only the pose is unknown, no template was ever rounded and nothing is interpolated. Of the frame, uint8, uint16 or
    grey levels of 0..255, counts what a template (h, w) at ``start`` (3,), some tenths of a px off, covers.
    Gauss-Newton steps with the slopes at ``start``.
    """
    half = start.new_tensor(size[::-1]) / 2
    turn = torch.stack((start[2].cos().abs(), start[2].sin().abs()))
    reach = torch.stack((turn @ half, turn.flip(0) @ half))
    (left, top), (right, bottom) = ((start[:2] + side * (reach + 1)).long().clamp(min=0).tolist() for side in (-1, 1))
    level = 1.0 if frame.is_floating_point() else WHITE / torch.iinfo(frame.dtype).max
    frame, pose = level * frame[top : bottom + 1, left : right + 1].double(), start - start.new_tensor((left, top, 0.0))
    grid = torch.cartesian_prod(*(torch.arange(n, dtype=start.dtype) for n in frame.shape)).flip(-1)
    covered = (transform(inverse(pose), grid).abs() <= half).all(-1)
    grid, seen = grid[covered], frame.flatten()[covered]
    nudge = NUDGE * start.new_tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    around, (x, y) = _values(scene, pose + nudge, frame, covered), (grid - pose[:2]).unbind(-1)
    gx, gy = ((around[k] - around[k + 1]) / (2 * NUDGE) for k in (0, 2))
    J = torch.stack((gx, gy, gx * y - gy * x), -1)  # of the frame by the pose, eq. (2)
    fit = torch.linalg.solve(J.mT @ J, J.mT)
    for _ in range(STEPS):
        step = fit @ (seen - _values(scene, pose[None], frame, covered)[0])
        pose = pose + step
        if float(step[:2].abs().max()) < SETTLED:
            break
    return pose + start.new_tensor((left, top, 0.0))


def _values(scene: Scene, poses: Tensor, frame: Tensor, covered: Tensor) -> Tensor:
    """What a ``frame`` (H, W) of ``scene`` at ``poses`` (n, 3) shows where ``covered`` (H W,): (n, N) float64."""
    return scene.render(poses, (frame.shape[0], frame.shape[1])).flatten(1)[:, covered].double()
