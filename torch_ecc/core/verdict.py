"""The verdict: score, covariance and status of solved templates, from the sums of their last look, for every engine.

It is made for every frame, of few numbers: what can be known before is, and on a CPU what nobody needs is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from torch_ecc.core.ambient import constant, lasting
from torch_ecc.core.clinging import clinging, scale_of
from torch_ecc.core.covariance import (
    Sandwich,
    coherence,
    hidden,
    largest_variance,
    pose_covariance,
    sandwich,
    unevenness,
)
from torch_ecc.core.criteria import centred, safe_inverse
from torch_ecc.core.estimate import Estimate, Reason, Status
from torch_ecc.core.noise import NOISE_SHARE
from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.pose import turn
from torch_ecc.core.pushed import Push
from torch_ecc.core.reference import Reference, copied
from torch_ecc.core.sampling import SAMPLERS, is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution
from torch_ecc.core.unlike import unlike

LEAST_COVERAGE = 0.5  # of the weight in sight must be believed: else what covers the template may be taken for it
LEAST_INFORMATION = 0.2  # of that of all pixels in sight must be left in what is believed, in x, y and theta each
AMBIGUITY_MARGIN = (1.5, 0.01)  # (a, b): a score s is as good as the best if 1 - s <= a (1 - s_best) + b
LARGEST_SIGMA = 0.5  # px at the farthest pixel: beyond it the texture does not fix the pose
LITTLE_NOISE = 0.1  # of the information: where it lies is no matter
MOST_UNEVEN = 2.0  # times the template's noise there may be where its gradients count: what more is left is none
UNEVEN_SHARE = 0.75  # of the information may be noise that was seen there, NOISE_SHARE if it is only supposed
LEAST_SHARE = 0.2  # of the information, if it is white: with less, noise of no spectrum fixes a pose
DOUBTFUL_SHARE = 0.8  # of the noise that there may be, as the likely reason why a template was not found
LEAST_CONTRAST = 0.1  # of the template's: what has less is flat, and so is what has no more than
BARE_NOISE = 2.0  # times the template's noise
ALIKE = 0.7  # correlation of what is coarse from which it is the template
FINE = 0.5  # of the template's share of what is finer: less is left of it where it is blurred
PLANAR = 1e-5  # of a patch's power: what is left of it off the plane of light is rounding

Number = TypeVar("Number", float, Tensor)

# The tests of ``verdict`` in their order, and what the first one that fails tells.
VERDICTS = (
    (Status.OUT_OF_VIEW, Reason.OUT_OF_VIEW),  # too little of the template's weight lies in the frame
    (Status.LOST, Reason.UNLIKE),  # what is believed of it does not look like the template
    (Status.LOST, Reason.INVERTED),  # it looks like its negative
    (Status.LOST, Reason.COVERED),  # too little of what lies there is believed
    (Status.LOW_TEXTURE, Reason.UNSURE),  # the pose is not observable: sigma is too large
    (Status.LOW_TEXTURE, Reason.NOISE),  # or is what the template's own noise makes it
    (Status.MAX_ITERATIONS, Reason.MOVING),  # it was still moving
    (Status.CONVERGED, Reason.NONE),  # no test fails
)


class Instruments(NamedTuple):
    """Of B templates: which have so much ``noise`` (B,) bool that it matters where it is, and by how much blocks count
    there, ``weight`` (B, blocks, 1), see ``unevenness``."""

    noisy: Tensor
    weight: Tensor


class Known(NamedTuple):
    """What the verdict on B templates needs, the same in every frame: ``free`` and ``template_free`` (B,), the degrees
    of freedom of what a residual's square sum is made of, frame and template; ``per_frame`` (B,), one over how many
    frames a template is the mean of; ``clusters`` (B, 9), see ``clinging.scale_of``, None if there are too few blocks;
    ``share`` (B,), ``noise_share`` of a variance of 1; ``instruments``, None if noise matters in none;
    ``sandwich``, see there."""

    free: Tensor
    template_free: Tensor
    per_frame: Tensor
    clusters: Tensor | None
    share: Tensor
    instruments: Instruments | None
    sandwich: Sandwich


def known_of(reference: Reference, normal: Normal, interpolation: str) -> Known:
    """Of templates of which those pixels count that ``normal`` is about."""
    noise, per_frame = reference.noise, reference.noise.frames.reciprocal()
    return Known(
        SAMPLERS[interpolation].noise_gain * normal.freedom,
        per_frame * normal.freedom,
        per_frame,
        scale_of(reference.grid, normal),
        normal.noise_share / NOISE_SHARE,
        instruments(reference, normal),
        sandwich(noise, normal, interpolation),
    )


def instruments(reference: Reference, normal: Normal) -> Instruments | None:
    """See ``Known``."""
    noisy = normal.noise_share * reference.noise.power > LITTLE_NOISE
    if is_cpu(noisy.device) and not bool(noisy.any()):
        return None
    weight, wiener = reference.blocks.weight, reference.blocks.wiener
    mean = (wiener * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
    return Instruments(noisy, (wiener / mean.clamp(min=LEAST))[:, :, None])


def known(reference: Reference, normal: Normal, interpolation: str) -> Known:
    """The same; made once where all pixels count and nobody asks for its gradients."""
    if normal is not reference.normal or normal.bread.requires_grad or torch.compiler.is_compiling():
        return known_of(reference, normal, interpolation)
    kept = reference.verdicts
    if interpolation not in kept and reference.one is not None:
        one = known(reference.one, reference.one.normal, interpolation)
        kept[interpolation] = copied(one, len(reference.K))
    elif interpolation not in kept:
        kept[interpolation] = lasting(known_of)(reference, normal, interpolation)
    return kept[interpolation]


def judge(
    reference: Reference,
    found: Solution,
    start: Tensor,
    settings: Settings,
    origin: Tensor | None = None,
    push: Push | None = None,
) -> Estimate:
    """The record of B solved templates; failed ones get their ``start`` (B, 3) back. ``displacement`` counts from
    ``origin`` (B, 3), by default the start. ``push``: what tells texture from noise."""
    normal, total, pose, axes = found.normal, found.total, found.pose, turn(found.pose.select(1, 2))
    constant = known(reference, normal, settings.interpolation)
    power, error, score = found.gain * found.gain, total.select(1, 6), correlation(normal, total)
    # One image's noise v: of the residuals' mean square the template's part is gain^2 v / frames, the frame's, sampled,
    # NG v.
    variance = error / torch.addcmul(constant.free, power, constant.template_free)
    of_template, seen = variance * constant.per_frame, variance / power
    (bias, most), white = biases(reference, found, constant, of_template), torch.addcmul(variance, of_template, power)
    clings = clinging(reference, found, white, constant.clusters)
    coherent = None if settings.interpolation not in reference.noise.alias else coherence(axes, reference.grid.sides)
    covariance = pose_covariance(constant.sandwich, seen, power, bias, clings.scatter, coherent)
    unseen = hidden(reference, found, seen), unlike(reference, found, score, clings)
    unobservable = largest_variance(reference.place.lever2, covariance), constant.share * most
    visible, believed = seen_and_believed(reference, found)
    share, on_cpu = normal.noise_share * variance, is_cpu(pose.device)
    if push is not None and normal is reference.normal and not (on_cpu and max(share.tolist()) <= LEAST_SHARE):
        share = push.unanswered(share)
    amounts = visible, score, found.gain, believed, *unobservable, found.error, share
    for more in (clings.strained, *unseen):  # which are no lack of texture
        covariance = covariance if more is None else covariance + more
    covariance = torch.bmm(torch.bmm(axes, covariance), axes.mT)
    tracked, status, reason = (codes.clone() for codes in _zeros(len(pose), pose.device))
    rms = (error / normal.total).sqrt()
    if not (on_cpu and beyond_doubt(amounts, settings)):
        status, reason = verdict(reference, found, amounts, settings, push)
        good = Status.good(status)
        unfitted = ~good & ~normal.noise_share.isfinite()  # singular: all that is in sight of the patch is left
        rms = torch.where(unfitted, (total[:, 2] / normal.total.clamp(min=LEAST)).sqrt(), rms)
        pose = torch.where(good[:, None], pose, start)
        covariance = torch.where(good[:, None, None], covariance, unknown(covariance))
    moved = pose - (start if origin is None else origin)
    return Estimate(pose, moved, score, status, found.iterations, covariance, rms, tracked, believed, reason)


def biases(reference: Reference, found: Solution, constant: Known, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Variances (B,) of the templates' noise where their gradients count, of which frames have ``seen`` (B,) in all of
    them: that which is likely, and that by which its share of the information is told."""
    even = torch.minimum(seen, reference.noise.power)
    if constant.instruments is None:
        return even, even
    noisy, weights = constant.instruments
    uneven = even * unevenness(weights, found, found.normal is reference.normal)
    likely = torch.where(noisy, torch.minimum(uneven, MOST_UNEVEN * reference.noise.power), even)
    return likely, torch.maximum(even, NOISE_SHARE / UNEVEN_SHARE * likely)


