"""Find templates anywhere in a frame, at any angle, without a start: global search, coarse to fine (section V).

The correlation with every place and angle at a coarse level (``bank``) gives candidates. Gauss-Newton aligns them,
level by level; score margins and non-maximum suppression leave few of them. When the best are ambiguous, places that
a whitened matched filter finds at full resolution (``matched_filter``) come in as well.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.align import engine_for, solve
from torch_ecc.core.ambient import lasting, plain, threads_for
from torch_ecc.core.criteria import centred, safe_inverse
from torch_ecc.core.estimate import Estimate, Origin, Status
from torch_ecc.core.filters import downsample
from torch_ecc.core.frame import as_gray
from torch_ecc.core.pose import unwrap
from torch_ecc.core.pyramid import pyramid
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import Sampler, inside
from torch_ecc.core.settings import Settings
from torch_ecc.core.sight import filled, picked
from torch_ecc.core.verdict import within_margin
from torch_ecc.search.bank import Bank, most_levels, search_level
from torch_ecc.search.matched_filter import whitened_matches
from torch_ecc.search.nearby import Allowed

SMALLEST_FRAME = 12  # px: a frame is not downsampled below this side
CANDIDATES = 192  # local maxima that are aligned at most: those of score s >= max(LEAST_SCORE, s_best - margin)
LEAST_SCORE = 0.3
GRID_MARGIN, ALIGNED_MARGIN = 0.25, 0.1  # of scores on the grid of pixels and angles; of aligned poses
FEWEST = 6  # the best so many go on whatever their scores
SUPPRESSION = 1.5  # px of a level at the farthest pixel: of poses nearer to each other the best one is kept
SURVIVORS = 16  # candidates aligned at the next level
FINALISTS = 3  # of them, refined at full resolution
FILTER_ANGLES = 4  # and their half turns, at which the whitened matched filter looks
FILTER_MATCHES = 4  # of its places, refined at full resolution
RESTART_DISTANCE = 1.0  # px at the farthest pixel: a refinement that took a pose farther begins anew from there
MAX_RESTARTS = 3
COARSE = Settings("bilinear", max_iterations=6, tolerance=0.1, robust=False)  # of alignments in a coarse level, its px
LEAST_VISIBLE = 0.4  # of a template's weight must lie in the frame


class Located(NamedTuple):
    """Where B templates were found.

    ``estimate`` (B, ...): the best pose, theta in (-pi, pi], and its status; LOST where nothing in the frame looks
    like the template, the pose being that of what looks most like it; ``displacement`` is what the last refinement has
    added. ``score`` (B,): ZNCC in [-1, 1] off the plane of light, by which candidates are ranked (the estimate's own
    is with it). ``runner_up`` and ``runner_up_score``: the same of the best pose at another place or angle; score -1
    where there is none. ``ambiguous`` (B,) bool: the runner-up is as good, 1 - s <= a (1 - s_best) + b with
    AMBIGUITY_MARGIN (a, b), or the texture does not fix the pose.
    """

    estimate: Estimate
    score: Tensor
    runner_up: Estimate
    runner_up_score: Tensor
    ambiguous: Tensor

    @property
    def pose(self) -> Tensor:
        """(B, 3) px, px, rad."""
        return self.estimate.pose

    @property
    def status(self) -> Tensor:
        """(B,) int8, see Status."""
        return self.estimate.status


@plain
def locate(
    reference: Reference,
    image: Tensor,
    **options: str | float | bool,
) -> Located:
    """Poses of B prepared templates anywhere in their images, (B or 1, 1, H, W), at any angle -> Located.

    At least 0.4 of a template must lie in the frame. For many frames make a ``Locator`` once. ``options``: of the last
    refinement, as in settings.Settings. Raises ValueError for bad shapes, dtypes, devices, NaN and unknown options.
    """
    if not isinstance(reference, Reference):
        raise ValueError(f"locate: reference must come from prepare, got {type(reference).__name__}")
    settings = Settings.of("locate", {"min_visible": LEAST_VISIBLE, **options})
    with threads_for(1):
        gray = as_gray("locate", "image", image)
        locator = Locator(reference, (gray.shape[-2], gray.shape[-1]), settings)
    return locator(gray)


class Locator:
    """Search for B prepared templates in frames of ``size`` (h, w), prepared once.

    ``settings``: of the last refinement.
    """

    @lasting
    def __init__(self, reference: Reference, size: tuple[int, int], settings: Settings | None = None) -> None:
        self.frame = size
        # A wrong place must not be made right by leaving out what does not fit.
        self.settings = replace(settings or Settings(min_visible=LEAST_VISIBLE), robust=False)
        self.pyramids, self.banks = [], []
        for b in range(len(reference.place.radius)):
            one = reference.select(torch.tensor([b], device=reference.place.radius.device))
            references = pyramid(one, most_levels(one))
            level = min(search_level(references), max((min(size) // SMALLEST_FRAME).bit_length() - 1, 0))
            h, w = (-(-n // 2**level) for n in size)
            self.pyramids.append(references[: level + 1])
            self.banks.append(Bank.of(references[level], (h, w)))

    @property
    def levels(self) -> int:
        """How many levels of a frame it needs."""
        return max(map(len, self.pyramids))

    @property
    def size(self) -> int:
        """How many complex numbers are kept."""
        return sum(bank.correlator.size for bank in self.banks)

    @property
    def work(self) -> int:
        """How many complex numbers a search multiplies."""
        return sum(bank.correlator.size * len(bank.corners) for bank in self.banks)

    @plain
    @torch.no_grad()
    def __call__(self, image: Tensor, near: Tensor | None = None) -> Located:
        """The templates in ``image``, (1 or B, 1, H, W) or as the tracker takes it, of the locator's size; of places
        that are as good the one nearest to ``near`` (B, 2 or 3), px (and rad), if that is given."""
        with threads_for(self.frame[0] * self.frame[1]):
            return self._located(image, near)

    def _located(self, image: Tensor, near: Tensor | None) -> Located:
        gray = as_gray("locate", "image", image)
        count, device = len(self.banks), self.banks[0].angles.device
        if gray.shape[-2:] != self.frame or len(gray) not in (1, count):
            (h, w), n = self.frame, f"1 or {count}" if count > 1 else "1"
            raise ValueError(f"locate: image must be {n} of {w}x{h} px, got {tuple(gray.shape)}")
        if gray.device != device:
            raise ValueError(f"locate: image must be on the reference's device {device}, got {gray.device}")
        if near is not None and (near.dim() != 2 or len(near) != count or near.shape[1] not in (2, 3)):
            raise ValueError(f"locate: near must be ({count}, 2) or ({count}, 3), got {tuple(near.shape)}")
        sight = self.pyramids[0][0].sight
        images = image_pyramid(gray if sight is None else filled(gray, sight.shown), self.levels)
        places = [None] * count if near is None else list(near.to(self.pyramids[0][0].place.radius))
        return _best_two([self.candidates(images, b, places[b], matched_filter=True) for b in range(count)])

    def candidates(
        self,
        images: list[Tensor],
        b: int,
        near: Tensor | None = None,
        *,
        matched_filter: bool = False,
        allowed: Allowed | None = None,
    ) -> tuple[Estimate, Tensor]:
        """Template ``b`` in the levels ``images`` (1 or B, 1, h, w) of a frame: a few distinct poses (K, ...) and their
        scores (K,), the best first; of those as good the nearest to ``near`` (2,) or (3,) first. Poses that are not
        ``allowed`` are looked at only where there are no others.

        ``matched_filter``: when they are ambiguous, or none was near the best, those of its places come in as well.
        """
        images = [image if len(image) == 1 else image[b : b + 1] for image in images]
        reference = self.pyramids[b][0]
        radius = reference.place.radius
        pose = self.coarse(images, b, allowed=allowed)
        finalists, others = pose[:FINALISTS], pose[FINALISTS:]
        if near is not None and len(others):
            nearest = pose_distance(others, near, radius=radius).argmin()
            finalists = torch.cat((finalists, others[nearest][None]))
        found = self.refined(images[0], b, finalists)
        best = _best_two([ranked(found, radius=radius)])
        slid = pose_distance(best.pose, finalists, radius=radius).min() > RESTART_DISTANCE  # perhaps past the place
        if matched_filter and bool(best.ambiguous | slid):
            angles = with_half_turns(pose[:, 2], radius)
            matches = whitened_matches(reference, images[0][0, 0], angles=angles, most=FILTER_MATCHES)
            estimate, score = self.refined(images[0], b, matches)
            found = Estimate(*map(torch.cat, zip(found[0], estimate, strict=True))), torch.cat((found[1], score))
        return ranked(found, radius=radius, near=near)

    def refined(self, image: Tensor, b: int, pose: Tensor) -> tuple[Estimate, Tensor]:
        """Template ``b`` aligned with ``image`` (1, 1, H, W) from poses (K, 3): estimate and score."""
        reference = self.pyramids[b][0]
        copies = reference.copies(len(pose))
        estimate = solve(copies, image, pose, self.settings)
        for _ in range(MAX_RESTARTS):  # where the texture lets a pose slide, iterations are spent on the way
            distance = pose_distance(estimate.displacement, torch.zeros_like(pose), radius=copies.place.radius)
            spent = estimate.status == Status.MAX_ITERATIONS
            far = (spent & (distance > RESTART_DISTANCE)).nonzero()[:, 0]
            if len(far) == 0:
                break
            again = solve(reference.copies(len(far)), image, estimate.pose[far], self.settings)
            estimate = estimate.put(far, again)
        estimate = estimate._replace(origin=torch.full_like(estimate.origin, int(Origin.ANYWHERE)))
        return estimate, detrended_zncc_at(copies, image, estimate.pose)

    def coarse(
        self, images: list[Tensor], b: int, near: Tensor | None = None, allowed: Allowed | None = None
    ) -> Tensor:
        """Poses (K, 3) of template ``b`` in one frame before they are refined at its full resolution, best first; of
        many only the SURVIVORS nearest to ``near`` (3,), if that is given."""
        references, bank = self.pyramids[b], self.banks[b]
        top = len(references) - 1
        pose, score = bank.candidates(images[top][0, 0], CANDIDATES)
        if allowed is not None:
            score = torch.where(allowed(pose * pose.new_tensor((2.0**top, 2.0**top, 1.0)))[0], score, -1.0)
        pose = pose[shortlist(pose, score, radius=references[top].place.radius, margin=GRID_MARGIN)]
        if near is not None:
            place = near / near.new_tensor((2.0**top, 2.0**top, 1.0))
            pose = pose[pose_distance(pose, place, radius=references[top].place.radius).argsort()[:SURVIVORS]]
        for level in range(top, min(top, 1) - 1, -1):  # the last level is left to the refinement
            pose = aligned(references[level], images[level], pose)
            pose = pose * pose.new_tensor((2.0, 2.0, 1.0)) if level else pose
        return torch.cat((pose[:, :2], unwrap(pose[:, 2:], torch.zeros_like(pose[:, 2:]))), -1)


def image_pyramid(image: Tensor, levels: int) -> list[Tensor]:
    """``image`` (B, 1, H, W) and its ``levels`` - 1 coarser ones."""
    images = [image]
    while len(images) < levels:
        images.append(downsample(images[-1]))
    return images


def aligned(reference: Reference, image: Tensor, pose: Tensor) -> Tensor:
    """Candidates (K, 3) of one template aligned with one level: the SURVIVORS of them, best first."""
    copies = reference.copies(len(pose))
    there = engine_for(copies, image, COARSE)(copies, image, pose, COARSE, None).pose
    before, after = detrended_zncc_at(copies, image, pose), detrended_zncc_at(copies, image, there)
    pose, score = torch.where((after > before)[:, None], there, pose), torch.maximum(before, after)
    return pose[shortlist(pose, score, radius=reference.place.radius, margin=ALIGNED_MARGIN)[:SURVIVORS]]


def detrended_zncc_at(reference: Reference, image: Tensor, pose: Tensor) -> Tensor:
    """Detrended ZNCC (K,), off the plane of light, at poses (K, 3); -1 where too little of the template is visible."""
    warp, pixels = reference.warps(pose), reference.grid.pixels
    weight = reference.weight * inside(warp, pixels, (image.shape[-2], image.shape[-1]))
    weight = weight if reference.sight is None else weight * picked(reference.sight.clear, warp, pixels)
    score = detrended_zncc(reference, weight, Sampler.of(image)(warp, pixels))
    visible = weight.sum(-1) >= LEAST_VISIBLE * reference.weight.sum(-1)
    return torch.where(visible & pose.isfinite().all(-1), score, -1.0)


def detrended_zncc(reference: Reference, weight: Tensor, g: Tensor) -> Tensor:
    """ZNCC (K,) of the templates and patches g (K, N) under ``weight`` (K, N) off the planes 1, u, v."""
    planes = torch.cat((torch.ones_like(g)[:, None], reference.uv), 1)
    weighted = planes * weight[:, None]
    inverse, _ = safe_inverse(weighted @ planes.mT)
    both = torch.stack((reference.signal[:, 3], g - g.mean(-1, keepdim=True)), -1)
    t, g = (both - planes.mT @ (inverse @ (weighted @ both))).unbind(-1)
    (t0, dt), (g0, dg) = centred(t, weight), centred(g, weight)
    norm = dt * dg
    score = (weight * t0 * g0).sum(-1) / norm.clamp(min=1e-30)
    return torch.where(norm > 1e-12 * (weight * g * g).sum(-1), score, 0.0).clamp(-1, 1)


def pose_distance(a: Tensor, b: Tensor, *, radius: Tensor) -> Tensor:
    """How far poses (..., 3) are apart at most at ``radius`` px, (...): |dx, dy| + radius |dtheta|, without the angle
    if ``b`` is (..., 2)."""
    step = a[..., : b.shape[-1]] - b
    angle = unwrap(step[..., 2:], torch.zeros_like(step[..., 2:])).abs().sum(-1)
    return torch.hypot(step[..., 0], step[..., 1]) + radius * angle


def non_maximum_suppression(pose: Tensor, score: Tensor, *, radius: Tensor) -> Tensor:
    """Indices of the poses (K, 3) that are SUPPRESSION px at ``radius`` from all of a better score (K,), best first."""
    order = score.argsort(descending=True, stable=True)
    near = pose_distance(pose[order][:, None], pose[order][None], radius=radius) < SUPPRESSION
    return order[~near.tril(-1).any(-1)]


def shortlist(pose: Tensor, score: Tensor, *, radius: Tensor, margin: float) -> Tensor:
    """Indices of the poses (K, 3) whose score (K,) is high enough to go on with, best first, after suppression.

    s >= max(LEAST_SCORE, s_best - ``margin``), CANDIDATES at most; and the FEWEST best before suppression, so that a
    runner-up is among them.
    """
    top, index = score.topk(min(2 * CANDIDATES, len(score)))
    high = top >= (top[0] - margin).clamp(min=LEAST_SCORE)
    high[:FEWEST] = True
    index = index[high]
    return index[non_maximum_suppression(pose[index], score[index], radius=radius)[:CANDIDATES]]


def with_half_turns(angle: Tensor, radius: Tensor) -> Tensor:
    """The first FILTER_ANGLES of ``angle`` (K,) rad that are SUPPRESSION px apart at ``radius``, then their half turns:
    an angle and its half turn count as one."""
    axis = F.pad(2 * angle[:, None], (2, 0))
    by_order = -torch.arange(len(angle), device=angle.device)
    first = angle[non_maximum_suppression(axis, by_order, radius=radius / 2)[:FILTER_ANGLES]]
    return unwrap(torch.cat((first, first + math.pi)), torch.zeros_like(first[:1]))


def ranked(found: tuple[Estimate, Tensor], *, radius: Tensor, near: Tensor | None = None) -> tuple[Estimate, Tensor]:
    """Distinct ones of found poses (K, ...) with their scores (K,), the best first; of those as good the nearest to
    ``near`` (2,) or (3,) first."""
    estimate, score = found
    order = non_maximum_suppression(estimate.pose, score, radius=radius)
    if near is not None:
        distance = pose_distance(estimate.pose[order], near, radius=radius)
        distance = torch.where(within_margin(score[order], score[order[0]]), distance, torch.inf)
        order = order[distance.argsort(stable=True)]
    return estimate.at(order), score[order]


def _best_two(found: list[tuple[Estimate, Tensor]]) -> Located:
    """Best and runner-up of each template's candidates (K, ...) and scores (K,), the best first."""

    def pick(rank: int) -> tuple[Estimate, Tensor]:
        rows = [(estimate, score, min(rank, len(score) - 1)) for estimate, score in found]
        fields = zip(*([value[k] for value in estimate] for estimate, _, k in rows), strict=True)
        scores = [score[k] if k == rank else torch.full_like(score[0], -1.0) for _, score, k in rows]
        return Estimate(*map(torch.stack, fields)), torch.stack(scores)

    (best, score), (second, other) = pick(0), pick(1)
    ambiguous = within_margin(torch.minimum(score, other), torch.maximum(score, other))
    return Located(best, score, second, other, ambiguous | (best.status == Status.LOW_TEXTURE))
