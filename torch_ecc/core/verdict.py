"""The verdict: score, covariance and status of solved templates, from the sums of their last look, for every engine.

It is made for every frame, of few numbers: what can be known before is, and on a CPU what nobody needs is left out.
"""

from __future__ import annotations

from math import inf
from typing import TypeVar

import torch
from torch import Tensor

from torch_ecc.core.ambient import constant
from torch_ecc.core.clinging import clinging
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.estimate import Estimate, Reason, Status
from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.pose import turn
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import SAMPLERS, is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution

LEAST_COVERAGE = 0.5  # of the weight in sight must be believed: else what covers the template may be taken for it
LEAST_INFORMATION = 0.2  # of that of all pixels in sight must be left in what is believed, in x, y and theta each
AMBIGUITY_MARGIN = (1.5, 0.01)  # (a, b): a score s is as good as the best if 1 - s <= a (1 - s_best) + b
LARGEST_SIGMA = 0.5  # px at the farthest pixel: beyond it the texture does not fix the pose
NOISE_SHARE = 0.6  # of the information in some direction is the template's noise: not even a good match helps, but
CHANCE = 42.0  # over the square root of the number of pixels: noise as such is within so much of all of it
DOUBTFUL_SHARE = 0.8  # of the noise that there may be, as the likely reason why a template was not found
LEAST_CONTRAST = 0.1  # of the template's: what has less is flat, and so is what has no more than
BARE_NOISE = 2.0  # times the template's noise
PLANAR = 1e-5  # of a patch's power: what is left of it off the plane of light is rounding

Number = TypeVar("Number", float, Tensor)

# The tests of ``decide`` in their order, and what the first one that fails tells.
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


def judge(
    reference: Reference, found: Solution, start: Tensor, settings: Settings, origin: Tensor | None = None
) -> Estimate:
    """The record of B solved templates; failed ones get their ``start`` (B, 3) back. ``displacement`` counts from
    ``origin`` (B, 3), by default the start."""
    normal, total, pose = found.normal, found.total, found.pose
    on_cpu = is_cpu(pose.device)
    match = score = correlation(normal, total)
    if not on_cpu or min(score.tolist()) < settings.min_score:
        match = torch.maximum(score, detrended(normal, total))  # light alone must not make a stranger of the template
    power, error, axes = found.gain.square(), total[:, 6], turn(pose[:, 2])
    of_both = 1 + power * reference.noise.place_share  # variance of template and frame together
    # One image's noise v: of the residuals' mean square the template's part is gain^2 v / frames, the frame's, sampled,
    # NG v.
    of_template = power / reference.noise.frames
    variance = error / (of_template + SAMPLERS[settings.interpolation].noise_gain).mul_(normal.freedom)
    scatter, strained = clinging(reference, found, variance, of_template.add_(1))
    alias = interpolation_error(reference, axes, settings.interpolation)
    covariance = pose_covariance(reference, normal, variance, of_both / power, axes, scatter, alias)
    visible, believed = seen_and_believed(reference, found)
    unobservable = largest_variance(reference, covariance), noise_share(reference, normal, variance)
    amounts = torch.stack((visible, match, found.gain, believed, *unobservable, found.error, score), 1)
    status, failed = decide(amounts, settings)  # strain is no lack of texture
    if strained is not None:
        covariance = torch.baddbmm(covariance, torch.bmm(axes, strained), axes.mT)
    worst, rms = max(status.tolist()) if on_cpu else max(Status), (error / normal.total).sqrt()
    tracked = reason = _zeros(len(pose), pose.device)  # Origin.TRACKED, Reason.NONE
    if worst > Status.CONVERGED:
        status, reason = explained(reference, found, failed, match, settings.min_score)
    if worst > Status.MAX_ITERATIONS:
        unfitted = ~normal.noise_share.isfinite()  # singular: all that is in sight of the patch is left
        rms = torch.where(unfitted, (total[:, 2] / normal.total.clamp(min=LEAST)).sqrt(), rms)
        good = Status.good(status)
        pose = torch.where(good[:, None], pose, start)
        covariance = torch.where(good[:, None, None], covariance, unknown(covariance))
    moved, last = pose - (start if origin is None else origin), (tracked.clone(), believed, reason.clone())
    return Estimate(pose, moved, score, status, found.iterations, covariance, rms, *last)


def decide(amounts: Tensor, settings: Settings) -> tuple[Tensor, Tensor]:
    """Status codes (B,) int8 from the ``amounts`` (B, 8) that ``VERDICTS`` are about, the last of which is never
    passed; and which test (B,) was the first to fail."""
    sign, limit = _limits(settings, amounts.dtype, amounts.device)
    first = (amounts * sign >= limit).to(torch.int8).argmin(1)  # NaN passes nothing
    return _codes(0, amounts.device).index_select(0, first), first


def explained(
    reference: Reference, found: Solution, failed: Tensor, match: Tensor, min_score: float
) -> tuple[Tensor, Tensor]:
    """Status and reason codes (B,) int8 of templates that have ``failed`` (B,) a test, by what else is known of them,
    as the correlation (B,) of what is believed, the ``match``."""
    status, reason = (_codes(k, failed.device).index_select(0, failed) for k in (0, 1))
    lost = status == Status.LOST
    reason = torch.where(lost & (match < -min_score), int(Reason.INVERTED), reason)
    reason = torch.where(lost & without_contrast(reference, found), int(Reason.FLAT), reason)
    textureless = noise_share(reference, reference.normal) > DOUBTFUL_SHARE  # that is why it was not found
    low = textureless & (lost | (status == Status.OUT_OF_VIEW))
    reason = torch.where(low, int(Reason.NOISE), reason).to(torch.int8)
    return torch.where(low, int(Status.LOW_TEXTURE), status).to(torch.int8), reason


