"""Templates that go together: where most have gone is where the others are to be looked for."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate
from torch_ecc.core.pose import compose, rotation

FEWEST_TOGETHER = 3  # templates that must have gone the same way for others to be looked for there
TOGETHER = 3.0  # px: they have gone the same way, and more than half of those that were found have


def gone_together(estimate: Estimate, start: Tensor, those: Tensor) -> Tensor | None:
    """Where all templates are expected (R, 3) if they have moved from the ``start`` (R, 3) as most of ``those`` (R,)
    have; None if these are few or have not gone the same way."""
    count = int(those.sum())
    if count < FEWEST_TOGETHER:
        return None
    expected = compose(common_motion(start[those], estimate.pose[those]).expand_as(start), start)
    agree = torch.hypot(*(estimate.pose - expected)[those, :2].T) <= TOGETHER
    return expected if int(agree.sum()) >= max(FEWEST_TOGETHER, count // 2 + 1) else None


def common_motion(start: Tensor, pose: Tensor) -> Tensor:
    """The motion (3,) of the frame that takes poses ``start`` (n, 3) to ``pose`` (n, 3), or most of them: medians."""
    angle = (pose - start)[:, 2].median()
    shift = pose[:, :2] - (rotation(angle) @ start[:, :2].mT).mT
    return torch.cat((shift.median(0).values, angle[None]))
