"""What comes between the target and the lens, or falls on the target."""

from __future__ import annotations

import math

import kornia.filters as KF
import torch
from torch import Tensor

from films.shot import FIRST, LAST, Film, Shot, frames
from torch_ecc.core.pose import transform
from torch_ecc.sim import Occluder, PlaneWaves, placed
from torch_ecc.sim.camera import optics

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


def shadow(shot: Shot, share: float, depth: float = 0.5) -> Film:
    """A strip's shadow passes, which takes away a ``depth`` of the light."""
    strip = placed_strip(shot, share, "passing")
    opacity = strip.cover(torch.zeros_like(shot.clean), torch.arange(len(shot.path)))
    return shot.film(shot.clean * (1 - depth * opacity), opacity > 0.05)


def drops(shot: Shot, share: float, radius: float = 3.5) -> Film:
    """Dark drops all over the window, still in the camera, which hide a ``share`` of everything, and go again."""
    count = round(-math.log(1 - share) * shot.frame[0] * shot.frame[1] / (math.pi * radius**2))
    places = torch.rand(count, 2, generator=torch.Generator().manual_seed(shot.seed)) * torch.tensor(shot.frame[::-1])
    center = torch.zeros(shot.frame)
    center[places[:, 1].long(), places[:, 0].long()] = 1.0
    wet = KF.filter2d(center[None, None], optics.disc(radius)[None]) > 0.5 * float(optics.disc(radius).max())
    hidden = torch.zeros(shot.clean.shape, dtype=torch.bool)
    hidden[FIRST:LAST] = wet
    return shot.film(torch.where(hidden, DARK, shot.clean), hidden)


def stuck(shot: Shot, share: float) -> Film:
    """A dark round thing falls on the target in frame FIRST and stays there."""
    radius = shot.size * math.sqrt(share / math.pi)
    u = torch.rand(1, 2, generator=torch.Generator().manual_seed(shot.seed), dtype=torch.float64)
    place = transform(shot.path, (u - 0.5) * (shot.size - 2 * radius))[:, 0]
    x, y = torch.arange(shot.frame[1]), torch.arange(shot.frame[0])[:, None]
    off = torch.stack([torch.hypot(x - px, y - py) for px, py in place.tolist()])[:, None]
    opacity = (radius - off).clamp(0, 1)
    opacity[:FIRST] = 0
    return shot.film(torch.lerp(shot.clean, torch.tensor(DARK), opacity), opacity > 0.05)


def needle(shot: Shot, width: float, level: float, opacity: float = 1.0) -> Film:
    """A needle or hair of a ``width`` (px) and grey ``level`` lies slantwise across the template."""
    u = torch.rand(2, generator=torch.Generator().manual_seed(shot.seed))
    angle, (cx, cy) = math.pi * float(u[0]), shot.path[:, :2].mean(0).tolist()
    x, y = torch.arange(shot.frame[1]) - cx, torch.arange(shot.frame[0])[:, None] - cy
    off = (x * math.sin(angle) - y * math.cos(angle) + shot.size / 4 * float(u[1] - 0.5)).abs()
    hidden = torch.zeros_like(shot.clean)
    hidden[FIRST:LAST] = opacity * (width / 2 + 0.5 - off).clamp(0, 1)
    return shot.film(torch.lerp(shot.clean, torch.tensor(level), hidden), hidden > 0.2)


def glass(shot: Shot, share: float, opacity: float) -> Film:
    """Something textured drifts across the template, through which it is seen."""
    strip = placed_strip(shot, share, "moving")
    hidden = opacity * strip.cover(torch.zeros_like(shot.clean), torch.arange(len(shot.path)))
    return shot.film(torch.lerp(shot.clean, surface(shot, strip, "textured"), hidden), hidden > 0.1)


def layer(shot: Shot, share: float, shift: int) -> Film:
    """On a strip the target's own texture is seen, ``shift`` px aside, which goes along with it."""
    strip = placed_strip(shot, share, "still")
    opacity = strip.cover(torch.zeros_like(shot.clean), torch.arange(len(shot.path)))
    return shot.film(torch.lerp(shot.clean, shot.clean.roll(shift, -1), opacity), opacity > 0.5)


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
