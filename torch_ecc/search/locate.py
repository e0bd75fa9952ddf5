"""Find templates anywhere in a frame, at any angle, without a start: global search, coarse to fine (section V).

The correlation with every place and turn at a coarse level (``bank``) gives candidates; Gauss-Newton brings each to its
local best, level by level, and drops those that lead to the same pose or fall behind. When several places look alike,
the template's ``details`` are searched for at full resolution as well.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.align import solve
from torch_ecc.core.ambient import lasting, plain
from torch_ecc.core.criteria import centred, safe_inverse
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.frame import as_gray
from torch_ecc.core.pose import unwrap
from torch_ecc.core.pyramid import pyramid
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import Sampler, halve, inside
from torch_ecc.core.settings import Settings
from torch_ecc.core.solver import State, iterate
from torch_ecc.search.bank import Bank, details, search_level

LEVELS = 8  # of a pyramid at most: it ends where the template gets too small
SMALLEST_FRAME = 12  # px: a frame is not halved below this side
CANDIDATES = 192  # local maxima of the correlation that are looked at, if so many are nearly as high as the best one
HANDICAP = (
    0.25,
    0.1,
)  # of correlation: what the best place may lack on the grid of pixels and turns; once it is aligned
HOPELESS = 0.3  # correlation of what needs no closer look
FEWEST = 6  # candidates that are looked at, however low
SURVIVORS = 16  # of them, brought to the next level
FINALISTS = 3  # of them, brought to the answer
TURNS = 4  # and their half turns, at which details are looked for
DETAILED = 4  # places with the right details, brought to the answer
LONGEST_WAY = 1.0  # px at the farthest pixel: a refinement that took a pose farther begins anew from there
REPEATS = 3  # of it at most
COARSE_ITERATIONS = 6
COARSE_TOLERANCE = 0.1  # px of a coarse level
NEIGHBOURS = 1.5  # px of the search's level at the farthest pixel: maxima nearer than that lead to one pose
DISTINCT = 1.5  # px at the farthest pixel: nearer than that two poses are one
LEAST_SEEN = 0.4  # of a template's weight must lie in the frame
AS_GOOD = (1.5, 0.01)  # a runner-up is as good if what its score lacks to 1 is at most a times the best one's, plus b


class Located(NamedTuple):
    """Where B templates were found.

    ``estimate`` (B, ...): the best pose, theta in (-pi, pi], and its status; LOST where nothing in the frame looks
    like the template, the pose being that of what looks most like it; ``displacement`` is what the last refinement has
    added. ``score`` (B,): correlation in [-1, 1] without the plane of light, by which candidates are ranked (the
    estimate's own is with it). ``runner_up`` and ``runner_up_score``: the same of the best pose at another place or
    angle; score -1 where there is none. ``ambiguous`` (B,) bool: the runner-up is as good, or the texture does not
    fix the pose.
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
    **options: str | float,
) -> Located:
    """Poses of B prepared templates anywhere in their images, (B or 1, 1, H, W), at any angle -> Located.

    At least 0.4 of a template must lie in the frame. For many frames make a ``Locator`` once. ``options``: of the last
    refinement, as in settings.Settings. Raises ValueError for bad shapes, dtypes, devices, NaN and unknown options.
    """
    if not isinstance(reference, Reference):
        raise ValueError(f"locate: reference must come from prepare, got {type(reference).__name__}")
    settings = Settings.of("locate", {"min_visible": LEAST_SEEN, **options})
    gray = as_gray("locate", "image", image)
    return Locator(reference, (gray.shape[-2], gray.shape[-1]), settings)(gray)


