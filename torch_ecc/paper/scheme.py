"""The paper's simulation scheme (section IV-A.1): a micrograph, its light, its motion and where templates are cut."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc import sim
from torch_ecc.core.pose import compose, inverse
from torch_ecc.core.reference import MARGIN

SIZE = 121  # px, side of the paper's template
FRAME = (480, 640)  # (h, w) px
CENTRE = (320.0, 240.0)  # px, where the motion has its middle
GAIN = 0.75  # exposure of the sequences of Fig. 3: the brightest spot of the uneven light stays below white
LAMP = sim.Lights((sim.VignetteLight(0.4), sim.GradientLight(0.5, 0.3)))  # a lamp off the axis, behind a lens
SURROUND = 150.0  # px, Gaussian of the Retinex surround: wider than any block of the micrograph


@dataclass(frozen=True)
class Harmonic:
    """Eq. (11): ``amplitude`` px in x and y and ``degrees`` in theta, ``points`` in a cycle."""

    amplitude: float = 20.0
    degrees: float = 5.0
    points: int = 40

    def path(self, size: tuple[int, int] = FRAME) -> Tensor:
        """Poses (points, 3) px, px, rad of the scene about the middle of a frame (h, w)."""
        turn = math.radians(self.degrees)
        return sim.placed(sim.harmonic((self.amplitude, self.amplitude, turn), self.points), (size[1] / 2, size[0] / 2))

    def closed(self, size: tuple[int, int] = FRAME) -> Tensor:
        """The same (points + 1, 3), begun with the pose that they end with."""
        path = self.path(size)
        return torch.cat((path[-1:], path))

    def __str__(self) -> str:
        return f"{self.amplitude:g} px, {self.degrees:g} deg, Nop {self.points}"


TEXT = Harmonic(100.0, 20.0, 160)  # as the text has it
CAPTION = Harmonic(100.0, 12.0, 200)  # as the caption of Fig. 2 has it


class Cut(NamedTuple):
    """Where templates are cut: ``pose`` (3,), of many images (F, 3), of the scene in the image they are cut from, and
    their own ``start`` (3,) in that image, upright and on whole pixels."""

    pose: Tensor
    start: Tensor

    def truth(self, path: Tensor) -> Tensor:
        """Exact poses (F, 3) of the template when the scene moves along ``path`` (F, 3)."""
        return compose(path, self.place().expand_as(path))

    def place(self) -> Tensor:
        """Poses of the templates in the scene, (3,) or (F, 3) as ``pose`` is."""
        return compose(inverse(self.pose), self.start.expand_as(self.pose))

    def template(self, image: Tensor, size: int = SIZE) -> Tensor:
        """The template (..., size + 2 MARGIN, size + 2 MARGIN) of images (..., h, w), with its surroundings."""
        reach = size // 2 + MARGIN
        x, y = self.start[:2].long().tolist()
        return image[..., y - reach : y + reach + size % 2, x - reach : x + reach + size % 2]


def cut_first(path: Tensor) -> Cut:
    """Templates cut from the first frame of a sequence, light and noise included (Algorithm 1, line 3)."""
    return Cut(path[0], path[0].round() * path.new_tensor((1.0, 1.0, 0.0)))


def cut_reflected() -> Cut:
    """Templates cut from the middle of the evenly lit image (text of section IV-A.1, Fig. 2(b))."""
    middle = torch.tensor((*CENTRE, 0.0), dtype=torch.float64)
    return Cut(middle, middle)


def scene() -> sim.Scene:
    """What the reflected component shows, known exactly everywhere: the default micrograph."""
    return sim.micrograph()


def original() -> Tensor:
    """Fig. 2(a): the micrograph under uneven light, (1, 1, 480, 640) uint8."""
    return sim.Camera(size=FRAME, light=LAMP).capture(scene(), cut_reflected().pose[None])


def components() -> sim.Retinex:
    """Fig. 2(b), (c): reflected and incident component of the original, (1, 1, 480, 640) each."""
    return sim.single_scale(original().float(), SURROUND)


def uneven_light() -> sim.FieldLight:
    """The incident component of the original as the light of a sequence: it stays with the camera."""
    return sim.FieldLight(components().incident[0, 0])


class Kept(NamedTuple):
    """A scene rendered once: ``frames`` (1 or B, 1, H, W) stand for its rendering at the same pose or poses, for
    any number of cameras and draws of the noise."""

    frames: Tensor

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """The middle (B, 1, h, w) of the frames kept, for B poses."""
        top, left = ((have - want) // 2 for have, want in zip(self.frames.shape[-2:], size, strict=True))
        return self.frames[:, :, top : top + size[0], left : left + size[1]].expand(len(poses), -1, -1, -1)