def beyond_doubt(amounts: Sequence[Tensor], settings: Settings) -> bool:
    """Whether the host sees that all templates pass all tests."""
    tests = zip(amounts, _limits(settings), strict=True)
    return all(sign * value >= limit for amount, (sign, limit) in tests for value in amount.tolist())  # NaN never is


def verdict(
    reference: Reference,
    found: Solution,
    amounts: Sequence[Tensor],
    settings: Settings,
    push: Push | None = None,
) -> tuple[Tensor, Tensor]:
    """Status and reason codes (B,) int8 from the ``amounts``, (B,) each, that ``VERDICTS`` are about, of which the
    second is the score: light that varies and noise must not make a stranger of the template. The last one is the share
    of the information that noise is if it is white. Where that may be noise of another kind, and all else is well,
    noise is what a ``push`` leaves."""
    visible, score, *others, noise, error, share = amounts
    match = torch.maximum(score, detrended(found.normal, found.total))
    match = torch.maximum(match, without_noise(reference, found, score))
    first = failed(torch.stack((visible, match, *others, noise, error), 1), settings)
    doubtful = (share > LEAST_SHARE) & Status.good(_codes(0, first.device).index_select(0, first))
    if push is not None and not (is_cpu(first.device) and not bool(doubtful.any())):
        noise = torch.maximum(noise, push(found, doubtful))
        first = failed(torch.stack((visible, match, *others, noise, error), 1), settings)
    return explained(reference, found, first, match, settings.min_score)


