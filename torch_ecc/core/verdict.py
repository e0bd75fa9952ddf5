"""Judge the outcome of a solve: score, residual, covariance and status per template."""

from __future__ import annotations

from math import pi
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_ecc.core.criteria import centred, safe_inverse
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import alike, library, rotation
from torch_ecc.core.reference import ALIASING, Reference, reweigh
from torch_ecc.core.sampling import NOISE_GAIN, host_looks, inside
from torch_ecc.core.settings import Settings
from torch_ecc.core.solver import State, warps

LARGEST_SIGMA = 0.5  # px at the farthest pixel: beyond it the texture does not fix the pose
NOISE_SHARE = 0.6  # of the information in some direction is the template's noise: not even a good match helps
FEW_BLOCKS = 4  # blocks per fitted column below which residuals cannot tell whether they cling together
DOUBTFUL_SHARE = 0.5  # the same, as the likely reason why a template was not found


class Sums(NamedTuple):
    """What all pixels of B patches tell, (B,) each: the patch's ``gain``, the residual's mean square ``power``, the
    correlation ``score``, the same ``alike`` under uneven light; and (B, 3) the residual's sums by ``blocks``."""

    gain: Any
    power: Any
    score: Any
    alike: Any
    blocks: Any


@np.errstate(all="ignore")
def judge(
    reference: Reference, state: State, start: Any, settings: Settings, size: tuple[int, int] | None = None
) -> Estimate:
    """The record of B solved templates; failed ones get their ``start`` (B, 3) back.

    ``size`` (h, w) of the frame: only pixels inside it count. None if all are known to be. ``start``, the state and the
    record hold tensors or, on a CPU, numpy arrays.
    """
    pose, whole, xp = state.pose, reference.at_hand, library(state.pose)
    if size is not None:
        seen = torch.as_tensor(inside(warps(reference, pose), reference.pixels, size))
        reference = reweigh(reference, seen)
    reference = reference.at_hand
    sums = add_up(reference, state.patch, settings.min_score)
    gain, power = (xp.where(abs(v) < xp.inf, v, 0.0) for v in (sums.gain, sums.power))
    noise = noise_variance(reference, power, gain, NOISE_GAIN[settings.interpolation])
    structure = clustering(reference, sums.blocks, noise * (1 + gain * gain))
    sampler = interpolation_error(reference, pose, settings.interpolation)
    covariance, fixed = pose_covariance(reference, noise, gain, pose, structure, sampler)
    shown = reference.moments[:, 1] >= settings.min_visible * whole.moments[:, 1]
    match = (sums.alike >= settings.min_score) & (gain > 0) & (abs(pose) < xp.inf).all(-1)
    empty = whole.noise**2 * whole.noise_share > DOUBTFUL_SHARE
    status = decide(shown, match, fixed, state.error <= settings.tolerance, empty)
    good = Status.good(status)
    pose = xp.where(good[:, None], pose, start)
    diagonal = alike(torch.eye(3, device=state.patch.device), start) > 0
    covariance = xp.where(good[:, None, None], covariance, xp.where(diagonal, xp.inf, 0.0))
    return Estimate(pose, pose - start, sums.score, status, state.iterations, covariance, power**0.5)


