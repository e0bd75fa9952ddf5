"""A film without end: covers, darkness and jumps come and go, and the target keeps going round."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from films.covers import DARK
from films.shot import CYCLE, NOISE, Film, Shot
from torch_ecc.sim.camera import sensor

LENGTH = {"clean": 20, "cover": 15, "dark": 3, "jump": 1}  # frames at least, and up to nine more


class Moment(NamedTuple):
    """The ``place`` of the target on its path, what happens, and the ``share`` of it that a cover would take."""

    place: int
    kind: str
    share: float

    @property
    def seen(self) -> float:
        """What share of the target is to be seen."""
        return {"cover": 1 - self.share, "dark": 0.0}.get(self.kind, 1.0)


def moments(seed: int) -> Iterator[Moment]:
    """What happens, frame by frame, the same for a ``seed``."""
    draw, k, kind, left, share = random.Random(seed), 0, "clean", 30, 0.0
    while True:
        if left == 0:
            kind = "clean" if kind != "clean" else draw.choice(("cover", "dark", "jump"))
            left = LENGTH[kind] + draw.randrange(10)
            share = draw.choice((0.1, 0.2, 0.3))
            k += draw.randrange(5, 20) if kind == "jump" else 0
        left, k = left - 1, (k + 1) % CYCLE
        yield Moment(k, kind, share)


def shown(shot: Shot, moment: Moment, n: int) -> Tensor:
    """Frame ``n`` (1, h, w), with noise of its own."""
    image = shot.clean[moment.place].clone()
    if moment.kind == "dark":
        image[:] = 10.0
    elif moment.kind == "cover":
        half, x = moment.share * shot.size / 2, float(shot.path[:, 0].mean())
        image[..., round(x - half) : round(x + half)] = DARK
    return sensor.quantise(sensor.read(image, NOISE, source=sensor.generator(shot.seed, n)), 8)


def soak_film(shot: Shot, truth: Tensor, seen: Tensor) -> Film:
    """What a run over such frames is judged by: ``truth`` (F, 3), ``seen`` (F,)."""
    return Film(
        shot.clean[:0], shot.path[:1, :2], shot.size, truth[:, None], seen[:, None], truth[:, None] * torch.nan, 0
    )
