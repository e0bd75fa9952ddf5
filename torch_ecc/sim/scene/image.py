"""Scenes from a still image, super-resolved: a real micrograph that can be moved by any fraction of a pixel.

The still is resampled ``ZOOM`` times finer by its Fourier series, and the finer samples are interpolated by a cubic
B-spline whose prefilter is exact in the same series (Unser, IEEE Signal Processing Magazine 16(6), 1999). The spline's
error falls with the fourth power of the spacing; against a scene with content up to 0.25 cycles per px it is below
0.001 px in every pixel that is 10 px or more from the still's border.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import tau

import torch
from torch import Tensor

from torch_ecc.core.pose import inverse, transform

ZOOM = 3  # samples of the spline per still pixel
MARGIN = 2  # coefficients kept beyond the still on each side
ROWS = 512  # lines transformed at once


@dataclass(frozen=True, eq=False)
class ImageScene:
    """A still as a scene. Build it with ``of``; beyond its borders the still goes on mirrored.

    ``coefficients`` (H, W) float32 of the spline, ``origin`` (x, y) in still px where the scene has its origin,
    ``scale`` scene px per still px.
    """

    coefficients: Tensor
    origin: tuple[float, float]
    scale: float = 1.0

    @classmethod
    def of(cls, image: Tensor, *, scale: float = 1.0, origin: tuple[float, float] | None = None) -> ImageScene:
        """From a still (h, w) in grey levels of 0..255; the origin of the scene is the still's centre unless given.

        ValueError for another shape, a still under 8 px, values that are not finite, or a scale that is not positive.
        """
        if image.dim() != 2 or min(image.shape) < 8:
            raise ValueError(f"ImageScene.of: image must be (h, w) of at least 8 x 8 px, got {tuple(image.shape)}")
        if not bool(image.double().isfinite().all()):
            raise ValueError("ImageScene.of: image must be finite")
        if not scale > 0:
            raise ValueError(f"ImageScene.of: scale must be > 0, got {scale}")
        h, w = image.shape
        across = torch.cat([_spline(rows.double()) for rows in image.split(ROWS)])
        down = torch.cat([_spline(rows).float() for rows in across.mT.split(ROWS)])
        coefficients = down.mT.contiguous()
        return cls(coefficients, ((w - 1) / 2, (h - 1) / 2) if origin is None else origin, scale)

    def value(self, points: Tensor) -> Tensor:
        """Grey levels at scene points: (..., 2) float64 px -> (...) float64."""
        (x, _), (y, _) = self._samples(points)
        return self._sum(x, y, (_weights(x.frac()), _weights(y.frac())))

    def gradient(self, points: Tensor) -> Tensor:
        """Gradient of the spline at scene points, grey levels per px: (..., 2) -> (..., 2)."""
        (x, x_sign), (y, y_sign) = self._samples(points)
        wx, wy = _weights(x.frac()), _weights(y.frac())
        dx = self._sum(x, y, (_slopes(x.frac()), wy)) * x_sign
        dy = self._sum(x, y, (wx, _slopes(y.frac()))) * y_sign
        return torch.stack((dx, dy), -1) * (ZOOM / self.scale)

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """Frames of ``size`` = (h, w) at poses (B, 3): (B, 1, h, w) float32 on the poses' device."""
        y, x = torch.meshgrid(*(torch.arange(n, device=poses.device, dtype=torch.float64) for n in size), indexing="ij")
        pixels = torch.stack((x, y), -1).reshape(-1, 2)
        frames = [self._frame(transform(inverse(pose), pixels)) for pose in poses.double()]
        return torch.stack(frames).reshape(-1, 1, *size) if frames else pixels.new_empty((0, 1, *size)).float()

    def _frame(self, points: Tensor) -> Tensor:
        """``value`` with weights in float32 of phases in float64: (P, 2) -> (P,)."""
        (x, _), (y, _) = self._samples(points)
        return self._sum(x, y, (_weights(x.frac().float()), _weights(y.frac().float())))

    def _samples(self, points: Tensor) -> list[tuple[Tensor, Tensor]]:
        """x and y in samples of the spline, mirrored into the still, each with the sign that mirroring gives slopes."""
        axes = []
        for i in (0, 1):
            last = self.coefficients.shape[1 - i] - 1 - 2 * MARGIN
            s = (points[..., i] / self.scale + self.origin[i]) * ZOOM
            folded = s.remainder(2 * last)
            sign = torch.where(folded <= last, 1.0, -1.0).to(s)
            axes.append((last - (last - folded).abs() + MARGIN, sign))
        return axes

    def _sum(self, x: Tensor, y: Tensor, weights: tuple[list[Tensor], list[Tensor]]) -> Tensor:
        """The 4 x 4 coefficients around each point, weighted."""
        width = self.coefficients.shape[1]
        corner = ((y.floor().long() - 1) * width + x.floor().long() - 1).flatten()
        flat = self.coefficients.to(x.device).flatten()
        total = torch.zeros_like(weights[0][0])
        for j, wy in enumerate(weights[1]):
            row = torch.zeros_like(total)
            for i, wx in enumerate(weights[0]):
                row += flat[j * width + i :].index_select(0, corner).reshape(x.shape) * wx
            total += row * wy
        return total


def _weights(f: Tensor) -> list[Tensor]:
    """The cubic B-spline at the four samples around a phase ``f`` in [0, 1)."""
    g = 1 - f
    return [g**3 / 6, 2 / 3 - f**2 * (2 - f) / 2, 2 / 3 - g**2 * (2 - g) / 2, f**3 / 6]


def _slopes(f: Tensor) -> list[Tensor]:
    """Derivatives of ``_weights`` per sample."""
    g = 1 - f
    return [-(g**2) / 2, f * (1.5 * f - 2), g * (2 - 1.5 * g), f**2 / 2]


def _spline(rows: Tensor) -> Tensor:
    """Spline coefficients along the last axis, ``ZOOM`` per sample: (N, n) -> (N, (n - 1) ZOOM + 1 + 2 MARGIN)."""
    n = rows.shape[-1]
    first, last = rows[:, :1], rows[:, -1:]
    at = torch.linspace(0, 1, n, device=rows.device, dtype=rows.dtype)
    # Without the line through its ends a row goes on, turned about each end, with the same slope: a mirrored one would
    # have a kink there, whose aliases reach far into the still.
    rest = rows - torch.lerp(first, last, at)
    spectrum = torch.fft.rfft(torch.cat((rest, -rest[:, 1:-1].flip(-1)), -1))
    period = 2 * (n - 1) * ZOOM
    frequency = torch.arange(n, device=rows.device, dtype=rows.dtype) / period
    spectrum = spectrum / ((2 + torch.cos(tau * frequency)) / 3)
    samples: Tensor = torch.fft.irfft(spectrum * ZOOM, period)
    count = (n - 1) * ZOOM + 1 + 2 * MARGIN
    fine = (torch.arange(count, device=rows.device, dtype=rows.dtype) - MARGIN) / ((n - 1) * ZOOM)
    return samples.roll(MARGIN, -1)[:, :count] + torch.lerp(first, last, fine)
