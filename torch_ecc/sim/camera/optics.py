"""The optics: what a lens distorts, Gaussian blur, and the disc of a lens out of focus. Images are (B, 1, h, w)."""

from __future__ import annotations

from math import ceil
from typing import Protocol

import kornia.filters as KF
import torch
from torch import Tensor

from torch_ecc.core.pose import inverse, transform
from torch_ecc.sim.scene.scene import Scene

CHUNK = 2**16  # pixels whose exact values are computed together
REACH = 4.0  # sigmas kept of a Gaussian
SUPERSAMPLING = 8  # sub-pixels per side used to draw the rim of the disc


class Distortion(Protocol):
    """A lens that shows things elsewhere, such as ``torch_ecc.Lens``."""

    def undistort(self, points: Tensor) -> Tensor:
        """Where points seen at (..., 2) px would be without it: (..., 2) px."""
        ...


def distorted(scene: Scene, lens: Distortion, poses: Tensor, size: tuple[int, int], margin: int) -> Tensor:
    """The scene as a lens shows it, at poses (B, 3) of what it would be without: (B, 1, h, w), with ``margin`` px more
    on each side than the frame that the lens speaks of. Exact: every pixel is the scene's own value where it looks."""
    h, w = size
    grid = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64, device=poses.device) for n in (h, w))).flip(1)
    frames = []
    for pose in poses.double():
        looks = (transform(inverse(pose), lens.undistort(part - margin) + margin) for part in grid.split(CHUNK))
        frames.append(torch.cat([scene.value(part).float() for part in looks]).view(1, h, w))
    return torch.stack(frames)


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
