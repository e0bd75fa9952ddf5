"""What the residuals of a strained target look like, and what a strain that they tell makes of its pose.

By focus, by a lens, or by a camera that exposes one row after the other, parts of a target move other than as one. What
each kind of it leaves in the blocks of a template follows from the template alone.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.ambient import constant
from torch_ecc.core.blocks import STRAINS, Parts
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.normal import LEAST, Normal

LEAST_SPREAD = 0.2  # of the mean: blocks that tell next to nothing count by what they tell
BY_CHANCE = 14.0  # so large may the square of 7 strains over its variance be by chance


class Strains(NamedTuple):
    """Of B templates: the ``pattern`` (B, 7, 3 blocks) that each of ``STRAINS`` leaves in every block under a gain of
    1, as a pose feels it; the ``fit`` (B, 7, 3 blocks) that takes such an effect to the strains that it is of, by least
    squares over what white noise leaves there; by what they ``shift`` the pose, (B, 3, 7), and the ``radius`` (B,); and
    by how much each block bears on the pose, ``share`` (B, 3, blocks)."""

    pattern: Tensor
    fit: Tensor
    shift: Tensor
    radius: Tensor
    share: Tensor


def strains_of(parts: Parts, normal: Normal, share: Tensor | None = None) -> Strains:
    """Of templates whose blocks count by a ``share`` (B, blocks), which the ``normal`` equations are about."""
    if share is not None:
        share = share[:, None, None]
        parts = parts._replace(normal=parts.normal * share, strain=parts.strain * share)
    dtype, inverse = parts.strain.dtype, normal.inverse
    shift = (inverse @ parts.strain.sum(-1, dtype=inverse.dtype)).to(dtype)
    left = parts.strain - torch.einsum("bpqn,bqm->bpmn", parts.normal, shift)
    rows = inverse[:, :3].to(dtype)
    power = torch.einsum("bkp,bpkn->bkn", rows, parts.normal[:, :, :3]).clamp(min=0)
    spread = (power + LEAST_SPREAD * power.mean(2, keepdim=True)) * normal.white.to(dtype).unsqueeze(2)
    pattern = torch.einsum("bkp,bpmn->bmkn", rows, left).flatten(2)
    weighted = pattern / spread.clamp(min=LEAST).flatten(1).unsqueeze(1)
    fit = safe_inverse(weighted @ pattern.mT)[0] @ weighted
    return Strains(pattern, fit, shift[:, :3], parts.radius, power)


def strained_by(strains: Strains, effect: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The strains (B, 7) that an ``effect`` (B, 3, blocks) on the pose is best explained by; the covariance (B, 7, 7)
    of what else each block adds to them; and how much of their square is no chance, (B,), 0 to 1."""
    flat = effect.flatten(1).unsqueeze(2)
    strain = strains.fit @ flat
    left = torch.baddbmm(flat, strains.pattern.mT, strain, alpha=-1).mT
    of_blocks = (strains.fit * left).unflatten(2, effect.shape[1:]).sum(2)
    uncertain, strain = of_blocks @ of_blocks.mT, strain.squeeze(2)
    return strain, uncertain, (1 - BY_CHANCE / ratio_of_squares(strain, uncertain)).clamp(min=0)


def without_strain(strains: Strains, effect: Tensor, strain: Tensor) -> Tensor:
    """The ``effect`` (B, 3, blocks) less that of a ``strain`` (B, 7)."""
    return effect - (strain.unsqueeze(1) @ strains.pattern).view_as(effect)


def strained_pose(strains: Strains, square: Tensor) -> Tensor:
    """The covariance (B, 3, 3), in the template's axes, of the pose of a target strained by 7 numbers with mean squares
    and products ``square`` (B, 7, 7).

    To shear is to turn and to strain by the same angle: a camera that shifts its rows turns the target by half of it,
    or by none, as one takes it.
    """
    turned = square.diagonal(dim1=1, dim2=2) @ _turning(square.dtype, square.device) / strains.radius.square()
    strained = (strains.shift @ square @ strains.shift.mT).to(turned.dtype)
    strained[:, 2, 2] += turned
    return strained.nan_to_num(0.0, 0.0, 0.0)


def ratio_of_squares(value: Tensor, covariance: Tensor) -> Tensor:
    """v^T C^-1 v of values (B, n) with a covariance (B, n, n): n by chance; 0 where it is singular."""
    inverse, regular = safe_inverse(covariance)
    ratio = (value[:, None] @ inverse @ value[..., None])[:, 0, 0]
    return torch.where(regular, ratio, 0.0)


@constant
def _turning(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Which of ``STRAINS`` turn parts of the target, 0 or 1."""
    return torch.tensor([float(turns) for _, turns in STRAINS], dtype=dtype, device=device)
