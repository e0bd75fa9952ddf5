"""Whitened matched filter: where a frame shows what it does not repeat, for places that look alike otherwise.

The matched filter in clutter with the spectrum of the frame itself (prewhitening: Turin, 1960), which is taken no finer
than a window of the template's size resolves it (Blackman and Tukey, 1958): texture that the frame repeats tells no
place and is divided away, so that what is rare decides.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.pose import compose
from torch_ecc.core.pyramid import as_images
from torch_ecc.core.reference import Reference
from torch_ecc.search.correlation import FLATTEST, Template, about_mean, fast_length, peaks, rotated


def whitened_matches(reference: Reference, image: Tensor, *, angles: Tensor, most: int) -> Tensor:
    """The ``most`` best poses (K, 3) of one template (B = 1) in ``image`` (h, w), at ``angles`` (A,) rad."""
    template, weight, corner = as_images(reference)
    weighted, sides = weight * about_mean(template, weight), template.shape[-2:]
    radius = math.ceil(math.hypot(*sides) / 2)
    side = 2 * radius + 1
    (h, w), shape = image.shape, [fast_length(max(n, side)) for n in image.shape]
    spectrum = _whitened(torch.fft.rfft2(image - image.mean(), s=shape), shape, width=max(sides))
    found = []
    for angle in angles.to(weighted).split(1):
        kernel = rotated(weighted, angle, middle=-corner, size=(side, side), spline=True)[0, 0]
        match = torch.fft.irfft2(spectrum * torch.fft.rfft2(kernel, s=shape).conj(), s=shape)
        match = match.roll((radius, radius), (0, 1))[:h, :w]
        score = match / match.std().clamp(min=1e-30)
        found.append(peaks(F.pad(score[None], (1, 1, 1, 1), value=-math.inf), most))
    best = torch.cat([peak.score[0] for peak in found]).topk(most).indices
    place = torch.cat([peak.place[0] for peak in found])[best].to(angles)
    pose = torch.cat((place, angles.repeat_interleave(most)[best, None]), -1)
    centre = F.pad(Template.of(reference).centre, (0, 1)).to(pose)  # places are those of the array's middle
    return compose(pose, centre.expand_as(pose))


def _whitened(spectrum: Tensor, shape: list[int], *, width: int) -> Tensor:
    """``spectrum`` (H, W // 2 + 1) of an image of ``shape`` (H, W) over its power in a window of ``width`` px."""
    lags = (torch.fft.fftfreq(n, 1 / n, dtype=spectrum.real.dtype, device=spectrum.device).abs() for n in shape)
    rows, columns = (F.relu(1 - lag / width) for lag in lags)
    window = rows[:, None] * columns  # Bartlett's: its spectrum is nowhere negative
    clutter = torch.fft.rfft2(torch.fft.irfft2(spectrum.abs().square(), s=shape) * window).real
    return spectrum / torch.maximum(clutter, (FLATTEST * clutter.mean()).clamp(min=1e-12))
