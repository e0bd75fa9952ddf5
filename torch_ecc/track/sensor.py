"""What in a frame is the camera's own, not the scene's: marks that a mask tells of, and dead lines; and what is kept of
the first one."""

from __future__ import annotations

import warnings

from torch import Tensor

from torch_ecc.core.dead_lines import DeadLines, dead_lines
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


def dead_in(where: str, frame: Tensor) -> DeadLines | None:
    """The dead lines of a camera whose ``frame`` (1 or R, 1, H, W) that is, with a warning."""
    dead = dead_lines(frame)
    if dead is not None:
        told = f"{len(dead.rows)} rows and {len(dead.columns)} columns of the frame are dead"
        warnings.warn(f"{where}: {told}: what lies beside them is put there, in all frames", stacklevel=6)
    return dead


def kept(frame: Tensor) -> Tensor:
    """A frame (1 or R, 1, H, W) in half the memory, good enough to look for look-alikes in: float16 about its mean."""
    gray = frame - frame.mean((2, 3), keepdim=True)
    return (gray / gray.square().mean((2, 3), keepdim=True).sqrt().clamp(min=1e-30)).clamp(-1e4, 1e4).half()
