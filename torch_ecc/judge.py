"""Judge the outcome of a solve: score, residual, covariance and status per template."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.criteria import centred, safe_inverse
from torch_ecc.estimate import Estimate, Status
from torch_ecc.pose import rotation
from torch_ecc.reference import ALIASING, Reference, reweigh
from torch_ecc.sampling import NOISE_GAIN, host_looks, inside
from torch_ecc.solver import Settings, State, warps

LARGEST_SIGMA = 0.5  # px at the farthest pixel: beyond it the texture does not fix the pose
NOISE_SHARE = 0.6  # of the information in some direction is the template's noise: not even a good match helps
FEW_BLOCKS = 4  # blocks per fitted column below which residuals cannot tell whether they cling together
DOUBTFUL_SHARE = 0.5  # the same, as the likely reason why a template was not found


def judge(
    reference: Reference, state: State, start: Tensor, settings: Settings, size: tuple[int, int] | None = None
) -> Estimate:
    """The record of B solved templates; failed ones get their ``start`` (B, 3) back.

    ``size`` (h, w) of the frame: only pixels inside it count. None if all are known to be.
    """
    pose, whole, visible = state.pose, reference, torch.ones_like(state.error)
    if size is not None:
        reference = reweigh(reference, inside(warps(reference, pose), reference.pixels, size))
        visible = reference.moments[:, 1] / whole.moments[:, 1]
    residual, gain = reference.criterion.fit(reference, state.patch)
    gain = gain.to(pose.dtype).nan_to_num(0.0, 0.0, 0.0)
    power = (reference.weight * residual * residual).sum(-1) / reference.moments[:, 1].clamp(min=1e-30)
    power = power.nan_to_num(0.0, 0.0, 0.0)
    score = correlation(reference.signal[:, 3], state.patch, reference.weight).to(pose.dtype)
    noise = noise_variance(reference, power, gain, NOISE_GAIN[settings.interpolation])
    structure = clustering(reference, residual, noise * (1 + gain * gain))
    sampler = interpolation_error(reference, pose, settings.interpolation)
    covariance, fixed = pose_covariance(reference, noise, gain, pose, structure, sampler)
    shown = visible >= settings.min_visible
    alike = score
    if not host_looks(score.device) or bool((score < settings.min_score).any()):
        # Light alone must not make a stranger of the template.
        alike = torch.maximum(score, flat_correlation(reference, state.patch).to(pose.dtype))
    match = (alike >= settings.min_score) & (gain > 0) & pose.isfinite().all(-1)
    status = decide(whole, shown, match, fixed, state.error <= settings.tolerance)
    good = Status.good(status)
    pose = torch.where(good[:, None], pose, start)
    unknown = torch.full_like(pose, float("inf")).diag_embed()
    covariance = torch.where(good[:, None, None], covariance, unknown)
    return Estimate(pose, pose - start, score, status, state.iterations, covariance, power.sqrt())


def decide(reference: Reference, shown: Tensor, match: Tensor, fixed: Tensor, converged: Tensor) -> Tensor:
    """Status codes (B,) int8 from what was found, (B,) bool each: enough of it is ``shown``, it is a ``match``, its
    texture has ``fixed`` the pose, the iterations have ``converged``."""
    status = torch.where(converged, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    status = torch.where(fixed, status, int(Status.LOW_TEXTURE))
    status = torch.where(match, status, int(Status.LOST))
    status = torch.where(shown, status, int(Status.OUT_OF_VIEW))
    empty = reference.noise.square() * reference.noise_share > DOUBTFUL_SHARE
    status = torch.where(empty & ~(match & shown), int(Status.LOW_TEXTURE), status)  # without texture: that is why
    return status.to(torch.int8)


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


def noise_variance(reference: Reference, power: Tensor, gain: Tensor, sampled: float) -> Tensor:
    """Variance (B,) of the noise of one image, from the residuals' mean square ``power`` (B,) = the template's share
    gain^2 v plus the frame's, of which its sampling left ``sampled`` v; freed of the fitted columns' part."""
    count, columns = reference.moments[:, 0], reference.K.shape[1]
    return power * count / (count - columns).clamp(min=1) / (gain * gain + sampled)


def clustering(reference: Reference, residual: Tensor, power: Tensor) -> Tensor:
    """How much more the increment scatters, (B, 3), with ``residual`` (B, N) than with white noise of ``power`` (B,).

    What no noise model knows (edges that the sampler rounds, light, an occluder, blur) leaves residuals that cling
    together where the gradients are. Their effect summed block by block tells the scatter that they bring (the
    cluster-robust sandwich); 1 where it is not more than the white one's.
    """
    K, blocks, columns = reference.K[:, :3], len(reference.block_sizes), reference.K.shape[1]
    if blocks < FEW_BLOCKS * columns:  # too few to tell a scatter from
        return torch.ones_like(power)[:, None].expand(-1, 3)
    sums = K.new_zeros(len(K), 3, blocks).index_add_(2, reference.block, K * residual[:, None])
    few = blocks / (blocks - columns)  # blocks are not free: the fit has made their sum zero
    white = K.square().sum(-1).to(power.dtype) * power[:, None]
    return (few * sums.square().sum(-1).to(power.dtype) / white.clamp(min=1e-30)).clamp(min=1.0).sqrt()


def interpolation_error(reference: Reference, pose: Tensor, interpolation: str) -> Tensor:
    """Covariance (B, 3, 3), in the template's axes, of what aliasing in the sampler shifts poses (B, 3) by.

    Where all pixels lie alike between the frame's (no rotation) their errors add up; over a turned template they
    cancel. The shift is ``Reference.alias`` times the sine of the phase, whose mean square is one half.
    """
    if interpolation not in ALIASING:
        return pose.new_zeros(len(pose), 3, 3)
    shift = reference.alias[:, ALIASING.index(interpolation)]
    width, height = (reference.box[:2, 2] - reference.box[:2, 0] + 1).to(pose.dtype)
    alike = _alike(pose[:, 2].cos(), width) * _alike(pose[:, 2].sin(), height)
    return shift @ shift.mT * (alike.square() / 2)[:, None, None]


def _alike(step: Tensor, count: Tensor) -> Tensor:
    """Mean of exp(2 pi i k step) over ``count`` neighbours k, but for its phase: 1 for whole steps (Dirichlet)."""
    step = step - step.round()
    return torch.sinc(count * step) / torch.sinc(step)


def pose_covariance(
    reference: Reference,
    noise: Tensor,
    gain: Tensor,
    pose: Tensor,
    structure: Tensor | None = None,
    sampler: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Covariance (B, 3, 3) of poses (B, 3) when template and frame have noise of variance ``noise`` (B,), the patch
    ``gain`` (B,) times the template's contrast; and whether the texture fixes the pose, (B,) bool.

    Sandwich of the instrumental-variable estimate, v S^-1 (P / gain^2 + P_t) S^-T with P = Z~ Z~^T, turned from the
    template's axes to the frame's. The template's noise is taken out of S, and out of P for its own part P_t: a
    derivative is antisymmetric, so that noise times its own derivative sums to nothing. ``structure`` (B, 3): see
    ``clustering``; ``sampler`` (B, 3, 3): see ``interpolation_error``.
    """
    own = torch.minimum(noise, reference.noise.to(noise.dtype) ** 2)
    inverse, regular = safe_inverse(reference.slope - own[:, None, None] * reference.inflation)
    textured = own * reference.noise_share < NOISE_SHARE
    frame = (1 / (gain * gain).clamp(min=1e-12))[:, None, None]
    spread = (1 + frame) * reference.spread - own[:, None, None] * reference.spread_noise
    local = inverse @ spread @ inverse.mT * noise[:, None, None]
    if structure is not None:
        local = local * structure[:, :, None] * structure[:, None, :]
    if sampler is not None:
        local = local + sampler
    turn = torch.eye(3, dtype=pose.dtype, device=pose.device).repeat(len(pose), 1, 1)
    turn[:, :2, :2] = rotation(pose[:, 2])
    covariance = turn @ local @ turn.mT
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    corner = diagonal[:, 0] + diagonal[:, 1] + diagonal[:, 2] * reference.radius**2
    return covariance, regular & textured & (corner < LARGEST_SIGMA**2)
