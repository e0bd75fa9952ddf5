"""Scenes made of plane waves: band-limited texture, known exactly at every real coordinate."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, tau
from typing import Literal

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation

LOWEST = 0.1  # lowest frequency of a random scene over its highest: keeps amplitudes ~ 1/f clear of the pole
CLEARANCE = 5.0  # standard deviations that must fit between the mean and both ends of the scale


@dataclass(frozen=True, eq=False)
class PlaneWaves:
    """``mean`` + sum of amplitude cos(wave . x' + phase), in grey levels of a 0..255 scale.

    ``waves`` (J, 2) in rad per px, ``amplitudes`` (J,) in grey levels, ``phases`` (J,) in rad; all float64.
    """

    waves: Tensor
    amplitudes: Tensor
    phases: Tensor
    mean: float = 128.0

    def __post_init__(self) -> None:
        count = len(self.waves)
        if self.waves.shape != (count, 2) or self.amplitudes.shape != (count,) or self.phases.shape != (count,):
            shapes = [tuple(t.shape) for t in (self.waves, self.amplitudes, self.phases)]
            raise ValueError(f"PlaneWaves: waves, amplitudes, phases must be (J, 2), (J,), (J,), got {shapes}")

    @classmethod
    def random(
        cls,
        count: int = 200,
        *,
        fmax: float = 0.25,
        rms_gradient: float = 7.0,
        mean: float = 128.0,
        spectrum: Literal["natural", "fine"] = "natural",
        seed: int = 0,
    ) -> PlaneWaves:
        """Isotropic texture of ``count`` waves with frequencies spread evenly from fmax / 10 to ``fmax`` cycles per px.

        ``rms_gradient``, grey levels per px, is the root mean square over the plane of one component of the gradient
        (mean of both components' squares). ``natural`` has amplitudes ~ 1/f: coarse and fine waves share the gradient
        equally; ``fine`` has equal amplitudes. The same seed gives the same scene on every machine. ValueError if the
        numbers are not positive, or if the texture would not fit into 0..255 around ``mean`` (5 standard deviations);
        a ``mean`` of 0 makes a layer for a ``Sum``, whose range is not checked.
        """
        _check_random(count, fmax, rms_gradient, spectrum)
        g = torch.Generator().manual_seed(seed)
        u, angle, phase = torch.rand(3, count, generator=g, dtype=torch.float64)
        f = fmax * (LOWEST + (1 - LOWEST) * u)
        # One direction per sector of pi / count: isotropic for any seed, not only on average.
        angle = pi * (torch.randperm(count, generator=g) + angle) / count
        waves = tau * f[:, None] * torch.stack((angle.cos(), angle.sin()), 1)
        amplitudes = 1 / f if spectrum == "natural" else torch.ones_like(f)
        amplitudes *= rms_gradient / (amplitudes[:, None] * waves).square().sum().div(4).sqrt()
        _check_range(mean, float(amplitudes.square().sum().div(2).sqrt()))
        return cls(waves, amplitudes, tau * phase, mean)

    def value(self, points: Tensor) -> Tensor:
        """Grey levels at scene points: (..., 2) float64 px -> (...) float64."""
        phases = points @ self.waves.to(points).mT + self.phases.to(points)
        return self.mean + phases.cos() @ self.amplitudes.to(points)

    def gradient(self, points: Tensor) -> Tensor:
        """Exact gradient at scene points, grey levels per px: (..., 2) -> (..., 2)."""
        phases = points @ self.waves.to(points).mT + self.phases.to(points)
        return -(self.amplitudes.to(points) * phases.sin()) @ self.waves.to(points)

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """The scene in a frame of ``size`` = (h, w) at poses (B, 3): (B, 1, h, w) float32 on the poses' device.

        cos(a x + (b y + c)) on the grid of pixels is the product of a table over x and a table over y, so that a frame
        is one matrix product (h x 2J)(2J x w); the phases are float64.
        """
        frames = [self._frame(pose, size) for pose in poses.double()]
        return torch.stack(frames).unsqueeze(1) if frames else poses.new_empty((0, 1, *size), dtype=torch.float32)

    def _frame(self, pose: Tensor, size: tuple[int, int]) -> Tensor:
        """(3,) -> (h, w). In the frame the wave vector is R k and the phase at the pose's position is ours."""
        turned = rotation(pose[2]) @ self.waves.to(pose).mT
        y, x = (torch.arange(n, device=pose.device) - t for n, t in zip(size, (pose[1], pose[0]), strict=True))
        across = x[:, None] * turned[0]
        down = y[:, None] * turned[1] + self.phases.to(pose)
        amplitudes = self.amplitudes.to(pose)
        left = torch.cat((amplitudes * down.cos(), -amplitudes * down.sin()), 1).float()
        right = torch.cat((across.cos(), across.sin()), 1).float()
        return left @ right.mT + self.mean


def _check_random(count: int, fmax: float, rms_gradient: float, spectrum: str) -> None:
    if count < 1:
        raise ValueError(f"PlaneWaves.random: count must be at least 1, got {count}")
    if not 0 < fmax <= 0.5:
        raise ValueError(f"PlaneWaves.random: fmax must be in (0, 0.5] cycles per px, got {fmax}")
    if not rms_gradient > 0:
        raise ValueError(f"PlaneWaves.random: rms_gradient must be > 0, got {rms_gradient}")
    if spectrum not in ("natural", "fine"):
        raise ValueError(f"PlaneWaves.random: spectrum must be 'natural' or 'fine', got {spectrum!r}")


def _check_range(mean: float, deviation: float) -> None:
    if mean != 0 and not CLEARANCE * deviation <= min(mean, 255 - mean):
        raise ValueError(
            f"PlaneWaves.random: grey levels {mean:g} +- {CLEARANCE:g} x {deviation:.1f} leave 0..255; "
            "lower rms_gradient or raise fmax"
        )
