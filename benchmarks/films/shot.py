"""A scene before a camera, and the film of it: the pictures, the truth, and the least error that they leave."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import transform, turn
from torch_ecc.paper.bound import jacobian, rounding
from torch_ecc.paper.scheme import FRAME, SIZE
from torch_ecc.sim import Camera, Pads, PlaneWaves, Scene, Speckle, micrograph
from torch_ecc.sim.camera import sensor

NOISE = 2.0  # grey levels
CYCLE = 40  # frames of eq. (11)
FIRST, LAST = 5, 32  # of the frames in which most disturbances last: first <= frame < last
REACH = 0.75  # of the template's side: farther from its centre spots do not count for its bound

SCENES: dict[str, Callable[[int], Scene]] = {
    "waves": lambda seed: PlaneWaves.random(seed=seed),
    "pads": lambda seed: Pads.wafer(seed=seed),
    "speckle": lambda seed: Speckle.random(seed=seed),
    "micrograph": micrograph,
}


def eq11(time: Tensor, center: tuple[float, float] = (320.0, 240.0)) -> Tensor:
    """Poses (..., 3) of eq. (11) with 20 px and 5 deg at ``time`` (...) in frames; upright, on a whole pixel at 0."""
    swing = (math.tau * time / CYCLE).cos()
    x, y = (c + 20 * swing for c in center)
    return torch.stack((x, y, math.radians(5) * (swing - 1)), -1)


def frames(count: int = CYCLE) -> Tensor:
    """Times of ``count`` frames."""
    return torch.arange(count, dtype=torch.float64)


class Film(NamedTuple):
    """``frames`` (F + 1, 1, h, w) uint8; R patches of ``size`` px at ``centers`` (R, 2) of the first one.

    Of the other frames: ``truth`` (F, R, 3) px, px, rad; what share of a patch is ``seen`` (F, R); the Cramer-Rao
    ``bound`` (F, R, 3) px, px, rad of that, NaN where nobody knows it; ``clear`` of F, from which on nothing disturbs.
    ``options`` of the tracker.
    """

    frames: Tensor
    centers: Tensor
    size: int
    truth: Tensor
    seen: Tensor
    bound: Tensor
    clear: int
    options: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Shot:
    """A ``scene`` along ``path`` (F + 1, 3) px, px, rad; a template of ``size`` px where its origin is at first."""

    scene: Scene
    seed: int = 0
    path: Tensor = field(default_factory=lambda: eq11(frames()))
    size: int = SIZE
    frame: tuple[int, int] = FRAME

    @cached_property
    def clean(self) -> Tensor:
        """The pictures before the sensor: (F + 1, 1, h, w) float32 grey levels."""
        return self.taken()

    @cached_property
    def slopes(self) -> tuple[Tensor, Tensor]:
        """The template (N,) and its Jacobian (N, 3) by x, y, theta, free of noise."""
        return jacobian(_near(self.scene, self.size), (self.size, self.size))

    def taken(self, **settings: Any) -> Tensor:
        """The pictures of a camera with other ``settings``."""
        camera, step = Camera(size=self.frame, bits=None, **settings), torch.gradient(self.path, dim=0)[0]
        parts = zip(self.path.split(4), step.split(4), strict=True)
        return torch.cat([camera.capture(self.scene, some, velocities=v) for some, v in parts])

    def moved(self, path: Tensor) -> Shot:
        """The same scene on another path."""
        return replace(self, path=path)

    def during(self, image: Tensor) -> Tensor:
        """The clean pictures, but in the frames FIRST to LAST those of ``image`` (F + 1, 1, h, w)."""
        return torch.cat((self.clean[:FIRST], image[FIRST:LAST], self.clean[LAST:]))

    def patch(self, image: Tensor) -> Tensor:
        """The template's pixels (n, n) in the first of the pictures ``image``."""
        (x, y), n = self.path[0, :2].long().tolist(), self.size // 2
        return image[0, 0, y - n : y + n + 1, x - n : x + n + 1]

    def inside(self, mask: Tensor) -> Tensor:
        """Which pixels (F + 1, N) of the template see what the frames' ``mask`` (F + 1, 1, h, w) has true."""
        x, y = transform(self.path, grid(self.size)).round().long().unbind(-1)
        h, w = mask.shape[-2:]
        there = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        return mask[torch.arange(len(mask))[:, None], 0, y.clamp(0, h - 1), x.clamp(0, w - 1)] & there

    def film(self, image: Tensor, hidden: Tensor | None = None, *, noise: float = NOISE, **changes: Any) -> Film:
        """The film of the pictures ``image`` (F + 1, 1, h, w) with white noise, of which the target is ``hidden`` (a
        mask of the same shape); with ``changes`` of other fields."""
        film = self.sensed(sense(image, self.seed, noise), hidden, noise**2 + rounding(8))
        return film._replace(**changes)

    def sensed(self, shown: Tensor, hidden: Tensor | None = None, variance: float | Tensor = math.nan) -> Film:
        """The film of the frames ``shown`` (F + 1, 1, h, w) uint8, each with noise of ``variance``, () or (N,).

        What is hidden in the first frame is no part of the template.
        """
        open_ = torch.ones(shown.shape, dtype=torch.bool) if hidden is None else ~hidden
        seen = self.inside(open_.expand(shown.shape))
        bound = visible_bound(*self.slopes, (seen[1:] & seen[0]) / (2 * torch.as_tensor(variance)))
        axes, share = turn(self.path[1:, 2]), seen[1:].double().mean(1)
        sigma = (axes @ bound @ axes.mT).diagonal(dim1=1, dim2=2).sqrt()
        whole = (share >= share.max()) & (share.min() < share.max())
        clear = len(share) - int(whole.flip(0).cumprod(0).sum())
        truth = self.path[1:, None]
        return Film(shown, self.path[:1, :2], self.size, truth, share[:, None], sigma[:, None], clear)


