"""What of a template moves with the rest of it, told from a sequence that was tracked.

In the template's own axes what moves with it stays as it is, but for the light; still background behind it, or another
part, changes with the motion. Where there is no texture nothing tells, and nothing matters.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.ambient import plain
from torch_ecc.core.estimate import Status, Track
from torch_ecc.core.patches import Size, as_size
from torch_ecc.core.sampling import Sampler, gradients
from torch_ecc.track.frame_mask import FEWEST, Views, chosen_frames, median, unexplained

BLOCK = 7  # px: residuals are compared over so many
ROUNDS = 4
USUAL = 0.3  # of the blocks fit better than that: what is usual
EXCESS = 4.0  # times the usual residual, and what being
SLIP = 0.15  # px off leaves


@plain
@torch.no_grad()
def suggest_mask(frames: Iterable[Tensor], track: Track, size: Size) -> Tensor:
    """What moves with each of R templates: (R, h, w) bool, what ``Tracker`` takes as ``mask``.

    ``frames``: those of the ``track`` (F, R, ...), (H, W) or (C, H, W); ``size`` of the templates. All of a template
    counts as moving with it if it has hardly moved, or was seen in fewer than five frames. What does not belong bends
    the track that it is told from: track again with the mask, and ask once more. ValueError for what does not fit.
    """
    sides = as_size("suggest_mask", size)
    some, looks = chosen_frames("suggest_mask", frames, track)
    masks = []
    for r in range(track.pose.shape[1]):
        good = Status.good(track.status[some, r])
        if int(good.sum()) < FEWEST:
            masks.append(torch.ones(sides, dtype=torch.bool, device=looks.device))
            continue
        views = Views.of(looks[good], track.pose[some[good], r], sides)
        patches = Sampler.of(views.image, "bspline3")(views.there, views.template)
        masks.append(_belonging(patches, sides))
    return torch.stack(masks)


def _belonging(patches: Tensor, size: tuple[int, int]) -> Tensor:
    """Which pixels (h, w) of patches (K, h w) stay as they are, but for gain and offset."""
    scene = median(patches)
    slope = gradients(scene.view(1, 1, *size)).square().sum(1, keepdim=True)
    kept = torch.ones_like(scene, dtype=torch.bool)
    for _ in range(ROUNDS):
        left = unexplained(patches, torch.where(kept, scene, torch.nan).expand_as(patches), scene.expand_as(patches))
        variance = F.avg_pool2d(median(left.abs()).square().view(1, 1, *size), BLOCK, 1, BLOCK // 2)
        expected = variance.quantile(USUAL) + SLIP**2 * F.avg_pool2d(slope, BLOCK, 1, BLOCK // 2)
        kept = (variance <= EXCESS * expected).flatten()
    return kept.view(size)
