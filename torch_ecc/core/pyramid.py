"""Coarser levels of prepared templates: level l has pixels of 2^l px, and pixel (i, j) lies at (2^l i, 2^l j)."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.filters import downsample
from torch_ecc.core.reference import Reference, prepare

SMALLEST_COARSE = 12  # px: a template is not halved below this side
LEAST_KEPT = 0.5  # of a coarse pixel must lie under the mask


def pyramid(reference: Reference, levels: int) -> list[Reference]:
    """``reference`` and up to ``levels`` - 1 coarser ones, while they keep size, pixels and texture enough."""
    references = [reference]
    while len(references) < levels:
        template, weight, corner = as_images(references[-1])
        kept, half = _halved(template, weight)
        enough = (kept > 0).sum((1, 2, 3)).min() >= SMALLEST_COARSE**2 // 2
        if min(half.shape[-2:]) < SMALLEST_COARSE or not bool(enough):
            break
        middle = half.new_tensor((half.shape[-1] - 1, half.shape[-2] - 1)) / 2
        centre = (references[-1].place.centre - corner) / 2 - middle
        try:
            references.append(prepare(half, criterion=reference.criterion, mask=kept, centre=centre))
        except ValueError:  # texture finer than this level: one single grey level is left
            break
    return references


def check_levels(levels: int, size: tuple[int, int]) -> None:
    """ValueError for ``levels`` that templates of ``size`` (h, w) cannot have."""
    most = max((min(size) // SMALLEST_COARSE).bit_length(), 1)
    if not isinstance(levels, int) or not 1 <= levels <= most:
        raise ValueError(f"levels: expected 1 to {most} for templates of {size[1]}x{size[0]} px, got {levels}")


def as_images(reference: Reference) -> tuple[Tensor, Tensor, Tensor]:
    """Template and weights as images (B, 1, h, w), zero where nothing counts, and the place (2,) of their pixel (0, 0)
    relative to the middle of the template array."""
    grid = reference.grid
    t, corner = reference.signal[:, 3], grid.box[:2, 0]
    w, h = (grid.box[:2, 2] - corner + 1).round().long().tolist()
    column, row = (grid.pixels[:2] - corner[:, None]).round().long()
    images = t.new_zeros(2, len(t), 1, h, w)
    weight = reference.weight
    images[:, :, 0, row, column] = torch.stack((torch.where(weight > 0, t, 0.0), weight))
    return images[0], images[1], corner


def _halved(template: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and grey levels of the next level; what the mask leaves out bears on neither."""
    seen = (weight > 0).to(weight.dtype)
    mean = (template * seen).sum((2, 3), keepdim=True) / seen.sum((2, 3), keepdim=True)
    share = downsample(seen)
    smooth = mean + downsample((template - mean) * seen) / share.clamp(min=1e-3)
    kept = downsample(weight) / share.clamp(min=1e-3) * (share >= LEAST_KEPT)
    return kept, smooth