def sense(image: Tensor, seed: int, noise: float = NOISE) -> Tensor:
    """White noise and rounding: (F, 1, h, w) float32 -> uint8."""
    return sensor.quantise(each(image, seed, partial(sensor.read, sigma=noise)), 8)


def each(image: Tensor, seed: int, change: Callable[..., Tensor]) -> Tensor:
    """Every picture changed by ``change(picture, source=generator)``, each with random numbers of its own."""
    return torch.stack([change(one, source=sensor.generator(seed, k)) for k, one in enumerate(image)])


@cache
def grid(size: int) -> Tensor:
    """The pixels (N, 2) of a template, from its centre."""
    row = torch.arange(size, dtype=torch.float64) - (size - 1) / 2
    y, x = torch.meshgrid(row, row, indexing="ij")
    return torch.stack((x.flatten(), y.flatten()), -1)


def visible_bound(template: Tensor, J: Tensor, weight: Tensor) -> Tensor:
    """The Cramer-Rao bound, covariances (F, 3, 3), of a ``template`` (N,) with Jacobian ``J`` (N, 3) whose pixels count
    by ``weight`` (F, N), one over the variance of their noise; infinite where the pose stays open. Gain and offset are
    unknown."""
    columns = torch.cat((J, torch.ones_like(J[:, :1]), (template - template.mean())[:, None]), 1)
    products = (columns[:, :, None] * columns[:, None, :]).flatten(1)
    gram = (weight.to(products) @ products).view(-1, 5, 5)
    known = ~gram.isnan().flatten(1).any(1)
    gram = torch.where(known[:, None, None], gram, 0.0)
    along = gram[:, :3, 3:]
    information = gram[:, :3, :3] - along @ torch.linalg.pinv(gram[:, 3:, 3:], hermitian=True) @ along.mT
    bound, failed = torch.linalg.inv_ex(information)
    closed = (failed == 0) & (bound.diagonal(dim1=1, dim2=2) > 0).all(1)
    bound = torch.where(closed[:, None, None], bound, math.inf)
    return torch.where(known[:, None, None], bound, math.nan)


def _near(scene: Scene, size: int) -> Scene:
    """Of a speckle the spots that a template at the origin can see: thousands of others cost seconds."""
    if not isinstance(scene, Speckle):
        return scene
    near = scene.centers.abs().amax(1) < REACH * size
    return Speckle(scene.centers[near], scene.sigmas[near], scene.levels[near], scene.base)
