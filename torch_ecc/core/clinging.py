"""Residuals that cling together: in blocks of pixels, in rows and columns of them, or as those of a strained picture.

What no noise model knows (edges that the sampler rounds, light, an occluder, blur, a line of a sensor) leaves residuals
that cling together. Their effect on a pose, summed over all of a cluster of pixels before it is squared, tells the
scatter that they bring (the cluster-robust sandwich). A target that is strained, as by focus, by a lens, or by a camera
that exposes one row after the other, leaves a pattern of them that is known: by how much it is strained is told from
them, and the pose is as uncertain as what one calls its place and its angle then is.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.ambient import constant
from torch_ecc.core.blocks import STRAINS, Parts
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.normal import LEAST
from torch_ecc.core.reference import Fields, Reference, each
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import Solution

FEW_BLOCKS = 4  # blocks per fitted column below which residuals cannot tell whether they cling together
SURE = 3.0  # standard deviations by which lines must scatter more than blocks do: lines are few, and scatter by chance
LEAST_SPREAD = 0.2  # of the mean: blocks that tell next to nothing count by what they tell
BY_CHANCE = 14.0  # so large may the square of 7 strains over its variance be by chance


class Clinging(NamedTuple):
    """``scatter`` (B, 3 or 1): variance of noise as each row of K feels it; ``strained`` (B, 3, 3): covariance of
    what the pose of a strained target may be off by, in the template's axes; None if it is not strained."""

    scatter: Tensor
    strained: Tensor | None


def clinging(reference: Reference, found: Solution, variance: Tensor, of_both: Tensor) -> Clinging:
    """What clings together in the residuals of B templates whose template and frame have noise of ``variance`` (B,) if
    it is white, ``of_both`` (B,) times as much together; the scatter is never less."""
    columns, occupied = reference.K.shape[1], reference.grid.occupied
    if occupied < FEW_BLOCKS * columns:  # too few to tell a scatter from
        return Clinging(variance.unsqueeze(1), None)
    free = occupied / (occupied - columns)  # blocks are not free: the fit has made their sum zero
    white, grid = found.normal.white * of_both.unsqueeze(1), reference.grid.blocks
    scatter = torch.maximum(found.total[:, 10:].div(white).mul_(free), variance.unsqueeze(1))
    certain = in_lines(found.sums[:, 7:], white, scatter, grid)[1]
    on_cpu = is_cpu(certain.device)
    if on_cpu and not bool(certain.any()):
        return Clinging(scatter, None)
    certain = certain.flatten(1).any(1)
    index = certain.nonzero()[:, 0] if on_cpu else torch.arange(len(certain), device=certain.device)
    effect, strained = without_strain(_at(index, reference.parts), _at(index, found))
    certain, white = certain[index], white[index]
    blocks = effect.square().sum(2, dtype=white.dtype).div(white).mul_(free)
    blocks = torch.maximum(blocks, variance[index].unsqueeze(1))
    lines, more = in_lines(effect, white, blocks, grid)
    most = torch.where(more, lines, blocks.unsqueeze(2)).amax(2)
    most = torch.where(certain[:, None], most, scatter[index])
    strained = torch.where(certain[:, None, None], strained, 0.0)
    none = strained.new_zeros(len(scatter), 3, 3)
    return Clinging(scatter.index_copy(0, index, most), none.index_copy(0, index, strained))


