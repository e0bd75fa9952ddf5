"""Trials: templates at random places of the micrograph, found again, or not, in a frame where something has changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.estimate import Status
from torch_ecc.core.pose import compose
from torch_ecc.paper.errors import errors
from torch_ecc.paper.methods import COMPARED, METHODS, Follower
from torch_ecc.paper.ref34 import Ref34
from torch_ecc.paper.scheme import SIZE, Cut, Kept, scene
from torch_ecc.sim import Camera
from torch_ecc.track.recover import AT_ONCE
from torch_ecc.track.tracker import Tracker

FRAME = (320, 320)  # (h, w) px
MIDDLE = torch.tensor((160.0, 160.0, 0.0), dtype=torch.float64)  # where templates are in their first frame
REACH = 1000.0  # px of the square on the micrograph that templates are drawn from
BORDER = 24  # px rendered around a frame, for its blur
FOUND = 0.5  # px at the template's corner: a template nearer than that is found
JUMP, TURN, NOISE = 2.0, 1.0, 2.0  # px, deg and grey levels, where they are not what is varied
TRACKERS: dict[str, dict[str, Any]] = {  # the default method with what is in reserve
    "linear, 3 levels": {"levels": 3, "search": False},
    "linear, search": {"search": True},
}
UNNOTICED = "wrong, not noticed"
SEED = 5


CAMERA = Camera(size=FRAME, noise_sigma=NOISE)  # of all trials, 8 bit, with whatever is varied


@dataclass(frozen=True, kw_only=True)
class Change:
    """What happens between the frame that templates of ``size`` px are cut from and the next one."""

    jump: float = JUMP  # px, in any direction
    turn: float = TURN  # deg, either way
    size: int = SIZE
    camera: Camera = CAMERA  # of the second frame


class Found(NamedTuple):
    """Over the levels of a sweep, by method: the share of templates found and the median error px of those."""

    rate: dict[str, list[float]]
    error: dict[str, list[float]]


def pairs(count: int, jump: float, turn: float) -> tuple[Cut, Tensor]:
    """Where B = ``count`` templates are cut, and poses (B, 3) of the scene in their next frames.

    The same places, angles and directions for every ``jump`` (px) and ``turn`` (deg).
    """
    source = torch.Generator().manual_seed(SEED)
    x, y, angle, way, sign = torch.rand(5, count, generator=source, dtype=torch.float64)
    place = torch.stack((REACH * (x - 0.5), REACH * (y - 0.5), math.tau * angle), -1)
    side = torch.where(sign < 0.5, -1.0, 1.0)
    way = math.tau * way
    move = torch.stack((jump * way.cos(), jump * way.sin(), math.radians(turn) * side), -1)
    return Cut(compose(MIDDLE.expand_as(place), place), MIDDLE), compose(MIDDLE + move, place)


@lru_cache(maxsize=1)
def _rendered(count: int, jump: float, turn: float) -> Kept:
    """The second frames without what the camera does to them, and with a border."""
    second = pairs(count, jump, turn)[1] + torch.tensor((BORDER, BORDER, 0.0), dtype=torch.float64)
    return Kept(scene().render(second, (FRAME[0] + 2 * BORDER, FRAME[1] + 2 * BORDER)))


class Tracked:
    """Trackers with ``options`` of templates in the middle of first frames (B, 1, H, W), made anew for every frame.

    ``status`` (B,): that of the last one.
    """

    status: Tensor

    def __init__(self, first: Tensor, size: int, options: Mapping[str, Any]) -> None:
        self.first, self.size, self.options, self.pose = first, size, options, MIDDLE.expand(len(first), 3)

    def track(self, frames: Tensor) -> Tensor:
        """Poses (B, 3) in the next frames."""
        # So few at once that all that need it are searched for in this very frame.
        some = zip(*(f.split(AT_ONCE) for f in (self.first, frames, self.pose[:, :2])), strict=True)
        found = [Tracker(a, at, self.size, prediction="hold", **self.options)(b) for a, b, at in some]
        self.status = torch.cat([estimate.status for estimate in found])
        return torch.cat([estimate.pose for estimate in found])


def sweep(changes: Sequence[Change], count: int, tick: Callable[[], None], *, trackers: bool = False) -> Found:
    """All methods, with ``trackers`` also those, over changes that make one thing worse and worse."""
    names, watched = (COMPARED, "linear") if not trackers else ((*COMPARED, *TRACKERS), "linear, search")
    found = Found({name: [] for name in (*names, UNNOTICED)}, {name: [] for name in names})
    first = CAMERA.capture(scene(), pairs(count, 0, 0)[0].pose, seed=SEED)
    followers: dict[int, dict[str, Follower | Tracked]] = {}
    for change in changes:
        cut, second = pairs(count, change.jump, change.turn)
        frames = change.camera.capture(_rendered(count, change.jump, change.turn), second, seed=SEED + 1)
        if change.size not in followers:
            followers[change.size] = {name: _start(name, first, change.size) for name in names}
        for name, follower in followers[change.size].items():
            follower.pose = MIDDLE.expand(count, 3)
            error = corner_error(follower.track(frames), cut.truth(second), change.size)
            good = error < FOUND
            found.rate[name].append(float(good.double().mean()))
            found.error[name].append(float(error[good].quantile(0.5)) if bool(good.any()) else math.nan)
            if name == watched and not isinstance(follower, Ref34):
                unnoticed = Status.good(follower.status) & ~good
                found.rate[UNNOTICED].append(float(unnoticed.double().mean()))
        tick()
    return found


def _start(name: str, first: Tensor, size: int) -> Follower | Tracked:
    """The method or tracker of that name, with templates of ``size`` px in first frames (B, 1, H, W)."""
    if name in TRACKERS:
        return Tracked(first, size, TRACKERS[name])
    return METHODS[name].start(Cut(MIDDLE, MIDDLE).template(first, size), MIDDLE.expand(len(first), 3))


def corner_error(pose: Tensor, truth: Tensor, size: int) -> Tensor:
    """Error (B,) in px at the corner of a template of ``size`` px: that of x and y plus that of theta there."""
    error = pose - truth
    corner: Tensor = error[:, :2].norm(dim=-1) + error[:, 2].abs() * size / math.sqrt(2)
    return corner


def sampler_errors(noise: float, count: int, samplers: Sequence[str], tick: Callable[[], None]) -> dict[str, Tensor]:
    """Sorted errors px of x and y of the templates that the default method finds, by sampler; both frames have
    ``noise`` grey levels."""
    (cut, second), view = pairs(count, JUMP, TURN), replace(CAMERA, noise_sigma=noise)
    first, frames = view.capture(scene(), cut.pose, seed=SEED), view.capture(scene(), second, seed=SEED + 1)
    template, start = cut.template(first), MIDDLE.expand_as(second)
    result = {}
    for name in samplers:
        pose = METHODS["linear"].start(template, start, name).track(frames)
        error = errors(pose, cut.truth(second))[:, :2].norm(dim=-1)
        result[name] = error[error < FOUND].sort().values
    tick()
    return result