class Locator:
    """Search for B prepared templates in frames of ``size`` (h, w), prepared once.

    ``settings``: of the last refinement.
    """

    @lasting
    def __init__(self, reference: Reference, size: tuple[int, int], settings: Settings | None = None) -> None:
        self.size = size
        self.settings = settings or Settings(min_visible=LEAST_SEEN)
        self.pyramids, self.banks = [], []
        device = reference.K.device
        for b in range(len(reference.K)):
            references = pyramid(reference.select(torch.tensor([b], device=device)), LEVELS)
            level = min(search_level(references), max((min(size) // SMALLEST_FRAME).bit_length() - 1, 0))
            h, w = (-(-n // 2**level) for n in size)
            self.pyramids.append(references[: level + 1])
            self.banks.append(Bank.of(references[level], (h, w)))

    @property
    def levels(self) -> int:
        """How many levels of a frame it needs."""
        return max(map(len, self.pyramids))

    @plain
    @torch.no_grad()
    def __call__(self, image: Tensor, near: Tensor | None = None) -> Located:
        """The templates in ``image``, (1 or B, 1, H, W) or as the tracker takes it, of the locator's size; of places
        that look alike the one nearest to ``near`` (B, 2 or 3), px (and rad), if that is given."""
        gray = as_gray("locate", "image", image)
        count, device = len(self.banks), self.banks[0].turns.device
        if gray.shape[-2:] != self.size or len(gray) not in (1, count):
            (h, w), n = self.size, f"1 or {count}" if count > 1 else "1"
            raise ValueError(f"locate: image must be {n} of {w}x{h} px, got {tuple(gray.shape)}")
        if gray.device != device:
            raise ValueError(f"locate: image must be on the reference's device {device}, got {gray.device}")
        if near is not None and (near.dim() != 2 or len(near) != count or near.shape[1] not in (2, 3)):
            raise ValueError(f"locate: near must be ({count}, 2) or ({count}, 3), got {tuple(near.shape)}")
        images = halvings(gray, self.levels)
        places = [None] * count if near is None else list(near.to(self.pyramids[0][0].place.radius))
        return _decide([self.candidates(images, b, places[b], closer=True) for b in range(count)])

    def candidates(
        self, images: list[Tensor], b: int, near: Tensor | None = None, *, closer: bool = False
    ) -> tuple[Estimate, Tensor]:
        """Template ``b`` in frames given as ``halvings`` (1 or B, 1, h, w): a few distinct poses (K, ...) and their
        scores (K,), the best first; of equally good ones those nearest to ``near`` (2,) or (3,) first.

        ``closer``: when they are ambiguous, or none was near the best, places with the right details come in as well.
        """
        images = [image if len(image) == 1 else image[b : b + 1] for image in images]
        reference = self.pyramids[b][0]
        pose = self.coarse(images, b)
        chosen, rest = pose[:FINALISTS], pose[FINALISTS:]
        if near is not None and len(rest):
            chosen = torch.cat((chosen, rest[distance(rest, near, reference.place.radius).argmin()][None]))
        found = self.refined(images[0], b, chosen)
        best = _decide([ranked(found, reference.place.radius)])
        slid = distance(best.pose, chosen, reference.place.radius).min() > LONGEST_WAY  # perhaps past the place
        if closer and bool(best.ambiguous | slid):
            turns = both_ways(pose[:, 2], reference.place.radius)
            more = self.refined(images[0], b, details(reference, images[0][0, 0], turns, DETAILED))
            found = Estimate(*map(torch.cat, zip(found[0], more[0], strict=True))), torch.cat((found[1], more[1]))
        return ranked(found, reference.place.radius, near)

    def refined(self, image: Tensor, b: int, pose: Tensor) -> tuple[Estimate, Tensor]:
        """Template ``b`` aligned with ``image`` (1, 1, H, W) from poses (K, 3): estimate and score."""
        copies = _copies(self.pyramids[b][0], len(pose))
        estimate = solve(copies, image, pose, self.settings)
        for _ in range(REPEATS):  # where the texture lets a pose slide, iterations are spent on the way
            way = distance(estimate.displacement, torch.zeros_like(pose), copies.place.radius)
            far = (way > LONGEST_WAY).nonzero()[:, 0]
            if len(far) == 0:
                break
            again = solve(_copies(copies, len(far)), image, estimate.pose[far], self.settings)
            estimate = Estimate(*(e.index_copy(0, far, a) for e, a in zip(estimate, again, strict=True)))
        return estimate, likeness(copies, image, estimate.pose)

    def coarse(self, images: list[Tensor], b: int) -> Tensor:
        """Poses (K, 3) of template ``b`` in one frame before they are refined at its full resolution, best first."""
        references, bank = self.pyramids[b], self.banks[b]
        top = len(references) - 1
        pose, score = bank.candidates(images[top][0, 0], CANDIDATES)
        pose = pose[foremost(pose, score, references[top].place.radius, NEIGHBOURS, HANDICAP[0])]
        for level in range(top, min(top, 1) - 1, -1):  # the last level is left to the refinement
            pose = descend(references[level], images[level], pose)
            pose = pose * pose.new_tensor((2.0, 2.0, 1.0)) if level else pose
        return torch.cat((pose[:, :2], unwrap(pose[:, 2:], torch.zeros_like(pose[:, 2:]))), -1)


def halvings(image: Tensor, levels: int) -> list[Tensor]:
    """``image`` (B, 1, H, W) and its ``levels`` - 1 coarser ones."""
    images = [image]
    while len(images) < levels:
        images.append(halve(images[-1]))
    return images


def descend(reference: Reference, image: Tensor, pose: Tensor) -> Tensor:
    """Candidates (K, 3) of one template brought to their best nearby: those that differ and may be it, best first."""
    copies = _copies(reference, len(pose))
    state, *_ = iterate(copies, image, "bilinear", State.start(pose), COARSE_TOLERANCE, COARSE_ITERATIONS)
    before, after = likeness(copies, image, pose), likeness(copies, image, state.pose)
    pose = torch.where((after > before)[:, None], state.pose, pose)
    return pose[foremost(pose, torch.maximum(before, after), reference.place.radius, DISTINCT, HANDICAP[1])[:SURVIVORS]]


def likeness(reference: Reference, image: Tensor, pose: Tensor) -> Tensor:
    """Correlation (K,) off the plane of light at poses (K, 3); -1 where too little of the template is in the image."""
    warp = reference.warps(pose)
    weight = reference.weight * inside(warp, reference.grid.pixels, (image.shape[-2], image.shape[-1]))
    score = flat_correlation(reference, weight, Sampler.of(image)(warp, reference.grid.pixels))
    enough = (weight.sum(-1) >= LEAST_SEEN * reference.weight.sum(-1)) & pose.isfinite().all(-1)
    return torch.where(enough, score, -1.0)


def flat_correlation(reference: Reference, weight: Tensor, g: Tensor) -> Tensor:
    """Correlation (K,) of the templates and patches g (K, N) under ``weight`` (K, N) without their planes 1, u, v."""
    planes = torch.cat((torch.ones_like(g)[:, None], reference.uv), 1)
    weighted = planes * weight[:, None]
    inverse, _ = safe_inverse(weighted @ planes.mT)
    both = torch.stack((reference.signal[:, 3], g - g.mean(-1, keepdim=True)), -1)
    t, g = (both - planes.mT @ (inverse @ (weighted @ both))).unbind(-1)
    (t0, dt), (g0, dg) = centred(t, weight), centred(g, weight)
    norm = dt * dg
    score = (weight * t0 * g0).sum(-1) / norm.clamp(min=1e-30)
    return torch.where(norm > 1e-12 * (weight * g * g).sum(-1), score, 0.0).clamp(-1, 1)


def distance(a: Tensor, b: Tensor, radius: Tensor) -> Tensor:
    """How far poses (..., 3) are apart at most at ``radius`` px, (...): the turn is left out if ``b`` is (..., 2)."""
    step = a[..., : b.shape[-1]] - b
    turn = unwrap(step[..., 2:], torch.zeros_like(step[..., 2:])).abs().sum(-1)
    return torch.hypot(step[..., 0], step[..., 1]) + radius * turn


def distinct(pose: Tensor, score: Tensor, radius: Tensor, apart: float = DISTINCT) -> Tensor:
    """Indices of the poses (K, 3) that are ``apart`` px from all of a better score (K,), the best first."""
    order = score.argsort(descending=True, stable=True)
    same = distance(pose[order][:, None], pose[order][None], radius) < apart
    return order[~same.tril(-1).any(-1)]


def both_ways(turn: Tensor, radius: Tensor) -> Tensor:
    """The first TURNS of ``turn`` (K,) rad that are DISTINCT px apart at ``radius``, and the same turned by half."""
    axis = F.pad(2 * turn[:, None], (2, 0))  # a turn and its half turn are one
    first = turn[distinct(axis, -torch.arange(len(turn), device=turn.device), radius / 2)[:TURNS]]
    return unwrap(torch.cat((first, first + math.pi)), torch.zeros_like(first[:1]))


def ranked(found: tuple[Estimate, Tensor], radius: Tensor, near: Tensor | None = None) -> tuple[Estimate, Tensor]:
    """Distinct ones of found poses (K, ...) with their scores (K,), the best first; of equally good ones those nearest
    to ``near`` (2,) or (3,) first."""
    estimate, score = found
    order = distinct(estimate.pose, score, radius)
    if near is not None:
        away = distance(estimate.pose[order], near, radius)
        away = torch.where(as_good(score[order], score[order[0]]), away, torch.inf)
        order = order[away.argsort(stable=True)]
    return Estimate(*(value[order] for value in estimate)), score[order]


def foremost(pose: Tensor, score: Tensor, radius: Tensor, apart: float, behind: float) -> Tensor:
    """``distinct`` of those whose score (K,) is not too low, nor more than ``behind`` the best one; CANDIDATES at most,
    and at least FEWEST before duplicates are dropped, so that a runner-up is among them."""
    top, first = score.topk(min(2 * CANDIDATES, len(score)))
    hopeful = top >= (top[0] - behind).clamp(min=HOPELESS)
    hopeful[:FEWEST] = True
    first = first[hopeful]
    return first[distinct(pose[first], score[first], radius, apart)[:CANDIDATES]]


def _copies(reference: Reference, count: int) -> Reference:
    return reference.select(torch.zeros(count, dtype=torch.int64, device=reference.K.device))


def as_good(score: Any, best: Any) -> Any:
    """Whether a ``score`` tells no worse match than the ``best`` one, any shape: bool."""
    factor, slack = AS_GOOD
    return 1 - score <= factor * (1 - best) + slack


def _decide(found: list[tuple[Estimate, Tensor]]) -> Located:
    """Best and runner-up of each template's candidates (K, ...)."""

    def pick(rank: int) -> tuple[Estimate, Tensor]:
        rows = [(e, s, min(rank, len(s) - 1)) for e, s in found]
        fields = zip(*([value[k] for value in e] for e, _, k in rows), strict=True)
        score = torch.stack([s[k] if k == rank else torch.full_like(s[0], -1.0) for _, s, k in rows])
        return Estimate(*map(torch.stack, fields)), score

    (best, score), (second, other) = pick(0), pick(1)
    alike = as_good(torch.minimum(score, other), torch.maximum(score, other))
    return Located(best, score, second, other, alike | (best.status == Status.LOW_TEXTURE))
