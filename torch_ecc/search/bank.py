"""A template turned through the whole circle, as spectra: its correlation with every place of a frame at once.

Zero-mean normalised correlation under the template's weights, the plane 1, x, y taken out of template and frame alike,
so that light which varies across the template does not count.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.noise import INSTRUMENT_BLUR
from torch_ecc.core.pose import compose, rotation
from torch_ecc.core.pyramid import as_images
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import Sampler, inside

SMALLEST_SEARCHED = 24  # px: root of the area that a template keeps at the level at which it is searched for
LEAST_DENSITY = 0.25  # of a level's pixels: texture per bandwidth, over that of white texture of the same contrast
TURN_LOSS = 0.1  # of the correlation, half way between two turns
COARSEST_TURN, FINEST_TURN = math.radians(6), math.radians(1.5)
LARGEST_DISC = 24  # px: turns get finer with the radius, and this many pixels tell enough
DISC_SHARE = 0.5  # of the texture must lie in a disc for the disc alone to be searched for
FLATTEST = 1e-4  # of the frame's variance: flatter places match nothing
CHUNK = 4  # turns transformed at once: more would not stay in the cache


class Bank(NamedTuple):
    """One template at A ``turns`` (A,) rad, for images of ``size`` (h, w) at its level.

    Spectra of ``shape`` (H, W), conjugated: ``texture`` (A, H, W // 2 + 1) of unit norm off the planes, ``planes``
    (1 or A, 3, H, W // 2 + 1) orthonormal, ``weight`` (1 or A, H, W // 2 + 1). All reach ``reach`` px from their
    middle, which is the template's point ``offset`` (2,).
    """

    size: tuple[int, int]
    shape: tuple[int, int]
    reach: int
    offset: Tensor
    turns: Tensor
    texture: Tensor
    planes: Tensor
    weight: Tensor

    @staticmethod
    def of(reference: Reference, size: tuple[int, int]) -> Bank:
        """Of one template (B = 1) at the level of images of ``size`` (h, w)."""
        template, weight, corner = as_images(reference)
        offset, radius, disc = _disc(reference)
        turns = _turns(reference, offset, radius)
        reach = math.ceil(radius)
        texture, weights = _turned(template, weight, offset - corner, turns, reach)
        if disc:
            weights = _disc_image(reach, radius, weights)[None]
            texture = texture * weights
        texture, planes = _orthonormal(texture, weights)
        shape = (fast_length(size[0] + 2 * reach), fast_length(size[1] + 2 * reach))
        spectra = (torch.fft.rfft2(kernel, s=shape).conj_physical() for kernel in (texture, planes, weights))
        local = offset.to(reference.place.radius.dtype) - reference.place.centre[0].to(reference.place.radius.dtype)
        return Bank(size, shape, reach, local, turns, *spectra)

    def candidates(self, image: Tensor, most: int) -> tuple[Tensor, Tensor]:
        """Where ``image`` (h, w) looks most like the template: at most ``most`` poses (K, 3) per CHUNK of turns and
        their correlations (K,). They are local maxima over the places, each at the best turn of the chunk."""
        image = image - image.mean()
        floor = FLATTEST * image.square().mean() * self.weight[0, 0, 0].real
        padded = F.pad(image[None, None], (self.reach,) * 4, mode="replicate")[0, 0]
        spectrum, square = (torch.fft.rfft2(i, s=self.shape) for i in (padded, padded * padded))
        places, turns = [], []
        norm: Tensor | None = None
        for k in range(0, len(self.turns), CHUNK):
            part = slice(k, k + CHUNK)
            if norm is None or len(self.weight) > 1:
                power = self._correlate(square, self.weight[part])
                power -= self._correlate(spectrum, self.planes[part]).square().sum(1)
                norm = power.clamp(min=floor.clamp(min=1e-12)).rsqrt()
            match = self._correlate(spectrum, self.texture[part])
            if len(self.weight) == 1:  # one norm for all turns: the best of them is best with and without it
                score = match.amax(0) * norm[0]
            else:
                match *= norm
                score = match.amax(0)
            places.append(_peaks(score, most))
            turns.append(self.turns[part][match.flatten(1)[:, places[-1].pixel].argmax(0)])
        peaks = Peaks(*(torch.cat(values) for values in zip(*places, strict=True)))
        pose = torch.cat((peaks.place, torch.cat(turns)[:, None]), -1).to(self.offset.dtype)
        back = torch.cat((-self.offset, self.offset.new_zeros(1)))
        return compose(pose, back.expand_as(pose)), peaks.score

    def _correlate(self, spectrum: Tensor, kernels: Tensor) -> Tensor:
        h, w = self.size
        rows = torch.fft.ifft(spectrum * kernels, dim=-2)[..., :h, :]  # the others are not transformed any further
        whole: Tensor = torch.fft.irfft(rows, n=self.shape[1], dim=-1)
        return whole[..., :w]


def details(reference: Reference, image: Tensor, turns: Tensor, most: int) -> Tensor:
    """Where ``image`` (h, w) shows what sets one template (B = 1) apart: ``most`` poses (K, 3) at ``turns`` (A,) rad.

    The matched filter in clutter with the spectrum of the frame itself (prewhitening: Turin, 1960), which is taken no
    finer than a window of the template's size resolves it (Blackman and Tukey, 1958): texture that the frame repeats
    tells no place and is divided away, so that what is rare decides.
    """
    template, weight, corner = as_images(reference)
    reach = math.ceil(math.hypot(*template.shape[-2:]) / 2)
    (h, w), size = image.shape, [fast_length(max(n, 2 * reach + 1)) for n in image.shape]
    spectrum = torch.fft.rfft2(image - image.mean(), s=size)
    lags = (torch.fft.fftfreq(n, 1 / n, dtype=image.dtype, device=image.device).abs() for n in size)
    rows, columns = (F.relu(1 - lag / max(template.shape[-2:])) for lag in lags)
    window = rows[:, None] * columns  # Bartlett's: its spectrum is nowhere negative
    clutter = torch.fft.rfft2(torch.fft.irfft2(spectrum.abs().square(), s=size) * window).real
    spectrum = spectrum / clutter.clamp(min=max(FLATTEST * float(clutter.mean()), 1e-12))
    found = []
    for turn in turns.to(template.dtype).split(1):
        kernel = torch.fft.rfft2(_turned(template, weight, -corner, turn, reach)[0][0], s=size)
        match = torch.fft.irfft2(spectrum * kernel.conj(), s=size).roll((reach, reach), (0, 1))[:h, :w]
        found.append(_peaks(match / match.std().clamp(min=1e-30), most))
    best = torch.cat([peaks.score for peaks in found]).topk(most).indices
    place = torch.cat([peaks.place for peaks in found]).to(turns)[best]
    pose = torch.cat((place, turns.repeat_interleave(most)[best, None]), -1)
    centre = F.pad(reference.place.centre, (0, 1)).to(pose)  # places are those of the array's middle
    return compose(pose, centre.expand_as(pose))


class Peaks(NamedTuple):
    """Maxima of an image: number of the ``pixel`` (K,), ``place`` (K, 2) between pixels, height ``score`` (K,)."""

    pixel: Tensor
    place: Tensor
    score: Tensor


def _peaks(score: Tensor, most: int) -> Peaks:
    """The ``most`` highest of the pixels of ``score`` (h, w) that are no less than their neighbours, by parabolas."""
    h, w = score.shape
    wide = F.pad(score, (1, 1, 1, 1), value=-1.0)
    across = torch.maximum(torch.maximum(wide[:, :-2], wide[:, 2:]), wide[:, 1:-1])
    around = torch.maximum(torch.maximum(across[:-2], across[2:]), across[1:-1])
    top, index = torch.where(score >= around, score, -1.0).flatten().topk(min(most, score.numel()))
    place, height = torch.stack((index % w, index // w), -1).to(score.dtype), top
    for axis, step, n in ((0, 1, w), (1, w, h)):
        framed = (place[:, axis] > 0) & (place[:, axis] < n - 1)
        before, after = (score.flatten()[(index + s).clamp(0, h * w - 1)] for s in (-step, step))
        slope, bend = (after - before) / 2, (2 * top - before - after).clamp(min=1e-6)
        offset = torch.where(framed, (slope / bend).clamp(-0.5, 0.5), 0.0)
        place[:, axis] += offset
        height = height + slope * offset / 2
    return Peaks(index, place, height)


def search_level(references: list[Reference]) -> int:
    """The coarsest level of a pyramid of one template at which its texture is still there.

    Blurred by s px, white texture keeps 1 / (4 pi s^2) of its power; texture that keeps much less of it lives in what
    the blur has taken.
    """
    level, full = 0, _power(references[0].signal[:, 3], references[0])
    for k, reference in enumerate(references[1:], 1):
        variance = (4**k - 1) / 3 + INSTRUMENT_BLUR**2 * 4**k  # of all blurs up to here, px^2
        density = 4 * math.pi * variance * _power(reference.columns.instrument[:, 3], reference) / full
        if float(reference.weight.count_nonzero()) >= SMALLEST_SEARCHED**2 and float(density) >= LEAST_DENSITY:
            level = k
    return level


def _power(t: Tensor, reference: Reference) -> Tensor:
    weight = reference.weight / reference.weight.sum(-1, keepdim=True)
    mean = (weight * t).sum(-1, keepdim=True)
    return (weight * (t - mean).square()).sum(-1)


def _disc(reference: Reference) -> tuple[Tensor, float, bool]:
    """Middle (2,) of the weights, px from the middle of the array, and the radius of what is searched for: that of a
    disc wholly inside the template, if enough of the texture lies in it (True), else of all."""
    weight = reference.weight[0]
    place = reference.grid.pixels[:2]
    middle = (weight * place).sum(-1) / weight.sum()
    radius = (place - middle[:, None]).norm(dim=0)
    _, full, corner = as_images(reference)
    h, w = full.shape[-2:]
    hole = full[0, 0] <= 0
    y, x = torch.meshgrid(*(torch.arange(n, dtype=full.dtype, device=full.device) for n in (h, w)), indexing="ij")
    cx, cy = (middle - corner).tolist()
    border = min(cx, cy, w - 1 - cx, h - 1 - cy)
    holes = ((x - cx) ** 2 + (y - cy) ** 2)[hole]
    largest = min(border, float(holes.min().sqrt()) - 1 if len(holes) else math.inf, LARGEST_DISC)
    t = reference.signal[0, 3]
    energy = weight * (t - (weight * t).sum() / weight.sum()).square()
    share = float((energy * (radius <= largest)).sum() / energy.sum())
    if largest >= 5 and share >= DISC_SHARE * min(1.0, (LARGEST_DISC / max(border, 1)) ** 2):
        return middle, largest, True
    return middle, float(radius[weight > 0].max()), False


def _turns(reference: Reference, offset: Tensor, radius: float) -> Tensor:
    """Turns (A,) of the whole circle, so close that the correlation falls by TURN_LOSS at most half way between."""
    x, y = reference.grid.pixels[:2] - offset[:, None]
    weight = reference.weight[0] * (x.square() + y.square() <= radius**2)
    gx, gy, _, t = reference.columns.instrument[0]
    spin = gx * y - gy * x
    loss = (weight * spin.square()).sum() / (weight * (t - (weight * t).sum() / weight.sum()).square()).sum() / 2
    step = 2 * math.sqrt(TURN_LOSS / max(float(loss), 1e-6))
    count = math.ceil(2 * math.pi / min(max(step, FINEST_TURN), COARSEST_TURN))
    turn = 2 * math.pi / count
    return torch.arange(count, device=t.device, dtype=t.dtype) * turn - math.pi + turn


def _turned(template: Tensor, weight: Tensor, middle: Tensor, turns: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Weighted template about its mean and weights, (A, n, n), turned about ``middle`` (2,) px of the array."""
    mean = (template * weight).sum() / weight.sum()
    weighted = (template - mean) * weight
    n = 2 * reach + 1
    span = torch.arange(n, device=turns.device, dtype=turns.dtype) - reach
    y, x = torch.meshgrid(span, span, indexing="ij")
    pixels = torch.stack((x.flatten(), y.flatten(), torch.ones_like(x.flatten())))
    warp = torch.cat((rotation(-turns), middle[:, None].expand(len(turns), 2, 1)), -1)
    size = (template.shape[-2], template.shape[-1])
    framed = inside(warp, pixels, size)
    spline = Sampler.of(weighted, "bspline3")
    shape = (len(turns), n, n)
    return (spline(warp, pixels) * framed).view(shape), (Sampler.of(weight)(warp, pixels) * framed).view(shape)


def _disc_image(reach: int, radius: float, like: Tensor) -> Tensor:
    span = torch.arange(2 * reach + 1, dtype=like.dtype, device=like.device) - reach
    return (span[:, None] ** 2 + span**2 <= radius**2).to(like)


def _orthonormal(texture: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Kernels: weighted ``texture`` (A, n, n) without its plane and of unit norm under ``weight`` (1 or A, n, n), and
    the weighted orthonormal planes (1 or A, 3, n, n)."""
    n = weight.shape[-1]
    span = torch.linspace(-1, 1, n, dtype=weight.dtype, device=weight.device)
    planes = torch.stack((weight.new_ones(n, n), span.expand(n, n), span[:, None].expand(n, n)))
    gram = torch.einsum("aij,kij,lij->akl", weight, planes, planes)
    lower = torch.linalg.cholesky(gram.double()).float()
    basis = torch.linalg.solve_triangular(lower, planes.flatten(1).expand(len(weight), 3, -1), upper=False)
    basis = basis.view(-1, 3, n, n)
    share = (texture[:, None] * basis).sum((2, 3), keepdim=True)
    planes = basis * weight[:, None]
    texture = texture - (share * planes).sum(1)
    norm = (texture.square() / weight.clamp(min=1e-3 * float(weight.max()))).sum((1, 2), keepdim=True).sqrt()
    return texture / norm.clamp(min=1e-30), planes


def fast_length(n: int) -> int:
    """The next even number of factors 2, 3 and 5: transforms of it are fast."""

    def smooth(m: int) -> bool:
        for p in (2, 3, 5):
            while m % p == 0:
                m //= p
        return m == 1

    n += n % 2
    while not smooth(n):
        n += 2
    return n
