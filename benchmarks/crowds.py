"""Tracks of some rigid bodies, drawn at random, which are to be put together again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc import Estimate, Groups, Status, Track
from torch_ecc.core.pose import compose, inverse

SIDES = (21.0, 31.0, 61.0)  # px, of patches
VAGUE = 10.0  # times as uncertain as usual is the angle of every tenth patch
WALK = torch.tensor((1.0, 1.0, 0.003), dtype=torch.float64)  # px, px, rad


class Crowd(NamedTuple):
    """A ``track`` (F, R, ...), so many moving ``bodies`` in it, and the number of the ``owner`` (R,) of each patch:
    that of its body, ``bodies`` itself of the still frame, -1 of what goes its own way."""

    track: Track
    bodies: int
    owner: Tensor

    @staticmethod
    def drawn(seed: int) -> Crowd:
        """One to four bodies of 2 to 24 patches each, near each other or over the whole view of 400 to 4000 px; a still
        frame in seven of ten; up to nine patches on ways of their own; 5 to 60 frames, in which up to 30 % are lost."""
        draw = Draw(torch.Generator().manual_seed(seed))
        frames, bodies, view, near = draw.whole(5, 60), draw.whole(1, 5), draw(400, 4000), draw(0, 1) < 0.6
        starts, poses, owner = [], [], []
        for body in range(bodies):
            starts.append(draw.places(draw.whole(2, 25), view, view / 3 if near else view))
            poses.append(compose(draw.motion(frames, starts[-1].mean(0)), starts[-1].expand(frames, -1, 3)))
            owner += [body] * len(starts[-1])
        starts.append(draw.places(draw.whole(3, 30) if draw(0, 1) < 0.7 else 0, view, view))
        poses.append(starts[-1].expand(frames, -1, 3))
        owner += [bodies] * len(starts[-1])
        starts.append(draw.places(draw.whole(0, 10), view, view))
        steps = draw(0.1, 1) * draw.normal(frames, len(starts[-1]), 3) * WALK
        poses.append(starts[-1] + steps.cumsum(0) - steps[:1])
        owner += [-1] * len(starts[-1])
        return Crowd(draw.seen(torch.cat(poses, 1), torch.cat(starts)), bodies, torch.tensor(owner))

    def right(self, found: Groups) -> float:
        """The share of patches of bodies, or of the still frame, that are together in the groups that were ``found``,
        less those beside them that do not belong there."""
        kept = 0
        for body in range(self.bodies + 1):
            own = [int(2 * (self.owner[group] == body).sum()) - len(group) for group in found.groups]
            kept += max(0, *own)
        return kept / int((self.owner >= 0).sum())


@dataclass(frozen=True)
class Draw:
    """By one generator."""

    generator: torch.Generator

    def __call__(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator, dtype=torch.float64))

    def whole(self, low: int, high: int) -> int:
        """From ``low`` to less than ``high``."""
        return int(torch.randint(low, high, (), generator=self.generator))

    def normal(self, *size: int) -> Tensor:
        return torch.randn(*size, generator=self.generator, dtype=torch.float64)

    def places(self, count: int, view: float, wide: float) -> Tensor:
        """Upright poses (count, 3) in a square that is ``wide`` px, in one of ``view`` px."""
        corner = torch.tensor((self(0, view - wide), self(0, view - wide)), dtype=torch.float64)
        inside = torch.rand(count, 2, generator=self.generator, dtype=torch.float64)
        return torch.nn.functional.pad(corner + wide * inside, (0, 1))

    def motion(self, frames: int, about: Tensor) -> Tensor:
        """(F, 1, 3) to and fro by 0.5 to 20 px, and by up to 6 deg about a pose (3,), from rest."""
        time = torch.linspace(0, math.tau * self.whole(1, 3), frames, dtype=torch.float64)
        wave = torch.stack([(time + self(0, math.tau)).sin() for _ in "xyt"], 1)
        far = 10 ** self(-0.3, 1.3)
        sway = (wave - wave[:1]) * torch.tensor((far, far, math.radians(self(0, 6))), dtype=torch.float64)
        middle = about.expand(frames, 3)
        return compose(compose(middle, sway), inverse(middle))[:, None]

    def seen(self, pose: Tensor, start: Tensor) -> Track:
        """What a tracker says of patches at ``pose`` (F, R, 3) that began at ``start`` (R, 3)."""
        count = len(start)
        place = torch.tensor([10 ** self(-2.5, -1.3) for _ in range(count)], dtype=torch.float64)
        turn = [math.sqrt(6) / SIDES[self.whole(0, 3)] * (VAGUE if self(0, 1) < 0.1 else 1.0) for _ in range(count)]
        sigma = torch.stack((place, place, place * torch.tensor(turn, dtype=torch.float64)), 1)
        pose = pose + sigma * self.normal(*pose.shape)
        lost = torch.rand(pose.shape[:2], generator=self.generator) < self(0, 0.3)
        lost[0] = False
        status = torch.where(lost, int(Status.LOST), int(Status.CONVERGED)).to(torch.int8)
        covariance, none, codes = torch.diag_embed(sigma.square()).expand(*pose.shape, 3), lost.double(), status * 0
        return Track(*Estimate(pose, pose - start, none, status, codes, covariance, none, codes, none, codes))
