"""A template as a surface that changes: what a frame shows of it that is new, in the template's own light.

A fit over all pixels of the template image, with what surrounds it. How far means of frames lie from each other,
although their texture is no longer the same, is told by ``track.ages``.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.criteria import Criterion, safe_inverse
from torch_ecc.core.grid import BLOCK
from torch_ecc.core.normal import LEAST
from torch_ecc.core.pose import pose_dtype
from torch_ecc.core.sampling import gradients

AROUND = 1e-3  # weight of what surrounds a template: it is fitted and told apart, but fixes nothing
SUDDEN = 0.2  # of the template's contrast, and
UNLIKELY = 4.0  # times the median square: what is left beyond both has covered the surface, not changed it


class Surface(NamedTuple):
    """B template images of ``size`` (h, w), N = h w pixels, as a criterion reads them (``criteria.Prepared``):
    least-squares ``K`` (B, p, N), ``signal`` = [G, t] (B, 4, N), ``weight`` (B, N), ``uv`` (B, 2, N); the ``columns``
    (B, p, N) that K is of."""

    K: Tensor
    signal: Tensor
    weight: Tensor
    uv: Tensor
    columns: Tensor
    size: tuple[int, int]

    @staticmethod
    def of(criterion: Criterion, template: Tensor, mask: Tensor, centre: Tensor) -> Surface:
        """Of images (B, 1, h, w) whose pixels count by their ``mask`` (B, 1, h, w) about a ``centre`` (B, 2)."""
        h, w = template.shape[2:]
        local = pixels(template)[:2] - centre.to(template)[:, :, None]
        gx, gy, t = torch.cat((gradients(template), template), 1).flatten(2).unbind(1)
        signal = torch.stack((gx, gy, gx * local[:, 1] - gy * local[:, 0], t), 1)
        uv = 2 * local / local.new_tensor((w - 1, h - 1))[:, None]
        columns = criterion.columns(signal, uv)
        surface = Surface(columns, signal, mask.flatten(1).clamp(min=AROUND), uv, columns, (h, w))
        return surface.counting(surface.weight)

    def counting(self, weight: Tensor) -> Self:
        """The same with other weights (B, N)."""
        RW = self.columns * weight[:, None]
        inverse, _ = safe_inverse((RW @ self.columns.mT).to(pose_dtype(RW.device)))
        return self._replace(K=inverse.to(RW.dtype) @ RW, weight=weight)

    def select(self, index: Tensor) -> Surface:
        """Those at ``index`` (n,)."""
        K, signal, weight, uv, columns = (value[index] for value in self[:-1])
        return Surface(K, signal, weight, uv, columns, self.size)

    def images(self, values: Tensor) -> Tensor:
        """(B, k, N) -> (B, k, h, w)."""
        return values.reshape(*values.shape[:2], *self.size)


def pixels(template: Tensor) -> Tensor:
    """Those of images (B, 1, h, w), homogeneous, from their middle: (3, h w)."""
    axes = (torch.arange(n, device=template.device, dtype=template.dtype) - (n - 1) / 2 for n in template.shape[2:])
    y, x = torch.meshgrid(*axes, indexing="ij")
    return torch.stack((x.flatten(), y.flatten(), torch.ones_like(x).flatten()))


def news(criterion: Criterion, surface: Surface, g: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """What patches ``g`` (B, N) show that is not in a surface yet, in the surface's own light, (B, N); and where that
    can be its own, (B, N) bool: ``seen`` (B, N), and not so much as what covers it would leave in a block."""
    own, sudden = seen, SUDDEN**2 * variance(surface.signal[:, 3], surface.weight)
    for _ in range(2):  # what covers it has bent the first fit
        fitted = surface if bool(own.all()) else surface.counting(surface.weight * own)
        residual, gain = criterion.fit(fitted, g)
        left = residual / gain[:, None]
        square = by_blocks(surface, left * left, seen)
        inner = own & (surface.weight > AROUND)
        usual = torch.where(inner, square, torch.nan).nanmedian(1, keepdim=True).values
        before, own = own, seen & (square <= UNLIKELY * usual + sudden)
        if torch.equal(before, own):
            break
    return torch.where(own, left, 0.0), own


def with_contrast(image: Tensor, old: Tensor, mask: Tensor) -> Tensor:
    """An ``image`` (B, 1, h, w) with as much contrast as the ``old`` one has where the ``mask`` counts."""
    new, was, weight = (value.flatten(1) for value in (image, old, mask))
    mean = ((new * weight).sum(1) / weight.sum(1).clamp(min=LEAST))[:, None, None, None]
    scale = (variance(was, weight) / variance(new, weight).clamp(min=LEAST)).sqrt()
    return mean + (image - mean) * scale[:, :, None, None]


def by_blocks(surface: Surface, values: Tensor, seen: Tensor) -> Tensor:
    """The mean (B, N) of ``values`` (B, N) over the pixels ``seen`` (B, N) of each one's block."""
    (h, w), kept = surface.size, seen.to(values)
    both = surface.images(torch.stack((values * kept, kept), 1))
    total, share = F.avg_pool2d(both, BLOCK, ceil_mode=True).unbind(1)
    mean = (total / share.clamp(min=LEAST)).repeat_interleave(BLOCK, 1).repeat_interleave(BLOCK, 2)
    return mean[:, :h, :w].flatten(1)


def variance(values: Tensor, weight: Tensor) -> Tensor:
    """Weighted, of (B, N): (B, 1)."""
    total = weight.sum(1, keepdim=True).clamp(min=LEAST)
    mean = (values * weight).sum(1, keepdim=True) / total
    return (weight * (values - mean).square()).sum(1, keepdim=True) / total
