"""Things between the stage and the lens: a probe tip, a hair, a hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

EDGE = 1.0  # px over which an occluder's rim goes from clear to opaque


@dataclass(frozen=True)
class Occluder:
    """An opaque ellipse or rectangle in frame coordinates that may cross the frame.

    In frame i its centre is at ``center`` + i ``velocity``, px and px per frame; ``half_size`` is (x, y) px; ``level``
    its grey level before the light. It is there in the frames ``first`` <= i < ``last`` (None: to the end).
    """

    center: tuple[float, float]
    half_size: tuple[float, float]
    level: float = 30.0
    velocity: tuple[float, float] = (0.0, 0.0)
    shape: Literal["ellipse", "rectangle"] = "rectangle"
    first: int = 0
    last: int | None = None

    def __post_init__(self) -> None:
        if not min(self.half_size) > 0:
            raise ValueError(f"Occluder: half_size must be > 0, got {self.half_size}")
        if self.shape not in ("ellipse", "rectangle"):
            raise ValueError(f"Occluder: shape must be 'ellipse' or 'rectangle', got {self.shape!r}")

    def cover(self, frames: Tensor, indices: Tensor) -> Tensor:
        """Frames ``indices`` (B,) with the occluder in them: (B, 1, h, w) -> (B, 1, h, w)."""
        alpha = self._opacity(indices, (frames.shape[-2], frames.shape[-1]))
        return torch.lerp(frames, torch.full_like(frames, self.level), alpha)

    def _opacity(self, indices: Tensor, size: tuple[int, int]) -> Tensor:
        """(B,) -> (B, 1, h, w) in [0, 1]."""
        i = indices[:, None, None, None].float()
        x = torch.arange(size[1], device=i.device) - (self.center[0] + i * self.velocity[0])
        y = torch.arange(size[0], device=i.device)[:, None] - (self.center[1] + i * self.velocity[1])
        x, y = (x / self.half_size[0]).abs(), (y / self.half_size[1]).abs()
        radius = torch.hypot(x, y) if self.shape == "ellipse" else torch.maximum(x, y)
        there = (i >= self.first) if self.last is None else (i >= self.first) & (i < self.last)
        return (0.5 + (1 - radius) * min(self.half_size) / EDGE).clamp(0, 1) * there
