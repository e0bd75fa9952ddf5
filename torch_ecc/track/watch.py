"""What a tracker knows of marks of its camera from frame to frame, and what they make of poses.

A sheen that stays where it is while a target moves is like a mark, but leaving out where it lies may cost more than it
bends. So unless one asks for marks to be heeded a pose remains as it is, and its covariance tells how far from it the
one is that there would be without them. Only where that is another place altogether, as of a template that follows an
aperture, or where the template was lost, is it taken instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.align import solve_again
from torch_ecc.core.ambient import lasting
from torch_ecc.core.covariance import largest_variance
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.grid import Place
from torch_ecc.core.normal import LEAST
from torch_ecc.core.reference import Reference
from torch_ecc.core.robust import Memory, unusual
from torch_ecc.core.settings import Settings
from torch_ecc.core.verdict import LARGEST_SIGMA, expected_score
from torch_ecc.search.locate import pose_distance
from torch_ecc.track.still import AROUND, BELIEVED, Still, behind

HEEDED, DOUBTED = 1, 2  # of marks: the template is seen without them; they may be some
ELSEWHERE = 2.0  # px, of its farthest pixel: what fits there has no mark in it that one does not know of
FARTHER = 1.5  # times as far one looks again
AT_ONCE = 4  # templates are looked at in one frame
SAME, CLEARLY = 2.0, 5.0  # times its sigma a pose without marks is off where it is the same place, or another one

State = Mapping[str, Tensor]


class Watch(NamedTuple):
    """What a tracker's state holds of R templates: the ``marks`` (H, W) of the camera, and whether they ``heed`` (R,)
    these: 0, HEEDED or DOUBTED; for how many frames (R,) more was left of them than noise leaves, and ``no_mark`` was
    found; how ``far`` (R,) px from their places in the first frame one has looked in vain; by what they may have been
    off there if there was one, the ``doubt`` (R, 3, 3); where they were, ``fitted`` (R, 3), when last no more was left
    than noise; and the first frame's ``level`` (2,), mean and standard deviation in grey levels."""

    marks: Tensor
    heed: Tensor
    no_mark: Tensor
    far: Tensor
    doubt: Tensor
    fitted: Tensor
    level: Tensor

    @staticmethod
    @lasting
    def begin(frame: Tensor, start: Tensor) -> Watch:
        """Of templates at ``start`` (R, 3) in a ``frame`` (1 or R, 1, H, W)."""
        none = torch.zeros_like(start[:, 0])
        level = torch.stack((frame.mean(), frame.var(correction=0).sqrt()))
        marks = torch.zeros_like(frame[0, 0], dtype=torch.uint8)
        doubt = start.new_zeros(len(start), 3, 3)
        return Watch(marks, none.to(torch.uint8), none.long(), none, doubt, start.clone(), level)

    @staticmethod
    def of(state: State) -> Watch:
        """From a tracker's buffers."""
        return Watch(*(state[name] for name in Watch._fields))

    def seen(self, reference: Reference, home: Tensor) -> Reference:
        """The templates, cut at ``home`` (R, 3), through a camera with these marks."""
        return behind(reference, home, self.marks > 0, self.heed == HEEDED)

    def doubted(self, reference: Reference, home: Tensor) -> Reference | None:
        """Those that may have marks, without them; None if there are none."""
        index = (self.heed == DOUBTED).nonzero()[:, 0]
        if len(index) == 0:
            return None
        some = reference._replace(sight=None, heed=None, coarse=None).select(index)
        return behind(some, home[index], self.marks > 0, torch.ones_like(index, dtype=torch.bool))

    def due(self, odd: Tensor, moved: Tensor) -> list[int]:
        """Which of the templates that leave more than noise does, ``odd`` (R,) bool, and have ``moved`` (R,) px, to
        look at: more and more seldom if there is nothing to find, but again farther off."""
        due = (self.no_mark & (self.no_mark - 1) == 0) | (moved > FARTHER * self.far + AROUND)
        due &= odd
        waiting = due & (due.cumsum(0) > AT_ONCE)
        self.no_mark.add_(odd & ~waiting)
        chosen: list[int] = (due & ~waiting).nonzero()[:, 0].tolist()
        return chosen


class Found(NamedTuple):
    """Of a frame: by what the poses of R templates are in ``doubt``, covariances (R, 3, 3); those to be had ``instead``
    of theirs; and whether ``new`` marks are known."""

    doubt: Tensor
    instead: dict[int, Estimate]
    new: bool


