"""Retinex: a micrograph as the product of what the surface reflects and the light that falls on it.

Refs. 39, 40 of the paper; single-scale (Jobson, Rahman, Woodell, IEEE TIP 6(3), 1997) log R = log I - log(G * I), and
multi-scale (the same, 6(7), 1997) the weighted mean of those over several Gaussians G. Images are (B, 1, h, w), >= 0.
"""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import kornia.filters as KF
import torch
import torch.nn.functional as F
from torch import Tensor

SCALES = (15.0, 80.0, 250.0)  # px, of the multi-scale original
FINEST = 6.0  # a blur wider than this many px is made on a smaller image
DARK = 1e-6  # grey levels: keeps the logarithm of darkness finite


class Retinex(NamedTuple):
    """``reflected`` x ``incident`` is the image; the incident part has the image's units, the reflected part none."""

    reflected: Tensor  # (B, 1, h, w)
    incident: Tensor  # (B, 1, h, w), > 0

    def surface(self, white: float = 240.0) -> Tensor:
        """The reflected part in grey levels: scaled so that its 99.9th percentile is ``white``, clipped to 0..255."""
        flat = self.reflected.flatten(1).sort(1).values
        top = flat[:, int(0.999 * (flat.shape[1] - 1))][:, None, None, None]
        return (self.reflected * (white / top.clamp_min(DARK))).clamp(0, 255)


def single_scale(images: Tensor, sigma: float = 80.0) -> Retinex:
    """Light is the image blurred by a Gaussian of ``sigma`` px: (B, 1, h, w) -> Retinex of that shape."""
    return multi_scale(images, (sigma,))


def multi_scale(
    images: Tensor, sigmas: tuple[float, ...] = SCALES, weights: tuple[float, ...] | None = None
) -> Retinex:
    """Light is the geometric mean of the image blurred by Gaussians of ``sigmas`` px: (B, 1, h, w) -> Retinex.

    ``weights``, one for each scale, are equal unless given, and are made to sum to 1. ValueError for another shape,
    negative or infinite pixels, scales or weights that are not positive, or another number of weights.
    """
    _check(images, sigmas, weights)
    images = images if images.is_floating_point() else images.double()
    share = torch.tensor(weights or (1.0,) * len(sigmas), dtype=torch.float64)
    logs = [
        w * _blur(images, s).clamp_min(DARK).log() for s, w in zip(sigmas, (share / share.sum()).tolist(), strict=True)
    ]
    incident = torch.stack(logs).sum(0).exp()
    return Retinex(images / incident, incident)


def _blur(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of any width: wide ones on an image made smaller by ``factor``, and smoothly enlarged again."""
    factor = max(1, int(sigma / FINEST))
    size = images.shape[-2:]
    small = F.interpolate(images, [max(1, ceil(n / factor)) for n in size], mode="area") if factor > 1 else images
    narrow = sigma / factor
    side = 2 * ceil(4 * narrow) + 1
    small = KF.gaussian_blur2d(small, (side, side), (narrow, narrow), border_type="replicate")
    return F.interpolate(small, size, mode="bicubic") if factor > 1 else small


def _check(images: Tensor, sigmas: tuple[float, ...], weights: tuple[float, ...] | None) -> None:
    if images.dim() != 4 or images.shape[1] != 1:
        raise ValueError(f"retinex: images must be (B, 1, h, w), got {tuple(images.shape)}")
    values = images.float()
    if not bool(values.isfinite().all()) or bool((values < 0).any()):
        raise ValueError("retinex: images must be finite and not negative")
    if not sigmas or not min(sigmas) > 0:
        raise ValueError(f"retinex: sigmas must be > 0 px, got {sigmas}")
    if weights is not None and (len(weights) != len(sigmas) or not min(weights) > 0):
        raise ValueError(f"retinex: weights must be {len(sigmas)} numbers > 0, got {weights}")
