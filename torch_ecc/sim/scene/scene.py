"""What a scene is, and sums of scenes.

A scene is a grey-level function of stage coordinates x' = (x', y'): px, x' right, y' down, the origin at the centre of
the template. Grey levels are on a nominal 0..255 scale. ``pose = (x, y, theta)`` (see ``torch_ecc.pose``) puts it into
a frame: I(x) = scene(W(p)^-1 x), so that pose x, y is the pixel where the scene's origin appears.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torch_ecc.sim.scene.pads import Pads
from torch_ecc.sim.scene.speckle import Speckle
from torch_ecc.sim.scene.waves import PlaneWaves

__all__ = ["Pads", "PlaneWaves", "Scene", "Speckle", "Sum"]


class Rendered(Protocol):
    """Anything that a camera can be put before."""

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """Frames of ``size`` = (h, w) at poses (B, 3): (B, 1, h, w) float32 on the poses' device."""
        ...


class Scene(Rendered, Protocol):
    """Anything with an exact value and gradient at real coordinates and a fast rendering of the same function."""

    def value(self, points: Tensor) -> Tensor:
        """Grey levels at scene points: (..., 2) float64 px -> (...) float64."""
        ...

    def gradient(self, points: Tensor) -> Tensor:
        """Gradient at scene points, grey levels per px: (..., 2) float64 -> (..., 2) float64."""
        ...


@dataclass(frozen=True)
class Sum:
    """The sum of scenes: layers of a micrograph, or a scene and its grain."""

    parts: tuple[Scene, ...]

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("Sum: parts must hold at least one scene, got none")

    def value(self, points: Tensor) -> Tensor:
        """(..., 2) -> (...)."""
        return torch.stack([part.value(points) for part in self.parts]).sum(0)

    def gradient(self, points: Tensor) -> Tensor:
        """(..., 2) -> (..., 2)."""
        return torch.stack([part.gradient(points) for part in self.parts]).sum(0)

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """(B, 3) -> (B, 1, h, w)."""
        frames = self.parts[0].render(poses, size)
        for part in self.parts[1:]:
            frames = frames + part.render(poses, size)
        return frames
