"""Surfaces that change, that stay, and that are read row by row, for templates that are to last."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional

from films.shot import NOISE, SCENES, sense
from torch_ecc.core.pose import inverse, transform
from torch_ecc.paper.bound import jacobian, rounding
from torch_ecc.sim import PlaneWaves, Scene
from torch_ecc.sim.camera import sensor

FRAME, CENTER, SIZE = (260, 280), (140.0, 130.0), 121
FADES = {"place by place": 0.5, "place by place, fast": 0.25}  # of the life, in which each place dissolves
CHANGES = ("dissolves", *FADES, "wave by wave", "patch by patch")
LIFE = 400  # frames
PATCH = 12  # px: side of what is replaced at once
PLACE = 24  # px from one place to the next
READ = 0.9  # of a frame's time, for all its rows


def wander(count: int) -> Tensor:
    """Poses (F, 3) over 9 px and 3 deg, upright on a whole pixel at first, that never lie alike between pixels."""
    time = torch.arange(count, dtype=torch.float64)
    x, y = (torch.sin(math.tau * time / cycle) for cycle in (40.0, 54.8))
    return torch.stack((CENTER[0] + 9 * x, CENTER[1] + 7 * y, math.radians(3) * x), -1)


def changing(family: str, change: str, seed: int, frames: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Frames (h, w) uint8 and true poses (3,) of a surface that loses 1/LIFE of its texture in each of the ``frames``
    after the first, and gets another one for it."""
    old, new = (SCENES[family](100 + 2 * seed + k) for k in (0, 1))
    for k, pose in enumerate(wander(frames + 1)):
        image = aged(old, new, change, k / LIFE, seed)(pose[None])
        yield sense(image, 10_000 * seed + k, NOISE)[0, 0], pose


def aged(old: Scene, new: Scene, change: str, share: float, seed: int) -> Callable[[Tensor], Tensor]:
    """What renders (1, 1, h, w) the ``old`` scene of which a ``share`` is the ``new`` one's."""
    if change == "wave by wave" and isinstance(old, PlaneWaves) and isinstance(new, PlaneWaves):
        order = torch.randperm(len(old.waves), generator=torch.Generator().manual_seed(seed))
        gone = torch.zeros(len(order), dtype=torch.bool)
        gone[order[: round(share * len(order))]] = True
        waves = torch.where(gone[:, None], new.waves, old.waves)
        rest = (torch.where(gone, getattr(new, n), getattr(old, n)) for n in ("amplitudes", "phases"))
        return partial(PlaneWaves(waves, *rest).render, size=FRAME)
    if change in ("patch by patch", *FADES):
        own = _patched if change == "patch by patch" else partial(_faded, fades=FADES[change])
        return partial(_by_place, old=old, new=new, share=partial(own, share=share, seed=seed))
    return lambda poses: (1 - share) * old.render(poses, FRAME) + share * new.render(poses, FRAME)


def least(family: str, seed: int, frames: int, every: int, size: int = SIZE) -> float:
    """Standard deviation in x and y, px, below which nobody knows from images alone where a surface that ``dissolves``
    lies after some ``frames`` as against the first image, each the mean of ``every`` so many: Cramer-Rao bound, with
    both textures unknown. In a plane of images (1 - a) A + a B a drift in a shows by its square alone."""
    share = torch.arange(every / 2, frames, every, dtype=torch.float64) / LIFE
    mixed = torch.stack((1 - share, share), 1)
    inside = mixed @ torch.linalg.solve(mixed.mT @ mixed, mixed.mT)
    weight = (torch.eye(len(share), dtype=torch.float64) - inside) * every / (NOISE**2 + rounding(8))
    old, new = (jacobian(SCENES[family](100 + 2 * seed + k), (size, size))[1] for k in (0, 1))
    slopes = mixed[:, :1, None] * old + mixed[:, 1:, None] * new  # (n, N, 3)
    normal = torch.einsum("ipa,jpb,ij->iajb", slopes, slopes, weight)[1:, :, 1:]
    sides = 3 * (len(share) - 1)
    covariance = torch.linalg.inv(normal.reshape(sides, sides))[-3:, -3:]
    return float(covariance.diagonal()[:2].mean().sqrt())


def _by_place(poses: Tensor, old: Scene, new: Scene, share: Callable[[Tensor], Tensor]) -> Tensor:
    """Of every place of the surface, (h, w, 2) px, the new one's ``share`` (h, w)."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in FRAME), indexing="ij")
    places = transform(inverse(poses), torch.stack((x, y), -1).reshape(-1, 2)).reshape(*FRAME, 2)
    return torch.lerp(old.render(poses, FRAME).double(), new.render(poses, FRAME).double(), share(places)).float()


def _patched(places: Tensor, share: float, seed: int) -> Tensor:
    """Squares are exchanged at once, each at a time of its own."""
    i, j = (((places + 1e-6) / PATCH).floor().long() + 50).unbind(-1)
    when = torch.rand(100, 100, generator=torch.Generator().manual_seed(seed))
    return (when[j, i] < share).double()


def _faded(places: Tensor, share: float, seed: int, fades: float) -> Tensor:
    """Each place begins to dissolve at a time of its own, like those near it."""
    when = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(seed)).double() * (1 - fades)
    begun = functional.grid_sample(when, places[None] / (12 * PLACE), padding_mode="reflection", align_corners=False)
    return ((share - begun[0, 0]) / fades).clamp(0, 1)


def still(seed: int, frames: int, noise: float = NOISE) -> Iterator[Tensor]:
    """Frames (h, w) of a scene in which nothing moves."""
    image = PlaneWaves.random(seed=seed).render(wander(1), FRAME)
    for k in range(frames + 1):
        yield sensor.quantise(sensor.read(image, noise, sensor.generator(seed, k)), 8)[0, 0]


def swaying(seed: int, frames: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Frames (h, w) whose rows are exposed one after the other, and poses (3,) when the target's middle row is, of a
    sway by 5 px at 0.7 rad per frame, from rest."""
    scene, middle, line = PlaneWaves.random(seed=seed), FRAME[0] / 2, READ / FRAME[0]

    def at(time: float) -> Tensor:
        return torch.tensor((CENTER[0] + 5 * math.sin(0.7 * max(time, 0)), CENTER[1], 0.0), dtype=torch.float64)

    for k in range(frames + 1):
        rows = [at(k + line * (row - middle) if k else 0.0) for row in range(FRAME[0])]
        parts = [
            scene.render((pose - torch.tensor((0.0, row, 0.0)))[None], (1, FRAME[1])) for row, pose in enumerate(rows)
        ]
        yield sense(torch.cat(parts, 2), 10_000 * seed + k, NOISE)[0, 0], at(k + line * (CENTER[1] - middle))
