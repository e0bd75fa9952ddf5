"""Zero-mean normalised correlation (ZNCC) of rotated templates with every place of an image at once, by FFT.

A template t is rotated by an angle and compared with the pixels g around a place under weights w. Light that varies
across the template does not count: with planes p orthonormal under w (<w p, p'> = 1 or 0),

    score = <k, g> / sqrt(<w, g^2> - sum_p <w p, g>^2),    k = w (t - sum_p <w p, t> p) / its norm under w,

so that every inner product is one correlation of the image, or its square, with a constant kernel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import Sampler, inside

CHUNK = 4  # angles transformed at once: more would not stay in the cache
FLATTEST = 1e-4  # of the image's variance: a place that has less of its own counts as having that much


class Template(NamedTuple):
    """What bank, filter and near search read of B prepared templates: here alone they know where a Reference keeps it.

    At the N pixels ``place`` (2, N): weights ``w`` (B, N), grey levels ``t`` (B, N), and ``smooth`` (B, 4, N), the
    smoothed derivatives by x, y and theta and the smoothed grey levels. Places and the poses' ``centre`` (B, 2) count
    from the array's middle; ``radius`` (B,) from the centre to the farthest pixel, in the poses' dtype.
    """

    place: Tensor
    w: Tensor
    t: Tensor
    smooth: Tensor
    centre: Tensor
    radius: Tensor

    @staticmethod
    def of(reference: Reference) -> Template:
        """Of prepared templates, without copies."""
        t = reference.signal[:, 3]
        place, columns = reference.place, reference.columns
        return Template(reference.grid.pixels[:2], columns.weight, t, columns.instrument, place.centre, place.radius)


class Correlator(NamedTuple):
    """B templates at A angles as kernels for one size of image, which has ``places`` (h, w) to put a kernel at.

    Conjugated spectra of images of ``shape`` (H, W): ``texture`` (B, A, H, W // 2 + 1) of unit norm off the planes,
    ``planes`` (B, 1 or A, P, H, W // 2 + 1) and ``weight`` (B, 1 or A, H, W // 2 + 1).
    """

    places: tuple[int, int]
    shape: tuple[int, int]
    texture: Tensor
    planes: Tensor
    weight: Tensor

    @staticmethod
    def of(texture: Tensor, weight: Tensor, *, planes: Tensor, size: tuple[int, int]) -> Correlator:
        """From kernels (B, A, n, m), (B, 1 or A, n, m) and (B, 1 or A, P, n, m), for images of ``size`` (h, w)."""
        n, m = texture.shape[-2:]
        shape = (fast_length(size[0]), fast_length(size[1]))
        spectra = (_spectra(kernel, shape) for kernel in (texture, planes, weight))
        return Correlator((size[0] - n + 1, size[1] - m + 1), shape, *spectra)

    @property
    def size(self) -> int:
        """How many complex numbers it holds."""
        return self.texture.numel() + self.planes.numel() + self.weight.numel()

    def scores(self, image: Tensor, chunk: int, variance: Tensor | None = None) -> Iterator[Tensor]:
        """ZNCC (B, chunk, h, w) of images (B, h, w) at all places, for ``chunk`` angles after the other; ``variance``
        (B,) of what they are parts of, by default their own."""
        image = image - image.mean((1, 2), keepdim=True)
        spectrum, square = (torch.fft.rfft2(i, s=self.shape)[:, None] for i in (image, image * image))
        least = FLATTEST * (image.square().mean((1, 2)) if variance is None else variance)[:, None, None, None]
        scale: Tensor | None = None
        for first in range(0, self.texture.shape[1], chunk):
            part = slice(first, first + chunk)
            if scale is None or self.weight.shape[1] > 1:
                scale = self._scale(spectrum, square, least=least, part=part)
            yield self._correlate(spectrum * self.texture[:, part]) * scale

    def _scale(self, spectrum: Tensor, square: Tensor, *, least: Tensor, part: slice) -> Tensor:
        """One over the norm off the planes of the pixels around each place, (B, a, h, w)."""
        weight = self.weight[:, part]
        power = self._correlate(square * weight)
        power -= self._correlate(spectrum[:, None] * self.planes[:, part]).square().sum(2)
        total = weight[..., :1, :1].real  # the sum of the weights
        return power.maximum((least * total).clamp(min=1e-12)).rsqrt()

    def _correlate(self, product: Tensor) -> Tensor:
        h, w = self.places
        rows = torch.fft.ifft(product, dim=-2)[..., :h, :]  # the others are not transformed any further
        whole: Tensor = torch.fft.irfft(rows, n=self.shape[1], dim=-1)
        return whole[..., :w]


def _spectra(kernels: Tensor, shape: tuple[int, int]) -> Tensor:
    """Conjugated spectra (B, A, ..., H, W // 2 + 1) of ``kernels`` (B, A, ..., n, m) in images of ``shape`` (H, W)."""
    h, w = shape
    spectra = kernels.new_empty(*kernels.shape[:-2], h, w // 2 + 1, dtype=kernels.dtype.to_complex())
    for part, kernel in zip(spectra.split(CHUNK, 1), kernels.split(CHUNK, 1), strict=True):
        rows = torch.fft.rfft(kernel, n=w)  # the others are zero
        torch.conj_physical(torch.fft.fft(rows, n=h, dim=-2), out=part)
    return spectra


def about_mean(image: Tensor, weight: Tensor) -> Tensor:
    """Images (B, 1, h, w) less their means under ``weight`` (B, 1, h, w), and zero where that is zero."""
    mean = (weight * image).sum((2, 3), keepdim=True) / weight.sum((2, 3), keepdim=True)
    return torch.where(weight > 0, image - mean, 0.0)


def span(n: int, like: Tensor) -> Tensor:
    """``n`` places (n,) one apart about 0, of the dtype and device of another tensor."""
    return torch.arange(n, dtype=like.dtype, device=like.device) - (n - 1) / 2


def rotated(image: Tensor, angles: Tensor, *, middle: Tensor, size: tuple[int, int], spline: bool = False) -> Tensor:
    """Images (B, 1, h, w) rotated by ``angles`` (A,) about their point ``middle`` (2,), which comes to the middle of
    ``size`` (n, m): (B, A, n, m), zero where the image ends; bilinear or, if asked for, by a cubic ``spline``."""
    y, x = torch.meshgrid(*(span(n, angles) for n in size), indexing="ij")
    pixels = torch.stack((x.flatten(), y.flatten(), torch.ones_like(x.flatten())))
    warp = torch.cat((rotation(-angles), middle[:, None].expand(len(angles), 2, 1)), -1)
    framed = inside(warp, pixels, (image.shape[-2], image.shape[-1]))
    of_each = torch.arange(len(image), device=image.device).repeat_interleave(len(angles))
    values = Sampler.of(image, "bspline3" if spline else "bilinear").select(of_each)(
        warp.repeat(len(image), 1, 1), pixels
    )
    values = values.view(len(image), len(angles), -1).mul_(framed)
    return values.view(len(image), len(angles), *size)


def detrended(texture: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Kernels of ``texture`` (..., n, m) under ``weight`` (..., n, m): off the planes 1, x, y, of unit norm, times the
    weight; and the orthonormal planes times the weight (..., 3, n, m)."""
    planes = _planes(weight)
    weighted = planes * weight.unsqueeze(-3)
    share = (texture.unsqueeze(-3) * weighted).sum((-2, -1), keepdim=True)
    texture = texture - (share * planes).sum(-3)
    norm = (weight * texture.square()).sum((-2, -1), keepdim=True).sqrt()
    return weight * texture / norm.clamp(min=1e-12), weighted


def _planes(weight: Tensor) -> Tensor:
    """The planes 1, x, y made orthonormal under ``weight`` (..., n, m) by Gram and Schmidt: (..., 3, n, m). Zero is
    one that the pixels that count do not tell from those before it."""
    y, x = (torch.linspace(-1, 1, n, dtype=weight.dtype, device=weight.device) for n in weight.shape[-2:])
    least = 1e-6 * weight.sum((-2, -1), keepdim=True)
    basis: list[Tensor] = []
    for plane in (torch.ones_like(weight), x.expand_as(weight), y[:, None].expand_as(weight)):
        shares = [(weight * plane * other).sum((-2, -1), keepdim=True) * other for other in basis]
        remainder = plane - sum(shares)
        square = (weight * remainder.square()).sum((-2, -1), keepdim=True)
        basis.append(remainder * torch.where(square > least, square.clamp(min=1e-30).rsqrt(), 0.0))
    return torch.stack(basis, -3)


class Peaks(NamedTuple):
    """K maxima each of B score maps of n axes: the number of their ``cell`` (B, K), their ``place`` (B, K, n) between
    the cells, last axis first (x, y, ...), and the ``score`` (B, K) there."""

    cell: Tensor
    place: Tensor
    score: Tensor


def peaks(framed: Tensor, most: int) -> Peaks:
    """The ``most`` highest of the cells that are no less than any neighbour (non-maximum suppression), by parabolas.

    ``framed`` (B, d_1 + 2, ..., d_n + 2): the outermost cells are only there to be compared with, -inf where there is
    nothing. If maxima are too few, the rest have scores near -1.
    """
    maxima = _local_maxima(framed)
    shape = maxima.shape[1:]
    top, cell = maxima.flatten(1).topk(min(most, shape.numel()))
    index = [cell // math.prod(shape[k + 1 :]) % n for k, n in enumerate(shape)]
    strides = [math.prod(framed.shape[k + 2 :]) for k in range(len(shape))]
    number = sum(((i + 1) * stride for i, stride in zip(index, strides, strict=True)), torch.zeros_like(cell))
    place, score, values = [], top, framed.flatten(1)
    for i, stride in zip(index, strides, strict=True):
        before, after = values.gather(1, number - stride), values.gather(1, number + stride)
        bend = (2 * top - before - after).clamp(min=1e-6)
        slope = torch.where(bend < math.inf, (after - before) / 2, 0.0)  # no parabola at the border
        offset = (slope / bend).clamp(-0.5, 0.5)
        place.append(i + offset)
        score = score + slope * offset / 2
    return Peaks(cell, torch.stack(place[::-1], -1), score)


def _local_maxima(framed: Tensor) -> Tensor:
    """The inner cells (B, d_1, ..., d_n) of ``framed``, -1 where a neighbour, also across a corner, is higher."""
    inner = around = framed
    for axis in range(1, framed.dim()):
        count = framed.shape[axis] - 2
        before, here, after = (around.narrow(axis, k, count) for k in range(3))
        inner, around = inner.narrow(axis, 1, count), torch.maximum(torch.maximum(before, after), here)
    return torch.where(inner >= around, inner, -1.0)


def fast_length(n: int) -> int:
    """The next even number of factors 2, 3 and 5, up to 2^20: transforms of it are fast."""
    n += n % 2
    while pow(30, 20, n):  # 30^20 is no multiple: there is another factor
        n += 2
    return n