def failed(amounts: Tensor, settings: Settings) -> Tensor:
    """Which of the tests of ``VERDICTS`` the ``amounts`` (B, 7) are the first to fail, (B,): the last one is none."""
    sign, limit = _limit_tensors(settings, amounts.dtype, amounts.device)
    passed = (amounts * sign >= limit).to(torch.int8)  # NaN passes nothing
    return torch.nn.functional.pad(passed, (0, 1)).argmin(1)


def explained(
    reference: Reference, found: Solution, failed: Tensor, match: Tensor, min_score: float
) -> tuple[Tensor, Tensor]:
    """Status and reason codes (B,) int8 of templates that have ``failed`` (B,) a test, by what else is known of them,
    as the correlation (B,) of what is believed, the ``match``."""
    status, reason = (_codes(k, failed.device).index_select(0, failed) for k in (0, 1))
    lost = status == Status.LOST
    textureless = noise_share(reference, reference.normal) > DOUBTFUL_SHARE  # that is why it was not found
    low = textureless & (lost | (status == Status.OUT_OF_VIEW))
    if not (is_cpu(low.device) and bool(low.all())):
        reason = torch.where(lost & (match < -min_score), int(Reason.INVERTED), reason)
        soft = (lost | (reason == Reason.UNSURE)) & blurred(reference, found)
        reason = torch.where(soft, int(Reason.BLURRED), reason)
        reason = torch.where(lost & without_contrast(reference, found), int(Reason.FLAT), reason)
    reason = torch.where(low, int(Reason.NOISE), reason).to(torch.int8)
    return torch.where(low, int(Status.LOW_TEXTURE), status).to(torch.int8), reason


