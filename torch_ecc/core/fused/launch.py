"""The launch of the fused kernel: tensors in, tensors out."""

from __future__ import annotations

from contextlib import nullcontext
from typing import NamedTuple

import torch
import triton.language as tl
from torch import Tensor

from torch_ecc.core.fused import kernel, look
from torch_ecc.core.fused.records import OF_LOOK, Answers, Frames, Grids, Trusted, Way
from torch_ecc.core.grid import BLOCK
from torch_ecc.core.native.engine import DEGREE
from torch_ecc.core.native.entry import How
from torch_ecc.core.native.packed import Packed
from torch_ecc.core.sampling import Sampler
from torch_ecc.core.solution import Trust

SAMPLER = {degree: name for name, degree in DEGREE.items()}
MANY = 256  # templates, two for each processor of a large GPU


class Shape(NamedTuple):
    """Of a program: what it takes at a time, see ``records.Way``, and how many warps."""

    pixels: int
    threads: int
    warps: int


def shape_for(device: torch.device, count: int) -> Shape:
    """Few templates have whole processors for themselves; of many, several share one. An interpreter's time is that of
    its steps."""
    if device.type == "cpu":
        return Shape(2048, 2048, 1)
    return Shape(256, 128, 4) if count > MANY else Shape(1024, 512, 16)


def call(
    image: Tensor, start: Tensor, packed: Packed, how: How, trust: Trust | None = None, distortion: Tensor | None = None
) -> list[Tensor]:
    """``entry.FIELDS`` of the packed templates in (B or 1, 1, H, W) from ``start`` (B, 3), float64, on, or of those
    that ``trust`` is about, seen with a ``distortion`` (B, 2, 2), float64. ``moments`` of those of which all pixels
    count begin with -1."""
    degree, most, tolerance, code = how
    n = len(start if trust is None else trust.which)
    results = [result.new_empty((n, *result.shape[1:])) for result in packed.results]
    image = image.float()
    frames = smooth = _frames(image, 1, image.shape)
    if degree > 1:
        smooth = _frames(Sampler.of(image, SAMPLER[degree]).values, degree, image.shape)
    grids = [_grids(packed, k) for k in range(len(packed.widths))]
    bend = start.new_zeros(len(start), 4) if distortion is None else distortion.contiguous()
    shape, constants = shape_for(image.device, n), 5 + max(code, 0)
    fixed = code, constants, 3 if code < 0 else constants, len(grids) > 1, *shape[:2]
    some, partial = (Way(tolerance, float(most), *_fixed(*fixed, either)) for either in (False, True))
    trusted, answers = _trusted(trust, packed, start), Answers._make([*results, start.new_empty(n, OF_LOOK.value)])
    with torch.cuda.device(image.device) if image.is_cuda else nullcontext():
        for way in (some, partial)[not Trust.whole(trust) :]:
            every = trusted, start.contiguous(), bend, answers, way
            kernel.solve[(n,)](frames, smooth, grids[0], grids[-1], *every, num_warps=shape.warps)
        look.answer[(n,)](smooth, grids[0], trusted, bend, answers, partial, num_warps=shape.warps)
    return results


def _fixed(*values: int | bool) -> list[tl.constexpr]:
    """What the kernel is compiled for."""
    return [tl.constexpr(value) for value in values]


def _frames(values: Tensor, degree: int, size: torch.Size) -> Frames:
    many = values[0].numel() if len(values) > 1 else 0
    return Frames(values.contiguous(), size[2], size[3], many, *_fixed(degree))


def _grids(packed: Packed, k: int) -> Grids:
    planes, weight, numbers = (tensor.contiguous() for tensor in packed.tensors[3 * k : 3 * k + 3])
    _, _, height, pitch = planes.shape
    even = weight.shape[:2] == (1, 1)
    return Grids(planes, weight, numbers, *_fixed(height, packed.widths[k], pitch, packed.steps[k], even))


def _trusted(trust: Trust | None, packed: Packed, start: Tensor) -> Trusted:
    """All of them, whole, if there is none."""
    across, count = -(-packed.widths[0] // BLOCK), packed.results[4].shape[2]
    lines = 1 << (max(across, count // across) - 1).bit_length()
    iterations, none = packed.results[2], packed.tensors[1]  # of the same types: else there would be another kernel
    which, blocks, asked, *_ = trust or (iterations, None, None)
    asked = start.new_ones(len(which), dtype=torch.bool) if asked is None else asked
    fixed = _fixed(across, count, lines, blocks is not None)
    return Trusted(which.contiguous(), (none if blocks is None else blocks).contiguous(), asked.contiguous(), *fixed)
