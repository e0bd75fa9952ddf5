"""The noise of a template: how much there is, and what it adds to sums over the template's gradients."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.criteria import centred
from torch_ecc.core.filters import blur, pad
from torch_ecc.core.pose import pose_dtype
from torch_ecc.core.sampling import gradients

INSTRUMENT_BLUR = 0.9  # px; 0.7 to 1 serve alike
DIM_BLURS = (2.0, 4.0)  # px, of templates in which texture is told from noise where it is coarse alone
NOISE_SHARE = 0.6  # of the information in any direction may be noise: else that, not texture, fixes the pose
NEARBY = 4.0  # px: Gaussian window in which the texture of a template is told from its noise
CERTAIN = 1.3  # times the noise's power in that window: by chance alone it is not more
# Of the x derivative of white noise of unit variance, by the blur: raw times blurred, and blurred squared.
NOISE_RESPONSE = {
    INSTRUMENT_BLUR: (0.176801398, 0.055585362),
    2.0: (0.009822021, 0.002479801),
    4.0: (0.000621317, 0.000155421),
}
LEAST_NOISE = 1e-3  # of the template's contrast: texture weaker than that fixes nothing, however clean the image
FULL_SCALES = (255.0, 1023.0, 4095.0, 16383.0, 65535.0)  # grey levels at which cameras clip


class Noise(NamedTuple):
    """Of B templates: ``level`` (B,), upper estimate of their noise, grey levels, ``power`` (B,), its square, how many
    ``frames`` (B,) each is the mean of, and what their instruments make of it, the ``response`` (B, 2), one of
    ``NOISE_RESPONSE``; ``alias``, of each sampler whose own error counts: (B, 3, 2), by how far
    aliasing along the template's x and y shifts the pose, rms over the phase. Where a template lies is uncertain by a
    ``place_share`` (B,) of what one frame's noise makes of a pose, and by a covariance ``place`` (B, 3, 3) in its axes,
    None if that is nothing."""

    level: Tensor
    power: Tensor
    frames: Tensor
    response: Tensor
    alias: dict[str, Tensor]
    place_share: Tensor
    place: Tensor | None = None

    @staticmethod
    def of(level: Tensor, instrument_blur: float = INSTRUMENT_BLUR) -> Noise:
        """Of templates cut from one frame."""
        power = level.to(pose_dtype(level.device)).square()
        one, response = torch.ones_like(power), power.new_tensor(NOISE_RESPONSE[instrument_blur])
        return Noise(level, power, one, response.repeat(len(power), 1), {}, one.clone())

    @property
    def of_frame(self) -> Tensor:
        """The power (B,) of the noise of one frame."""
        return self.power * self.frames

    @property
    def of_both(self) -> Tensor:
        """What noise leaves (B,) of a frame less the template, under a gain of 1."""
        return self.power * (1 + self.frames)


def template_noise(gray: Tensor, kept: Tensor, known: Tensor | None = None) -> Tensor:
    """Upper estimate (B,) of the noise of templates (B, 1, h, w), grey levels, where ``kept`` > 0, unless it is
    ``known`` (B,); never less than next to nothing of the contrast."""
    weight = kept.flatten(1)
    contrast = centred(gray.flatten(1), weight)[1] / weight.sum(-1).sqrt()
    return torch.maximum(noise_level(gray, kept) if known is None else known.to(contrast), LEAST_NOISE * contrast)


def blurred(image: Tensor, margin: int, noise: Tensor, instrument_blur: float) -> tuple[Tensor, Tensor, Tensor]:
    """An ``image`` (B, 1, h, w) blurred, its gradient (B, 2, h, w), and how much of that is texture, not ``noise``:
    (B, 1, h, w). What it was continued by, the ``margin`` px, has the same noise twice and more.

    A wide blur leaves so little noise that no place need be left out for it, but would bring in that of the margin.
    """
    if instrument_blur == INSTRUMENT_BLUR:
        soft = blur(image, instrument_blur)
        slopes = gradients(soft)
        return soft, slopes, wiener_weight(slopes, noise)
    soft = pad(blur(image[:, :, margin:-margin, margin:-margin], instrument_blur), margin)
    return soft, gradients(soft), torch.ones_like(soft)


def wiener_weight(gradient: Tensor, noise: Tensor) -> Tensor:
    """How much of the ``gradient`` (B, 2, h, w), blurred by INSTRUMENT_BLUR, is texture, not ``noise`` (B,), near each
    pixel: (B, 1, h, w).

    The factor S / (S + N / 2) that makes the scatter of two equally noisy images least, from the gradient's power
    nearby. Where a template is flat its gradient is all noise, which as an instrument would only add scatter. The noise
    may vary from pixel to pixel, (B, 1, h, w).
    """
    noise = noise.view(-1, 1, 1, 1) if noise.dim() == 1 else noise
    floor = 2 * NOISE_RESPONSE[INSTRUMENT_BLUR][1] * noise.to(gradient.dtype).square()
    power = (blur(gradient.square().sum(1, keepdim=True), NEARBY) - CERTAIN * floor).clamp(min=0)
    return power / (power + floor / 2).clamp(min=1e-30)


def errors_in_variables(sums: Tensor) -> Tensor:
    """Sum over pixels of q (dW/dp)^T dW/dp from their sums (B, 4) of q {1, x, y, x^2 + y^2}: (B, 3, 3).

    What gradients that are white noise would leave in Z W G^T.
    """
    n, x, y, square = sums.unbind(-1)
    zero = torch.zeros_like(n)
    return torch.stack((n, zero, y, zero, n, -x, y, -x, square), -1).reshape(-1, 3, 3)


def largest_eigenvalue(matrix: Tensor) -> Tensor:
    """Largest eigenvalue (B,) of a product of symmetric matrices (B, n, n), positive ones; 0 if there is none.

    By a high power of the matrix, to 7 % from above, which an eigenvalue solver would not do without synchronising.
    """
    scale = matrix.abs().amax((-2, -1), keepdim=True).clamp(min=1e-30)
    power = torch.linalg.matrix_power(matrix / scale, 16).diagonal(dim1=-2, dim2=-1).sum(-1)
    largest: Tensor = power.clamp(min=0).pow(1 / 16) * scale[:, 0, 0]
    return largest


def clipped(image: Tensor) -> Tensor:
    """Which pixels (B, 1, H, W) are as dark as can be, or as bright, and all their neighbours too."""
    levels = image.new_tensor(FULL_SCALES)
    top = image.amax((2, 3), keepdim=True)
    bright = (image == top) & (top[..., None] == levels).any(-1)
    extreme = F.pad((image <= 0) | bright, (1, 1, 1, 1), value=True)
    for dim in (-1, -2):
        before, here, after = (extreme.narrow(dim, k, extreme.shape[dim] - 2) for k in range(3))
        extreme = before & here & after
    return extreme


def noise_level(image: Tensor, kept: Tensor) -> Tensor:
    """Upper estimate of the white noise of (B, 1, H, W) where ``kept`` > 0, grey levels, (B,).

    Median response to the difference of two Laplacians (Immerkaer, 1996), which cancels flat areas, ramps and edges
    along rows or columns; what fine texture leaves in it counts as noise. Where the image is clipped there is none.
    """
    kept = kept * ~clipped(image)
    response = torch.where(kept[:, :, 1:-1, 1:-1] > 0, noise_samples(image), float("nan"))
    return response.flatten(1).nanmedian(-1).values.nan_to_num()


def noise_samples(image: Tensor) -> Tensor:
    """What the inner pixels of (B, 1, H, W) say of its noise, whose standard deviation is the median of them: all but
    the border, (B, 1, H - 2, W - 2)."""
    return image.diff(n=2, dim=-1).diff(n=2, dim=-2).abs() / (6 * 0.6745)
