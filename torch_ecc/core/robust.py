"""Robust solve: where blocks of a patch do not fit, they are trusted less, by iteratively re-weighted least squares.

What covers a part of a template leaves residuals there that no noise explains; whole blocks of pixels show that where
single pixels do not. Least squares is tried first: if all blocks fit alike, that is the answer. Else each block's trust
follows from its residual, at first at the start and under a model that a minority of blocks cannot bend (medians), then
where the engine comes to with that trust, until it settles.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torch_ecc.core.normal import LEAST
from torch_ecc.core.reference import BLOCK, Blocks, Reference, each
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, Trust
from torch_ecc.core.verdict import LEAST_COVERAGE, correlation, coverage, expected_score, within_margin

OUTLIER = 3.0  # times the variance that is expected of a block: beyond it less and less is believed
DISTRUST = 3.0  # trust = (OUTLIER / ratio)^this
NO_TRUST = 0.02  # less is none
QUANTILE, TO_MEDIAN = 0.3, 1.13  # of the blocks' variances: a scale that covers of well over half cannot raise
LEAST_SLIP, SLIP = 0.00125, 0.045  # px^2 / 2: blocks may seem to have slipped by 0.05 px rms, as of the sampler,
FIRST_SLIP = 1.0  # to 0.3 px, as of blur; before the solve by more
LEAST_NOISE = 0.01  # of the template's contrast: smaller residuals shift nothing
NOISIER = 1.5  # times the usual residual variance: more is no noise where blocks do not fit alike
SEEN = 0.5  # of a block's weight must be in sight for it to tell the scale
ROUNDS = 5
BASIN = 8.0  # px at the farthest pixel: what is seen in part is not farther from the start
SETTLED = 0.01  # of the template's weight: trust changes no more


class Engine(Protocol):
    """A whole implementation of the loop: ``solver`` or ``native``."""

    @staticmethod
    def solve(
        reference: Reference, image: Tensor, start: Tensor, settings: Settings, trust: Trust | None = None
    ) -> Solution:
        """Poses of B templates in (B or 1, 1, H, W) from ``start`` (B, 3) on, or of those that ``trust`` is about."""
        ...


class Scale(NamedTuple):
    """The variance expected per pixel of a block: ``noise`` + ``slip`` * (mean square of its slopes), (B, 1) each."""

    noise: Tensor
    slip: Tensor


def solve(
    engine: Engine, reference: Reference, image: Tensor, start: Tensor, settings: Settings, usual: Tensor | None = None
) -> Solution:
    """Poses of B templates in (B or 1, 1, H, W) from ``start`` (B, 3) on; ``usual`` (B,): their scores so far."""
    found = engine.solve(reference, image, start, settings)
    if not settings.robust:
        return found
    usual = expected_score(reference) if usual is None else usual
    blocks, seen, floor = reference.blocks, found.sums[:, 0], least_noise(reference)
    variance = residual_variance(found.sums)
    scale = robust_scale(variance, blocks, seen, floor, Scale(floor + inf, torch.full_like(floor, SLIP)))
    uneven = (excess(variance, blocks, seen, scale) > OUTLIER).any(1)
    doubtful = uneven | ~within_margin(correlation(found.normal, found.total), usual)
    index = torch.arange(len(start), device=start.device)
    if is_cpu(start.device):  # nowhere else does the host ask
        index = doubtful.nonzero()[:, 0]
        if len(index) == 0:
            return found
    again = reweighted(engine, reference, image, start, settings, usual, index)
    # Far from the answer nothing fits: perhaps least squares has come nearer, unless it has slid away from the cover.
    way = ((found.pose - start) * reference.place.lever)[index]
    far = (coverage(again) < LEAST_COVERAGE) & (torch.linalg.vector_norm(way, dim=1) < BASIN)
    if not is_cpu(start.device) or bool(far.any()):
        there = reweighted(engine, reference, image, found.pose, settings, usual, index)
        again = each(lambda old, new: _put(old, torch.arange(len(index), device=index.device), new, far), again, there)
    # Noise may have grown in all of the patch: then least squares is right, and only the scale is not.
    better = doubtful[index] & (uneven[index] | (coverage(again) > LEAST_COVERAGE))
    found = found._replace(trust=torch.ones_like(variance))
    return each(lambda old, new: _put(old, index, new, better), found, again)


def _put(old: Tensor, index: Tensor, new: Tensor, better: Tensor) -> Tensor:
    """``old`` (B, ...) with what is ``better`` (n,) of the ``new`` (n, ...) at ``index`` (n,)."""
    chosen = torch.where(better.view(-1, *[1] * (new.dim() - 1)), new, old[index])
    return old.index_copy(0, index, chosen)


def reweighted(
    engine: Engine,
    reference: Reference,
    image: Tensor,
    start: Tensor,
    settings: Settings,
    usual: Tensor,
    index: Tensor,
) -> Solution:
    """The templates at ``index`` (n,) solved from their ``start`` (B, 3) with trust that has settled."""
    blocks, floor = each(lambda value: value[index], reference.blocks), least_noise(reference)[index]
    whole = Trust(index, torch.ones_like(blocks.count))
    look = engine.solve(reference, image, start, settings.once, whole)
    variance, gain = median_fit(look.sums, blocks)
    normal = look.normal
    contrast = (normal.energy / normal.total.clamp(min=LEAST))[:, None] * gain.square()
    most = (NOISIER * (1 - usual[index, None]) * contrast).to(floor.dtype).maximum(floor)
    scale = robust_scale(variance, blocks, look.sums[:, 0], floor, Scale(most, torch.full_like(most, FIRST_SLIP)))
    trusted = trust(excess(variance, blocks, look.sums[:, 0], scale))
    place = start
    for _ in range(ROUNDS):
        found = engine.solve(reference, image, place, settings, Trust(index, trusted))
        variance = residual_variance(found.sums)
        most = Scale(scale.noise, scale.slip.clamp(max=SLIP))  # no cover may talk itself in
        scale = robust_scale(variance, blocks, found.sums[:, 0], floor, most)
        before, trusted = trusted, trust(excess(variance, blocks, found.sums[:, 0], scale))
        change = ((trusted - before).abs() * blocks.count).sum(1)
        if is_cpu(start.device) and bool((change <= SETTLED * blocks.count.sum(1)).all()):
            break
        place = start.index_copy(0, index, found.pose)
    return found._replace(trust=before)


def trust(ratio: Tensor) -> Tensor:
    """How much is believed of blocks (B, n) whose variance is ``ratio`` times what is expected: 1, or falling to 0."""
    weight = (OUTLIER / ratio.clamp(min=OUTLIER)).pow(DISTRUST)
    return torch.where(weight < NO_TRUST, 0.0, weight)


def excess(variance: Tensor, blocks: Blocks, seen: Tensor, scale: Scale) -> Tensor:
    """Residual ``variance`` (B, n) of blocks over what is expected; of those with less weight ``seen`` (B, n) than that
    of a block's pixels by as much less over 1 as noise scatters more in them."""
    ratio = variance / torch.addcmul(scale.noise, scale.slip, blocks.slope)
    return (ratio - 1).mul_((seen / BLOCK**2).clamp_(max=1).sqrt_()).add_(1)


