"""Dead lines of a camera: rows and columns of pixels that show nothing, in a template as in every frame.

They stay with the camera while the target moves, and are the sharpest edges there are: what is in a template of them
would hold it where it was. So they are told from the first frame, and what lies beside them is put in their place.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

LEVEL = 0.2  # of the contrast of lines around it: a line of pixels with less is as good as of one grey level
OFF = 0.5  # times that contrast: so far is its level from theirs
SHARP = 0.3  # of the step to a dead line is there at most between the two lines beside it: no lens is as sharp
NEXT = 2  # lines to either side that are around one


class DeadLines(NamedTuple):
    """``rows`` and ``columns`` that are dead, (n,) each, and what is put there, (2, n) each: the nearest lines that are
    not dead, on both sides."""

    rows: Tensor
    columns: Tensor
    beside_rows: Tensor
    beside_columns: Tensor

    def repair(self, image: Tensor) -> Tensor:
        """An ``image`` (B, 1, H, W) with means of what lies beside its dead lines in their place."""
        image = _repaired(image, self.rows, self.beside_rows)
        return _repaired(image.mT, self.columns, self.beside_columns).mT


def dead_lines(frame: Tensor) -> DeadLines | None:
    """Those of all frames (B, 1, H, W), float, of a camera; None if there are none: lines as good as of one grey level,
    which is far from that of the scene on both sides, from one pixel to the next, where the scene is not flat."""
    rows, columns = (torch.stack([_dead(one) for one in image[:, 0]]).all(0) for image in (frame, frame.mT))
    if not bool(rows.any() | columns.any()):
        return None
    return DeadLines(rows.nonzero()[:, 0], columns.nonzero()[:, 0], _beside(rows), _beside(columns))


def _dead(image: Tensor) -> Tensor:
    """Which rows (H,) of an image (H, W)."""
    spread, level = torch.std_mean(image, 1, correction=0)
    if len(level) <= 2 * NEXT:
        return torch.zeros_like(level, dtype=torch.bool)
    most = F.pad(spread, (NEXT, NEXT)).unfold(0, 2 * NEXT + 1, 1)
    around = torch.stack((most[:, :NEXT].amax(1), most[:, NEXT + 1 :].amax(1)))
    flat = spread < LEVEL * around.amin(0)
    beside = _beside(flat)
    beyond = torch.stack((beside[0] - 1, beside[1] + 1)).clamp(0, len(level) - 1)
    off, blurred = (level[flat] - level[beside]).abs(), (level[beyond] - level[beside]).abs()
    certain = flat.clone()
    certain[flat] = ((off > OFF * around.amax(0)[flat]) & (blurred < SHARP * off)).all(0)
    if not bool(certain.any()):
        return certain
    like = [(value >= value[certain].min()) & (value <= value[certain].max()) for value in (spread, level)]
    return certain | (like[0] & like[1])  # where the scene around them is flat too


def _beside(dead: Tensor) -> Tensor:
    """The nearest lines before and after those that are ``dead`` (n,), and are not: (2, k)."""
    number = torch.arange(len(dead), device=dead.device)
    before = torch.where(dead, -1, number).cummax(0).values
    after = torch.where(dead, len(dead), number).flip(0).cummin(0).values.flip(0)
    both = torch.where(before < 0, after, before), torch.where(after == len(dead), before, after)
    return torch.stack(both)[:, dead]


def _repaired(image: Tensor, rows: Tensor, beside: Tensor) -> Tensor:
    if len(rows) == 0:
        return image
    image = image.float() if image.dtype == torch.uint16 else image  # few operations know that
    mean = image.index_select(2, beside.flatten()).float().unflatten(2, beside.shape).mean(2)
    return image.index_copy(2, rows, (mean if image.is_floating_point() else mean.round()).to(image.dtype))
