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
from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.reference import Fields, Grid, Reference, each
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import SUMS, Solution, clustered

FEW_BLOCKS = 4  # blocks per fitted column below which residuals cannot tell whether they cling together
SURE = 3.0  # standard deviations by which lines must scatter more than blocks do: lines are few, and scatter by chance
LEAST_SPREAD = 0.2  # of the mean: blocks that tell next to nothing count by what they tell
BY_CHANCE = 14.0  # so large may the square of 7 strains over its variance be by chance


class Clinging(NamedTuple):
    """``scatter`` (B, 1, 3): by how many times more than white noise each row of K feels the residuals, at least 1;
    ``strained`` (B, 3, 3): covariance of what the pose of a strained target may be off by, in the template's axes.
    None where nothing clings together, or nobody can tell."""

    scatter: Tensor | None
    strained: Tensor | None


def clinging(reference: Reference, found: Solution, white: Tensor, scale: Tensor | None) -> Clinging:
    """What clings together in the residuals of B templates whose template and frame have noise of variance ``white``
    (B,) together if it is that, with clusters of a ``scale_of``."""
    if scale is None:
        return Clinging(None, None)
    scatter, certain = scattered(found.total[:, SUMS:], white, scale)
    on_cpu = is_cpu(white.device)
    if on_cpu and not bool(certain.any()):
        return Clinging(scatter, None)
    certain = certain.flatten(1).any(1)
    index = certain.nonzero()[:, 0] if on_cpu else torch.arange(len(certain), device=certain.device)
    effect, strained = without_strain(_at(index, reference.parts), _at(index, found))
    certain, grid = certain[index], reference.grid.blocks
    ratio = clustered(effect.to(white.dtype), grid)
    blocks, more = scattered(ratio, white[index], scale[index])
    lines = (ratio * scale[index] / white[index, None]).view(-1, 3, 3) * _shares(grid, white.dtype, white.device)[1]
    most = torch.where(more, lines, blocks).amax(1, keepdim=True)
    most = torch.where(certain[:, None, None], most, scatter[index])
    strained = torch.where(certain[:, None, None], strained, 0.0)
    none = strained.new_zeros(len(scatter), 3, 3)
    return Clinging(scatter.index_copy(0, index, most), none.index_copy(0, index, strained))


def scale_of(grid: Grid, normal: Normal) -> Tensor | None:
    """What takes square sums (B, 9) over clusters, see ``solution.clustered``, to the scatter that they tell, times
    white noise's: of lines, to the least that would be so by chance. None if blocks are too few to tell."""
    columns, occupied = normal.inverse.shape[1], grid.occupied
    if occupied < FEW_BLOCKS * columns:
        return None
    free = occupied / (occupied - columns)  # blocks are not free: the fit has made their sum zero
    sure, _ = _shares(grid.blocks, normal.white.dtype, normal.white.device)
    return (normal.white.new_tensor([[free], [1], [1]]) / (sure * normal.white[:, None])).flatten(1)


def scattered(squares: Tensor, white: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """How much more the square sums (B, 9) over blocks tell than white noise of variance ``white`` (B,) makes of them,
    (B, 1, 3), and where (B, 3, 3) those over lines tell more than that for certain; over blocks they never do."""
    ratio = (squares * scale / white.unsqueeze(1)).view(-1, 3, 3)
    scatter = ratio[:, :1].clamp(min=1.0)
    return scatter, ratio > scatter


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
def _shares(grid: tuple[int, int], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Of blocks, and of rows and columns of a grid of them, (3, 1) each: how many times the scatter of blocks theirs is
    for certain; and that times what makes up for so few.

    The fit has made the sum of n lines zero, and an error over a scatter of so few has Student's distribution, with the
    variance (n - 1) / (n - 3).
    """
    sure, free = [1 + SURE * (2 / n) ** 0.5 for n in grid], [n / max(n - 3, 1) for n in grid]
    most = [s * f for s, f in zip(sure, free, strict=True)]
    both = torch.tensor([[1.0, *sure], [1.0, *most]], dtype=dtype, device=device)[:, :, None]
    return both[0], both[1]
