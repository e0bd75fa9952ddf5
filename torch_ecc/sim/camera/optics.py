"""Blur of the optics: Gaussian, and the disc of a lens out of focus. Images are (B, 1, h, w)."""

from __future__ import annotations

from math import ceil

import kornia.filters as KF
import torch
from torch import Tensor

REACH = 4.0  # sigmas kept of a Gaussian
SUPERSAMPLING = 8  # sub-pixels per side used to draw the rim of the disc


def margin(blur_sigma: float, defocus_radius: float) -> int:
    """Pixels that ``focus`` needs, and takes away, on each side."""
    return _gaussian_reach(blur_sigma) + _disc_reach(defocus_radius)


def focus(frames: Tensor, blur_sigma: float, defocus_radius: float) -> Tensor:
    """Blurred frames without their margin: (B, 1, h + 2m, w + 2m) -> (B, 1, h, w); untouched pixels have no border."""
    m = margin(blur_sigma, defocus_radius)
    if blur_sigma > 0:
        side = 2 * _gaussian_reach(blur_sigma) + 1
        frames = KF.gaussian_blur2d(frames, (side, side), (blur_sigma, blur_sigma))
    if defocus_radius > 0:
        frames = KF.filter2d(frames, disc(defocus_radius).to(frames)[None])
    return frames[..., m : frames.shape[-2] - m, m : frames.shape[-1] - m]


def disc(radius: float) -> Tensor:
    """The image of a point out of focus, sum 1: a disc of ``radius`` px with a smooth rim, (2n + 1, 2n + 1)."""
    n = _disc_reach(radius)
    fine = (torch.arange((2 * n + 1) * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - n - 0.5
    inside = (fine[:, None] ** 2 + fine**2 <= radius**2).float()
    kernel = torch.nn.functional.avg_pool2d(inside[None], SUPERSAMPLING)[0]
    return kernel / kernel.sum()


def _gaussian_reach(sigma: float) -> int:
    return ceil(REACH * sigma)


def _disc_reach(radius: float) -> int:
    return ceil(radius)
