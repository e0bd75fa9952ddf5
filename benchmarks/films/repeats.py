"""Equal and nearly equal parts, and what makes a tracker take one for the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from films.covers import covered
from films.shot import Film, Shot, frames, sense
from torch_ecc.core.pose import compose
from torch_ecc.sim import Occluder, Pads, micrograph
from torch_ecc.sim.scene.layout import Rectangle

BASE = 70.0  # grey levels between the parts
SMALL = (300, 360)  # (h, w) px of an array's frames
LENGTH = 12  # frames of an array
EVENT = range(3, 5)  # frames in which something lies on it


def twin(shot: Shot, share: float = 0.0) -> Film:
    """An equal part elsewhere on the target, the template covered by a flat strip over ``share`` of it."""
    image, opacity = (shot.clean, None) if share == 0 else covered(shot, share, "flat", "still")
    there = torch.tensor((-150.0, -70.0, 0.0), dtype=torch.float64)
    path = compose(shot.path, there.expand_as(shot.path))
    side = shot.size / 2 + 10
    window = Pads.of([Rectangle(0, 0, 2 * side, 2 * side, 1.0)]).render(path, shot.frame)
    image = torch.lerp(image, shot.moved(path).clean, window)
    return shot.film(image, None if opacity is None else opacity > 0.5)


def array(seed: int, spread: float) -> Shot:
    """A drifting array of parts; each level and size differs from the others' by a share of ``spread`` at most."""
    draw = torch.Generator().manual_seed(seed)
    pitch, *u = torch.rand(8, generator=draw, dtype=torch.float64).tolist()
    pitch = 55 + 30 * pitch
    part = [  # x, y, width, height (in pitches), level
        (0.0, 0.0, 0.45 + 0.2 * u[0], 0.4 + 0.2 * u[1], 70 + 40 * u[2]),
        (0.25 * (u[3] - 0.5), 0.33, 0.12, 0.25, 50.0),
        (0.36, 0.2 * (u[4] - 0.5), 0.15, 0.1, 40 * (u[5] - 0.5)),
    ]
    cells = [(i, j) for i in range(-5, 6) for j in range(-5, 6)]
    own = 1 + spread * (2 * torch.rand(len(cells), len(part), 2, generator=draw) - 1)
    rectangles = [
        Rectangle(pitch * (i + x), pitch * (j + y), pitch * w * size, pitch * h, level * shade)
        for (i, j), cell in zip(cells, own.tolist(), strict=True)
        for (x, y, w, h, level), (shade, size) in zip(part, cell, strict=True)
    ]
    drift = 4 * (2 * torch.tensor([u[6], u[0], 0.5], dtype=torch.float64) - 1) / LENGTH
    path = torch.tensor([SMALL[1] / 2, SMALL[0] / 2, 0.0]).double() + frames(LENGTH)[:, None] * drift
    size = round(pitch) // 2 * 2 + 1
    return Shot(Pads.of(rectangles, sigma=1.0, base=BASE), seed, path, size, SMALL)


def spoiled(shot: Shot, *things: Occluder) -> Film:
    """The film with ``things`` on it in the frames EVENT."""
    image, hidden = shot.clean, torch.zeros_like(shot.clean)
    indices = torch.arange(len(image))
    for thing in things:
        image, hidden = thing.cover(image, indices), thing.cover(hidden, indices)
    return shot.film(image, hidden != 0)._replace(clear=EVENT.stop - 1)


def on(shot: Shot, half: tuple[float, float], level: float, shape: str = "ellipse", reach: float = 0.35) -> Occluder:
    """A thing somewhere on the template."""
    x, y = (
        reach * shot.size * (2 * torch.rand(2, generator=torch.Generator().manual_seed(shot.seed + 7)) - 1)
    ).tolist()
    cx, cy = shot.path[EVENT.start, :2].tolist()
    return Occluder((cx + x, cy + y), half, level, shape=shape, first=EVENT.start, last=EVENT.stop)


def dusted(shot: Shot) -> Film:
    """A grain of 28 px."""
    return spoiled(shot, on(shot, (3.0, 3.0), 20.0))


def glinting(shot: Shot) -> Film:
    """A white reflection, a lamp's, of 80 px."""
    return spoiled(shot, on(shot, (6.0, 4.0), 255.0))


def needled(shot: Shot) -> Film:
    """A needle over 3 % of the template."""
    thin = 0.015 * shot.size
    return spoiled(shot, on(shot, (thin, 3.0 * shot.size), 25.0, "rectangle"))


def lit(shot: Shot) -> Film:
    """A spot of a lamp on a quarter of the template, twice as bright."""
    side = shot.size / 4
    thing = on(shot, (side, side), 1.0, reach=0.2)
    alpha = thing.cover(torch.zeros_like(shot.clean), torch.arange(len(shot.clean)))
    return shot.film((shot.clean * (1 + 0.7 * alpha)).clamp(max=255))._replace(clear=EVENT.stop - 1)


EVENTS: dict[str, Callable[[Shot], Film]] = {
    "dust": dusted,
    "glint": glinting,
    "needle": needled,
    "lamp": lit,
}