def without_contrast(reference: Reference, found: Solution) -> Tensor:
    """Where (B,) what is believed is as good as flat."""
    normal = found.normal
    most = torch.maximum(LEAST_CONTRAST**2 * normal.energy, BARE_NOISE * reference.noise.of_frame * normal.total)
    flat: Tensor = found.total[:, 2] <= most
    return flat


@constant
def _limits(settings: Settings, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Which way each amount counts, and how much it has to be at least, (8,) each."""
    least = settings.min_visible, settings.min_score, torch.finfo(dtype).tiny, LEAST_COVERAGE
    most = LARGEST_SIGMA**2, 1.0, settings.tolerance
    limit = torch.tensor([*least, *(-m for m in most), inf], dtype=dtype, device=device)
    sign = torch.tensor([1, 1, 1, 1, -1, -1, -1, 1], dtype=dtype, device=device)
    return sign, limit


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
        return all_of_it if normal is whole else normal.total / whole.total, all_of_it
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


def interpolation_error(reference: Reference, axes: Tensor, interpolation: str) -> Tensor | None:
    """What aliasing in the sampler shifts poses with ``axes`` (B, 3, 3), see ``pose.turn``, by: a square root (B, 3, 2)
    of its covariance in the template's axes; None where it does not count.

    Where all pixels lie alike between the frame's (no rotation) their errors add up; over a turned template they
    cancel: the mean of exp(2 pi i k step) over n neighbours k is sin(pi n step) / (n sin(pi step)) but for its phase
    (Dirichlet). The shift is ``Noise.alias`` times the sine of the phase, whose mean square is one half.
    """
    alias = reference.noise.alias.get(interpolation)
    if alias is None:
        return None
    step = axes[:, 0, :2]
    step = step - step.round()
    coherent = torch.sinc(step * reference.grid.sides).div_(torch.sinc(step)).prod(1)
    return alias * coherent[:, None, None]


def pose_covariance(
    reference: Reference,
    normal: Normal,
    variance: Tensor,
    factor: Tensor,
    axes: Tensor,
    scatter: Tensor | None = None,
    alias: Tensor | None = None,
) -> Tensor:
    """Covariance (B, 3, 3) of poses with ``axes`` (B, 3, 3), see ``pose.turn``, when template and frame have noise of
    ``variance`` (B,): ``factor`` (B,) = 1 + 1 / gain^2 times the template's.

    Sandwich of the instrumental-variable estimate, v S^-1 (P / gain^2 + P_t) S^-T with P = Z~ Z~^T, turned from the
    template's axes to the frame's. The template's noise is taken out of S, and out of P for its own part P_t: a
    derivative is antisymmetric, so that noise times its own derivative sums to nothing. ``scatter`` (B, 1 or 3): see
    ``clinging``, by default white; ``alias`` (B, 3, 2): see ``interpolation_error``.
    """
    bias = torch.minimum(variance / reference.noise.frames, reference.noise.power)[:, None, None]
    bread = torch.addcmul(normal.bread, bias, normal.bread_bias, value=-1)
    meat = torch.addcmul(factor[:, None, None] * normal.meat, bias, normal.meat_bias, value=-1)
    cofactors = torch.linalg.cross(bread.roll(-1, 1), bread.roll(-2, 1))  # the inverse is their transpose / det
    determinant = (bread[:, :1] * cofactors[:, :1]).sum(2, keepdim=True)
    scale = (variance.unsqueeze(1) if scatter is None else scatter).sqrt().unsqueeze(2)
    bread = torch.bmm(axes, cofactors.mT * (scale / determinant))
    covariance = torch.bmm(torch.bmm(bread, meat), bread.mT)
    if reference.noise.place is not None:
        covariance = covariance + axes @ reference.noise.place @ axes.mT
    if alias is None:
        return covariance
    alias = torch.bmm(axes, alias)
    return torch.baddbmm(covariance, alias, alias.mT)


def largest_variance(reference: Reference, covariance: Tensor) -> Tensor:
    """Variance (B,) of the farthest pixel's place, px^2."""
    return (covariance.diagonal(dim1=1, dim2=2) * reference.place.lever2).sum(1)


def noise_share(reference: Reference, normal: Normal, variance: Tensor | None = None) -> Tensor:
    """The largest part (B,) of the information in any direction that the template's noise can be, whose variance is at
    most ``variance`` (B,), over what it may be: the more pixels there are, the better noise is told from texture.
    Infinite or NaN where the texture leaves a direction open."""
    power, frames = reference.noise.power, reference.noise.frames
    most = max(NOISE_SHARE, 1 - CHANCE / reference.grid.pixels.shape[1] ** 0.5)
    share = normal.noise_share * (power if variance is None else torch.minimum(power, variance / frames))
    return share.div(most)


def unknown(covariance: Tensor) -> Tensor:
    """The ``covariance`` (..., 3, 3) of what was not found: (3, 3)."""
    return _infinite(covariance.dtype, covariance.device)


@constant
def _infinite(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.diag(torch.full((3,), inf, dtype=dtype, device=device))


@constant
def _zeros(count: int, device: torch.device) -> Tensor:
    """The codes (B,) of poses that no search has given, and that nothing speaks against."""
    return torch.zeros(count, dtype=torch.int8, device=device)
