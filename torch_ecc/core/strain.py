"""What the residuals of a strained target look like, and what a strain that they tell makes of its pose.

By focus, by a lens, or by a camera that exposes one row after the other, parts of a target move other than as one. What
each kind of it leaves in the blocks of a template follows from the template alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.ambient import constant
from torch_ecc.core.blocks import STRAINS
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.normal import LEAST, Normal

if TYPE_CHECKING:
    from torch_ecc.core.reference import Reference

LEAST_SPREAD = 0.2  # of the mean: blocks that tell next to nothing count by what they tell
SURE = 3.0  # standard deviations by which lines must scatter more than blocks do: lines are few, and scatter by chance
BY_CHANCE = 14.0  # so large may the square of 7 strains over its variance be by chance


class Strains(NamedTuple):
    """Of B templates: the ``pattern`` (B, 7, 3 blocks) that each of ``STRAINS`` leaves in every block under a gain of
    1, as a pose feels it; the ``fit`` (B, 7, 3 blocks) that takes such an effect to the strains that it is of, by least
    squares over what white noise leaves there; by what they ``shift`` the pose, (B, 3, 7), and the ``radius`` (B,); and
    how many times that of blocks the scatter of so few ``lines`` (B, 3, 3) may be, see ``few_lines``."""

    pattern: Tensor
    fit: Tensor
    shift: Tensor
    radius: Tensor
    lines: Tensor


def strains_of(reference: Reference, normal: Normal | None = None, share: Tensor | None = None) -> Strains:
    """Of templates whose blocks count by a ``share`` (B, blocks), which the ``normal`` equations are about."""
    parts, normal = reference.parts, reference.normal if normal is None else normal
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
    lines = few_lines(power.to(inverse.dtype), reference.grid.blocks)
    pattern, fit, shift = (value.to(inverse.dtype) for value in (pattern, fit, shift[:, :3]))
    return Strains(pattern, fit, shift, parts.radius, lines)


def few_lines(share: Tensor, grid: tuple[int, int]) -> Tensor:
    """How many times their scatter that of blocks, and of rows and columns of them, may be, (B, 3, 3), if blocks bear
    on a pose by a ``share`` (B, 3, blocks).

    The fit has made the sum of n lines zero, and an error over a scatter of so few has Student's distribution, with the
    variance (n - 1) / (n - 3). Lines that bear little are none: n = (sum s)^2 / sum s^2 (Kish, Survey Sampling, 1965).
    """
    power = share.unflatten(2, grid)
    lines = [each.sum(2).square() / each.square().sum(2).clamp(min=LEAST) for each in (power.sum(3), power.sum(2))]
    n = torch.stack(lines, 1).clamp(min=1)
    return F.pad(by_chance(n) * n / (n - 3).clamp(min=1), (0, 0, 1, 0), value=1.0)


def by_chance(n: Tensor) -> Tensor:
    """How many times the scatter of blocks that of ``n`` lines of them may be without meaning anything."""
    return 1 + SURE * (2 / n).sqrt()


def strained_by(strains: Strains, effect: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The strains (B, 7) that an ``effect`` (B, 3, blocks) on the pose is best explained by; the covariance (B, 7, 7)
    of what else each block adds to them; and how much of their square is no chance, (B,), 0 to 1."""
    flat = effect.flatten(1).unsqueeze(1)
    strain = flat @ strains.fit.mT
    left = torch.baddbmm(flat, strain, strains.pattern, alpha=-1)
    of_blocks = (strains.fit * left).unflatten(2, effect.shape[1:]).sum(2)
    uncertain, strain = of_blocks @ of_blocks.mT, strain.squeeze(1)
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
