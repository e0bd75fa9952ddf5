"""Templates in 16 bits, as a compiled engine reads them: whole rows of pixels, and the numbers that go with them.

All columns of a criterion are made of three images (d/dx, d/dy and t) and the pixels' coordinates, so that with the
inverse of the normal equations K g = (Z W R^T)^-1 (Z W g) takes 6 bytes per pixel where K takes 4 per column. The
images were rounded to whole numbers when the template was prepared (``reference.Columns``): nothing is lost here.
"""

from __future__ import annotations

from functools import cached_property
from struct import Struct
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.columns import LEVELS
from torch_ecc.core.grid import BLOCK
from torch_ecc.core.reference import Reference
from torch_ecc.core.solution import CLUSTERS, SUMS

LANES = 16  # pixels of the widest vector that an engine reads rows in: their pitch is a multiple of it
MOST = 10  # columns
PLANES = 7
NUMBERS = 122  # of a template, Numbers in csrc/template.h
MOMENTS = 225  # of it, normal.Moments


GRID = Struct("@9q")  # Grid in csrc/engine.cpp


class _Packed(NamedTuple):
    tensors: list[Tensor]
    widths: list[int]
    steps: list[int]


class Packed(_Packed):
    """B templates on one grid or two, the coarser one second, of each:

    ``planes`` (B, 7, h, pitch) int16: d/dx, d/dy and t of the instrument, of the signal, and the Wiener weights, 0
    where there is no pixel; ``weight`` (B or 1, h or 1, pitch), float32, of one row if all rows are alike;
    ``numbers`` (B, ...), float64, in the order of ``Numbers`` in csrc/template.h. ``widths``: columns of the grids;
    ``steps``: px between them.
    """

    @cached_property
    def results(self) -> list[Tensor]:
        """Tensors of the shapes and dtypes that an engine answers with: those of ``entry.Answer``."""
        (count, _, height, _), new = self.tensors[0].shape, self.tensors[2].new_empty
        blocks = -(-height // BLOCK) * -(-self.widths[0] // BLOCK)
        sums = new((count, SUMS, blocks), dtype=torch.float32)
        single = new(count), new(count, dtype=torch.int64), new(count)
        return [new((count, 3)), *single, sums, new((count, SUMS + CLUSTERS)), new((count, MOMENTS))]

    @cached_property
    def pixels(self) -> int:
        """Of each template."""
        return self.tensors[0][0, 0].numel()

    @cached_property
    def memory(self) -> bytes:
        """Where all this lies, as csrc/engine.cpp reads it; a single grid is the coarser one too."""
        last = len(self.widths) - 1
        return Struct("@q").pack(last) + self._grid(0) + self._grid(last)

    def _grid(self, k: int) -> bytes:
        planes, weight, numbers = self.tensors[3 * k : 3 * k + 3]
        _, _, height, pitch = planes.shape
        places = (tensor.data_ptr() for tensor in (planes, weight, numbers))
        even, alike = weight.shape[:2] == (1, 1), planes.stride(0) == 0
        return GRID.pack(*places, height, pitch, self.widths[k], self.steps[k], even, alike)

    def copies(self, count: int) -> Packed:
        """Of one template, so many in the same memory."""
        one_row = [tensor.dim() == 3 and tensor.shape[1] == 1 for tensor in self.tensors]  # which serves for all
        pairs = zip(self.tensors, one_row, strict=True)
        many = [tensor if one else tensor.expand(count, *tensor.shape[1:]) for tensor, one in pairs]
        return Packed(many, self.widths, self.steps)

    def __reduce__(self) -> tuple[type[Packed], tuple[object, ...]]:
        return Packed, tuple(self)  # a copy lies elsewhere


def pack(reference: Reference) -> Packed:
    """The templates on all pixels and, if there is one, on the coarser grid."""
    coarse = reference.coarse
    grids = [(reference, 1), *([] if coarse is None else [(coarse, _step(coarse))])]
    tensors, widths = zip(*(_tensors(grid, step) for grid, step in grids), strict=True)
    return Packed([tensor for those in tensors for tensor in those], list(widths), [step for _, step in grids])


def _step(coarse: Reference) -> int:
    """Px between the pixels of a subsampled grid: what divides all distances from the first column and row."""
    places = (coarse.grid.pixels[:2] - coarse.grid.box[:2, :1]).round().long()
    return max(int(torch.gcd(*(_divisor(v) for v in places))), 1)


def _divisor(values: Tensor) -> Tensor:
    while len(values) > 1:
        values = F.pad(values, (0, len(values) % 2))
        values = torch.gcd(values[::2], values[1::2])
    return values[0]


def _tensors(reference: Reference, step: int) -> tuple[list[Tensor], int]:
    """Planes, weight and numbers of one grid, and its width."""
    columns, grid = reference.columns, reference.grid
    column, row = ((grid.pixels[:2] - grid.box[:2, :1]).round().long() / step).long()
    width, height = int(column.max()) + 1, int(row.max()) + 1
    pitch = -(-width // LANES) * LANES
    at = row * pitch + column
    levels = columns.level[:, :, None]
    slopes = (columns.instrument[:, :2], columns.signal[:, :2])
    t = torch.stack((columns.instrument[:, 3], columns.signal[:, 3]), 1) - levels
    values = [slopes[0], t[:, :1], slopes[1], t[:, 1:]]
    parts = [v / columns.unit[:, k, None, None] for k, v in enumerate(values)] + [columns.wiener[:, None] * LEVELS]
    planes = torch.zeros(len(t), 7, height * pitch, dtype=torch.int16, device=at.device)
    # NaN, as of grey levels so large that their sums overflow, is as good as any: nothing is found with it.
    planes[:, :, at] = torch.cat(parts, 1).nan_to_num().round().clamp(-LEVELS, LEVELS).to(torch.int16)
    weight = columns.weight.new_zeros(len(t), height * pitch)
    weight[:, at] = columns.weight
    weight = weight.view(-1, height, pitch)
    if len(at) == width * height and bool((columns.weight == 1).all()):
        weight = weight[:1, :1].clone()
    return [planes.view(-1, 7, height, pitch), weight, _numbers(reference)], width


def _numbers(reference: Reference) -> Tensor:
    """See ``Numbers`` in csrc/template.h."""
    columns, normal, place = reference.columns, reference.normal, reference.place
    dtype = place.radius.dtype
    mean = torch.stack((columns.instrument[:, 3].mean(-1), columns.signal[:, 3].mean(-1)), 1)
    corner = (reference.grid.box[:2, 0] - place.centre).to(dtype)
    half = (1 / place.unit.diagonal(dim1=1, dim2=2)).to(dtype)
    t = columns.signal[:, 3:] - mean[:, 1:, None]
    both = torch.cat((t, torch.ones_like(t)), 1)
    slopes = columns.instrument[:, :3] * columns.weight[:, None]
    inverse = F.pad(normal.inverse, 2 * (0, MOST - normal.inverse.shape[-1]))
    rows = [
        *(corner, half, place.radius[:, None], columns.unit, columns.level, mean),
        *(normal.total[:, None], normal.gram[:, 0, 3:], normal.energy[:, None].sqrt()),
        *((slopes @ both.mT).mT.flatten(1), inverse.flatten(1)),
    ]
    return torch.cat([value.to(dtype) for value in rows], 1).contiguous()
