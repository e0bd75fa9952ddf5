"""Speckle: round Gaussian spots, as sprayed patterns for DIC, grains and dust."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_ecc.core.pose import transform
from torch_ecc.sim.scene.footprint import footprint

REACH = 5.0  # sigmas from its centre after which a spot is not drawn: 4e-6 of its level
CHUNK = 1 << 20  # spots times points worked on at once


@dataclass(frozen=True, eq=False)
class Speckle:
    """``base`` + sum of level exp(-r^2 / (2 sigma^2)) over N spots.

    ``centers`` (N, 2) px in the scene, ``sigmas`` (N,) px, ``levels`` (N,) grey levels (negative is dark); float64.
    """

    centers: Tensor
    sigmas: Tensor
    levels: Tensor
    base: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.centers)
        if self.centers.shape != (count, 2) or self.sigmas.shape != (count,) or self.levels.shape != (count,):
            shapes = [tuple(t.shape) for t in (self.centers, self.sigmas, self.levels)]
            raise ValueError(f"Speckle: centers, sigmas, levels must be (N, 2), (N,), (N,), got {shapes}")
        if not bool((self.sigmas > 0).all()):
            raise ValueError(f"Speckle: sigmas must be > 0, got {float(self.sigmas.min())}")

    @classmethod
    def random(
        cls,
        count: int = 20000,
        *,
        extent: float = 1500.0,
        sigmas: tuple[float, float] = (1.8, 2.6),
        level: float = -38.0,
        base: float = 210.0,
        seed: int = 0,
    ) -> Speckle:
        """``count`` spots of ``level`` grey levels each, anywhere in a square of side ``extent`` px.

        Their sizes lie between the two ``sigmas`` in px. ValueError for counts or sizes that are not positive.
        """
        if count < 1 or not extent > 0 or not 0 < sigmas[0] <= sigmas[1]:
            raise ValueError(
                "Speckle.random: count must be >= 1, extent > 0 and sigmas 0 < low <= high, "
                f"got {count}, {extent}, {sigmas}"
            )
        g = torch.Generator().manual_seed(seed)
        x, y, size = torch.rand(3, count, generator=g, dtype=torch.float64)
        centers = extent * (torch.stack((x, y), 1) - 0.5)
        return cls(centers, sigmas[0] + (sigmas[1] - sigmas[0]) * size, torch.full_like(size, level), base)

    def value(self, points: Tensor) -> Tensor:
        """Grey levels at scene points: (..., 2) float64 px -> (...) float64."""
        flat = points.reshape(-1, 2)
        parts = [self._spots(some)[0].sum(-1) for some in flat.split(max(1, CHUNK // len(self.centers)))]
        return self.base + torch.cat(parts).reshape(points.shape[:-1])

    def gradient(self, points: Tensor) -> Tensor:
        """Exact gradient at scene points, grey levels per px: (..., 2) -> (..., 2)."""
        parts = []
        for some in points.reshape(-1, 2).split(max(1, CHUNK // len(self.centers))):
            spots, offsets = self._spots(some)
            parts.append(-((spots / self.sigmas.to(some) ** 2)[..., None] * offsets).sum(-2))
        return torch.cat(parts).reshape(points.shape)

    def _spots(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Each spot's own value and the offset from it: (P, 2) -> (P, N), (P, N, 2)."""
        offsets = points[:, None] - self.centers.to(points)
        spread = (-offsets.square().sum(-1) / (2 * self.sigmas.to(points) ** 2)).exp()
        return self.levels.to(points) * spread, offsets

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """Frames of ``size`` = (h, w) at poses (B, 3): (B, 1, h, w) float32 on the poses' device."""
        frames = torch.full((len(poses), size[0] * size[1]), self.base, dtype=torch.float32, device=poses.device)
        centers, sigmas = self.centers.to(poses.device), self.sigmas.to(poses.device)
        levels, narrow = self.levels.to(poses.device).float(), (-0.5 / sigmas**2).float()
        for frame, pose in zip(frames, poses.double(), strict=True):
            # A spot is round: its box stays upright in the frame.
            upright = torch.nn.functional.pad(transform(pose, centers), (0, 1))
            for box, pixel, x, y in footprint(upright, (REACH * sigmas)[:, None].expand(-1, 2), size):
                spots = (narrow.index_select(0, box) * (x * x + y * y)).exp_()
                frame.index_add_(0, pixel, spots * levels.index_select(0, box))
        return frames.reshape(-1, 1, *size)
