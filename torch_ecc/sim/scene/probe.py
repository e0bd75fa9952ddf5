"""A probe over a substrate: an engraved metal head with three fingers, drawn exactly, in or out of focus."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_ecc.core.pose import compose, inverse, rotation, transform
from torch_ecc.sim.scene.layout import Rectangle
from torch_ecc.sim.scene.pads import Pads
from torch_ecc.sim.scene.scene import Scene

METAL = 62.0  # grey levels
FINGERS = ((-36.0, 0.0, 36.0), 40.0, 11.0)  # y' of their middles, length and width, px: ground, signal, ground
HEAD = (-20.0, 44.0, 52.0)  # x' from and to, half its width, px
SHAFT = (44.0, 900.0, 30.0)


@dataclass(frozen=True, eq=False)
class Probe:
    """Coordinates count from the middle of the head; the fingers point to -x'. ``tip`` (x', y') px is the middle one's.

    ``cover`` is 1 where the probe is, 0 elsewhere; ``colour`` is its grey levels times that. Both are blurred by
    ``sigma`` px in focus; dz um away from it the blur is (sigma^2 + (defocus dz)^2)^1/2, ``defocus`` in px per um.
    """

    cover: Pads
    colour: Pads
    tip: tuple[float, float]
    defocus: float = 0.08

    @classmethod
    def infinity(cls, *, scale: float = 1.0, sigma: float = 1.0, defocus: float = 0.08, seed: int = 0) -> Probe:
        """Ground, signal, ground; ``scale`` 1 makes a head of 64 x 104 px. The same ``seed`` is the same engraving."""
        if not (scale > 0 and defocus >= 0):
            raise ValueError(f"Probe: scale must be > 0 and defocus >= 0, got {scale} and {defocus}")
        outline = [_box(*HEAD[:2], -HEAD[2], HEAD[2]), _box(*SHAFT[:2], -SHAFT[2], SHAFT[2])]
        middles, length, width = FINGERS
        outline += [_box(HEAD[0] - length, HEAD[0], y - width / 2, y + width / 2) for y in middles]
        cover = [_scaled(box, scale) for box in outline]
        marks = [_scaled(box, scale) for box in _engraving(seed)]
        colour = [box._replace(level=METAL) for box in cover] + marks
        tip = (scale * (HEAD[0] - length), 0.0)
        return cls(Pads.of(cover, sigma=sigma), Pads.of(colour, sigma=sigma), tip, defocus)

    def over(self, substrate: Scene, relative: Tensor, dz: float) -> Covered:
        """The scene of both: the probe at the pose ``relative`` (3,) on the substrate, ``dz`` um out of focus."""
        sigma = (self.cover.sigma**2 + (self.defocus * dz) ** 2) ** 0.5
        return Covered(substrate, replace(self.cover, sigma=sigma), replace(self.colour, sigma=sigma), relative)


@dataclass(frozen=True, eq=False)
class Covered:
    """``below`` (1 - cover) + colour: a scene under an opaque part that lies at the pose ``relative`` (3,) on it."""

    below: Scene
    cover: Pads
    colour: Pads
    relative: Tensor

    def value(self, points: Tensor) -> Tensor:
        """Grey levels at scene points: (..., 2) -> (...)."""
        own = self._own(points)
        return self.below.value(points) * (1 - self.cover.value(own)) + self.colour.value(own)

    def gradient(self, points: Tensor) -> Tensor:
        """Exact gradient: (..., 2) -> (..., 2)."""
        own, turn = self._own(points), rotation(self.relative[2]).to(points).mT
        cover, colour = (part.gradient(own) @ turn for part in (self.cover, self.colour))
        seen = 1 - self.cover.value(own)[..., None]
        return self.below.gradient(points) * seen - self.below.value(points)[..., None] * cover + colour

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """Frames of ``size`` = (h, w) at poses (B, 3) of the scene below: (B, 1, h, w)."""
        own = compose(poses.double(), self.relative.to(poses.device).expand(len(poses), 3))
        seen = 1 - self.cover.render(own, size)
        return self.below.render(poses, size) * seen + self.colour.render(own, size)

    def _own(self, points: Tensor) -> Tensor:
        """Points in the part's coordinates."""
        return transform(inverse(self.relative).to(points), points.reshape(-1, 2)).reshape(points.shape)


def _box(left: float, right: float, top: float, bottom: float, level: float = 1.0) -> Rectangle:
    return Rectangle((left + right) / 2, (top + bottom) / 2, right - left, bottom - top, level, 0.0)


def _scaled(box: Rectangle, scale: float) -> Rectangle:
    x, y, width, height = (scale * value for value in box[:4])
    return box._replace(x=x, y=y, width=width, height=height)


def _engraving(seed: int) -> list[Rectangle]:
    """Bright and dark marks on the head, one per field of a 5 x 8 grid and never beyond it, and one on each finger."""
    g = torch.Generator().manual_seed(seed)
    left, right, half = HEAD
    marks = []
    for row in range(8):
        for column in range(5):
            x, y, width, height, level, there = torch.rand(6, generator=g).tolist()
            if there < 0.75:
                w, h = 3 + 6 * width, 3 + 7 * height
                cx = left + 6 + (column + 0.3 + 0.4 * x) * (right - left - 12) / 5
                cy = -half + 6 + (row + 0.3 + 0.4 * y) * (2 * half - 12) / 8
                marks.append(Rectangle(cx, cy, w, h, 110 * level - 20, 0.0))
    middles, length, width = FINGERS
    return marks + [_box(left - 0.8 * length, left - 3, y - width / 6, y + width / 6, 70.0) for y in middles]
