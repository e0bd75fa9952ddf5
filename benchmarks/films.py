"""Films of hostile conditions: a scene before a camera, what is done to the picture, and the truth that stays known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import compose, inverse, transform, turn
from torch_ecc.paper.bound import jacobian, rounding
from torch_ecc.paper.scheme import FRAME, SIZE, Harmonic
from torch_ecc.sim import Camera, Pads, PlaneWaves, Scene, Speckle, micrograph
from torch_ecc.sim.camera import sensor

NOISE = 2.0  # grey levels
REACH = 0.75  # of the template's side: beyond it spots do not count for its bound


def eq11(frames: int = 40, amplitude: float = 20.0, degrees: float = 5.0) -> Tensor:
    """Poses (frames, 3) of eq. (11), of 40 in a cycle, turned so that the first one is upright, on a whole pixel."""
    path = Harmonic(amplitude, degrees, 40).closed()
    path = path[torch.arange(frames) % 40]
    return path - path[0] * path.new_tensor((0.0, 0.0, 1.0))


SCENES = {
    "waves": lambda seed: PlaneWaves.random(seed=seed),
    "pads": lambda seed: Pads.wafer(seed=seed),
    "speckle": lambda seed: Speckle.random(seed=seed),
    "micrograph": lambda seed: micrograph(seed),
}


class Film(NamedTuple):
    """``frames`` (F + 1, 1, h, w) uint8, R patches of ``size`` px at ``centers`` (R, 2) of the first one, their ``truth``
    (F, R, 3) px, px, rad in the others, what share of each is ``seen`` (F, R), the Cramer-Rao ``bound`` (F, R, 3) of
    that (NaN where nobody knows), the frame ``clear`` of F from which on nothing disturbs any more, and ``options`` of
    the tracker."""

    frames: Tensor
    centers: Tensor
    size: int
    truth: Tensor
    seen: Tensor
    bound: Tensor
    clear: int
    options: dict[str, Any] = {}  # noqa: RUF012 - never written to


@dataclass(frozen=True, eq=False)
class Shot:
    """A ``scene`` along ``path`` (F + 1, 3) px, px, rad, with a template of ``size`` px where its origin is at first."""

    scene: Scene
    seed: int = 0
    path: Tensor = eq11()  # noqa: RUF009 - never written to
    size: int = SIZE
    frame: tuple[int, int] = FRAME

    @cached_property
    def clean(self) -> Tensor:
        """The pictures before the sensor: (F + 1, 1, h, w) float32 grey levels."""
        return self.taken(Camera(size=self.frame, bits=None))

    @cached_property
    def slopes(self) -> tuple[Tensor, Tensor]:
        """The template (N,) and its Jacobian (N, 3) by x, y, theta, free of noise."""
        return jacobian(_near(self.scene, self.size), (self.size, self.size))

    def taken(self, camera: Camera) -> Tensor:
        """The same by another camera."""
        return torch.cat([camera.capture(self.scene, some, first=4 * k) for k, some in enumerate(self.path.split(4))])

    def moved(self, path: Tensor) -> Shot:
        """The same scene on another path."""
        return replace(self, path=path)

    def inside(self, mask: Tensor) -> Tensor:
        """Which pixels (F, N) of the template see what the frames' ``mask`` (F + 1, 1, h, w) has true."""
        place = transform(self.path[1:], grid(self.size)).round().long()
        x, y = place.unbind(-1)
        h, w = mask.shape[-2:]
        there = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        frame = torch.arange(1, len(mask))[:, None]
        return mask[frame, 0, y.clamp(0, h - 1), x.clamp(0, w - 1)] & there

    def film(self, image: Tensor, hidden: Tensor | None = None, *, noise: float = NOISE, **more: Any) -> Film:
        """The film of the pictures ``image`` (F + 1, 1, h, w) with white noise, of which the target is ``hidden`` (a
        mask of the same shape); ``more``: other fields."""
        film = self.sensed(sense(image, self.seed, noise), hidden, noise**2 + rounding(8))
        return film._replace(**more)

    def sensed(self, frames: Tensor, hidden: Tensor | None = None, variance: float = math.nan) -> Film:
        """The film of ``frames`` (F + 1, 1, h, w) uint8 with noise of ``variance``."""
        mask = torch.zeros(frames.shape, dtype=torch.bool) if hidden is None else hidden
        seen = self.inside(~mask)
        bound = visible_bound(*self.slopes, seen, 2 * variance)
        axes = turn(self.path[1:, 2])
        share, whole = seen.double().mean(1), seen.all(1)
        clear = len(share) - int(whole.flip(0).cumprod(0).sum())
        sigma = (axes @ bound @ axes.mT).diagonal(dim1=1, dim2=2).sqrt()
        return Film(frames, self.path[:1, :2], self.size, self.path[1:, None], share[:, None], sigma[:, None], clear)


def sense(image: Tensor, seed: int, noise: float = NOISE) -> Tensor:
    """White noise and rounding: (F, 1, h, w) float32 -> uint8."""
    noisy = [sensor.read(frame, noise, sensor.generator(seed, k)) for k, frame in enumerate(image)]
    return sensor.quantise(torch.stack(noisy), 8)


@cache
def grid(size: int) -> Tensor:
    """The pixels (N, 2) of a template, from its centre."""
    row = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    y, x = torch.meshgrid(row, row, indexing="ij")
    return torch.stack((x.flatten(), y.flatten()), -1)


def visible_bound(template: Tensor, J: Tensor, seen: Tensor, variance: float) -> Tensor:
    """The Cramer-Rao bound, covariances (F, 3, 3), of what is ``seen`` (F, N) of a ``template`` (N,) with Jacobian ``J``
    (N, 3); infinite where that leaves the pose open."""
    one = torch.ones_like(template)
    columns = torch.cat((J, one[:, None], (template - template.mean())[:, None]), 1)
    products = (columns[:, :, None] * columns[:, None, :]).flatten(1)
    gram = (seen.to(products) @ products).view(-1, 5, 5)
    A, B, C = gram[:, :3, :3], gram[:, :3, 3:], gram[:, 3:, 3:]
    information = A - B @ torch.linalg.pinv(C, hermitian=True) @ B.mT
    bound, failed = torch.linalg.inv_ex(information)
    open_ = (failed > 0) | ~(bound.diagonal(dim1=1, dim2=2) > 0).all(1)
    return variance * torch.where(open_[:, None, None], math.inf, bound)


def _near(scene: Scene, size: int) -> Scene:
    """Of a speckle the spots that a template at the origin can see: thousands of others cost seconds."""
    if not isinstance(scene, Speckle):
        return scene
    near = scene.centers.abs().amax(1) < REACH * size
    return Speckle(scene.centers[near], scene.sigmas[near], scene.levels[near], scene.base)


def placed_template(path: Tensor, center: Tensor) -> Tensor:
    """Where (F + 1, 3) an upright patch marked at ``center`` (2,) of the first frame goes."""
    start = torch.cat((center.double(), torch.zeros(1, dtype=torch.float64)))
    move = compose(path, inverse(path[:1]).expand_as(path))
    return compose(move, start.expand_as(path))
