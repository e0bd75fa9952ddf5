"""What a sensor does to an ideal image: noise that is the same for any batch, and quantisation.

Grey levels are on the nominal 0..255 scale until ``quantise``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt, tau

import numpy as np
import torch
from torch import Tensor

WHITE = 255.0
DTYPES = {8: torch.uint8, 16: torch.uint16}


@dataclass(frozen=True)
class Drift:
    """Slow drift of a sensor: in frame i gain 1 + ``gain`` s and offset ``offset`` s, with s = sin(2 pi i / period)."""

    gain: float = 0.05
    offset: float = 4.0
    period: float = 200.0

    def __post_init__(self) -> None:
        if not abs(self.gain) < 1:
            raise ValueError(f"Drift: gain must be in (-1, 1), got {self.gain}")
        if not self.period > 0:
            raise ValueError(f"Drift: period must be > 0 frames, got {self.period}")

    def apply(self, frames: Tensor, indices: Tensor) -> Tensor:
        """(B, 1, h, w) grey levels of frames ``indices`` (B,) -> the same shape."""
        s = (tau * indices.double() / self.period).sin().float()[:, None, None, None]
        return frames * (1 + self.gain * s) + self.offset * s


def noise_sigma(variance: float) -> float:
    """Grey levels of 0..255 for a noise variance on the [0, 1] scale, as the paper gives it (Fig. 4)."""
    if not variance >= 0:
        raise ValueError(f"noise_sigma: variance must be >= 0, got {variance}")
    return WHITE * sqrt(variance)


def generator(seed: int, *keys: int) -> torch.Generator:
    """Random numbers of one frame or stage: the same whatever batch, worker or device asks, unrelated to others'."""
    # torch's CPU generator keeps 32 bits of its seed: hash all numbers into them instead of adding.
    word = int(np.random.SeedSequence((seed, *keys)).generate_state(1)[0])
    return torch.Generator().manual_seed(word)


def shot(frame: Tensor, full_well: float, source: torch.Generator) -> Tensor:
    """Photon noise: a Poisson number of electrons, ``full_well`` of them at grey level 255. Any shape."""
    electrons = frame.cpu().clamp_min(0) * (full_well / WHITE)
    counts: Tensor = torch.poisson(electrons, generator=source)
    return counts.to(frame.device).mul(WHITE / full_well)


def read(frame: Tensor, sigma: float, source: torch.Generator) -> Tensor:
    """Additive Gaussian noise of ``sigma`` grey levels. Any shape."""
    return frame + sigma * torch.randn(frame.shape, generator=source).to(frame.device)


def quantise(frames: Tensor, bits: int | None) -> Tensor:
    """Grey levels 0..255 to whole counts: uint8, or uint16 with 65535 for 255; None leaves float32 unclipped."""
    if bits is None:
        return frames
    top = (1 << bits) - 1
    return (frames * (top / WHITE)).round_().clamp_(0, top).to(DTYPES[bits])
