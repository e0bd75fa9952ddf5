"""What comes between the target and the lens: strips that cover a share of the template, still, moving or passing."""

from __future__ import annotations

import torch
from films import Film, Shot
from torch import Tensor

from torch_ecc.sim import Occluder, PlaneWaves, placed

FIRST, LAST = 5, 32  # frames with a cover that comes and goes at once
PASSING = 8.0  # px per frame of one that comes in and leaves
DARK = 30.0  # grey levels
KINDS = ("flat", "textured", "mean")
MOTIONS = ("still", "moving", "passing")


def cover(shot: Shot, share: float, kind: str, motion: str) -> Film:
    """A strip over the whole height or width of the template that covers a ``share`` of it. It is DARK and flat,
    textured, or of the template's mean, and stands still, drifts across the template or comes in and leaves."""
    strip = placed_strip(shot, share, motion)
    indices = torch.arange(len(shot.path))
    opacity = strip.cover(torch.zeros_like(shot.clean), indices)
    image = torch.lerp(shot.clean, surface(shot, strip, kind), opacity)
    return shot.film(image, opacity > 0.5)


def placed_strip(shot: Shot, share: float, motion: str) -> Occluder:
    """The strip; where its centre may lie leaves all of it inside the template in every frame."""
    middle, travel = shot.path[:, :2].mean(0), (shot.path[:, :2] - shot.path[:, :2].mean(0)).abs().amax(0)
    axis, side = shot.seed % 2, 1 - shot.seed // 2 % 2 * 2  # left to right, top to bottom, and back
    width = share * shot.size
    room = max((shot.size - width) / 2 - float(travel[axis]), 0.0)
    half, center, velocity = [2.0 * shot.size] * 2, middle.tolist(), [0.0, 0.0]
    half[axis], first, last = width / 2, FIRST, LAST
    if motion == "still":
        center[axis] += 0.5 * side * room
    elif motion == "moving":
        velocity[axis] = side * 2 * room / (LAST - FIRST)
        center[axis] -= side * room + FIRST * velocity[axis]
    else:
        velocity[axis] = side * PASSING
        reach = shot.size / 2 + float(travel[axis]) + width / 2
        center[axis] -= side * reach + FIRST * velocity[axis]
        first, last = 0, None
    return Occluder((center[0], center[1]), (half[0], half[1]), 1.0, (velocity[0], velocity[1]), first=first, last=last)


def surface(shot: Shot, strip: Occluder, kind: str) -> Tensor:
    """What a strip looks like, everywhere: grey levels that broadcast to the frames."""
    if kind == "flat":
        return torch.full((1, 1, 1, 1), DARK)
    if kind == "mean":
        x, y, n = *shot.path[0, :2].long().tolist(), shot.size // 2
        return shot.clean[:1, :, y - n : y + n + 1, x - n : x + n + 1].mean((2, 3), keepdim=True)
    index = torch.arange(len(shot.path), dtype=torch.float64)[:, None]
    drift = torch.cat((index * index.new_tensor(strip.velocity), 0 * index), 1)
    return PlaneWaves.random(seed=1000 + shot.seed).render(placed(drift, strip.center), shot.frame)
