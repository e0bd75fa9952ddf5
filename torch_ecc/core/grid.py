"""Where the pixels of templates lie, in their own coordinates, and what their poses speak of."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import pose_dtype

BLOCK = 6  # px: side of the blocks over which the last look at a patch is summed


class Grid(NamedTuple):
    """Where the pixels of all templates lie: ``pixels`` (3, N), homogeneous, relative to the middle of the template
    array; ``box`` (3, 4), the corners of their bounding box, and ``sides`` (2,), how many of them it is wide and high;
    ``block`` (N,), the number of the block that a pixel is in, of ``blocks`` = (rows, columns) of them, of which
    ``occupied`` hold a pixel."""

    pixels: Tensor
    box: Tensor
    sides: Tensor
    block: Tensor
    blocks: tuple[int, int]
    occupied: int


class Place(NamedTuple):
    """What the poses of B templates speak of: ``centre`` (B, 2), the point x' = 0 in the grid's coordinates; ``radius``
    (B,) px from there to the farthest pixel; ``lever`` (B, 3): by how many px an increment of 1 in x, y, theta moves
    that pixel, and its square; ``unit`` (B, 2, 3) takes pixels to positions about the centre over half the box."""

    centre: Tensor
    radius: Tensor
    lever: Tensor
    lever2: Tensor
    unit: Tensor


def grid_of(used: Tensor, image: Tensor) -> Grid:
    """The grid of the pixels ``used`` (h w,) of an ``image`` (B, 1, h, w)."""
    axes = (torch.arange(n, device=image.device, dtype=image.dtype) - (n - 1) / 2 for n in image.shape[-2:])
    y, x = (axis.flatten()[used] for axis in torch.meshgrid(*axes, indexing="ij"))
    (left, right), (top, bottom) = ((float(v.min()), float(v.max())) for v in (x, y))
    box = image.new_tensor([[left, right, right, left], [top, top, bottom, bottom], [1, 1, 1, 1]])
    column, row = ((x - left) / BLOCK).long(), ((y - top) / BLOCK).long()
    blocks = (int(bottom - top) // BLOCK + 1, int(right - left) // BLOCK + 1)
    block = row * blocks[1] + column
    sides = (box[:2, 2] - box[:2, 0] + 1).to(pose_dtype(image.device))
    pixels, occupied = torch.stack((x, y, torch.ones_like(x))), int((torch.bincount(block) > 0).sum())
    return Grid(pixels, box, sides, block, blocks, occupied)


def place_of(grid: Grid, centre: Tensor, weight: Tensor) -> Place:
    """Of templates with their ``centre`` (B, 2) there in a grid, whose pixels have a ``weight`` (B, N)."""
    local = grid.pixels[:2] - centre[:, :, None]
    radius = (local.square().sum(1) * (weight > 0)).amax(-1).sqrt().to(pose_dtype(centre.device))
    lever = torch.stack((torch.ones_like(radius), torch.ones_like(radius), radius), -1)
    half = (grid.box[:2, 2] - grid.box[:2, 0]).clamp(min=1.0)[:, None] / 2
    one = torch.eye(2, dtype=half.dtype, device=half.device).expand(len(centre), 2, 2)
    return Place(centre, radius, lever, lever.square(), torch.cat((one, -centre[:, :, None]), -1) / half)
