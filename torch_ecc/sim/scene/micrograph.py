"""The default scene: an integrated circuit as a microscope shows it, analytic to the last grain."""

from __future__ import annotations

import torch

from torch_ecc.sim.scene.floorplan import circuit
from torch_ecc.sim.scene.layout import EXTENT
from torch_ecc.sim.scene.pads import Pads
from torch_ecc.sim.scene.scene import Sum
from torch_ecc.sim.scene.speckle import Speckle
from torch_ecc.sim.scene.waves import PlaneWaves

SUBSTRATE = 152.0  # grey levels


def micrograph(seed: int = 0, *, sigma: float = 1.0, grain: float = 1.5) -> Sum:
    """Circuit, stain, grain and dust over 1500 x 1500 px, with cells of transistors at the origin.

    ``sigma`` px is the point-spread function of the optics, ``grain`` the rms gradient of the surface's grain in grey
    levels per px. The same seed gives the same scene on every machine.
    """
    half = EXTENT / 2
    layers = Pads.of(circuit((-half, -half, half, half), seed), sigma=sigma, base=SUBSTRATE)
    stain = PlaneWaves.random(24, fmax=0.008, rms_gradient=0.12, mean=0.0, seed=seed)
    texture = PlaneWaves.random(60, fmax=0.25, rms_gradient=grain, mean=0.0, seed=seed + 1)
    return Sum((layers, stain, texture, _dust(seed, sigma)))


def _dust(seed: int, sigma: float) -> Speckle:
    """A few dark specks anywhere, never sharper than the optics."""
    g = torch.Generator().manual_seed(seed)
    x, y, size, level = torch.rand(4, 160, generator=g, dtype=torch.float64)
    centers = EXTENT * (torch.stack((x, y), 1) - 0.5)
    return Speckle(centers, (sigma**2 + (3 * size**3) ** 2).sqrt(), -25 - 45 * level)
