"""Which pixels of a frame do small turned boxes cover? The renderers of pads and specks touch only those.

Boxes of all sizes are walked at once, without a Python loop over boxes: first their rows, then the pixels of each row.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

PIECE = 30_000  # pixels worked on at once by a processor: they fit its cache, and no thread waits for another


class Footprint(NamedTuple):
    """P pixels covered by boxes; a pixel under several boxes appears once for each."""

    box: Tensor  # (P,) int64 index of the box
    pixel: Tensor  # (P,) int64 index into the flattened (h, w) frame
    x: Tensor  # (P,) float32 coordinates of the pixel in the box's own frame, px from its centre
    y: Tensor


class _Spans(NamedTuple):
    """S rows of pixels, each inside one box."""

    box: Tensor  # (S,) int64
    pixel: Tensor  # (S,) int64, the first
    length: Tensor  # (S,) int64
    start: Tensor  # (4, S) float32: cos, sin of the box and where the first pixel is in its frame


def footprint(poses: Tensor, half_sizes: Tensor, size: tuple[int, int]) -> Iterator[Footprint]:
    """Pixels within the boxes |x'| <= half width, |y'| <= half height: (N, 3) box -> frame, (N, 2), (h, w).

    They come in pieces: of about ``PIECE`` pixels for a processor, all at once for an accelerator.
    """
    near = _meets(poses, half_sizes, size)
    box, y = _rows(poses[near], half_sizes[near], size[0])
    box = near[box]
    pose = poses.index_select(0, box)
    cos, sin, v = pose[:, 2].cos(), pose[:, 2].sin(), y - pose[:, 1]
    first, count = _span(pose[:, 0], v, (cos, sin), half_sizes.index_select(0, box), size[1])
    u = first - pose[:, 0]
    # Start of each row in float64, steps along it in float32: single precision never sees frame coordinates.
    start = torch.stack((cos, sin, cos * u - sin * v, sin * u + cos * v)).float()
    spans = _Spans(box, y * size[1] + first, count, start)
    ends = count.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    piece = PIECE if ends.device.type == "cpu" else max(1, total)
    marks = torch.arange(0, total, piece, device=ends.device)
    cuts = [*torch.searchsorted(ends, marks, right=True).tolist(), len(ends)]
    for a, b in pairwise(cuts):
        yield _fill(spans, slice(a, b))


def _fill(spans: _Spans, part: slice) -> Footprint:
    """The pixels of some of the rows."""
    owner, step = _ragged(spans.length[part])
    c, s, x, y = (line[part].index_select(0, owner) for line in spans.start)
    pixel = spans.pixel[part].index_select(0, owner) + step
    return Footprint(spans.box[part].index_select(0, owner), pixel, x.addcmul_(c, step), y.addcmul_(s, step))


def _extent(poses: Tensor, half_sizes: Tensor) -> Tensor:
    """Half sizes of the upright boxes around turned ones: (N, 3), (N, 2) -> (N, 2)."""
    cos, sin = poses[:, 2].cos().abs(), poses[:, 2].sin().abs()
    width, height = half_sizes.unbind(1)
    return torch.stack((cos * width + sin * height, sin * width + cos * height), 1)


def _meets(poses: Tensor, half_sizes: Tensor, size: tuple[int, int]) -> Tensor:
    """Indices of the boxes that may touch the frame, (M,)."""
    far = poses.new_tensor((size[1] - 1, size[0] - 1))
    extent = _extent(poses, half_sizes)
    inside = (poses[:, :2] + extent >= 0) & (poses[:, :2] - extent <= far)
    return inside.all(1).nonzero().squeeze(1)


def _rows(poses: Tensor, half_sizes: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Every (box, row of the frame) pair that may meet: two (S,) int64."""
    extent = _extent(poses, half_sizes)[:, 1]
    top = (poses[:, 1] - extent).ceil().clamp(0, height).long()
    bottom = (poses[:, 1] + extent).floor().add(1).clamp(0, height).long()
    box, step = _ragged((bottom - top).clamp_min(0))
    return box, top.index_select(0, box) + step


def _span(x: Tensor, v: Tensor, turn: tuple[Tensor, Tensor], half: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """First pixel and number of pixels of each row inside its box.

    Inside is |c u - s v| <= half width and |s u + c v| <= half height, with ``turn`` = (c, s) and ``v`` from the pose.
    """
    lows, highs = [], []
    for side, offset, reach in ((turn[0], -turn[1] * v, half[:, 0]), (turn[1], turn[0] * v, half[:, 1])):
        # A side parallel to the row bounds nothing, or everything: a tiny slope says both without a case for it.
        slope = torch.where(side.abs() < 1e-12, torch.full_like(side, 1e-12), side)
        ends = torch.stack(((-reach - offset) / slope, (reach - offset) / slope))
        lows.append(ends.amin(0))
        highs.append(ends.amax(0))
    first = (x + torch.maximum(*lows)).ceil().clamp(0, width)
    last = (x + torch.minimum(*highs)).floor().clamp(-1, width - 1)
    return first.long(), (last - first + 1).clamp_min(0).long()


def _ragged(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of unequal length, flattened: (S,) lengths -> (P,) index of the row, (P,) position in it."""
    owner = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    start = counts.cumsum(0) - counts
    return owner, torch.arange(len(owner), device=counts.device) - start.index_select(0, owner)
