"""Dim pictures are tracked where they are large enough, and grain is no texture, whatever its spectrum."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import torch_ecc as te
from torch_ecc import Reason, Status
from torch_ecc.core import pushed
from torch_ecc.core.filters import blur
from torch_ecc.sim import micrograph

SIZE, SIDE, MOVED = 151, 200, (1.4, -0.6)


def frame(image: Tensor, noise: float, seed: int) -> Tensor:
    """A camera's 8 bits (h, w)."""
    grain = noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return (image + grain).round().clamp(0, 255).to(torch.uint8)


def waves(contrast: float, shift: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> Tensor:
    """Wavelengths of 20 to 60 px with a standard deviation of ``contrast`` grey levels: (h, w)."""
    u = torch.rand(3, 40, generator=torch.Generator().manual_seed(seed))
    k, a, phase = 0.1 + 0.2 * u[0], math.pi * u[1], math.tau * u[2]
    x, y = torch.arange(SIDE) - SIDE / 2 - shift[0], torch.arange(SIDE)[:, None] - SIDE / 2 - shift[1]
    each = (k[:, None, None] * (x * a.cos()[:, None, None] + y * a.sin()[:, None, None]) + phase[:, None, None]).cos()
    return 110 + contrast * each.sum(0) / math.sqrt(20)


def edge(dark: float, noise: float, spread: float, seed: int) -> Tensor:
    """One straight edge; where its ``dark`` side is black it has no noise. The noise was blurred by ``spread`` px."""
    x, y = torch.arange(SIDE) - SIDE / 2, torch.arange(SIDE)[:, None] - SIDE / 2
    angle = math.radians(25 + 37 * (seed // 10))
    bright = torch.sigmoid((x * math.cos(angle) + y * math.sin(angle)) / 1.5)
    grain = torch.randn(1, 1, SIDE, SIDE, generator=torch.Generator().manual_seed(seed))
    grain = grain if spread == 0 else blur(grain, spread)
    grain = noise * grain[0, 0] / grain.std() * (bright.sqrt() if dark == 0 else 1)
    return (dark + (170 - dark) * bright + grain).round().clamp(0, 255).to(torch.uint8)


@pytest.mark.parametrize("contrast", [3.0, 4.0, 8.0])
def test_what_is_dimmer_than_its_noise_is_tracked_as_sigma_says(contrast):
    """Noise 4: a score of 0.36 at the dimmest. Predicted, believed, and off by no more than what is predicted."""
    off = []
    for seed in range(4):
        first, second = frame(waves(contrast), 4, 2 * seed), frame(waves(contrast, MOVED), 4, 2 * seed + 1)
        predicted = te.texture(first, [(100.0, 100.0)], SIZE)
        found = te.Tracker(first, [(100.0, 100.0)], SIZE)(second)
        assert found.status == Status.CONVERGED
        assert (found.sigma / predicted - 1).abs().max() < 0.3
        off.append((found.displacement[0, :2] - torch.tensor(MOVED)) / found.sigma[0, :2])
    assert torch.stack(off).square().mean() < 2


def test_another_dim_picture_is_not_it():
    first = frame(waves(4.0), 4, 0)
    tracker = te.Tracker(first, [(100.0, 100.0)], SIZE, search=False)
    assert tracker(frame(waves(4.0, seed=1), 4, 1)).status == Status.LOST


def test_what_is_withheld_is_withheld_for_its_sigma():
    """The smaller a dim patch, the larger its sigma, until it is too large to be of use."""
    first = frame(waves(4.0), 4, 0)
    sigma = torch.stack([te.texture(first, [(100.0, 100.0)], n)[0] for n in (31, 61, 91, 121, 151)])[:, :2].amax(1)
    assert sigma[0] == torch.inf
    assert (sigma.diff()[sigma[:-1].isfinite()] < 0).all()
    assert sigma[-1] < 0.1


@pytest.mark.parametrize("spread", [0.0, 0.6, 1.0], ids="grain blurred by {} px".format)
@pytest.mark.parametrize("dark", [0.0, 40.0], ids=["black", "grey"])
@pytest.mark.parametrize("size", [61, 121])
def test_grain_along_an_edge_is_no_texture(dark, spread, size):
    """Of one image nobody can tell that such grain is none of the scene's; the next one does not have it."""
    for seed in (0, 10, 20):
        tracker = te.Tracker(edge(dark, 3.0, spread, seed), [(100.0, 100.0)], size, search=False)
        for k in (1, 2):
            assert int(tracker(edge(dark, 3.0, spread, seed + k)).reason) in {Reason.NOISE, Reason.UNSURE}


@pytest.mark.parametrize("size", [31, 61, 121, 301])
def test_noise_of_any_size_is_no_texture(size):
    grain = torch.full((size + 40, size + 40), 100.0)
    assert te.texture(frame(grain, 5.0, size), [((size + 39) / 2,) * 2], size).isinf().all()


def test_a_blurred_picture_is_no_noise():
    """It answers every push less, but in one direction no less than in another."""
    pose = torch.tensor([[100.0, 100.0, 0.0]], dtype=torch.float64)
    sharp = micrograph(0).render(pose, (SIDE, SIDE))
    tracker = te.Tracker(frame(sharp[0, 0], 2, 0), [(100.0, 100.0)], 121, search=False)
    found = tracker(frame(blur(sharp, 4.0)[0, 0], 2, 1))
    assert found.status == Status.CONVERGED
    assert (found.displacement / found.sigma).abs().max() < 5


def test_what_has_texture_is_asked_no_more_and_grain_always(monkeypatch):
    """After some frames in which it came back clearly."""
    asked, left_of_push = [], pushed.left_of_push
    monkeypatch.setattr(pushed, "left_of_push", lambda *given: asked.append(1) or left_of_push(*given))
    tracker = te.Tracker(frame(waves(4.0), 4, 0), [(100.0, 100.0)], SIZE, search=False)
    for k in range(pushed.ENOUGH + 4):
        assert tracker(frame(waves(4.0), 4, k + 1)).status == Status.CONVERGED
    assert len(asked) == pushed.ENOUGH == int(tracker.answered)
    grain = te.Tracker(edge(40.0, 3.0, 1.0, 0), [(100.0, 100.0)], 121, search=False)
    for k in range(pushed.ENOUGH + 4):
        assert int(grain(edge(40.0, 3.0, 1.0, k + 1)).reason) in {Reason.NOISE, Reason.UNSURE}
    assert int(grain.answered) == 0
