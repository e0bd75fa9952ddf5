"""Sampling, linearised: how values between pixels change with their place and with the image, by look-ups alone.

A pair of neighbouring taps with weights whose sum is X and whose second is s has the value X L(m), with L a bilinear
look-up and m = s / X the pair's centre of mass (``Sampler``). Its slope is X' L + (s' - m X') L'.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import cycle, product
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import Sampler, lookup, make_sampler, prefilter_matrix
from torch_ecc.core.settings import Settings


class Look(NamedTuple):
    """Patches as they were seen: ``values`` (B, 4, N), what was sampled and what the slopes of the image make of that
    when x, y and theta of the pose grow; ``by_image``: what leads from gradients by the first of them, (B, N), to that
    by the image (I, 1, H, W)."""

    values: Tensor
    by_image: Callable[[Tensor], Tensor]


def look(reference: Reference, image: Tensor, pose: Tensor, settings: Settings) -> Look:
    """At B templates in (B or 1, 1, H, W) at poses (B, 3)."""
    warp, pixels = reference.warps(pose), reference.grid.pixels
    sample = make_sampler(settings.interpolation, image.to(reference.K.dtype), warp, reference.grid.box)
    seen = linearised(sample, warp, pixels)
    return Look(along_pose(seen, warp, pose, pixels), partial(seen.by_image, size=image.shape))


def along_pose(seen: Linearised, warp: Tensor, pose: Tensor, pixels: Tensor) -> Tensor:
    """``Look.values`` in the ``warp`` (B, 2, 3) of a ``pose`` (B, 3)."""
    offset = torch.cat((warp[:, :, :2], warp[:, :, 2:] - pose[:, :2, None]), 2).to(seen.g.dtype) @ pixels
    (gx, gy), (x, y) = seen.slopes.unbind(1), offset.unbind(1)
    return torch.stack((seen.g, gx, gy, gx * y - gy * x), 1)  # eq. (2): d(x, y) / dtheta = (y, -x)


class Linearised(NamedTuple):
    """Patches ``g`` (B, N) that a ``sampler`` has taken, their ``slopes`` (B, 2, N), d/dx and d/dy per px of the frame,
    and the ``lookups`` that they are sums of: where (B, 2, N), and with what weight (B, N)."""

    sampler: Sampler
    g: Tensor
    slopes: Tensor
    lookups: list[tuple[Tensor, Tensor]]

    def by_image(self, by_g: Tensor, size: torch.Size) -> Tensor:
        """The gradient by the image, of ``size`` (I, 1, H, W), that ``make_sampler`` has made the sampler of, from that
        by the patches (B, N): the transposes of sampling, prefilter and crop."""
        by, kernel = self.by_values(by_g), self.sampler.kernel
        if kernel.ring:
            given = kernel.taps, kernel.ring, by.dtype, by.device
            rows, columns = (prefilter_matrix(n - 2 * kernel.ring, *given) for n in by.shape[-2:])
            by = rows.mT @ by @ columns
        if by.shape == size:
            return by
        total, (h, w) = by.new_zeros(size), by.shape[-2:]
        corners = (self.sampler.origin + kernel.ring).long().tolist()
        for frame, (x, y), part in zip(cycle(total), corners, by, strict=False):
            frame[:, y : y + h, x : x + w] += part
        return total

    def by_values(self, by_g: Tensor) -> Tensor:
        """The gradient by the sampler's values (I, 1, h, w)."""
        values = self.sampler.values
        total = by_g.new_zeros(values.shape)
        for at, weight in self.lookups:
            grid, by = at.mT.unsqueeze(1), (by_g * weight)[:, None, None]
            if len(values) == 1:  # of all templates together: not an image for each
                grid, by = grid.transpose(0, 1), by.transpose(0, 2)
            total += _backward(by, values, grid, image=True)
        return total


def linearised(sampler: Sampler, warp: Tensor, pixels: Tensor) -> Linearised:
    """Of ``sampler(warp, pixels)``: at ``warp`` (B, 2, 3) of ``pixels`` (3, N). Where values have a kink, as bilinear
    ones have on the pixels, slopes are those to the right and down."""
    points, kernel, values = sampler.points(warp, pixels), sampler.kernel, sampler.values
    scale = sampler.scale().to(points.dtype)
    if kernel.ring == 0:
        g = lookup(values, points)
        return Linearised(sampler, g, slopes_of(values, points) * scale, [(points, torch.ones_like(g))])
    floor = points.floor()
    pairs, steps = kernel.pairs(points - floor), kernel.slopes(points - floor)
    both = zip(pairs, steps, strict=True)
    shifts = [torch.addcmul(s, second / total, t, value=-1) for (_, total, second), (t, s) in both]
    g, slopes, lookups = torch.zeros_like(points[:, 0]), torch.zeros_like(points), []
    dx, dy = slopes.unbind(1)
    for (j, row), i in product(enumerate(sampler.middles(floor, pairs)), range(len(pairs))):
        value, (along, down) = lookup(values, row[i]), (slopes_of(values, row[i]) * scale).unbind(1)
        x, y = pairs[i][1][:, 0], pairs[j][1][:, 1]
        dx.addcmul_(y, torch.addcmul(steps[i][0][:, 0] * value, shifts[i][:, 0], along))
        dy.addcmul_(x, torch.addcmul(steps[j][0][:, 1] * value, shifts[j][:, 1], down))
        g.addcmul_(x * y, value)
        lookups.append((row[i], x * y))
    return Linearised(sampler, g, slopes, lookups)


def slopes_of(image: Tensor, points: Tensor) -> Tensor:
    """Of ``sampling.lookup`` by the normalised points: (B, 2, N)."""
    b, _, n = points.shape
    image = image if len(image) == b else image.expand(b, -1, -1, -1)
    one = image.new_ones(()).expand(b, 1, 1, n)
    return _backward(one, image, points.mT.unsqueeze(1), image=False).squeeze(1).mT


def _backward(by: Tensor, values: Tensor, grid: Tensor, *, image: bool) -> Tensor:
    """The gradient of a bilinear look-up, with a border that repeats, by the image or else by the grid."""
    found = torch.ops.aten.grid_sampler_2d_backward(by, values, grid, 0, 1, True, [image, not image])
    gradient: Tensor = found[0 if image else 1]
    return gradient