def arrays(event: str, spread: float, count: int) -> Iterator[Film]:
    """``count`` arrays on which ``event`` happens."""
    for seed in range(count):
        yield EVENTS[event](array(seed, spread))


def crossings(count: int) -> Iterator[Film]:
    """Two equal parts that pass each other, one over the other, each followed by a patch of one tracker."""
    for seed in range(count):
        u = torch.rand(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).tolist()
        yield crossing(seed, 20 * u[0], 2 + 4 * u[1], math.radians(4 * u[2]))


def crossing(seed: int, beside: float, speed: float, turn: float) -> Film:
    """They pass at a distance of ``beside`` px, ``speed`` px per frame each, turning by ``turn`` in all."""
    time = frames(CROSSING) - CROSSING / 2
    one = torch.stack((180 + speed * time, 150 - beside / 2 + 0 * time, turn * time / CROSSING), -1).double()
    other = torch.stack((180 - speed * time, 150 + beside / 2 + 0 * time, -turn * time / CROSSING), -1).double()
    one, other = (path - path[0] + path[0].round() * path.new_tensor((1.0, 1.0, 0.0)) for path in (one, other))
    below, above = Shot(part(seed), seed, one, 61, SMALL), Shot(part(seed), seed, other, 61, SMALL)
    window = Pads.of([Rectangle(0, 0, 71, 71, 1.0)]).render(other, SMALL)
    image = torch.lerp(below.clean, above.clean, window)
    first, second = below.film(image, window > 0.5), above.film(image)
    both = {name: torch.cat((getattr(first, name), getattr(second, name)), 1) for name in ("truth", "seen", "bound")}
    return first._replace(centers=torch.cat((first.centers, second.centers)), **both)


def leaps(hidden: str, count: int) -> Iterator[Film]:
    """24 patches of 31 px on a micrograph, whose parts repeat every 30 px, that leaps by up to 4, 8 or 13 px in x and y
    in every frame; from the third one on part of the picture is ``hidden``, see HIDDEN."""
    x, y = (40.0 * torch.arange(1, n + 1, dtype=torch.float64) + 20 for n in (6, 4))
    centers = torch.cartesian_prod(x, y)
    for seed in range(count):
        for farthest in (4.0, 8.0, 13.0):
            u = torch.rand(21, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            step = (2 * u - 1) * u.new_tensor((farthest, farthest, 0.0)) * (frames(21) > 0)[:, None]
            shot = Shot(micrograph(), seed, step + step.new_tensor((180.0, 130.0, 0.0)), 31, (260, 360))
            mask = HIDDEN[hidden](torch.arange(360)).expand(shot.clean.shape)
            mask = mask & (frames(21) > 2)[:, None, None, None]
            truth = torch.nn.functional.pad(centers, (0, 1)) + step[1:, None]
            open_ = torch.nn.functional.avg_pool2d((~mask[1:]).double(), 31, 1)[:, 0]  # of the square around each pixel
            at = (truth[..., :2].round().long() - 15).unbind(-1)
            seen = open_[torch.arange(20)[:, None], at[1], at[0]]
            shown = sense(torch.where(mask, 90.0, shot.clean), seed)
            yield Film(shown, centers, 31, truth, seen, math.nan * truth, 20)


HIDDEN: dict[str, Callable[[Tensor], Tensor]] = {  # columns of a picture
    "open": lambda x: x < 0,
    "half hidden": lambda x: x < 150,
    "behind bars": lambda x: x % 46 < 10,
}
CROSSING = 40  # frames


def part(seed: int) -> Pads:
    """Some pads on an empty ground."""
    u = torch.rand(5, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    rows = [Rectangle(40 * a - 20, 40 * b - 20, 8 + 14 * c, 8 + 14 * d, 40 + 60 * e) for a, b, c, d, e in u.tolist()]
    return Pads.of(rows, sigma=1.0, base=BASE)


def leap() -> Iterator[Film]:
    """A still array of equal pads, 60 px apart; in the second frame 28 px of dust lie on the tracked one."""
    x, y = torch.arange(480.0), torch.arange(400.0)[:, None]
    u, v = (x - 210) % 60 - 30, (y - 170) % 60 - 30
    pads = 70 + 100 * edge(18 - u.abs()) * edge(14 - v.abs()) + 45 * edge(3 - (u - 8).abs()) * edge(v.abs() - 14)
    dusty = torch.where(torch.hypot(x - 246, y - 195) < 3, 20.0, pads)
    truth = torch.tensor([[[240.0, 200.0, 0.0]]], dtype=torch.float64).expand(9, 1, 3)
    for seed in range(10):
        shown = sense(torch.stack([pads, pads, dusty, *[pads] * 7])[:, None], seed)
        yield Film(shown, truth[0, :, :2], 61, truth, torch.ones(9, 1), math.nan * truth, 2)


def edge(distance: Tensor) -> Tensor:
    """From 0 to 1 over about 3 px."""
    return torch.sigmoid(distance / 0.8)