@dataclass(frozen=True, eq=False)
class Marks:
    """Those of a tracker's camera, which its ``state`` tells, to R templates, as ``reference`` has them and, those that
    may have some, ``doubted``. ``asked``: whether they are to be heeded wherever they are found."""

    reference: Reference
    doubted: Reference | None
    settings: Settings
    state: State
    asked: bool

    @staticmethod
    def of(reference: Reference, settings: Settings, state: State, asked: bool) -> Marks:
        """Of R templates as they are when nothing is hidden."""
        watch, home = Watch.of(state), state["start"]
        return Marks(watch.seen(reference, home), watch.doubted(reference, home), settings, state, asked)

    def __call__(
        self, image: Tensor, estimate: Estimate, start: Tensor, odd: Tensor | None, which: Tensor | None
    ) -> tuple[Estimate, bool]:
        """The ``estimate`` of an ``image`` (1, 1, H, W), from the ``start`` (R, 3) on, in which there is more left of
        those that are ``odd`` (R,) bool, None for none, than any noise leaves; of these only those ``which`` (R,) are
        looked at. And whether there are new marks."""
        fitted, pose = self.state["fitted"], estimate.pose.detach()
        if odd is None or which is None:
            fitted.copy_(pose)
            return estimate, False
        fitted.copy_(torch.where(odd[:, None], fitted, pose))
        if not bool((odd & which).any()):
            return estimate, False
        found = self.found(image, estimate, start, odd & which)
        estimate = estimate._replace(covariance=estimate.covariance + found.doubt)
        for r, other in found.instead.items():
            estimate = estimate.put(torch.tensor([r], device=start.device), other)
        return estimate, found.new

    @torch.no_grad()
    def found(self, image: Tensor, estimate: Estimate, start: Tensor, odd: Tensor) -> Found:
        """What tells of marks, if any of the templates is ``odd`` (R,)."""
        watch, pose = Watch.of(self.state), estimate.pose.detach()
        home, radius = self.state["start"], self.reference.place.radius
        moved, fitted = (pose_distance(there, home, radius=radius) for there in (pose, watch.fitted))
        pure = ((fitted > ELSEWHERE) & (watch.heed == 0)).tolist()
        doubt, odd = self.known(image, estimate, start, odd)
        found, good = Found(doubt, {}, False), Status.good(estimate.status)
        grown = (watch.heed == HEEDED) & (~good | (estimate.coverage < BELIEVED)) & (self.state["since"] == 1)
        watch.no_mark.masked_fill_(grown, 0)
        for r in watch.due(odd, moved):
            at = torch.tensor([r], device=start.device)
            found = self.looked(self.still(at, image, start, pure[r]), at, found, estimate.at(at), moved[r])
        near = odd & (watch.heed == 0) & (moved <= ELSEWHERE) & good  # farther off a mark shows
        return found._replace(doubt=found.doubt + torch.where(near[:, None, None], watch.doubt, 0.0))

    def looked(self, still: Still, at: Tensor, found: Found, estimate: Estimate, moved: Tensor) -> Found:
        """What was ``found``, and what a look tells at the template ``at`` (1,) that has ``moved`` () px, as far as its
        ``estimate`` (1, ...) is right."""
        watch, state, pose = Watch.of(self.state), self.state, estimate.pose
        good, heed = bool(Status.good(estimate.status)), int(watch.heed[at])
        trial = still.trial(still.shown) if heed == DOUBTED else None
        if trial is None or not trial.fits:
            trial = still.without_marks(pose)
        if trial is None:
            watch.far[at] = watch.far[at].maximum(moved)
            if good and heed == 0 and not still.pure and bool(moved <= ELSEWHERE):
                watch.doubt[at] = still.doubt(pose, state["trust"][at])
            elif still.pure:
                watch.doubt[at] = 0
            return found
        more, same, other = apart(self.reference.place, estimate, trial.estimate, at)
        taken = self.asked or heed == HEEDED or not good or bool(other)
        if taken:
            found.instead[int(at)] = trial.estimate
            state["score"][at], state["trust"][at] = expected_score(trial.reference), 1
        else:
            found.doubt[at] = more
        watch.marks.copy_(~trial.shown)
        watch.heed[at] = HEEDED if taken else DOUBTED
        more_of_it = heed != 0 and not trial.fits  # as behind a coder in every frame
        if good and more_of_it and (not taken or bool(same)):
            watch.far[at] = watch.far[at].maximum(moved)
        else:
            watch.no_mark[at], watch.far[at] = 0, 0
        return found._replace(new=True)

    def still(self, at: Tensor, image: Tensor, start: Tensor, pure: bool) -> Still:
        """The template ``at`` (1,)."""
        watch, state = Watch.of(self.state), self.state
        whole, first = self.reference.through(None), state["first"][0, 0]
        alone = whole if len(whole.K) == 1 else whole.select(slice(int(at), int(at) + 1))
        shown, home = watch.marks == 0, state["start"][at]
        return Still(alone, image, first, watch.level, start[at], home, shown, pure, self.settings, [])

    def known(self, image: Tensor, estimate: Estimate, start: Tensor, odd: Tensor) -> tuple[Tensor, Tensor]:
        """By what marks that are known bring poses into doubt, (R, 3, 3), and which (R,) are ``odd`` for all that."""
        doubt = torch.zeros_like(estimate.covariance)
        which = (Watch.of(self.state).heed == DOUBTED).nonzero()[:, 0]
        index = which[odd[which]]
        if self.doubted is None or len(index) == 0:
            return doubt, odd
        part = self.doubted._replace(sight=None).select(odd[which].nonzero()[:, 0])._replace(sight=self.doubted.sight)
        settings, home, memory = replace(self.settings, robust=False), self.state["start"], Memory.none(part)
        without, solution = solve_again(part, image, start[index], settings, home[index], memory)
        left = unusual(part, solution, self.settings, memory.score)
        more, _, other = apart(self.reference.place, estimate.at(index), without, index)
        odd_still = other | ~Status.good(without.status) | ~Status.good(estimate.status[index])
        odd_still |= torch.zeros_like(odd_still) if left is None else left
        return doubt.index_copy(0, index, more), odd.index_copy(0, index, odd_still)


def apart(place: Place, found: Estimate, without: Estimate, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """By what covariance (n, 3, 3) the poses ``found`` of templates at ``index`` (n,) are in doubt if those ``without``
    marks may be right, which may be off by their own; and which (n,) of these are the same, and which other places."""
    off, lever2 = without.pose - found.pose, place.lever2[index]
    square, own = (off.square() * lever2).sum(1), largest_variance(lever2, without.covariance)
    more = (1 - own / square.clamp(min=LEAST)).clamp(min=0)[:, None, None] * off[:, :, None] * off[:, None]
    return more, square <= SAME**2 * own, square > (CLEARLY**2 * own).clamp(min=LARGEST_SIGMA**2)
