"""The verdict: score, covariance and status of solved templates, from the sums of their last look, for every engine."""

from __future__ import annotations

from functools import lru_cache
from math import inf

import torch
from torch import Tensor

from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.reference import Normal, Reference
from torch_ecc.core.sampling import SAMPLERS, host_looks
from torch_ecc.core.settings import Settings
from torch_ecc.core.solver import Solution

LARGEST_SIGMA = 0.5  # px at the farthest pixel: beyond it the texture does not fix the pose
NOISE_SHARE = 0.6  # of the information in some direction is the template's noise: not even a good match helps
FEW_BLOCKS = 4  # blocks per fitted column below which residuals cannot tell whether they cling together
DOUBTFUL_SHARE = 0.5  # of the information, as the likely reason why a template was not found
PLANAR = 1e-5  # of a patch's power: what is left of it off the plane of light is rounding


def judge(reference: Reference, found: Solution, start: Tensor, settings: Settings) -> Estimate:
    """The record of B solved templates; failed ones get their ``start`` (B, 3) back."""
    normal, noise_model, pose = found.normal, reference.noise, found.pose
    sums = found.sums.sum(-1, dtype=pose.dtype).nan_to_num(0.0, 0.0, 0.0)
    gain = found.gain.nan_to_num(0.0, 0.0, 0.0)
    clustered = torch.linalg.vecdot(*2 * [found.sums[:, 7:]]).to(pose.dtype)
    match = score = correlation(normal, sums)
    if not host_looks(pose.device) or min(score.tolist()) < settings.min_score:
        match = torch.maximum(score, detrended(normal, sums))  # light alone must not make a stranger of the template
    square = gain * gain
    # One image's noise: of the residuals' mean square the template's share is gain^2 v and the frame's, sampled, NG v.
    variance = sums[:, 6] / (normal.freedom * (square + SAMPLERS[settings.interpolation].noise_gain)).clamp(min=1e-30)
    scatter = cluster_robust(reference, normal, clustered / (1 + square)[:, None], variance)
    alias = interpolation_error(reference, pose, settings.interpolation)
    covariance, observable = pose_covariance(reference, normal, variance, square, pose, scatter, alias)
    status = decide(
        normal.total >= settings.min_visible * reference.normal.total,
        (match >= settings.min_score) & (gain > 0),
        observable,
        found.error <= settings.tolerance,
        noise_model.level.square() * reference.normal.noise_share > DOUBTFUL_SHARE,
    )
    good = Status.good(status)
    pose = torch.where(good[:, None], pose, start)
    covariance = torch.where(good[:, None, None], covariance, _unknown(pose.dtype, pose.device))
    rms = (sums[:, 6] / normal.total.clamp(min=1e-30)).clamp(min=0).sqrt()
    return Estimate(pose, pose - start, score, status, found.iterations, covariance, rms)


def decide(visible: Tensor, similar: Tensor, observable: Tensor, converged: Tensor, textureless: Tensor) -> Tensor:
    """Status codes (B,) int8, from (B,) bool each: enough of a template is ``visible``, it looks ``similar``, its
    texture makes the pose ``observable``, the iterations have ``converged``, it is ``textureless`` from the start."""
    codes = _codes(converged.device)
    status = torch.where(converged, codes[Status.CONVERGED], codes[Status.MAX_ITERATIONS])
    status = torch.where(observable, status, codes[Status.LOW_TEXTURE])
    status = torch.where(similar, status, codes[Status.LOST])
    status = torch.where(visible, status, codes[Status.OUT_OF_VIEW])
    return torch.where(textureless & ~(similar & visible), codes[Status.LOW_TEXTURE], status)  # that is why


def correlation(normal: Normal, sums: Tensor) -> Tensor:
    """Zero-mean normalised correlation (B,) from the sums (B, 10) of ``solver.summed``; 0 where either is flat."""
    tiny = torch.finfo(sums.dtype).tiny
    return (sums[:, 3] * (sums[:, 2] * normal.energy).clamp(min=tiny).rsqrt()).clamp(-1, 1)


def detrended(normal: Normal, sums: Tensor) -> Tensor:
    """The same off the planes 1, u, v in template and patch: unlike ``correlation`` it does not change in light that
    varies across the template."""
    planes, along = normal.gram[:, :3, :3], normal.gram[:, :3, 3:]
    both = torch.cat((along, sums[:, [1, 4, 5], None]), -1)
    power = both.mT @ safe_inverse(planes)[0] @ both  # of both in the planes, (B, 2, 2)
    tt, gg, tg = normal.gram[:, 3, 3] - power[:, 0, 0], sums[:, 2] - power[:, 1, 1], sums[:, 3] - power[:, 0, 1]
    solid = (tt > PLANAR * normal.energy) & (gg > PLANAR * sums[:, 2])
    return torch.where(solid, tg * (tt * gg).clamp(min=torch.finfo(tg.dtype).tiny).rsqrt(), 0.0).clamp(-1, 1)


