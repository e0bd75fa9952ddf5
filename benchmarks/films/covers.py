"""What comes between the target and the lens: strips that cover a share of the template, still, moving or passing."""

from __future__ import annotations

import torch
from torch import Tensor

from films.shot import FIRST, LAST, Film, Shot, frames
from torch_ecc.sim import Occluder, PlaneWaves, placed

PASSING = 8.0  # px per frame of one that comes in and leaves
DARK = 30.0  # grey levels
KINDS = ("flat", "textured", "mean")
MOTIONS = ("still", "moving", "passing")


def cover(shot: Shot, share: float, kind: str, motion: str) -> Film:
    """A strip over the whole height or width of the template that covers a ``share`` of it. It is DARK and flat,
    textured, or of the template's mean, and stands still, drifts across the template or comes in and leaves."""
    image, opacity = covered(shot, share, kind, motion)
    return shot.film(image, opacity > 0.5)


def covered(shot: Shot, share: float, kind: str, motion: str) -> tuple[Tensor, Tensor]:
    """The pictures with the strip, and its opacity, (F + 1, 1, h, w) each."""
    strip = placed_strip(shot, share, motion)
    opacity = strip.cover(torch.zeros_like(shot.clean), torch.arange(len(shot.path)))
    return torch.lerp(shot.clean, surface(shot, strip, kind), opacity), opacity


def placed_strip(shot: Shot, share: float, motion: str) -> Occluder:
    """The strip; where its centre may lie leaves all of it inside the template in every frame."""
    middle = shot.path[:, :2].mean(0)
    axis, side = shot.seed % 2, 1 - shot.seed // 2 % 2 * 2  # left to right, top to bottom, and back
    travel, width = float((shot.path[:, axis] - middle[axis]).abs().max()), share * shot.size
    room = max((shot.size - width) / 2 - travel, 0.0)
    half, center, velocity = [2.0 * shot.size] * 2, middle.tolist(), [0.0, 0.0]
    half[axis], first, last = width / 2, FIRST, LAST
    if motion == "still":
        center[axis] += 0.5 * side * room
    elif motion == "moving":
        velocity[axis] = side * 2 * room / (LAST - FIRST)
        center[axis] -= side * room + FIRST * velocity[axis]
    else:
        velocity[axis] = side * PASSING
        center[axis] -= side * (shot.size / 2 + travel + width / 2) + FIRST * velocity[axis]
        first, last = 0, None
    return Occluder((center[0], center[1]), (half[0], half[1]), 1.0, (velocity[0], velocity[1]), first=first, last=last)


def surface(shot: Shot, strip: Occluder, kind: str) -> Tensor:
    """What a strip looks like, everywhere: grey levels that broadcast to the frames."""
    if kind == "flat":
        return torch.full((1, 1, 1, 1), DARK)
    if kind == "mean":
        return shot.patch(shot.clean).mean()[None, None, None, None]
    drift = frames(len(shot.path))[:, None] * torch.tensor((*strip.velocity, 0.0))
    return PlaneWaves.random(seed=1000 + shot.seed).render(placed(drift, strip.center), shot.frame)