def without_contrast(reference: Reference, found: Solution) -> Tensor:
    """Where (B,) what is believed is as good as flat."""
    normal = found.normal
    most = torch.maximum(LEAST_CONTRAST**2 * normal.energy, BARE_NOISE * reference.noise.of_frame * normal.total)
    flat: Tensor = found.total[:, 2] <= most
    return flat


def blurred(reference: Reference, found: Solution) -> Tensor:
    """Where (B,) blocks look like the template's but for what is finer than they are."""
    blocks, (count, g, square), noise = reference.blocks, found.sums[:, :3].unbind(1), reference.noise.of_frame
    shares = []
    for n, one, two in ((count, g, square), (blocks.weight, blocks.t, blocks.square)):
        inside, power = (two - one * one / n.clamp(min=LEAST)).sum(1), (noise * n.sum(1)).to(n)
        shares.append((inside - power).clamp(min=0) / (two.sum(1) - power).clamp(min=LEAST))
    return (coarse_correlation(reference, found.sums) >= ALIKE) & (shares[0] <= FINE * shares[1])


def coarse_correlation(reference: Reference, sums: Tensor, trust: Tensor | None = None) -> Tensor:
    """That (B,) of the means of blocks with ``sums`` (B, 10, blocks) with the template's."""
    weight = sums[:, 0] if trust is None else sums[:, 0] * trust
    g, t = sums[:, 1] / sums[:, 0].clamp(min=LEAST), reference.blocks.t / reference.blocks.weight.clamp(min=LEAST)
    (g, norm), (t, contrast) = centred(g, weight), centred(t, weight)
    return (g * t * weight).sum(1) / (norm * contrast).clamp(min=LEAST)


def _limits(settings: Settings) -> list[tuple[int, float]]:
    """Which way each amount counts, and how much it has to be at least."""
    least = settings.min_visible, settings.min_score, torch.finfo(torch.float32).tiny, LEAST_COVERAGE
    most = LARGEST_SIGMA**2, 1.0, settings.tolerance, LEAST_SHARE
    return [*((1, value) for value in least), *((-1, -value) for value in most)]


