"""Scatter against the Cramer-Rao bound on analytic scenes, honesty of the covariance, and the least that anyone has."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.align import align
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.pose import inverse, transform
from torch_ecc.core.reference import MARGIN
from torch_ecc.paper.bound import cramer_rao, rounding
from torch_ecc.paper.errors import rms
from torch_ecc.paper.methods import prepared
from torch_ecc.paper.scheme import SIZE, Cut
from torch_ecc.sim import Camera, Scene
from torch_ecc.sim.camera.sensor import WHITE

NUDGE = 1 / 64  # px: half the base of the oracle's difference quotients
SETTLED = 1e-6  # px: the last step of an oracle that has its answer
STEPS = 30  # at most; it takes two or three from nearby
BATCH = 50  # pairs that are aligned at once
ROOM = 40  # px that a frame is larger than the template and its surroundings, on each side
FRAME = SIZE + 2 * MARGIN + 2 * ROOM
MIDDLE = torch.tensor([FRAME // 2, FRAME // 2, 0], dtype=torch.float64)


@dataclass(frozen=True)
class Draws:
    """Random pairs of template and frame, both drawn anew each time.

    ``noise`` in grey levels, ``count`` pairs, displacements up to 10 px in x and y and, with ``turn``, any angle;
    ``bits`` of the camera, None for no rounding.
    """

    noise: float = 0.0
    count: int = 250
    turn: bool = True
    interpolation: str = "bspline3"
    bits: int | None = 8
    seed: int = 0


class Pairs(NamedTuple):
    """Where templates are cut in the ``first`` frames, poses (n, 3) of the scene in the ``next`` ones, both frames
    (n, 1, H, W)."""

    cut: Cut
    pose: Tensor
    first: Tensor
    next: Tensor

    @property
    def truth(self) -> Tensor:
        """Poses (n, 3) of the templates in the next frames."""
        return self.cut.truth(self.pose)


def pairs(scene: Scene, draws: Draws) -> Iterator[Pairs]:
    """The pairs of ``draws``, some at a time: templates at random sub-pixel places, frames at random poses."""
    generator = torch.Generator().manual_seed(draws.seed)
    phase, shift = torch.rand(2, draws.count, 3, generator=generator, dtype=torch.float64) - 0.5
    first = MIDDLE + phase * torch.tensor([1.0, 1.0, 0.0])
    second = first + shift * torch.tensor([20.0, 20.0, math.tau if draws.turn else 0.0])
    camera = Camera(size=(FRAME, FRAME), noise_sigma=draws.noise, bits=draws.bits)
    for k in range(0, draws.count, BATCH):
        a, b = first[k : k + BATCH], second[k : k + BATCH]
        seen = (camera.capture(scene, p, seed=2 * draws.seed + i, first=k) for i, p in enumerate((a, b)))
        yield Pairs(Cut(a, MIDDLE), b, *seen)


class Scatter(NamedTuple):
    """Pose errors (draws, 3) px, px, rad, their normalised squares over 3 (draws,), the bound (3,), iterations and
    status (draws,)."""

    error: Tensor
    nees: Tensor
    bound: Tensor
    iterations: Tensor
    status: Tensor

    @property
    def ratio(self) -> Tensor:
        """Root mean square error over the Cramer-Rao bound, (3,)."""
        return rms(self.error) / self.bound


def scatter(scene: Scene, draws: Draws) -> Scatter:
    """Align all pairs of ``draws``."""
    return by_sampler(scene, draws, (draws.interpolation,))[draws.interpolation]


def by_sampler(scene: Scene, draws: Draws, samplers: tuple[str, ...]) -> dict[str, Scatter]:
    """``scatter`` of the same pairs with each of the ``samplers``."""
    found: dict[str, list[Estimate]] = {name: [] for name in samplers}
    truth = []
    for pair in pairs(scene, draws):
        near = pair.truth + torch.tensor([0.3, -0.3, math.radians(0.17)])
        reference = prepared(pair.cut.template(pair.first), {})
        for name, estimates in found.items():
            estimates.append(align(reference, pair.next, near, interpolation=name))
        truth.append(pair.truth)
    bound = cramer_rao(scene, (SIZE, SIZE), 2 * (draws.noise**2 + rounding(draws.bits)))
    return {name: _summary(estimates, torch.cat(truth), bound) for name, estimates in found.items()}


def _summary(estimates: list[Estimate], truth: Tensor, bound: Tensor) -> Scatter:
    found = Estimate(*(torch.cat(v) for v in zip(*estimates, strict=True)))
    error = found.pose - truth
    nees = (error[:, None] @ torch.linalg.solve(found.covariance, error[:, :, None])).flatten() / 3
    return Scatter(error, nees, bound, found.iterations, found.status)


def least(scene: Scene, draws: Draws) -> Tensor:
    """Pose errors (draws, 3) px, px, rad on the pairs of ``draws`` of one who knows the scene: all that rounding and
    noise leave to least squares. The scene is fitted to either frame, and one pose taken relative to the other."""
    errors = []
    for pair in pairs(scene, draws):
        first, second = (
            torch.stack([oracle(scene, f[0], p, (SIZE, SIZE)) for f, p in zip(frames, poses, strict=True)])
            for frames, poses in ((pair.first, pair.cut.pose), (pair.next, pair.pose))
        )
        errors.append(Cut(first, MIDDLE).truth(second) - pair.truth)
    return torch.cat(errors)


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
