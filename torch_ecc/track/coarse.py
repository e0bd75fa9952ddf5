"""Where templates are in the coarser levels of a frame: the start of the finest one."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.reference import Reference
from torch_ecc.core.solver import iterate
from torch_ecc.core.step import State
from torch_ecc.search.locate import detrended_zncc_at

COARSE_TOLERANCE = 0.1  # px of a coarse level


def coarse_to_fine(references: list[Reference], images: list[Tensor], pose: Tensor, most: int) -> Tensor:
    """Poses (R, 3) from ``pose`` (R, 3) on, by at most so many iterations in each coarser level of the templates and
    the frame. What a level has found is kept only if it looks better to the next finer one than its start: fine texture
    is not there in a coarse level, which then leads anywhere."""
    for level in range(len(references) - 1, 0, -1):
        scale, double = (pose.new_tensor((s, s, 1.0)) for s in (2.0**level, 2.0))
        state, *_ = iterate(
            references[level], images[level], "bilinear", State.start(pose / scale), COARSE_TOLERANCE, most
        )
        finer = references[level - 1], images[level - 1]
        better = detrended_zncc_at(*finer, state.pose * double) > detrended_zncc_at(*finer, pose / scale * double)
        pose = torch.where(better[:, None], state.pose * scale, pose)
    return pose
