"""A template as a surface that changes: what a frame shows of it that is new, and how far one mean of frames lies from
another although its texture is no longer the same.

Both are fits over all pixels of the template image, with what surrounds it. Texture that has come and gone leaves a
residual as coarse as texture is, which drags plain least squares along. How far two means of frames are apart is told
by generalised least squares, in which every frequency counts by how little of the residual it holds.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.criteria import Criterion, safe_inverse
from torch_ecc.core.normal import LEAST
from torch_ecc.core.pose import pose_dtype
from torch_ecc.core.reference import BLOCK
from torch_ecc.core.sampling import gradients

AROUND = 1e-3  # weight of what surrounds a template: it is fitted and told apart, but fixes nothing
QUICK = 16  # px: sides that are whole multiples of it are transformed quickly
SMOOTH = 7  # frequencies in x and in y over which a spectrum is averaged
DARKEST = 1e-4  # of a spectrum's largest value: no frequency counts as if there were less
CLUSTER = 12  # px: side of blocks in which residuals may cling together
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


class Comparison(NamedTuple):
    """How far images lie from a surface: the ``step`` (B, 3) of its pose, px, px, rad; the ``covariance`` (B, 3, 3) of
    what all that is new in them would feign if the surface were whole, both in its axes; and the ``correlation`` (B,)
    that is left when light and pose are fitted."""

    step: Tensor
    covariance: Tensor
    correlation: Tensor


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


def compare(criterion: Criterion, surface: Surface, g: Tensor, counted: Tensor, noise: Tensor) -> Comparison:
    """Images ``g`` (B, N) with a surface, over the pixels ``counted`` (B, N); of what is left, white noise has the
    variance ``noise`` (B,)."""
    plain = surface.counting(surface.weight * counted)
    residual, _ = criterion.fit(plain, g)
    power, texture = spectrum(plain, residual), spectrum(plain, plain.signal[:, 3])
    # Where the texture is nothing but noise it would only add scatter.
    whitening = ((1 - texture.amin((1, 2), keepdim=True) / texture) / power).sqrt()
    whitening = whitening / whitening.amax((1, 2), keepdim=True)
    white = filtered(transform(plain, plain.columns * plain.weight[:, None]), whitening)
    inverse = safe_inverse((white @ white.mT).to(pose_dtype(g.device)))[0].to(g.dtype)
    twice = filtered(torch.fft.fft2(white.view(*white.shape[:2], *power.shape[1:])), whitening, plain.size)
    weighed = plain._replace(K=inverse @ twice * plain.weight[:, None])
    left = criterion.fit(weighed, g).residual * plain.weight
    influence = inverse[:, :3] @ white * filtered(transform(plain, left[:, None]), whitening)
    covariance = scatter(weighed, power, influence)
    changed = (variance(residual, plain.weight)[:, 0] - noise.to(residual)).clamp(min=0)
    alike = (1 - changed / variance(g, plain.weight)[:, 0].clamp(min=LEAST)).clamp(min=0).sqrt()
    return Comparison(criterion.step(weighed, g).to(covariance), covariance, alike)


def transform(surface: Surface, values: Tensor) -> Tensor:
    """Fourier transform of ``values`` (B, k, N), continued by zeros to a size that is quick: (B, k, h', w')."""
    h, w = (-(-n // QUICK) * QUICK for n in surface.size)
    transformed: Tensor = torch.fft.fft2(surface.images(values), s=(h, w))
    return transformed


def filtered(transformed: Tensor, response: Tensor, size: tuple[int, int] | None = None) -> Tensor:
    """What was ``transformed`` (B, k, h', w'), times a ``response`` (B, h', w') over the frequency: (B, k, h' w'), or
    (B, k, h w) of images of ``size`` (h, w)."""
    h, w = size or response.shape[1:]
    values: Tensor = torch.fft.ifft2(transformed * response[:, None]).real
    return values[..., :h, :w].flatten(2)


def spectrum(surface: Surface, values: Tensor) -> Tensor:
    """Power (B, h', w') of ``values`` (B, N), per pixel, smoothed over SMOOTH frequencies in x and y; nowhere less than
    a small part of its largest."""
    hann = (torch.hann_window(n, periodic=False, dtype=values.dtype, device=values.device) for n in surface.size)
    window = surface.weight * torch.outer(*hann).flatten()
    mean = (values * window).sum(1, keepdim=True) / window.sum(1, keepdim=True).clamp(min=LEAST)
    power = transform(surface, ((values - mean) * window)[:, None]).abs().square()
    power = F.avg_pool2d(F.pad(power, (SMOOTH // 2,) * 4, mode="circular"), SMOOTH, 1)[:, 0]
    power = power / window.square().sum(1)[:, None, None].clamp(min=LEAST)
    return power.maximum(DARKEST * power.amax((1, 2), keepdim=True)).clamp(min=LEAST)


def scatter(weighed: Surface, power: Tensor, influence: Tensor) -> Tensor:
    """Covariance (B, 3, 3) of an increment: by a residual with a spectrum ``power`` (B, h', w'), or, of a component in
    which that makes more, by the ``influence`` (B, 3, h' w') of one that clings together in blocks, rows or columns."""
    rows = transform(weighed, weighed.K[:, :3])
    covariance = ((rows * power[:, None]).flatten(2) @ rows.flatten(2).mH).real / power[0].numel()
    there = influence.view_as(rows)
    across, down = (there.sum(dim).square().sum(-1) for dim in (2, 3))
    blocks = (F.avg_pool2d(there, CLUSTER, ceil_mode=True, divisor_override=1)).square().sum((2, 3))
    most = torch.maximum(blocks, torch.maximum(across, down))
    factor = (most / covariance.diagonal(dim1=1, dim2=2).clamp(min=LEAST)).clamp(min=1).sqrt()
    return (covariance * factor[:, :, None] * factor[:, None, :]).to(pose_dtype(power.device))
