"""Lithographic scenes: sharp rectangles seen through a Gaussian point-spread function, exactly.

A rectangle blurred by a Gaussian is a product of two differences of error functions in the rectangle's own axes, at
any angle. Levels add up; rectangles that share an edge join without a seam.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import pi, sqrt

import torch
from torch import Tensor

from torch_ecc.core.pose import compose, inverse, rotation, transform
from torch_ecc.sim.scene.footprint import footprint
from torch_ecc.sim.scene.layout import Rectangle, wafer

REACH = 5.0  # sigmas beyond an edge after which a rectangle is not drawn: 3e-7 of its level
EXACT_REACH = 9.0  # the same for value() and gradient(): 1e-19 of its level
CHUNK = 512  # points worked on at once by value() and gradient(), with the rectangles near them


@dataclass(frozen=True, eq=False)
class Pads:
    """``base`` plus N rectangles blurred by a Gaussian of ``sigma`` px.

    ``poses`` (N, 3) rectangle -> scene, ``half_sizes`` (N, 2) px, ``levels`` (N,) grey levels; all float64.
    """

    poses: Tensor
    half_sizes: Tensor
    levels: Tensor
    sigma: float = 1.0
    base: float = 0.0

    def __post_init__(self) -> None:
        if not self.sigma > 0:
            raise ValueError(f"Pads: sigma must be > 0, got {self.sigma}")
        count = len(self.poses)
        if self.poses.shape != (count, 3) or self.half_sizes.shape != (count, 2) or self.levels.shape != (count,):
            shapes = [tuple(t.shape) for t in (self.poses, self.half_sizes, self.levels)]
            raise ValueError(f"Pads: poses, half_sizes, levels must be (N, 3), (N, 2), (N,), got {shapes}")

    @classmethod
    def of(cls, rectangles: Iterable[Rectangle], *, sigma: float = 1.0, base: float = 0.0) -> Pads:
        """A scene of ``rectangles`` on a background of ``base`` grey levels."""
        rows = torch.tensor([tuple(r) for r in rectangles], dtype=torch.float64).reshape(-1, 6)
        return cls(rows[:, (0, 1, 5)], rows[:, 2:4] / 2, rows[:, 4], sigma, base)

    @classmethod
    def wafer(cls, *, pitch: float = 90.0, contrast: float = 70.0, sigma: float = 1.0, seed: int = 0) -> Pads:
        """Bright pads on a grid, joined by a few lines: large flat areas and few edges, hard for a tracker.

        ``pitch`` px between pads, ``contrast`` grey levels of the pads over the substrate. Covers 1500 x 1500 px.
        ValueError if pitch or sigma is not positive.
        """
        return cls.of(wafer(pitch, contrast, seed), sigma=sigma, base=100.0)

    def value(self, points: Tensor) -> Tensor:
        """Grey levels at scene points: (..., 2) float64 px -> (...) float64."""
        flat = points.reshape(-1, 2)
        parts = [self._near(some)._value(some) for some in flat.split(CHUNK)]
        return self.base + torch.cat([flat.new_empty(0), *parts]).reshape(points.shape[:-1])

    def gradient(self, points: Tensor) -> Tensor:
        """Exact gradient at scene points, grey levels per px: (..., 2) -> (..., 2)."""
        flat = points.reshape(-1, 2)
        parts = [self._near(some)._gradient(some) for some in flat.split(CHUNK)]
        return torch.cat([flat.new_empty(0, 2), *parts]).reshape(points.shape)

    def _near(self, points: Tensor) -> Pads:
        """The rectangles that double precision can see at any of the points (P, 2)."""
        centers, half = self.poses[:, :2].to(points), self.half_sizes.to(points)
        reach = half.norm(dim=1, keepdim=True) + EXACT_REACH * self.sigma
        low, high = points.detach().amin(0) - reach, points.detach().amax(0) + reach
        near = ((centers >= low) & (centers <= high)).all(1)
        return Pads(self.poses.to(points)[near], half[near], self.levels.to(points)[near], self.sigma)

    def _value(self, points: Tensor) -> Tensor:
        """The sum of all rectangles: (P, 2) -> (P,)."""
        local = transform(inverse(self.poses), points)
        x, y = (_band(local[..., i], self.half_sizes[:, None, i], self.sigma) for i in (0, 1))
        return self.levels @ (x * y)

    def _gradient(self, points: Tensor) -> Tensor:
        """Its gradient: slopes along each rectangle's own axes, turned into the scene: (P, 2) -> (P, 2)."""
        local, half = transform(inverse(self.poses), points), self.half_sizes[:, None]
        x, y = (_band(local[..., i], half[..., i], self.sigma) for i in (0, 1))
        dx, dy = (_slope(local[..., i], half[..., i], self.sigma) for i in (0, 1))
        turn = self.levels[:, None, None] * rotation(self.poses[:, 2])
        return (turn[..., 0].mT @ (dx * y) + turn[..., 1].mT @ (x * dy)).mT

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """Frames of ``size`` = (h, w) at poses (B, 3): (B, 1, h, w) float32 on the poses' device."""
        frames = torch.full((len(poses), size[0] * size[1]), self.base, dtype=torch.float32, device=poses.device)
        rectangles, half = self.poses.to(poses.device), self.half_sizes.to(poses.device)
        levels, single = self.levels.to(poses.device).float(), half.float()
        for frame, pose in zip(frames, poses.double(), strict=True):
            placed = compose(pose.expand_as(rectangles), rectangles)
            for box, pixel, x, y in footprint(placed, half + REACH * self.sigma, size):
                width, height, level = (values.index_select(0, box) for values in (*single.unbind(1), levels))
                frame.index_add_(0, pixel, _band(x, width, self.sigma) * _band(y, height, self.sigma) * level)
        return frames.reshape(-1, 1, *size)


def _band(x: Tensor, half: Tensor, sigma: float) -> Tensor:
    """The interval |x| <= half blurred by a Gaussian: 1 inside, 0 outside."""
    scale = 1 / (sqrt(2) * sigma)
    return 0.5 * (torch.erf((x + half) * scale) - torch.erf((x - half) * scale))


def _slope(x: Tensor, half: Tensor, sigma: float) -> Tensor:
    """Derivative of ``_band`` by x, per px."""
    left, right = (x + half) / sigma, (x - half) / sigma
    return ((-0.5 * left**2).exp() - (-0.5 * right**2).exp()) / (sqrt(2 * pi) * sigma)
