"""The map of trackability is te.texture, everywhere at once."""

from __future__ import annotations

import time
from statistics import median

import pytest
import torch

import torch_ecc as te
from torch_ecc.sim.scene.waves import PlaneWaves


@pytest.fixture(scope="module")
def frame():
    """640 x 480, 8 bits: fine texture on one half, noise alone on the other, and a bright pedestal."""
    scene = PlaneWaves.random(seed=1).render(torch.tensor([[320.0, 240.0, 0.2]]).double(), (480, 640))[0, 0]
    fade = ((torch.arange(640) - 260) / 40).sigmoid()
    noise = 2 * torch.randn(480, 640, generator=torch.Generator().manual_seed(0))
    return (120 + (scene - scene.mean()) * fade + noise).round().clamp(0, 255).to(torch.uint8)


def both(frame: torch.Tensor, size: int | tuple[int, int], places: int = 100) -> tuple[torch.Tensor, torch.Tensor]:
    """Sigma of the map and of te.texture at some of its places, (places, 3) each."""
    found = te.texture_map(frame, size)
    generator = torch.Generator().manual_seed(0)
    row, column = (torch.randint(len(axis), (places,), generator=generator) for axis in (found.y, found.x))
    return found.sigma[row, column], te.texture(frame, torch.stack((found.x[column], found.y[row]), 1), size)


@pytest.mark.parametrize("size", [121, (40, 75)], ids=str)
def test_it_is_texture(frame, size):
    mapped, wanted = both(frame, size)
    seen = wanted.isfinite().all(1)
    assert 20 < seen.sum() < 95  # both kinds of place are there
    assert (mapped.isfinite().all(1) == seen).float().mean() > 0.97  # at the edge of what is observable they may differ
    seen &= mapped.isfinite().all(1)
    off = (mapped[seen] / wanted[seen] - 1).abs().amax(1)
    assert (off < 0.05).float().mean() > 0.97  # so they may where other instruments begin to serve
    assert off.max() < 0.25


def test_it_is_texture_on_a_real_frame(data):
    from torch_ecc.io import open_frames

    mapped, wanted = both(open_frames(data / "mechanism_video").first, 121)
    assert (mapped / wanted - 1).abs().max() < 0.05


def test_grey_levels_may_be_of_any_kind(frame):
    """A high pedestal and another unit change nothing but the rounding of the camera, which floats do not have."""
    float_map = te.texture_map(frame.float(), 61).sigma
    scaled = te.texture_map(frame.float() * 7 + 30_000, 61).sigma
    torch.testing.assert_close(scaled, float_map, rtol=2e-3, atol=0)
    turned = te.texture_map(frame.float().mT.contiguous(), 61).sigma
    torch.testing.assert_close(turned.transpose(0, 1)[..., [1, 0, 2]], float_map, rtol=1e-3, atol=0)


def test_the_best_places_are_where_the_texture_is(frame):
    found = te.texture_map(frame, 61)
    places = found.best(6)
    assert places.shape == (6, 2)
    assert (places[:, 0] > 260).all()
    apart = (places[:, None] - places[None]).abs().amax(-1) + 1000 * torch.eye(6)
    assert apart.min() >= 61
    predicted = te.texture(frame, places, 61)[:, 0]
    assert predicted.max() < 0.02
    assert len(te.texture_map(torch.full((80, 90), 7, dtype=torch.uint8), 21).best(5)) == 0


@pytest.mark.parametrize(("size", "half", "most"), [(31, 0.03, 0.08), (20, 0.05, 0.2)])
def test_small_patches_are_as_right_as_it_says(frame, size, half, most):
    mapped, wanted = both(frame, size)
    assert (mapped.isfinite() == wanted.isfinite()).all()  # with the same instruments
    off = (mapped / wanted - 1).abs()[wanted.isfinite().all(1)].amax(1)
    assert off.median() < half
    assert off.quantile(0.9) < most


def test_it_costs_some_dozens_of_calls(frame):
    """One texture call for 121 px stands for a map of some 1,600 places: in processor time."""

    def cost(call):
        begun = time.thread_time()
        call()
        return time.thread_time() - begun

    te.texture_map(frame, 121)  # what is made once per size of frame
    pairs = [
        (cost(lambda: te.texture_map(frame, 121)), cost(lambda: te.texture(frame, [(400, 240)], 121))) for _ in range(5)
    ]
    assert median(a for a, _ in pairs) <= 30 * median(b for _, b in pairs)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda f: te.texture_map(f, 500), r"frame must be one image of 500x500 px or more, got \(480, 640\)"),
        (lambda f: te.texture_map(f, 3), "size must be one or two whole numbers of at least 5 px"),
        (lambda f: te.texture_map(f, 61, step=0), "step must be 1 px or more, got 0"),
        (lambda f: te.texture_map(f.expand(2, 1, -1, -1), 61), "frame must be one image"),
    ],
)
def test_bad_input_is_told(frame, call, words):
    with pytest.raises(ValueError, match=words):
        call(frame)
