"""Incident light: fields that multiply a scene.

x and y below are pixel coordinates from the centre of the frame divided by ``scale_px``; left at None, that is half the
frame's width, so that x runs from -1 to 1. A field may change with the index of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import tau
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

Size = tuple[int, int]


class Light(Protocol):
    """A multiplicative field for each frame."""

    def field(self, indices: Tensor, size: Size) -> Tensor:
        """The light in frames ``indices`` (B,) of ``size`` = (h, w): float32 that broadcasts to (B, 1, h, w)."""
        ...


@dataclass(frozen=True)
class GradientLight:
    """1 + ``x`` x + ``y`` y, clipped at darkness."""

    x: float = 0.5
    y: float = 0.3
    scale_px: float | None = None

    def __post_init__(self) -> None:
        _check_scale("GradientLight", self.scale_px)

    def field(self, indices: Tensor, size: Size) -> Tensor:
        """(B,) -> (1, 1, h, w): the same in every frame."""
        x, y = _grid(size, self.scale_px, indices)
        return (1 + self.x * x + self.y * y).clamp_min(0).float().expand(1, 1, *size)


@dataclass(frozen=True)
class SpotLight:
    """``floor`` + ``height`` exp(-r^2 / ``spread``), r from a centre that goes round an ellipse.

    In frame i the centre is ``center`` + ``travel`` (cos, sin)(2 pi i / ``period``); ``travel`` (0, 0) stands still.
    """

    floor: float = 0.55
    height: float = 0.6
    spread: float = 0.12
    center: tuple[float, float] = (0.0, 0.0)
    travel: tuple[float, float] = (0.3, 0.2)
    period: float = 100.0
    scale_px: float | None = None

    def __post_init__(self) -> None:
        _check_scale("SpotLight", self.scale_px)
        for name in ("spread", "period"):
            if not getattr(self, name) > 0:
                raise ValueError(f"SpotLight: {name} must be > 0, got {getattr(self, name)}")
        if self.floor < 0 or self.floor + self.height < 0:
            raise ValueError(f"SpotLight: floor and floor + height must be >= 0, got {self.floor} and {self.height}")

    def field(self, indices: Tensor, size: Size) -> Tensor:
        """(B,) -> (B, 1, h, w). The exponential of a sum is a product of one over x and one over y."""
        x, y = _grid(size, self.scale_px, indices)
        phase = tau * indices.double()[:, None, None, None] / self.period
        across = (-((x - self.center[0] - self.travel[0] * phase.cos()) ** 2) / self.spread).exp()
        down = (-((y - self.center[1] - self.travel[1] * phase.sin()) ** 2) / self.spread).exp()
        return self.floor + self.height * (across.float() * down.float())


@dataclass(frozen=True)
class VignetteLight:
    """The cos^4 law of a lens, (1 + ``edge`` r^2)^-2: 1 at the centre, falling to every side."""

    edge: float = 0.2
    scale_px: float | None = None

    def __post_init__(self) -> None:
        _check_scale("VignetteLight", self.scale_px)
        if self.edge < 0:
            raise ValueError(f"VignetteLight: edge must be >= 0, got {self.edge}")

    def field(self, indices: Tensor, size: Size) -> Tensor:
        """(B,) -> (1, 1, h, w): the same in every frame."""
        x, y = _grid(size, self.scale_px, indices)
        return (1 + self.edge * (x * x + y * y)).pow(-2).float().expand(1, 1, *size)


@dataclass(frozen=True)
class LampDrift:
    """A lamp that breathes: 1 + ``amplitude`` sin(2 pi i / ``period``) over the whole frame i."""

    amplitude: float = 0.1
    period: float = 200.0

    def __post_init__(self) -> None:
        if not 0 <= self.amplitude <= 1:
            raise ValueError(f"LampDrift: amplitude must be in [0, 1], got {self.amplitude}")
        if not self.period > 0:
            raise ValueError(f"LampDrift: period must be > 0 frames, got {self.period}")

    def field(self, indices: Tensor, size: Size) -> Tensor:
        """(B,) -> (B, 1, 1, 1)."""
        level = 1 + self.amplitude * (tau * indices.double() / self.period).sin()
        return level.float()[:, None, None, None]


@dataclass(frozen=True, eq=False)
class FieldLight:
    """A field measured on an image (h, w), such as the incident component of ``retinex``, stretched over the frame.

    Only its shape counts: it is scaled to a mean of 1. ValueError if it is not (h, w), not finite or negative.
    """

    image: Tensor

    def __post_init__(self) -> None:
        if self.image.dim() != 2:
            raise ValueError(f"FieldLight: image must be (h, w), got {tuple(self.image.shape)}")
        image = self.image.double()
        if not bool(image.isfinite().all()) or bool((image < 0).any()) or not bool((image > 0).any()):
            raise ValueError("FieldLight: image must be finite, not negative and not dark everywhere")

    def field(self, indices: Tensor, size: Size) -> Tensor:
        """(B,) -> (1, 1, h, w): the same in every frame."""
        image = self.image.to(indices.device).float()[None, None]
        image = F.interpolate(image, size, mode="bilinear", align_corners=True)
        return image / image.mean()


@dataclass(frozen=True)
class Lights:
    """The product of several lights."""

    parts: tuple[Light, ...]

    def field(self, indices: Tensor, size: Size) -> Tensor:
        """(B,) -> what the product of the parts broadcasts to."""
        product = torch.ones((1, 1, 1, 1), device=indices.device)
        for part in self.parts:
            product = product * part.field(indices, size)
        return product


def _grid(size: Size, scale_px: float | None, indices: Tensor) -> tuple[Tensor, Tensor]:
    """x (1, w) and y (h, 1), float64, in units of the scale."""
    h, w = size
    scale = w / 2 if scale_px is None else scale_px
    x = (torch.arange(w, device=indices.device, dtype=torch.float64) - (w - 1) / 2) / scale
    y = (torch.arange(h, device=indices.device, dtype=torch.float64) - (h - 1) / 2) / scale
    return x[None], y[:, None]


def _check_scale(name: str, scale_px: float | None) -> None:
    if scale_px is not None and not scale_px > 0:
        raise ValueError(f"{name}: scale_px must be > 0, got {scale_px}")
