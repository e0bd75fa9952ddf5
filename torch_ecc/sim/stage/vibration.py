"""Vibration of the floor, and what a spring-mounted thing does on it; functions of continuous time.

Floors of laboratories are specified by criteria of the same rms speed in every third of an octave: VC-C 12.5 um/s,
VC-D 6.25, VC-E 3.12 (Amick, Gendreau, Busch and Gordon, "Evolving criteria for research facilities", SPIE 5933, 2005).
A thing on springs moves against the floor by T(f) = q^2 / (1 - q^2 + 2 i zeta q) of the floor's motion, q = f / f_0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log2, tau

import torch
from torch import Tensor

LINES = 128  # sinusoids over the band
BAND_HZ = (1.0, 80.0)  # where the criteria hold
CHUNK = 1 << 22  # sinusoids times instants worked on at once


@dataclass(frozen=True)
class Floor:
    """Settings of the floor: rms speed in a third of an octave, and the radius about which it rocks (for theta)."""

    speed_um_s: float = 6.25  # VC-D
    rocking_um: float = 1e5

    def __post_init__(self) -> None:
        if not self.speed_um_s >= 0:
            raise ValueError(f"Floor: speed_um_s must be >= 0, got {self.speed_um_s}")
        if not self.rocking_um > 0:
            raise ValueError(f"Floor: rocking_um must be > 0, got {self.rocking_um}")


@dataclass(frozen=True, eq=False)
class Vibration:
    """A sum of K sinusoids: ``frequency_hz`` (K,), ``amplitudes`` (..., 2 K, 3) um, um, rad of cosines, then sines."""

    frequency_hz: Tensor
    amplitudes: Tensor

    @classmethod
    def on(cls, floor: Floor, natural_hz: Tensor, damping: Tensor, *, sources: list[torch.Generator]) -> Vibration:
        """Motion against the floor of things with these natural frequencies and damping ratios (3,) in x, y, theta.

        One thing for each of B ``sources``: amplitudes (B, 2 K, 3). Only they are random; the frequencies are common.
        """
        low, high = BAND_HZ
        octaves = log2(high / low)
        offsets = torch.rand(LINES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        frequency = low * torch.exp2(octaves * (torch.arange(LINES) + offsets) / LINES)
        q = frequency[:, None] / natural_hz
        transmitted = q**2 / torch.complex(1 - q**2, 2 * damping * q).abs()
        speed = floor.speed_um_s * (3 * octaves / LINES) ** 0.5
        size = (
            speed
            / (tau * frequency[:, None])
            * transmitted
            / torch.tensor((1.0, 1.0, floor.rocking_um), dtype=torch.float64)
        )
        draws = [torch.randn(2, LINES, 3, generator=g, dtype=torch.float64) for g in sources]
        return cls(frequency, (torch.stack(draws) * size).flatten(1, 2))

    def only(self, index: int) -> Vibration:
        """The vibration of one of B things."""
        return Vibration(self.frequency_hz, self.amplitudes[index])

    def at(self, times_s: Tensor) -> Tensor:
        """Displacement at times (T,) s: (..., T, 3) um, um, rad, on the device of the times."""
        amplitudes = self.amplitudes.to(times_s)
        parts = []
        for some in times_s.split(max(1, CHUNK // LINES)):
            phase = tau * some[:, None] * self.frequency_hz.to(times_s)
            parts.append(torch.cat((phase.cos(), phase.sin()), 1) @ amplitudes)
        return torch.cat(parts, -2)