def decide(shown: Any, match: Any, fixed: Any, converged: Any, empty: Any) -> Any:
    """Status codes (B,) int8 from what was found, (B,) bool each: enough of it is ``shown``, it is a ``match``, its
    texture has ``fixed`` the pose, the iterations have ``converged``, it is ``empty`` of any texture of its own."""
    xp = library(shown)
    status = xp.where(converged, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    status = xp.where(fixed, status, int(Status.LOW_TEXTURE))
    status = xp.where(match, status, int(Status.LOST))
    status = xp.where(shown, status, int(Status.OUT_OF_VIEW))
    status = xp.where(empty & ~(match & shown), int(Status.LOW_TEXTURE), status)  # that is why
    return xp.asarray(status, dtype=xp.int8)


def add_up(reference: Reference, patch: Tensor, min_score: float) -> Sums:
    """What there is to know from the pixels (B, N) of B patches, in the library of the reference's moments."""
    moments, t, mean = reference.moments, reference.signal.select(1, 3), patch.sum(-1, keepdim=True) / patch.shape[1]
    residual, gain = reference.criterion.fit(reference, patch)
    rest = patch - mean
    weighted, blocks = reference.weight * rest, patch.new_zeros(len(patch), 3, len(reference.block_sizes))
    blocks.index_add_(2, reference.block, reference.K.narrow(1, 0, 3) * residual.unsqueeze(1))
    power, (excess, square, along) = (
        dot(reference.weight * residual, residual),
        (weighted.sum(-1), dot(weighted, rest), dot(weighted, t)),
    )
    gain, mean, power, excess, square, along, blocks = (
        alike(v, moments) for v in (gain, mean[:, 0], power, excess, square, along, blocks)
    )
    xp, total, level, norm = library(moments), moments[:, 1].clip(1e-30), moments[:, 2], moments[:, 3]
    norm = norm * (square - excess * excess / total).clip(0) ** 0.5
    score = ((along - excess * level) / norm.clip(1e-30)).clip(-1, 1)
    score = xp.where(norm > 1e-12 * (square + mean * mean * total), score, 0.0)
    alike_ = score
    if not host_looks(patch.device) or (score < min_score).any():
        # Light alone must not make a stranger of the template.
        alike_ = xp.maximum(score, alike(flat_correlation(reference, patch), moments))
    return Sums(gain, power / total, score, alike_, (blocks * blocks).sum(-1))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Sums (B,) of the products of (1 or B, N) and (B, N)."""
    product: Tensor = torch.linalg.vecdot(a, b)
    return product


def correlation(t: Tensor, g: Tensor, weight: Tensor) -> Tensor:
    """Zero-mean normalised correlation (B,) of t and g (B, N) under weights (1 or B, N); 0 where either is flat."""
    (t0, dt), (g0, dg) = centred(t, weight), centred(g, weight)
    norm = dt * dg
    score = (weight * t0 * g0).sum(-1) / norm.clamp(min=1e-30)
    return torch.where(norm > 1e-12 * (weight * g * g).sum(-1), score, 0.0).clamp(-1, 1)


def flat_correlation(reference: Reference, g: Tensor) -> Tensor:
    """Correlation (B,) of the templates and patches g (B, N) without their planes 1, x', y': unlike ``correlation``,
    it is the same in light that varies across the template."""
    uv = reference.uv
    planes = torch.cat((torch.ones_like(uv[:, :1]), uv), 1)
    weighted = planes * reference.weight[:, None]
    inverse, _ = safe_inverse(weighted @ planes.mT)
    both = torch.stack((reference.signal[:, 3], g - g.mean(-1, keepdim=True)), -1)
    t, g = (both - planes.mT @ (inverse @ (weighted @ both))).unbind(-1)
    return correlation(t, g, reference.weight)


def noise_variance(reference: Reference, power: Any, gain: Any, sampled: float) -> Any:
    """Variance (B,) of the noise of one image, from the residuals' mean square ``power`` (B,) = the template's share
    gain^2 v plus the frame's, of which its sampling left ``sampled`` v; freed of the fitted columns' part."""
    count, columns = reference.moments[:, 0], reference.K.shape[1]
    return power * count / (count - columns).clip(1) / (gain * gain + sampled)


def clustering(reference: Reference, clustered: Any, power: Any) -> Any:
    """How much more the increment scatters, (B, 3), than with white noise of ``power`` (B,).

    What no noise model knows (edges that the sampler rounds, light, an occluder, blur) leaves residuals that cling
    together where the gradients are. Their effect summed block by block, its squares ``clustered`` (B, 3), tells the
    scatter that they bring (the cluster-robust sandwich); 1 where it is not more than the white one's.
    """
    blocks, columns = len(reference.block_sizes), reference.K.shape[1]
    if blocks < FEW_BLOCKS * columns:  # too few to tell a scatter from
        return 0 * clustered + 1
    few = blocks / (blocks - columns)  # blocks are not free: the fit has made their sum zero
    white = reference.moments[:, 4:] * power[:, None]
    return (few * clustered / white.clip(1e-30)).clip(1.0) ** 0.5


def interpolation_error(reference: Reference, pose: Any, interpolation: str) -> Any:
    """Covariance (B, 3, 3), in the template's axes, of what aliasing in the sampler shifts poses (B, 3) by.

    Where all pixels lie alike between the frame's (no rotation) their errors add up; over a turned template they
    cancel. The shift is ``Reference.alias`` times the sine of the phase, whose mean square is one half.
    """
    if interpolation not in ALIASING:
        return 0.0
    xp, shift = library(pose), alike(reference.alias, pose)[:, ALIASING.index(interpolation)]
    sides = alike(reference.box, pose)[:2, 2] - alike(reference.box, pose)[:2, 0] + 1
    alike_ = _alike(rotation(pose[:, 2])[:, 0], sides).prod(-1)
    return shift @ xp.swapaxes(shift, -1, -2) * (alike_ * alike_ / 2)[:, None, None]


def _alike(step: Any, count: Any) -> Any:
    """Mean of exp(2 pi i k step) over ``count`` neighbours k, but for its phase: 1 for whole steps (Dirichlet)."""
    xp, step = library(step), pi * (step - step.round())
    return xp.where(step == 0, 1.0, xp.sin(count * step) / (count * xp.sin(step)))


def pose_covariance(
    reference: Reference, noise: Any, gain: Any, pose: Any, structure: Any = None, sampler: Any = 0.0
) -> tuple[Any, Any]:
    """Covariance (B, 3, 3) of poses (B, 3) when template and frame have noise of variance ``noise`` (B,), the patch
    ``gain`` (B,) times the template's contrast; and whether the texture fixes the pose, (B,) bool.

    Sandwich of the instrumental-variable estimate, v S^-1 (P / gain^2 + P_t) S^-T with P = Z~ Z~^T, turned from the
    template's axes to the frame's. The template's noise is taken out of S, and out of P for its own part P_t: a
    derivative is antisymmetric, so that noise times its own derivative sums to nothing. ``structure`` (B, 3): see
    ``clustering``; ``sampler`` (B, 3, 3): see ``interpolation_error``.
    """
    xp = library(pose)
    own = xp.minimum(noise, reference.noise**2)
    textured = own * reference.noise_share < NOISE_SHARE
    noise, own, frame = (v[:, None, None] for v in (noise, own, 1 / (gain * gain).clip(1e-12)))
    inverse, regular = safe_inverse(reference.slope - own * reference.inflation)
    spread = (1 + frame) * reference.spread - own * reference.spread_noise
    local = inverse @ spread @ xp.swapaxes(inverse, -1, -2) * noise
    if structure is not None:
        local = local * structure[:, :, None] * structure[:, None, :]
    turn = 0 * local
    turn[:, :2, :2], turn[:, 2, 2] = rotation(pose[:, 2]), 1.0
    covariance = turn @ (local + sampler) @ xp.swapaxes(turn, -1, -2)
    corner = covariance[:, 0, 0] + covariance[:, 1, 1] + covariance[:, 2, 2] * reference.radius**2
    return covariance, regular & textured & (corner < LARGEST_SIGMA**2)