def in_lines(effect: Tensor, white: Tensor, scatter: Tensor, grid: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Scatter (B, 3, 2) as of rows and of columns of blocks with an ``effect`` (B, 3, blocks), and whether it is for
    certain more than the ``scatter`` (B, 3) of blocks."""
    member, kind, sure, free = _lines(grid, effect.dtype, effect.device)
    lines = torch.matmul(torch.matmul(effect, member).square_(), kind).div(white.unsqueeze(2))
    return lines * free, lines > sure * scatter.unsqueeze(2)


def without_strain(parts: Parts, found: Solution) -> tuple[Tensor, Tensor]:
    """The effect (B, 3, blocks) of residuals on the pose less that of the strain that fits it best, and the covariance
    (B, 3, 3) that this strain brings, see ``Clinging``.

    To shear is to turn and to strain by the same angle: a camera that shifts its rows turns the target by half of it,
    or by none, as one takes it.
    """
    pattern, spread, shift = patterns(parts, found)
    effect, weighted = found.sums[:, 7:], pattern / spread[:, None]
    gram = torch.einsum("bmkn,blkn->bml", weighted, pattern)
    fit = torch.einsum("bml,blkn->bmkn", safe_inverse(gram)[0], weighted)
    strain = torch.einsum("bmkn,bkn->bm", fit, effect)
    left = effect - torch.einsum("bm,bmkn->bkn", strain, pattern)
    of_blocks = torch.einsum("bmkn,bkn->bmn", fit, left)  # what else each of them adds
    uncertain = of_blocks @ of_blocks.mT
    certain = (1 - BY_CHANCE / ratio_of_squares(strain, uncertain)).clamp(min=0)[:, None]
    effect = effect - torch.einsum("bm,bmkn->bkn", strain * (certain > 0), pattern)
    square = (strain[:, :, None] * strain[:, None] + uncertain) * (certain / found.gain.to(certain).square()[:, None])[
        ..., None
    ]
    turned = (square.diagonal(dim1=1, dim2=2) * _turning(square.dtype, square.device)).sum(1) / parts.radius.square()
    strained = (shift @ square @ shift.mT).to(turned.dtype)
    strained[:, 2, 2] += turned
    return effect, strained.nan_to_num(0.0, 0.0, 0.0)


def ratio_of_squares(value: Tensor, covariance: Tensor) -> Tensor:
    """v^T C^-1 v of values (B, n) with a covariance (B, n, n): n by chance; 0 where it is singular."""
    inverse, regular = safe_inverse(covariance)
    ratio = (value[:, None] @ inverse @ value[..., None])[:, 0, 0]
    return torch.where(regular, ratio, 0.0)


def patterns(parts: Parts, found: Solution) -> tuple[Tensor, Tensor, Tensor]:
    """What strains, see ``Parts``, leave in each block under a gain of 1, as a pose feels it, (B, 7, 3, blocks); what
    white noise of some variance leaves there, (B, 3, blocks); and by what they shift the pose, (B, 3, 7)."""
    normal, share = found.normal, found.sums[:, 0] / parts.weight.clamp(min=LEAST)
    share = (share if found.trust is None else share * found.trust)[:, None, None]
    of_columns, of_strain = parts.normal * share, parts.strain * share
    shift = (normal.inverse @ of_strain.sum(-1, dtype=normal.inverse.dtype)).to(share.dtype)
    left = of_strain - torch.einsum("bpqn,bqm->bpmn", of_columns, shift)
    rows = normal.inverse[:, :3].to(share.dtype)
    power = torch.einsum("bkp,bpkn->bkn", rows, of_columns[:, :, :3]).clamp(min=0)
    spread = (power + LEAST_SPREAD * power.mean(2, keepdim=True)) * normal.white.to(share.dtype).unsqueeze(2)
    return torch.einsum("bkp,bpmn->bmkn", rows, left), spread.clamp(min=LEAST), shift[:, :3]


def _at(index: Tensor, record: Fields) -> Fields:
    """The part of a ``record`` that is about the templates at ``index`` (n,)."""
    return each(lambda value: value[index], record)


@constant
def _turning(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Which of ``STRAINS`` turn parts of the target, 0 or 1."""
    return torch.tensor([float(turns) for _, turns in STRAINS], dtype=dtype, device=device)


@constant
def _lines(grid: tuple[int, int], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """Of a grid of blocks: which rows and columns they are in, (blocks, rows + columns); which of these are rows, and
    which columns, (rows + columns, 2); how many times that of blocks their scatter is for certain, (2,); and what makes
    up for so few, (2,).

    The fit has made the sum of n lines zero, and an error over a scatter of so few has Student's distribution, with the
    variance (n - 1) / (n - 3).
    """
    rows, columns = (torch.eye(n, dtype=dtype, device=device) for n in grid)
    member = torch.cat((rows.repeat_interleave(grid[1], 0), columns.repeat(grid[0], 1)), 1)
    kind = torch.eye(2, dtype=dtype, device=device).repeat_interleave(torch.tensor(grid, device=device), 0)
    sure, free = [1 + SURE * (2 / n) ** 0.5 for n in grid], [n / max(n - 3, 1) for n in grid]
    numbers = torch.tensor([sure, free], dtype=dtype, device=device)
    return member, kind, numbers[0], numbers[1]
