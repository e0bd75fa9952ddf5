"""What a template has in each block of its pixels, by which it is judged where it fits a frame and where not."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.criteria import centred
from torch_ecc.core.grid import BLOCK, Grid

if TYPE_CHECKING:
    from torch_ecc.core.reference import Reference

THIRD = 20.0  # times a variance is that of third differences
HALF_FULL = 0.5  # of the fullest block's weight: a block with less of it tells too little


class Blocks(NamedTuple):
    """Of the blocks of B templates, (B, blocks) each: their ``weight``, the weighted sum of ``t`` less its mean and of
    its ``square``, the mean square of the texture's slopes, or of those around if that is more, ``slope``; and which of
    those that hold pixels enough are ``flat``, as half of them are, or ``steep``, as is the other half; ``enough``:
    either; ``share``: what their weighted sums are to be multiplied by for a mean, 0 of the others; by how much their
    slopes count as instruments, the mean of ``wiener``. ``lined`` (B, 2): the variance of offsets that columns, and
    rows, of the template may have at most."""

    weight: Tensor
    t: Tensor
    square: Tensor
    slope: Tensor
    flat: Tensor
    steep: Tensor
    enough: Tensor
    share: Tensor
    wiener: Tensor
    lined: Tensor


# By what parts of a target, at (x, y) about its centre, may move other than as one, and whether that is half a turn:
# it grows; grows along x and shrinks along y; and so along the diagonals; bends, along y and along x; tilts, about y
# and about x.
STRAINS: tuple[tuple[Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], bool], ...] = (
    (lambda x, y: (x, y), False),
    (lambda x, y: (x, -y), True),
    (lambda x, y: (y, x), True),
    (lambda x, y: (y * y, -x * y), False),
    (lambda x, y: (x * y, -x * x), False),
    (lambda x, y: (x * x, x * y), False),
    (lambda x, y: (x * y, y * y), False),
)


class Parts(NamedTuple):
    """What the blocks of B templates add to sums over Z W (p rows), the last dimension of which they are: ``normal``
    (B, p, p, blocks) those with R, ``strain`` (B, p, 7, blocks) with what the picture changes by in each of
    ``STRAINS``, as large as moves the farthest pixel, ``radius`` (B,) px away, by some 1 px; ``weight`` (B, blocks)."""

    normal: Tensor
    strain: Tensor
    weight: Tensor
    radius: Tensor


def blocks_of(reference: Reference) -> Blocks:
    """Made of a prepared template."""
    grid, weight = reference.grid, reference.weight
    t, _ = centred(reference.signal[:, 3], weight)
    slopes = reference.columns.wiener * reference.signal[:, :2].square().sum(1)
    rows = torch.stack((weight, weight * t, weight * t * t, weight * slopes, weight * reference.columns.wiener), 1)
    sums = rows.new_zeros(*rows.shape[:2], grid.blocks[0] * grid.blocks[1]).index_add_(2, grid.block, rows)
    count, of_t, square, slope, wiener = sums.unbind(1)
    slope = (slope / count.clamp(min=1e-30)).view(-1, *grid.blocks)
    around = F.avg_pool2d(slope, 3, 1, 1, count_include_pad=False)  # blur brings edges from the next block
    slope = torch.maximum(slope, around).flatten(1)
    enough = count > HALF_FULL * count.amax(1, keepdim=True)
    middle = torch.where(enough, slope, torch.nan).nanmedian(1, keepdim=True).values
    share = torch.where(enough, 1 / count, 0.0)
    flat, wiener = slope <= middle, wiener / count.clamp(min=1e-30)
    lined = torch.stack([line_variance(grid, axis, weight, t) for axis in (0, 1)], 1)
    return Blocks(count, of_t, square, slope, enough & flat, enough & ~flat, enough, share, wiener, lined)


def line_variance(grid: Grid, axis: int, weight: Tensor, t: Tensor) -> Tensor:
    """That (B,) of the offsets that lines of templates ``t`` (B, N) under a ``weight`` (B, N) can have, one after the
    other along an ``axis`` of their ``grid``: by third differences of their means, which leave next to nothing of a
    smooth scene."""
    line = (grid.pixels[axis] - grid.box[axis, 0]).round().long()
    most = grid.blocks[1 - axis] * BLOCK
    sums = t.new_zeros(2, len(t), most).index_add_(2, line, torch.stack((weight, weight * t)))
    full = sums[0] > HALF_FULL * sums[0].amax(1, keepdim=True)
    mean = sums[1] / sums[0].clamp(min=1e-30)
    off = mean.diff(n=3, dim=1)
    known = (full[:, 3:] & full[:, 2:-1] & full[:, 1:-2] & full[:, :-3]).to(t)
    return (off.square() * known).sum(1) / (THIRD * known.sum(1).clamp(min=1))


def parts_of(reference: Reference) -> Parts:
    """Made of a prepared template."""
    columns, grid = reference.columns, reference.grid
    R, Z = (reference.criterion.columns(v, reference.uv) for v in (columns.signal, columns.instrument))
    place = (grid.pixels[:2] - reference.place.centre[:, :, None]) / reference.place.radius[:, None, None]
    gx, gy, x, y = (v.to(R.dtype) for v in (*columns.signal[:, :2].unbind(1), *place.unbind(1)))
    moved = [shape(x, y) for shape, _ in STRAINS]
    both, p = torch.cat((R, torch.stack([gx * dx + gy * dy for dx, dy in moved], 1)), 1), R.shape[1]
    sums = torch.einsum("bpnk,bqnk->bpqn", *(tiled(rows, grid) for rows in (Z * columns.weight[:, None], both)))
    return Parts(sums[:, :, :p], sums[:, :, p:], reference.blocks.weight, reference.place.radius)


def tiled(rows: Tensor, grid: Grid) -> Tensor:
    """``rows`` (B, p, N) of a grid's pixels, block by block: (B, p, blocks, BLOCK^2), 0 where there is none."""
    column, row = (grid.pixels[:2] - grid.box[:2, :1]).round().long() % BLOCK
    tiles = rows.new_zeros(*rows.shape[:2], grid.blocks[0] * grid.blocks[1], BLOCK**2)
    tiles.flatten(2).index_copy_(2, (grid.block * BLOCK + row) * BLOCK + column, rows)
    return tiles


def patch_of(reference: Reference) -> Tensor:
    """Pixels (B,) that the texture is alike over: the sum of its squared autocorrelation."""
    grid, used = reference.grid, reference.weight > 0
    t, _ = centred(reference.signal[:, 3], reference.weight)
    column, row = (grid.pixels[:2] - grid.box[:2, :1]).round().long()
    height, width = (2 * BLOCK * n for n in grid.blocks)  # half of it empty: it is not periodic
    texture = t.new_zeros(len(t), height * width).index_add_(1, row * width + column, t * used)
    power = torch.fft.rfft2(texture.view(-1, height, width)).abs().square().to(grid.sides)
    power[..., 1 : width // 2] *= 2**0.5  # which stand for two
    total = texture.square().sum(1, dtype=power.dtype).square().clamp(min=1e-30)
    patch: Tensor = power.square().sum((1, 2)) / (height * width) / total
    return patch