def cluster_robust(reference: Reference, normal: Normal, clustered: Tensor, variance: Tensor) -> Tensor:
    """Standard deviations (B, 3) that each row of K gives to noise of the given ``variance`` (B,), over those that it
    would give to white noise of variance 1; never less than for white noise.

    What no noise model knows (edges that the sampler rounds, light, an occluder, blur) leaves residuals that cling
    together where the gradients are. Their effect summed block by block, its squares ``clustered`` (B, 3), tells the
    scatter that they bring (the cluster-robust sandwich).
    """
    blocks, columns = reference.grid.occupied, reference.K.shape[1]
    if blocks < FEW_BLOCKS * columns:  # too few to tell a scatter from
        return variance[:, None].sqrt().expand(-1, 3)
    free = blocks / (blocks - columns)  # blocks are not free: the fit has made their sum zero
    return torch.maximum(free * clustered / normal.white.clamp(min=1e-30), variance[:, None]).sqrt()


def interpolation_error(reference: Reference, pose: Tensor, interpolation: str) -> Tensor | None:
    """What aliasing in the sampler shifts poses (B, 3) by, in the template's axes: a square root (B, 3, 2) of its
    covariance; None where it does not count.

    Where all pixels lie alike between the frame's (no rotation) their errors add up; over a turned template they
    cancel: the mean of exp(2 pi i k step) over n neighbours k is sin(pi n step) / (n sin(pi step)) but for its phase
    (Dirichlet). The shift is ``Noise.alias`` times the sine of the phase, whose mean square is one half.
    """
    names = [name for name, kernel in SAMPLERS.items() if kernel.aliases]
    if interpolation not in names:
        return None
    step = torch.stack((pose[:, 2].cos(), pose[:, 2].sin()), -1)
    step = step - step.round()
    box = reference.grid.box
    coherent = (torch.sinc((box[:2, 2] - box[:2, 0] + 1) * step) / torch.sinc(step)).prod(-1)
    return reference.noise.alias[:, names.index(interpolation)] * (coherent / 2**0.5)[:, None, None]


def pose_covariance(
    reference: Reference,
    normal: Normal,
    variance: Tensor,
    square: Tensor,
    pose: Tensor,
    scatter: Tensor | None = None,
    alias: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Covariance (B, 3, 3) of poses (B, 3) when template and frame have noise of ``variance`` (B,), the patch the
    ``square`` (B,) of its gain times the template's power; and whether the texture makes the pose observable, (B,).

    Sandwich of the instrumental-variable estimate, v S^-1 (P / gain^2 + P_t) S^-T with P = Z~ Z~^T, turned from the
    template's axes to the frame's. The template's noise is taken out of S, and out of P for its own part P_t: a
    derivative is antisymmetric, so that noise times its own derivative sums to nothing. ``scatter`` (B, 3): see
    ``cluster_robust``, by default white; ``alias`` (B, 3, 2): see ``interpolation_error``.
    """
    own = torch.minimum(variance, reference.noise.level.to(variance.dtype).square())
    bias, frame = own[:, None, None], (1 + 1 / square.clamp(min=1e-12))[:, None, None]
    bread = torch.linalg.inv_ex(normal.bread - bias * normal.bread_bias)[0]
    meat = frame * normal.meat - bias * normal.meat_bias
    scatter = variance.sqrt()[:, None] if scatter is None else scatter
    turn = _turn(pose[:, 2])
    bread = torch.bmm(turn, scatter[:, :, None] * bread)
    covariance = torch.bmm(torch.bmm(bread, meat), bread.mT)
    if alias is not None:
        alias = torch.bmm(turn, alias)
        covariance = torch.baddbmm(covariance, alias, alias.mT)
    variances = covariance.diagonal(dim1=1, dim2=2)
    corner = (variances * reference.place.lever.square()).sum(-1)
    return covariance, (corner < LARGEST_SIGMA**2) & (own * normal.noise_share < NOISE_SHARE)


def _turn(theta: Tensor) -> Tensor:
    """From the template's axes x', y', theta to the frame's: (B, 3, 3)."""
    c, s = theta.cos(), theta.sin()
    none, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack((c, s, none, -s, c, none, none, none, one), -1).view(-1, 3, 3)


@lru_cache(maxsize=16)
@torch.inference_mode(False)
def _unknown(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The covariance of what was not found."""
    return torch.diag(torch.full((3,), inf, dtype=dtype, device=device))


@lru_cache(maxsize=16)
@torch.inference_mode(False)
def _codes(device: torch.device) -> tuple[Tensor, ...]:
    """Every status as a tensor, so that the host need not hand them over in every frame."""
    return torch.tensor(list(Status), dtype=torch.int8, device=device).unbind()
