"""A layer over the template that moves by itself pulls its pose, and no residual shows how far: sigma covers it."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from torch_ecc import Estimate, Tracker, align, prepare
from torch_ecc.core.reference import Reference
from torch_ecc.sim.scene.waves import PlaneWaves

SIZE, FRAME = 61, (130, 140)
START = torch.tensor([[70.0, 65.0, 0.0], [71.3, 64.2, 0.02]], dtype=torch.float64)
AWAY = torch.tensor([[70.0, 65.0, 0.0], [63.0, 72.0, -0.1]], dtype=torch.float64)


def seen(seed: int, sheen: float) -> tuple[Reference, Estimate]:
    """A template and where it is said to be, under a layer of ``sheen`` times its contrast that goes another way."""
    layer = PlaneWaves.random(seed=100 + seed).render(AWAY, FRAME) - 128.0
    noise = 2 * torch.randn((2, 1, *FRAME), generator=torch.Generator().manual_seed(seed))
    frames = (PlaneWaves.random(seed=seed).render(START, FRAME) + sheen * layer + noise).round().float()
    reference = prepare(frames[:1, :, 35:96, 40:101])
    return reference, align(reference, frames[1:], START[1:])


def ratios(sheen: float) -> Tensor:
    """Errors over sigma of 12 scenes, (12, 3)."""
    told = [seen(seed, sheen)[1] for seed in range(12)]
    return torch.cat([(one.pose - START[1:]) / one.sigma for one in told if one.status[0] == 0])


def test_sigma_covers_what_another_layer_does():
    error = ratios(0.35)
    assert len(error) >= 8
    assert 0.4 < error.square().mean().sqrt() < 1.2


@pytest.mark.parametrize("size", [(5, 61), (61, 5), (11, 61), (21, 21)])
def test_sigma_covers_a_blur_of_what_has_few_blocks(size: tuple[int, int]):
    """Too few to tell how residuals cling together, or only along one side: then more than noise leaves is none."""
    ratio = {}
    for sigma in (0.0, 3.0):
        ratio[sigma] = torch.cat([blurred(seed, size, sigma) for seed in range(12)])
    assert 0.7 < ratio[0.0].square().mean().sqrt() < 1.3
    assert len(ratio[3.0]) >= 4
    assert ratio[3.0].square().mean().sqrt() < 2.5


def blurred(seed: int, size: tuple[int, int], sigma: float) -> Tensor:
    """Error over sigma (n, 3) of a template that is blurred in the frame, if its pose is believed."""
    clean = PlaneWaves.random(seed=seed).render(START, FRAME).float()
    soft = clean if sigma == 0 else gaussian_blur2d(clean, (25, 25), (sigma, sigma))
    noise = 2 * torch.randn((2, 1, *FRAME), generator=torch.Generator().manual_seed(seed))
    frames = (torch.cat((clean[:1], soft[1:])) + noise).round()
    told = Tracker(frames[0], START[:1, :2], size, search=False)(frames[1])
    return ((told.pose - START[1:]) / told.sigma)[told.status == 0]


def test_sigma_of_noise_is_that_of_noise():
    assert 0.7 < ratios(0.0).square().mean().sqrt() < 1.3


def test_a_texture_is_alike_over_as_many_pixels_as_it_is_coarse():
    """White noise over one, noise blurred by s px over 2 pi s^2; a sample of either over twice as many."""
    white = torch.randn(1, 1, 160, 160, generator=torch.Generator().manual_seed(0))
    x = torch.arange(-9.0, 10.0)
    kernel = torch.exp(-x.square() / 2 / 2.0**2)
    rows = torch.nn.functional.conv2d(white, kernel.view(1, 1, 1, -1))
    soft = torch.nn.functional.conv2d(rows, kernel.view(1, 1, -1, 1))
    one, many = (float(prepare(50 * image / image.std() + 128).patch[0]) for image in (white, soft))
    assert math.isclose(one, 2, rel_tol=0.3)
    assert math.isclose(many, 4 * math.pi * 2.0**2, rel_tol=0.3)
