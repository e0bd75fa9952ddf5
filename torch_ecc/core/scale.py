"""What variance is to be expected of the blocks of a template, told by most of them: robust scales and medians.

A minority of blocks, whatever it shows, does not move any of them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.blocks import Blocks
from torch_ecc.core.grid import BLOCK
from torch_ecc.core.normal import LEAST

QUANTILE, TO_MEDIAN = 0.3, 1.13  # of the blocks' variances: a scale that covers of well over half cannot raise
LEAST_SLIP = 0.00125  # px^2 / 2: blocks may seem to have slipped by 0.05 px rms, as of the sampler
SEEN = 0.5  # of a block's weight must be in sight for it to tell the scale


class Scale(NamedTuple):
    """The variance expected per pixel of a block: ``noise`` + ``slip`` * (mean square of its slopes), (B, 1) each."""

    noise: Tensor
    slip: Tensor


def excess(variance: Tensor, blocks: Blocks, seen: Tensor, scale: Scale) -> Tensor:
    """Residual ``variance`` (B, n) of blocks over what is expected; of those with less weight ``seen`` (B, n) than that
    of a block's pixels by as much less over 1 as noise scatters more in them."""
    ratio = variance / torch.addcmul(scale.noise, scale.slip, blocks.slope)
    return (ratio - 1).mul_((seen / BLOCK**2).clamp_(max=1).sqrt_()).add_(1)


def residual_variance(sums: Tensor) -> Tensor:
    """Mean square (B, n) of each block's residuals from the sums (B, 10, n)."""
    return sums[:, 6] / sums[:, 0].clamp(min=LEAST)


def robust_scale(variance: Tensor, blocks: Blocks, seen: Tensor, floor: Tensor, most: Scale) -> Scale:
    """The scale of block variances (B, n): noise from the flatter half of the blocks, slip from the others.

    ``seen`` (B, n): weight in sight; ``floor`` (B, 1): the least noise; ``most``: the largest scale.
    """
    there = seen > SEEN * blocks.weight
    noise = quantile(variance, blocks.flat & there).minimum(most.noise).maximum(floor)
    slip = quantile((variance - noise) / blocks.slope.clamp(min=LEAST), blocks.steep & there)
    return Scale(noise, slip.clamp(min=LEAST_SLIP).minimum(most.slip))


def quantile(values: Tensor, used: Tensor) -> Tensor:
    """What a share of QUANTILE of the values (B, n) that are ``used`` does not exceed, brought to their median as of
    noise: (B, 1)."""
    ranked = torch.where(used, values, torch.inf).sort(1).values
    rank = (used.sum(1, keepdim=True) * QUANTILE).long()
    return (ranked.gather(1, rank) * TO_MEDIAN).nan_to_num(0.0, 0.0, 0.0)


def median_fit(sums: Tensor, blocks: Blocks) -> tuple[Tensor, Tensor]:
    """Each block's mean square (B, n) of what gain * t + offset leaves of it, and the gain (B, 1): the median of those
    of single blocks, weighted by their contrast, as is the offset. A minority of blocks does not move them."""
    weight, g, gg, tg = sums[:, :4].unbind(1)
    seen, some = weight / blocks.weight.clamp(min=LEAST), weight.clamp(min=LEAST)
    t, tt = blocks.t * seen, blocks.square * seen
    contrast = (tt - t * t / some).clamp(min=0)
    gain = weighted_median((tg - t * g / some) / contrast.clamp(min=LEAST), contrast * blocks.steep)
    offset = weighted_median((g - gain * t) / some, weight)
    left = gg - 2 * (gain * tg + offset * g) + gain * gain * tt + 2 * gain * offset * t + offset * offset * weight
    return left.clamp(min=0) / some, gain


def weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    """(B, n), (B, n) -> (B, 1)."""
    ranked, order = values.sort(1)
    share = weight.gather(1, order).cumsum(1)
    middle = (share < share[:, -1:] / 2).sum(1, keepdim=True)
    return ranked.gather(1, middle.clamp(max=values.shape[1] - 1))
