"""What in a frame is the camera's own, not the scene's: marks that a mask tells of, dead lines, impulse noise; and what
is kept of the first one."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.dead_lines import DeadLines, dead_lines
from torch_ecc.core.impulses import Impulses, impulses
from torch_ecc.core.sight import as_frame_mask

FIND = "find"  # in place of a mask: what the camera shows of its own is to be found out


def shown(where: str, mask: Tensor | str | None, frame: Tensor) -> Tensor | None:
    """Where a camera whose ``frame`` (1 or R, 1, H, W) that is shows the scene, None for everywhere as far as one
    knows. ValueError for no mask."""
    if isinstance(mask, str) and mask != FIND:
        raise ValueError(f"{where}: frame_mask: expected a tensor (H, W) or {FIND!r}, got {mask!r}")
    return (
        None
        if mask is None or isinstance(mask, str)
        else as_frame_mask(where, mask, (frame.shape[2], frame.shape[3])).to(frame.device)
    )


class Dead(NamedTuple):
    """What shows nothing in the frames of a camera: ``lines``, and single pixels by chance; None if there are none."""

    lines: DeadLines | None
    single: Impulses | None

    def repair(self, image: Tensor) -> Tensor:
        """An ``image`` (B, 1, H, W) with what lies beside in their place."""
        image = image if self.lines is None else self.lines.repair(image)
        return image if self.single is None else self.single.repair(image)

    def to(self, device: torch.device) -> Dead:
        """On another one."""
        lines = None if self.lines is None else DeadLines(*(part.to(device) for part in self.lines))
        return Dead(lines, None if self.single is None else Impulses(*(level.to(device) for level in self.single)))


def dead_in(where: str, frame: Tensor) -> Dead | None:
    """What is dead in the frames of a camera whose ``frame`` (1 or R, 1, H, W) that is, with a warning."""
    lines = dead_lines(frame)
    single = impulses(frame if lines is None else lines.repair(frame))
    if lines is not None:
        told = f"{len(lines.rows)} rows and {len(lines.columns)} columns of the frame are dead"
        warnings.warn(f"{where}: {told}: what lies beside them is put there, in all frames", stacklevel=6)
    if single is not None:
        told = "single pixels of the frame are black or white by chance"
        warnings.warn(f"{where}: {told}: what lies around them is put there, in all frames", stacklevel=6)
    return None if lines is None and single is None else Dead(lines, single)


def kept(frame: Tensor) -> Tensor:
    """A frame (1 or R, 1, H, W) in half the memory, good enough to look for look-alikes in: float16 about its mean."""
    gray = frame - frame.mean((2, 3), keepdim=True)
    return (gray / gray.square().mean((2, 3), keepdim=True).sqrt().clamp(min=1e-30)).clamp(-1e4, 1e4).half()
