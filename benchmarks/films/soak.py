"""A film without end: covers, darkness and jumps come and go, and the target keeps going round."""

from __future__ import annotations

import random
from collections.abc import Iterator

import torch
from torch import Tensor

from films.covers import DARK
from films.shot import CYCLE, Film, Shot, sense


def stream(shot: Shot, count: int) -> Iterator[tuple[Tensor, Tensor, float]]:
    """``count`` frames (1, h, w), where the target is (3,), and what share of it is seen."""
    draw, k, kind, left, share = random.Random(shot.seed), 0, "clean", 30, 0.0
    for n in range(count):
        if left == 0:
            kind = "clean" if kind != "clean" else draw.choice(("cover", "dark", "jump"))
            left = {"clean": 20, "cover": 15, "dark": 3, "jump": 1}[kind] + draw.randrange(10)
            share = draw.choice((0.1, 0.2, 0.3))
            k += draw.randrange(5, 20) if kind == "jump" else 0
        left, k = left - 1, (k + 1) % CYCLE
        image, pose = shot.clean[k].clone(), shot.path[k]
        if kind == "dark":
            image[:] = 10.0
        elif kind == "cover":
            half, x = share * shot.size / 2, float(shot.path[:, 0].mean())
            image[..., round(x - half) : round(x + half)] = DARK
        seen = {"cover": 1 - share, "dark": 0.0}.get(kind, 1.0)
        yield sense(image[None], shot.seed * count + n)[0], pose, seen


def soak_film(shot: Shot, truth: Tensor, seen: Tensor) -> Film:
    """What a run over the stream is judged by."""
    return Film(
        shot.clean[:0], shot.path[:1, :2], shot.size, truth[:, None], seen[:, None], truth[:, None] * torch.nan, 0
    )
