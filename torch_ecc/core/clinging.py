"""Residuals that cling together: in blocks of pixels, in rows and columns of them, or as those of a strained picture.

What no noise model knows (edges that the sampler rounds, light, an occluder, blur, a line of a sensor) leaves residuals
that cling together. Their effect on a pose, summed over all of a cluster of pixels before it is squared, tells the
scatter that they bring (the cluster-robust sandwich). A target that is strained leaves a pattern of them that is known,
see ``strain``: by how much it is strained is told from them, and the pose is as uncertain as what one calls its place
and its angle then is.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.ambient import constant
from torch_ecc.core.grid import Grid
from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import SUMS, Solution, clustered
from torch_ecc.core.strain import Strains, by_chance, strained_by, strained_pose, strains_of, without_strain

FEW_BLOCKS = 4  # blocks per fitted column below which residuals cannot tell whether they cling together


class Clinging(NamedTuple):
    """``scatter`` (B, 1, 3): by how many times more than white noise each row of K feels the residuals, at least 1;
    ``ratio`` (B, 3, 3): the same of blocks, and of rows and columns of them over what these may be by chance;
    ``strained`` (B, 3, 3): covariance of what the pose of a strained target may be off by, in the template's axes.
    None where nothing clings together, or nobody can tell."""

    scatter: Tensor | None
    ratio: Tensor | None
    strained: Tensor | None


class Residuals(NamedTuple):
    """Of B templates: their ``effect`` (B, 3, blocks) on the pose in each block, its ``ratio`` (B, 3, 3) to what white
    noise has, of square sums over blocks, rows and columns, ``unit`` (B, 9) what takes such sums there; the patch's
    ``gain`` (B,), and the ``strains`` that the template may show."""

    effect: Tensor
    ratio: Tensor
    unit: Tensor
    gain: Tensor
    strains: Strains


def clinging(reference: Reference, found: Solution, white: Tensor, scale: Tensor | None) -> Clinging:
    """What clings together in the residuals of B templates whose template and frame have noise of variance ``white``
    (B,) together if it is that, with clusters of a ``scale_of``."""
    if scale is None:
        return Clinging(None, None, None)
    unit, on_cpu = scale / white.unsqueeze(1), is_cpu(white.device)
    ratio = (found.total[:, SUMS:] * unit).view(-1, 3, 3)
    scatter = ratio[:, :1].clamp(min=1.0)
    more = ratio > scatter  # of lines, for certain; blocks never do
    if on_cpu and not bool(more.any()):
        return Clinging(scatter, ratio, None)
    certain = more.flatten(1).any(1)
    all_of_it = Residuals(found.sums[:, 7:], ratio, unit, found.gain, strains(reference, found))
    if not on_cpu or bool(certain.all()):
        lines, strained = explained(all_of_it, reference.grid.blocks)
        chosen = certain[:, None, None]
        strained = None if strained is None else torch.where(chosen, strained, 0.0)
        return Clinging(torch.where(chosen, lines, scatter), ratio, strained)
    index = certain.nonzero()[:, 0]
    lines, strained = explained(each(lambda value: value[index], all_of_it), reference.grid.blocks)
    none = scatter.new_zeros(len(scatter), 3, 3)
    strained = None if strained is None else none.index_copy(0, index, strained)
    return Clinging(scatter.index_copy(0, index, lines), ratio, strained)


def scale_of(grid: Grid, normal: Normal) -> Tensor | None:
    """What takes square sums (B, 9) over clusters, see ``solution.clustered``, to the scatter that they tell, times
    white noise's: of lines, to the least that would be so by chance. None if blocks are too few to tell."""
    columns, occupied = normal.inverse.shape[1], grid.occupied
    if occupied < FEW_BLOCKS * columns:
        return None
    free = occupied / (occupied - columns)  # blocks are not free: the fit has made their sum zero
    return (_scales(grid.blocks, free, normal.white.dtype, normal.white.device) / normal.white[:, None]).flatten(1)


def explained(residuals: Residuals, grid: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
    """What clings together, see ``Clinging``, in residuals less those of the strain that fits them best, if they are
    it for certain."""
    effect, ratio, unit, gain, strains = residuals
    effect = effect.to(unit.dtype)  # in which as many templates at once are judged as each alone
    strain, uncertain, certain = strained_by(strains, effect)
    strained = None
    if not (is_cpu(gain.device) and not any(certain.tolist())):
        effect = without_strain(strains, effect, strain * (certain > 0)[:, None])
        ratio = (clustered(effect, grid) * unit).view(-1, 3, 3)
        square = strain[:, :, None] * strain[:, None] + uncertain
        strained = strained_pose(strains, square * (certain / gain.to(certain).square())[:, None, None])
    scatter = ratio[:, :1].clamp(min=1.0)
    lines = ratio * strains.lines
    return torch.where(ratio > scatter, lines, scatter).amax(1, keepdim=True), strained


def strains(reference: Reference, found: Solution) -> Strains:
    """Those that templates may show, of the blocks in sight and as far as they are trusted."""
    if found.trust is None and found.normal is reference.normal:
        return reference.strains
    share = found.sums[:, 0] / reference.parts.weight.clamp(min=LEAST)
    counted = share if found.trust is None else share * found.trust
    return strains_of(reference, found.normal, counted)


@constant
def _scales(grid: tuple[int, int], free: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """What makes the scatter (3, 1) of blocks, and of rows and columns of them, that which is so for certain."""
    lines = torch.tensor(grid, dtype=dtype, device=device)
    return torch.cat((lines.new_tensor([free]), 1 / by_chance(lines)))[:, None]