@constant
def _limit_tensors(settings: Settings, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The same of those that ``VERDICTS`` are about, (7,) each."""
    sign, limit = zip(*_limits(settings)[:7], strict=True)
    return torch.tensor(sign, dtype=dtype, device=device), torch.tensor(limit, dtype=dtype, device=device)


@constant
def _codes(column: int, device: torch.device) -> Tensor:
    """Of ``VERDICTS``: (8,) int8."""
    return torch.tensor([int(verdict[column]) for verdict in VERDICTS], dtype=torch.int8, device=device)


def seen_and_believed(reference: Reference, found: Solution) -> tuple[Tensor, Tensor]:
    """The share (B,) of the template's weight in sight, and of that what was believed: 0 if that holds next to none of
    the information."""
    normal, whole = found.normal, reference.normal
    if found.trust is None:
        all_of_it = torch.ones_like(found.error)
        return (all_of_it if normal is whole else normal.total / whole.total), all_of_it
    seen = found.sums[:, 0].sum(1, dtype=normal.total.dtype)
    visible, believed = seen / whole.total, normal.total / seen.clamp(min=LEAST)
    information = (normal.bread.diagonal(dim1=1, dim2=2) / whole.bread.diagonal(dim1=1, dim2=2)).amin(1)
    return visible, torch.where(information >= LEAST_INFORMATION * visible, believed, 0.0)


def expected_score(reference: Reference) -> Tensor:
    """The correlation (B,) of the template and another image of it with the noise that a frame seems to have."""
    noise, normal = reference.noise, reference.normal
    mean = (1 + noise.frames.to(noise.level)) / 2  # of the frame's noise and the template's, over the template's
    return (1 - noise.level.square() * mean * normal.total / normal.energy).clamp(min=0.0)


def just_as_good(best: Number) -> Number:
    """The least score s that is as good as the ``best`` one, any shape: 1 - s = a (1 - s_best) + b."""
    a, b = AMBIGUITY_MARGIN
    return 1 - a * (1 - best) - b


def within_margin(score: Tensor, best: Tensor) -> Tensor:
    """Whether a ``score`` s is as good as the ``best`` one, any shape: bool."""
    return score >= just_as_good(best)


def correlation(normal: Normal, total: Tensor) -> Tensor:
    """Zero-mean normalised correlation (B,) from the sums (B, ...) of ``solution.summed``; 0 where either is flat."""
    power = (total[:, 2] * normal.energy).clamp_(min=torch.finfo(total.dtype).tiny)
    return (total[:, 3] * power.rsqrt_()).clamp_(-1, 1)


def detrended(normal: Normal, total: Tensor) -> Tensor:
    """The same off the planes 1, u, v in template and patch: unlike ``correlation`` it does not change in light that
    varies across the template."""
    planes, along = normal.gram[:, :3, :3], normal.gram[:, :3, 3:]
    both = torch.cat((along, torch.stack((total[:, 1], total[:, 4], total[:, 5]), 1)[:, :, None]), -1)
    power = both.mT @ safe_inverse(planes)[0] @ both  # of both in the planes, (B, 2, 2)
    tt, gg, tg = normal.gram[:, 3, 3] - power[:, 0, 0], total[:, 2] - power[:, 1, 1], total[:, 3] - power[:, 0, 1]
    solid = (tt > PLANAR * normal.energy) & (gg > PLANAR * total[:, 2])
    return torch.where(solid, tg * (tt * gg).clamp(min=torch.finfo(tg.dtype).tiny).rsqrt(), 0.0).clamp(-1, 1)


def without_noise(reference: Reference, found: Solution, score: Tensor) -> Tensor:
    """What the ``score`` (B,) would be without noise that hides a dim template: over what the template's noise lets
    expect, and no more than the correlation of the blocks' means, in which noise is next to nothing."""
    coarse = coarse_correlation(reference, found.sums, found.trust)
    return torch.minimum(score / expected_score(reference).clamp(min=LEAST), coarse)


def noise_share(reference: Reference, normal: Normal, variance: Tensor | None = None) -> Tensor:
    """The largest part (B,) of the information in any direction that the template's noise can be, whose variance is at
    most ``variance`` (B,), over what it may be. Infinite or NaN where the texture leaves a direction open."""
    power, frames = reference.noise.power, reference.noise.frames
    power = power if variance is None else torch.minimum(power, variance / frames)
    return normal.noise_share / NOISE_SHARE * power


def predicted_sigma(reference: Reference, normal: Normal, variance: Tensor) -> Tensor:
    """Sigma (B, 3) px, px, rad of poses in frames with noise of ``variance`` (B,), of templates that are seen there as
    they are; infinite where the pose is not observable."""
    bias = torch.minimum(variance / reference.noise.frames, reference.noise.power)
    covariance = pose_covariance(sandwich(reference.noise, normal), variance, torch.ones_like(variance), bias)
    observable = largest_variance(reference.place.lever2, covariance) <= LARGEST_SIGMA**2
    observable &= noise_share(reference, normal, variance) <= 1
    return torch.where(observable[:, None], covariance.diagonal(dim1=1, dim2=2).sqrt(), torch.inf)


def unknown(covariance: Tensor) -> Tensor:
    """The ``covariance`` (..., 3, 3) of what was not found: (3, 3)."""
    return _infinite(covariance.dtype, covariance.device)


@constant
def _infinite(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.diag(torch.full((3,), inf, dtype=dtype, device=device))


@constant
def _zeros(count: int, device: torch.device) -> list[Tensor]:
    """Origin, status and reason codes (B,) of poses that no search has given, and that nothing speaks against."""
    return [torch.zeros(count, dtype=torch.int8, device=device) for _ in range(3)]
