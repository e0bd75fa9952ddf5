"""Impulse noise: pixels that are black or white by chance, others in every frame (salt and pepper).

A few of a hundred hide more of a template than all other noise does, and single pixels among others that are far from
them are nothing that a lens could show. Where a camera has such pixels the median of those around is put there.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

SHARE = 0.005  # of the pixels are as black, and as many as white, where a camera has impulse noise
FAR = 0.25  # of all levels: so far from the median around is an impulse for certain
NEAR = 0.03  # of them: as near to black or white, which have noise too
MOST = 0.25  # of the pixels: a picture of black and white is none of them
OFF = 0.05  # of them: so far is what is as black or white, where there are impulses


class Impulses(NamedTuple):
    """The levels of such pixels, () each: these are no brighter than ``black``, or no darker than ``white``."""

    black: Tensor
    white: Tensor

    def repair(self, image: Tensor) -> Tensor:
        """An ``image`` (B, 1, H, W) with medians of what lies around in their place."""
        image = image.float() if image.dtype == torch.uint16 else image  # few operations know that
        where, middle = _off(image, self, OFF)
        return image.index_put(where, middle.to(image.dtype))


def impulses(frame: Tensor) -> Impulses | None:
    """Those of a camera whose ``frame`` (B, 1, H, W) that is, float; None if it has none: both black and white."""
    low, high = frame.amin(), frame.amax()
    levels = Impulses(torch.lerp(low, high, NEAR), torch.lerp(high, low, NEAR))
    if ((frame <= levels.black) | (frame >= levels.white)).float().mean() > MOST:
        return None
    b, _, y, x = _off(frame, levels, FAR)[0]
    bright = frame[b, 0, y, x] >= levels.white
    few = SHARE * frame.numel()
    return levels if min(int(bright.sum()), int((~bright).sum())) > few else None


def _off(image: Tensor, levels: Impulses, share: float) -> tuple[tuple[Tensor, ...], Tensor]:
    """Where pixels of these levels are off by a ``share`` of them, (n,) each, and the medians (n,) of 3 x 3 there."""
    b, c, y, x = ((image <= levels.black) | (image >= levels.white)).nonzero(as_tuple=True)
    step = torch.arange(-1, 2, device=image.device)
    rows, columns = ((at[:, None] + step).clamp(0, n - 1) for at, n in zip((y, x), image.shape[2:], strict=True))
    around = image[b[:, None, None], 0, rows[:, :, None], columns[:, None, :]].flatten(1).float()
    middle = around.median(1).values
    far = (around[:, 4] - middle).abs() > share * (levels.white - levels.black)
    return (b[far], c[far], y[far], x[far]), middle[far]
