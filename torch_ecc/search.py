"""Search for a lost template around its last pose, at one pyramid level: every shift, several turns."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.pose import compose
from torch_ecc.reference import Reference
from torch_ecc.sampling import Bilinear, inside
from torch_ecc.solver import warps

LEAST_SEEN = 0.25  # of a template's weight must lie in the frame
TURNS_DEG = (0.0, -8.0, 8.0, -16.0, 16.0, -24.0, 24.0)


def best_match(reference: Reference, image: Tensor, pose: Tensor) -> Tensor:
    """The pose (B, 3) near ``pose`` (B, 3) with the best correlation in ``image`` (1 or B, 1, H, W).

    Tries whole-pixel shifts up to the template's radius and turns up to 24 deg.
    """
    best, highest = pose, torch.full_like(pose[:, 0], -2.0)
    for turn in TURNS_DEG:
        candidate, score = best_shift(reference, image, pose + pose.new_tensor((0.0, 0.0, math.radians(turn))))
        better = score.to(highest.dtype) > highest
        best, highest = torch.where(better[:, None], candidate, best), torch.where(better, score, highest)
    return best


def best_shift(reference: Reference, image: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """The whole-pixel shift of ``pose`` (B, 3) along the template's axes with the best correlation, and that, (B,).

    Zero-mean normalised correlation under the template's weights, for all shifts at once, as correlations of images.
    What would leave the frame does not count.
    """
    (left, top), (right, bottom) = reference.box[:2, 0].tolist(), reference.box[:2, 2].tolist()
    reach, (h, w) = int(reference.radius.amax()), (int(bottom - top) + 1, int(right - left) + 1)
    y, x = (torch.arange(n + 2 * reach, device=image.device) + first - reach for n, first in ((h, top), (w, left)))
    yy, xx = torch.meshgrid(y, x, indexing="ij")
    pixels = torch.stack((xx.flatten(), yy.flatten(), torch.ones_like(xx.flatten())))
    warp, shape = warps(reference, pose), (1, len(pose), len(y), len(x))
    window = Bilinear(image)(warp, pixels)
    window = (window - window.mean(-1, keepdim=True)).view(shape)
    framed = inside(warp, pixels, (image.shape[-2], image.shape[-1])).view(shape).to(window.dtype)
    score, best = _scores(window, framed, *_as_images(reference, (h, w))).flatten(2)[0].max(-1)
    span = 2 * reach + 1
    shift = torch.stack((best % span - reach, best // span - reach, torch.zeros_like(best)), -1)
    return compose(pose, shift.to(pose.dtype)), score


def _as_images(reference: Reference, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Template less its weighted mean, and the weights summing to one, as images (B, 1, h, w)."""
    t = reference.signal[:, 3]
    weight = (reference.weight / reference.weight.sum(-1, keepdim=True)).expand_as(t)
    t = t - (weight * t).sum(-1, keepdim=True)
    column, row = (reference.pixels[:2] - reference.box[:2, :1]).round().long()
    images = t.new_zeros(2, len(t), 1, *size)
    images[:, :, 0, row, column] = torch.stack((t, weight))
    return images[0], images[1]


def _scores(window: Tensor, framed: Tensor, t: Tensor, weight: Tensor) -> Tensor:
    """Normalised correlation (1, B, shifts, shifts) of templates with their windows (1, B, H, W), of what lies in the
    frame; -1 where that is too little."""

    def correlate(image: Tensor, kernel: Tensor) -> Tensor:
        return F.conv2d(image, kernel, groups=len(kernel))

    window = window * framed
    seen, tw = correlate(framed, weight), weight * t
    share = seen.clamp(min=1e-6)
    g, h = correlate(window, weight), correlate(framed, tw)
    product = correlate(window, tw) - g * h / share
    power = correlate(window * window, weight) - g * g / share
    own = correlate(framed, tw * t) - h * h / share
    floor = 1e-6 * own.amax((2, 3), keepdim=True)
    score = product / (power.clamp(min=floor) * own.clamp(min=floor)).sqrt()
    return torch.where(seen >= LEAST_SEEN, score, -1.0)
