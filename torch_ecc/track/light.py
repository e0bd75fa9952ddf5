"""Templates that were lost because of the light: where they were last it has become dark, or is too bright to show."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Reason, Status
from torch_ecc.core.noise import FULL_SCALES

DARK = 0.3  # of the first frame's level and contrast: less is dark
CLIPPED = 0.3  # of the pixels at a level at which cameras clip
MAY_BE = (Reason.UNLIKE, Reason.COVERED, Reason.FLAT)  # which may be because of the light


@torch.no_grad()
def told_of_light(estimate: Estimate, image: Tensor, state: Mapping[str, Tensor], sides: Tensor) -> Estimate:
    """The ``estimate`` of R templates of ``sides`` (2,) px in an ``image`` (1, 1, H, W), in which those that are
    lost because of the light are so for that reason; ``state``: the tracker's, as before the frame."""
    codes = zip(estimate.status.tolist(), estimate.reason.tolist(), strict=True)
    lost = [r for r, (status, reason) in enumerate(codes) if status == Status.LOST and reason in MAY_BE]
    if not lost or len(image) > 1:  # of frames of their own no level is kept
        return estimate
    reason, (mean, deviation) = estimate.reason.clone(), state["level"]
    for r in lost:
        places = (image, state["pose"][r]), (state["first"], state["start"][r])
        now, before = (around(frame[0, 0], place, sides) for frame, place in places)
        before = before * deviation + mean  # it is kept off these
        if now.mean() < DARK * before.mean() and now.std() < DARK * before.std():
            reason[r] = int(Reason.DARK)
        elif float(now.max()) in FULL_SCALES and (now == now.max()).float().mean() > CLIPPED:
            reason[r] = int(Reason.CLIPPED)
    return estimate._replace(reason=reason)


def around(frame: Tensor, place: Tensor, sides: Tensor) -> Tensor:
    """What a ``frame`` (H, W) shows in an upright box of ``sides`` (2,) px, x and y, about a ``place`` (3,), as far as
    that is in sight, and of one pixel at least."""
    last = sides.new_tensor(frame.shape[::-1]) - 1
    low, high = ((place[:2] + shift).round().clamp(min=0).minimum(last).long() for shift in (-sides / 2, sides / 2))
    return frame[low[1] : high[1] + 1, low[0] : high[0] + 1].float()