def least_noise(reference: Reference) -> Tensor:
    """Variance (B, 1) that noise has at least: that of the template's, or next to nothing of its contrast."""
    contrast = reference.normal.energy / reference.normal.total.clamp(min=LEAST)
    least = torch.maximum(reference.noise.power, LEAST_NOISE**2 * contrast)
    return least.to(reference.K.dtype).unsqueeze(1)


def residual_variance(sums: Tensor) -> Tensor:
    """Mean square (B, n) of each block's residuals from the sums (B, 10, n)."""
    return sums[:, 6] / sums[:, 0].clamp(min=LEAST)


def robust_scale(variance: Tensor, blocks: Blocks, seen: Tensor, floor: Tensor, most: Scale) -> Scale:
    """The scale of block variances (B, n): noise from the flatter half of the blocks, slip from the others.

    ``seen`` (B, n): weight in sight; ``floor`` (B, 1): the least noise; ``most``: the largest scale.
    """
    there = seen > SEEN * blocks.count
    noise = quantile(variance, blocks.flat & there).minimum(most.noise).maximum(floor)
    slip = quantile((variance - noise) / blocks.slope.clamp(min=LEAST), blocks.steep & there)
    return Scale(noise, slip.clamp(min=LEAST_SLIP).minimum(most.slip))


def quantile(values: Tensor, used: Tensor) -> Tensor:
    """What a share of QUANTILE of the values (B, n) that are ``used`` does not exceed, brought to their median as of
    noise: (B, 1)."""
    ranked = torch.where(used, values, torch.inf).sort(1).values
    rank = (used.sum(1, keepdim=True) * QUANTILE).long()
    return (ranked.gather(1, rank) * TO_MEDIAN).nan_to_num(0.0, 0.0, 0.0)


def median_fit(sums: Tensor, blocks: Blocks) -> tuple[Tensor, Tensor]:
    """Each block's mean square (B, n) of what gain * t + offset leaves of it, and the gain (B, 1): the median of those
    of single blocks, weighted by their contrast, as is the offset. A minority of blocks does not move them."""
    weight, g, gg, tg = sums[:, :4].unbind(1)
    seen, some = weight / blocks.count.clamp(min=LEAST), weight.clamp(min=LEAST)
    t, tt = blocks.t * seen, blocks.square * seen
    contrast = (tt - t * t / some).clamp(min=0)
    gain = weighted_median((tg - t * g / some) / contrast.clamp(min=LEAST), contrast * blocks.steep)
    offset = weighted_median((g - gain * t) / some, weight)
    left = gg - 2 * (gain * tg + offset * g) + gain * gain * tt + 2 * gain * offset * t + offset * offset * weight
    return left.clamp(min=0) / some, gain


def weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    """(B, n), (B, n) -> (B, 1)."""
    ranked, order = values.sort(1)
    share = weight.gather(1, order).cumsum(1)
    middle = (share < share[:, -1:] / 2).sum(1, keepdim=True)
    return ranked.gather(1, middle.clamp(max=values.shape[1] - 1))
