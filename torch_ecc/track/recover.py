"""Templates that were not found, or look less like themselves than usual, are searched for: near, then anywhere.

A search must never make it worse. A place that was tracked to, close to where it was expected, is kept unless another
one is clearly better, and no place is taken that a look-alike of the template may be as well. Where many templates have
gone together, that is where the others are looked for.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.align import solve, solve_again
from torch_ecc.core.ambient import lasting
from torch_ecc.core.estimate import Estimate, Origin, Reason, Status
from torch_ecc.core.pose import unwrap
from torch_ecc.core.reference import Reference
from torch_ecc.core.robust import RECOGNISED, Memory
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.sight import filled
from torch_ecc.core.verdict import expected_score, within_margin
from torch_ecc.search.locate import LEAST_VISIBLE, SUPPRESSION, Locator, detrended_zncc_at, image_pyramid, pose_distance
from torch_ecc.search.look_alikes import NEARER, REACH, RIVAL, LookAlikes, look_alikes_anywhere, look_alikes_near
from torch_ecc.search.nearby import ANGLE_STEP, HALF_WIDTH, LARGEST_ANGLE, LEAST_SCORE, Allowed, Nearby
from torch_ecc.track.budget import RESERVE, Budget
from torch_ecc.track.doubt import (
    BASIN,
    WHOLE,
    Past,
    beats,
    familiar,
    gone_elsewhere,
    of_a_part,
    plausible,
    share_in_sight,
    strained,
    strayed,
    suspect,
)
from torch_ecc.track.lost import disproved, told, waiting
from torch_ecc.track.max_step import MaxStep
from torch_ecc.track.textureless import least_contrast, textureless
from torch_ecc.track.together import TOGETHER, gone_together

AT_ONCE = 4  # templates searched for in the whole of one frame; the others in turn
KEPT = 2**25  # complex numbers prepared for searches of the whole frame, 256 MB
NEARBY_AT_ONCE = 64  # and near where they are expected
PATIENCE = 16  # frames in which a lost template is searched for at every chance; later ever more seldom
SELDOM = 16  # frames between two searches for what has been lost for long
ALIGNED, NEARBY_ALIGNED = 20_000_000, 1_000_000  # pixels that can be read while a search aligns what it has found
KNOWN = 0.75 * REACH  # px: look-alikes of a place found near are known if it is not farther from the last one
AT_REST = 8.0  # px at the farthest pixel: what has moved more has not stayed where it was
ALIKE = 0.55  # of the usual score: a part that is not believed need not be covered, it may be that of another thing
COARSE = (8.0, ANGLE_STEP)  # px, rad: as finely as places are told apart before they are refined


def from_rest(reference: Reference, image: Tensor, estimate: Estimate, past: Past, settings: Settings) -> Estimate:
    """The ``estimate`` of an ``image`` (1 or R, 1, H, W) in which those that are lost, and were expected to go on, have
    been tried where they were last: nobody knows if they have."""
    index = (~Status.good(estimate.status) & (past.velocity != 0).any(1) & (past.since > 1)).nonzero()[:, 0]
    if len(index) == 0:
        return estimate
    view = image if len(image) == 1 else image[index]
    part = reference.select(index)
    memory = Memory.none(part)._replace(score=past.usual[index])
    found, _ = solve_again(part, view, past.pose[index], settings, past.home[index], memory)
    stayed = pose_distance(found.pose, past.pose[index], radius=part.place.radius) <= AT_REST
    good = Status.good(found.status) & stayed & ~of_a_part(part, found, image)
    return estimate.put(index[good], found.at(good))


class Recovery:
    """The searches of one tracker, and what is prepared for them."""

    @lasting
    def __init__(self, reference: Reference, settings: Settings, budget: Budget, max_step: MaxStep) -> None:
        # A wrong place must not be made right by leaving out what does not fit.
        self.reference, self.settings, self.max_step = reference, replace(settings, robust=False), max_step
        self.as_tracked = settings
        self.budget, self.farthest = budget, float(reference.place.radius.max())
        self.expected = expected_score(reference)
        self.window, self.flattest = least_contrast(reference)
        self.textureless, self.hopeless = textureless(reference, settings)
        self.locators: dict[int, Locator] = {}  # of the templates last searched for
        self.nearby: tuple[list[int], Nearby] | None = None
        self.near: dict[int, LookAlikes] = {}  # of templates that a search has led elsewhere, in the first frame
        self.anywhere: dict[int, LookAlikes] = {}

    def __call__(self, images: list[Tensor], estimate: Estimate, start: Tensor, past: Past) -> Estimate:
        """The ``estimate`` of a frame with those templates searched for that are suspect and due: around ``start``
        (R, 3), where they were last, then anywhere. ``images``: the frame, and as many coarser levels as there are.
        """
        estimate = self.rejoin(images[0], estimate, past)
        due = self.due(estimate, past)
        if not due or not self.budget.left():
            return waiting(estimate, due, past.usual)
        images[:] = self.unmarked(images)
        if self.flat(images[0]):
            return told(estimate, due, Reason.FLAT)
        estimate, gone = self.searched_near(images[0], estimate, start, past, due)
        ahead = (pose_distance(start, past.pose, radius=self.reference.place.radius) > BASIN).tolist()
        if turned := [r for r in gone if ahead[r]]:  # or it has not gone on
            estimate, lost = self.searched_near(images[0], estimate, past.pose, past, turned)
            gone = [r for r in gone if r in lost or not ahead[r]]
        gone = [r for r in gone if not self.searched_all(past.since[r])]
        for k, r in enumerate(gone):
            if k == AT_ONCE or not self.budget.left(RESERVE):
                estimate = waiting(estimate, gone[k:], past.usual)
                break
            estimate = self.search_anywhere(images, estimate, past, r)
        return self.follow(images[0], estimate, start, past.usual) if gone else estimate

    def searched_near(
        self, image: Tensor, estimate: Estimate, start: Tensor, past: Past, due: list[int]
    ) -> tuple[Estimate, list[int]]:
        """The ``estimate`` of an ``image`` with the templates ``due`` searched for around their ``start`` (R, 3), and
        which of them have no plausible place yet."""
        found = self.search_near(image, estimate, start, past, sorted(due))
        estimate = self.follow(image, self.own(found, estimate, start, past), start, past.usual)
        suspects = suspect(estimate, past.usual)
        kept = plausible(estimate, start, past, self.reference.place.radius).tolist()
        return estimate, [r for r in due if suspects[r] and not kept[r]]

    def unmarked(self, images: list[Tensor]) -> list[Tensor]:
        """The ``images`` in float; if the camera has marks, the first one alone, without them."""
        sight, image = self.reference.sight, images[0].float()
        return [image, *images[1:]] if sight is None else [filled(image, sight.shown)]

    def flat(self, image: Tensor) -> bool:
        """Whether the ``image`` (1 or R, 1, H, W) is nowhere more than noise to any template: a light is out."""
        about, side = image - image.mean(), min(self.window, *image.shape[-2:])
        mean, square = (F.avg_pool2d(v, side, max(side // 2, 1)) for v in (about, about * about))
        return bool((square - mean * mean).amax() <= self.flattest)

    def due(self, estimate: Estimate, past: Past) -> list[int]:
        """Which of the suspect templates to search for in this frame: less often those that have had a place since the
        last frame or too little texture for one, and never those that no search can find."""
        due, suspects = [], suspect(estimate, past.usual)
        placed = (Status.good(estimate.status) & (past.since == 1)).tolist()
        for r, n in enumerate(past.suspect_frames.tolist()):
            rarely = placed[r] or self.textureless[r]
            pause = n & (n - 1) if rarely else (n + r) % min(1 << min(n // PATIENCE, 8), SELDOM)
            if suspects[r] and pause == 0 and not self.hopeless[r]:
                due.append(r)
        return self.budget.in_turn(due, AT_ONCE)[:NEARBY_AT_ONCE]

    def comes_first(self, since: Tensor) -> bool:
        """Whether templates that are gone are searched for before it is tried whether something covers them: if all
        were there in the last frame, ``since`` (R,) is 1, and can be; where the host sees it."""
        return (
            is_cpu(since.device) and max(since.tolist()) == 1 and not any(self.hopeless) and self.budget.left(RESERVE)
        )

    def search_near(self, image: Tensor, estimate: Estimate, start: Tensor, past: Past, due: list[int]) -> Estimate:
        """Second attempt for the templates ``due``: around their ``start`` (R, 3)."""
        index = torch.tensor(due, device=start.device)
        view = image if len(image) == 1 else image[index]
        surroundings = self.surroundings(due)
        self.budget.spend(surroundings.correlator.size, NEARBY_ALIGNED * len(due))
        found = surroundings.find(
            self.reference.select(index), view, start[index], self.settings, self.allowed(past, index)
        )
        known = familiar(found, past.usual[index]) & beats(found, estimate.at(index))
        known &= ~self.max_step.exceeded(found.pose, past.pose[index], past.since[index])
        return estimate.put(index[known], found.at(known))

    def allowed(self, past: Past, index: Tensor) -> Allowed | None:
        """Which poses (n, K, 3) of templates at ``index`` (n,) are near enough to their last ones; None if all are."""
        if not self.max_step.known:
            return None
        last, since = past.pose[index, None], past.since[index, None]
        return lambda pose: ~self.max_step.exceeded(pose, last, since, COARSE)

    def searched_all(self, since: Tensor) -> bool:
        """Whether a search near has looked wherever a template can have come to in ``since`` () frames."""
        length, angle = self.max_step
        return bool((2 * length * since <= HALF_WIDTH) & (2 * angle * since <= LARGEST_ANGLE))

    def search_anywhere(self, images: list[Tensor], estimate: Estimate, past: Past, r: int) -> Estimate:
        """Third attempt for template ``r``: anywhere in the frame, of places that look alike the nearest."""
        locator, pose = self.locator(r, (images[0].shape[-2], images[0].shape[-1])), past.pose[r]
        self.budget.spend(locator.work, ALIGNED)
        images += image_pyramid(images[-1], locator.levels - len(images) + 1)[1:]
        views = [image if len(image) == 1 else image[r : r + 1] for image in images]
        index = torch.tensor([r], device=pose.device)
        found, _ = locator.candidates(views, 0, pose, allowed=self.allowed(past, index))
        possible = ~self.max_step.exceeded(found.pose, pose, past.since[r])
        whole = share_in_sight(locator.pyramids[0][0], found.pose, images[0]) >= WHOLE
        found, best = found.at(possible), found.at(possible & whole)
        best = best.at(index.new_zeros(1)) if len(best.pose) else estimate.at(index)
        known = familiar(best, past.usual[index]) & ~strained(locator.pyramids[0][0], best)
        if not (known & beats(best, estimate.at(index))):
            return estimate
        radius = self.reference.place.radius[r]
        distance = pose_distance(best.pose[0], pose, radius=radius)
        others = LookAlikes.around(found, best.pose[0], radius).nearest(best.score[0], torch.ones_like(radius))
        twin = torch.minimum(others, self.twin(r, best.score[0], past, locator))
        if self.confusable(distance, twin, distance + self.max_step.reach(past.since[r], radius)):
            return told(estimate, [r], Reason.AMBIGUOUS)
        turned = torch.cat((best.pose[:, :2], unwrap(best.pose[:, 2:], pose[2])), -1)
        return estimate.put(index, best._replace(pose=turned))

    def not_misled(
        self, image: Tensor, estimate: Estimate, start: Tensor, past: Past, which: Tensor | None = None
    ) -> Estimate:
        """The ``estimate`` in which those templates ``which`` (R,), None for all, are lost that were tracked away from
        where they were expected, or to where nobody has seen them go, and that look-alikes may have led there."""
        known = zip(past.since.tolist(), past.found.tolist(), strict=True)
        each = zip((estimate.pose - start).tolist(), known, strict=True)
        if all(k == (1, 0) and math.hypot(x, y) + self.farthest * abs(q) <= BASIN for (x, y, q), k in each):
            return estimate  # as in most frames, of which this is to be seen at once
        radius = self.reference.place.radius
        away = gone_elsewhere(estimate, start, past, radius)
        strays = Status.good(estimate.status) & (away | (past.since > 1))
        strays &= (estimate.origin == Origin.TRACKED) if which is None else which
        index = strays.nonzero()[:, 0]
        if len(index) == 0:
            return estimate
        expected = ~strayed(estimate, start, past, radius, BASIN)[index]
        part = (past.since[index] > 1) & of_a_part(self.reference.select(index), estimate.at(index), past.first)
        seen = self.seen_whole(image, estimate, strays, past.usual)
        part |= (seen.score.maximum(estimate.score) < RECOGNISED * past.usual)[index]
        lost = strays.index_put((index,), part | self.doubtful(seen, index, start, past, expected))
        half = strays & ~lost & away & ((estimate.coverage < WHOLE) | ~within_margin(estimate.score, past.usual))
        estimate = disproved(estimate, lost, Reason.AMBIGUOUS)
        if not self.budget.left():
            return disproved(estimate, half, Reason.WAITING)
        return disproved(estimate, self.rivalled(image, estimate, half, past), Reason.AMBIGUOUS)

    def seen_whole(self, image: Tensor, estimate: Estimate, which: Tensor, usual: Tensor) -> Estimate:
        """The ``estimate`` in an ``image`` in which those of the templates ``which`` (R,) that are believed in part, or
        less than is ``usual`` (R,), have the score of the whole off the plane of light, as look-alikes have theirs, if
        it is not far from that."""
        doubted = (estimate.coverage < WHOLE) | (estimate.score < RECOGNISED * usual)
        index = (which & doubted).nonzero()[:, 0]
        if len(index) == 0:
            return estimate
        view = image.float() if len(image) == 1 else image[index].float()
        score = detrended_zncc_at(self.reference.select(index), view, estimate.pose.detach()[index])
        score = torch.where(score >= ALIKE * usual[index], score.to(estimate.score), estimate.score[index])
        return estimate._replace(score=estimate.score.index_copy(0, index, score))

    def rivalled(self, image: Tensor, estimate: Estimate, half: Tensor, past: Past) -> Tensor:
        """Which of the templates ``half`` (R,) recognised in an ``image`` are recognised as well at another place near
        the last one: a half of a template often looks like what is beside it."""
        index = half.nonzero()[:, 0]
        if len(index) == 0:
            return half
        surroundings, view = self.surroundings(index.tolist()), image.float()
        self.budget.spend(surroundings.correlator.size, NEARBY_ALIGNED * len(index))
        place, score = surroundings.candidates(view if len(view) == 1 else view[index], past.pose[index])
        radius, here = self.reference.place.radius[index], estimate.pose.detach()[index]
        beside = (pose_distance(place, here[:, None], radius=radius[:, None]) > SUPPRESSION) & (score >= LEAST_SCORE)
        rivals = torch.zeros_like(index, dtype=torch.bool)
        for k in range(place.shape[1]):
            some = (beside[:, k] & ~rivals).nonzero()[:, 0]
            if len(some) == 0:
                continue
            which = index[some]
            seen = view if len(view) == 1 else view[which]
            found = solve(self.reference.select(which), seen, place[some, k], self.as_tracked)
            other = pose_distance(found.pose, here[some], radius=radius[some]) > SUPPRESSION
            known = Status.good(found.status) & (found.score >= RECOGNISED * past.usual[which])
            rivals[some] = other & known & (found.coverage >= RIVAL * estimate.coverage[which])
        return half.index_put((index,), rivals)

    def own(self, found: Estimate, before: Estimate, start: Tensor, past: Past) -> Estimate:
        """``found`` without the leaps from the ``start`` (R, 3) to where look-alikes of the templates may be as well:
        these are as ``before``."""
        leapt = (found.origin != before.origin).nonzero()[:, 0]
        if len(leapt) == 0:
            return found
        doubtful = leapt[self.doubtful(found, leapt, start, past, past.since[leapt] == 1)]
        return told(found.put(doubtful, before.at(doubtful)), doubtful.tolist(), Reason.AMBIGUOUS)

    def doubtful(self, found: Estimate, index: Tensor, start: Tensor, past: Past, expected: Tensor) -> Tensor:
        """Of templates at ``index`` (n,) whether the places ``found`` (R, ...) may be those of look-alikes: (n,) bool.
        These are known around the last place only; farther away are only places that were ``expected`` (n,)."""
        raised = self.raised(found.score, past.usual)
        which: list[int] = index.tolist()
        twin = torch.stack([self.near_twin(r, found.score[r], raised[r], which, past) for r in which])
        radius = self.reference.place.radius[index]
        distance, moved = (pose_distance(found.pose[index], p[index], radius=radius) for p in (start, past.pose))
        guessed = past.since[index] > 1  # where it is expected, which may be far from where it was last
        distance = torch.where(guessed, torch.maximum(distance, moved), distance)
        farthest = moved + self.max_step.reach(past.since[index], radius)
        return self.confusable(distance, twin, farthest) | (~expected & (moved > KNOWN))

    @staticmethod
    def confusable(distance: Tensor, twin: Tensor, farthest: Tensor) -> Tensor:
        """Whether (...) a place at a ``distance`` (...) from where a template is expected may be that of its ``twin``
        (...) px away, if that is no farther than the ``farthest`` (...) that can have come there."""
        return (distance > NEARER * twin) & (twin <= farthest)

    def raised(self, score: Tensor, usual: Tensor) -> Tensor:
        """By what factor (R,) scores are higher than they were in the first frame, as far as the ``usual`` one (R,)
        tells and a place of ``score`` (R,) or (), which would be a look-alike's: there is less noise now."""
        return (torch.maximum(score, usual) / self.expected.clamp(min=1e-6)).clamp(min=1.0)

    def rejoin(self, image: Tensor, estimate: Estimate, past: Past) -> Estimate:
        """Where most have gone the same way from the first frame, those that are lost are tried there, which costs
        next to nothing."""
        good = Status.good(estimate.status)
        lost = (~good).nonzero()[:, 0]
        expected = gone_together(estimate, past.home, good) if len(image) == 1 and len(lost) else None
        return estimate if expected is None else self.tried(image.float(), estimate, expected, lost, past.usual)

    def follow(self, image: Tensor, estimate: Estimate, start: Tensor, usual: Tensor) -> Estimate:
        """Where several have been found away from their ``start`` (R, 3) and most have gone the same way, all that have
        not are tried there."""
        good, searched = Status.good(estimate.status), estimate.origin != Origin.TRACKED
        expected = gone_together(estimate, start, good & searched) if len(image) == 1 else None
        if expected is None:
            return estimate
        off = torch.hypot(*(estimate.pose - expected)[:, :2].T) > TOGETHER
        doubted = torch.tensor(suspect(estimate, usual), device=start.device) | searched
        return self.tried(image, estimate, expected, (doubted & (off | ~good)).nonzero()[:, 0], usual)

    def tried(self, image: Tensor, estimate: Estimate, expected: Tensor, index: Tensor, usual: Tensor) -> Estimate:
        """The ``estimate`` with templates at ``index`` (n,) where they are ``expected`` (R, 3), if they are there."""
        if len(index) == 0:
            return estimate
        found, good = solve(self.reference.select(index), image, expected[index], self.settings), estimate.ok[index]
        known = familiar(found, usual[index]) & (~good | within_margin(found.score, estimate.score[index]))
        found = found._replace(origin=torch.full_like(found.origin, int(Origin.NEARBY)))
        return estimate.put(index[known], found.at(known))

    def twin(self, r: int, score: Tensor, past: Past, locator: Locator) -> Tensor:
        """How far () from template ``r`` the nearest look-alike in the first frame is that is as good as a ``score``
        ()."""
        if r not in self.anywhere:
            first = past.first if len(past.first) == 1 else past.first[r : r + 1]
            self.anywhere[r] = look_alikes_anywhere(locator, first.float(), past.home[r])
        raised = self.raised(score, past.usual)[r]
        twin = self.anywhere[r].nearest(score, raised)  # of many it knows the best, not the nearest
        return twin if bool(twin.isinf()) else twin.minimum(self.near_twin(r, score, raised, [r], past))

    def near_twin(self, r: int, score: Tensor, raised: Tensor, which: list[int], past: Past) -> Tensor:
        """The same () of those within REACH, looked for around all templates ``which`` it is about at once."""
        unseen = [r for r in which if r not in self.near]
        if unseen:
            self.near |= zip(unseen, self._look_near(unseen, past), strict=True)
        return self.near[r].nearest(score, raised)

    @lasting
    def _look_near(self, templates: list[int], past: Past) -> list[LookAlikes]:
        index = torch.tensor(templates, device=past.home.device)
        first = past.first if len(past.first) == 1 else past.first[index]
        return look_alikes_near(self.reference.select(index), first.float(), past.home[index], self.settings)

    @lasting
    def surroundings(self, due: list[int]) -> Nearby:
        """The search near where the templates ``due`` are expected, kept while they are the same ones."""
        if self.nearby is None or self.nearby[0] != due:
            index = torch.tensor(due, device=self.reference.K.device)
            self.nearby = due, Nearby.of(self.reference.select(index))
        return self.nearby[1]

    @lasting
    def locator(self, r: int, size: tuple[int, int]) -> Locator:
        """The search for template ``r``; those last used are kept."""
        if r not in self.locators:
            template = self.reference.select(torch.tensor([r], device=self.reference.K.device))
            new = Locator(template, size, replace(self.settings, min_visible=LEAST_VISIBLE))
            while self.locators and new.size + sum(each.size for each in self.locators.values()) > KEPT:
                del self.locators[next(iter(self.locators))]
            self.locators[r] = new
        return self.locators[r]
