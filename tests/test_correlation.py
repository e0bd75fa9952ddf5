"""Laws of the correlation that both searches are made of: its definition, its invariances, exact peaks of parabolas."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc.core.pose import rotation
from torch_ecc.search.correlation import Correlator, detrended, fast_length, peaks, rotated

SIDE = 9


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def off_planes(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """``values`` (h, w) less their weighted least-squares plane, float64."""
    h, w = values.shape
    y, x = torch.meshgrid(torch.arange(h).double(), torch.arange(w).double(), indexing="ij")
    planes, root = torch.stack((torch.ones_like(x), x, y), -1).view(-1, 3), weight.double().sqrt().view(-1, 1)
    fit = torch.linalg.lstsq(root * planes, root * values.double().view(-1, 1)).solution
    return values.double() - (planes @ fit).view(h, w)


def zncc(a: torch.Tensor, b: torch.Tensor, weight: torch.Tensor) -> float:
    """Detrended ZNCC of two patches (h, w) by its definition."""
    a, b, weight = off_planes(a, weight), off_planes(b, weight), weight.double()
    return float((weight * a * b).sum() / ((weight * a * a).sum() * (weight * b * b).sum()).sqrt())


def correlator(texture: torch.Tensor, weight: torch.Tensor, size: tuple[int, int]) -> Correlator:
    """Of textures and weights (B, A, n, m)."""
    kernels, planes = detrended(texture, weight)
    return Correlator.of(kernels, weight, planes=planes, size=size)


@pytest.mark.parametrize("chunk", [1, 2, 3])
@pytest.mark.parametrize("weights", [1, 3], ids=["one weight", "a weight per angle"])
def test_the_score_is_the_detrended_zncc_of_every_place(weights, chunk):
    """B = 2 templates, A = 3 angles, light across the image, weights of any value."""
    texture, weight = uniform(2, 3, SIDE, SIDE - 2), uniform(2, weights, SIDE, SIDE - 2, seed=1) + 0.05
    image = 50 * uniform(2, 20, 17, seed=2) + 3 * torch.arange(17) + 900
    score = torch.cat(list(correlator(texture, weight, (20, 17)).scores(image, chunk)), 1)
    assert score.shape == (2, 3, 20 - SIDE + 1, 17 - SIDE + 3)
    for b, a, y, x in [(0, 0, 0, 0), (0, 1, 11, 10), (1, 2, 5, 3), (1, 0, 11, 0), (1, 1, 7, 9)]:
        patch = image[b, y : y + SIDE, x : x + SIDE - 2]
        expected = zncc(texture[b, a], patch, weight[b, a % weights])
        assert float(score[b, a, y, x]) == pytest.approx(expected, abs=2e-4)


def test_gain_offset_and_a_plane_change_no_score():
    texture, weight, image = uniform(1, 2, SIDE, SIDE), uniform(1, 1, SIDE, SIDE, seed=1), uniform(1, 30, 25, seed=2)
    plane = torch.arange(25) * 0.02 - 0.01 * torch.arange(30)[:, None]
    (score,) = correlator(texture, weight, (30, 25)).scores(image, 2)
    (other,) = correlator(2 * texture + plane[:SIDE, :SIDE], weight, (30, 25)).scores(5 * image + plane - 7, 2)
    assert (score - other).abs().max() < 1e-3
    assert score.abs().max() <= 1 + 1e-4


@pytest.mark.parametrize("contrast", [1e-4, 1e-3, 1.0])
def test_flat_places_match_nothing_but_faint_ones_do(contrast):
    """Grain of 1e-3 of the image's deviation or less counts as flat; a tenth of it is as good as any."""
    texture = uniform(1, 1, SIDE, SIDE)
    image = 10 * uniform(1, 40, 40, seed=2)
    image[0, :, 20:] = 5.0
    image[0, 5 : 5 + SIDE, 25 : 25 + SIDE] += contrast * texture[0, 0]
    score = next(correlator(texture, torch.ones_like(texture), (40, 40)).scores(image, 1))[0, 0, 5, 25]
    assert (score < 0.1) if contrast < 0.01 else (score > 0.99)


@pytest.mark.parametrize("mask", ["corner", "column", "pixel"])
def test_the_planes_are_orthonormal_where_the_weight_lies(mask):
    """Those that the pixels cannot tell apart are left out, and nothing becomes NaN."""
    weight = torch.zeros(SIDE, SIDE)
    rows, columns = {"corner": (slice(4), slice(5)), "column": (slice(None), 3), "pixel": (4, 4)}[mask]
    weight[rows, columns] = 1.0
    kernel, planes = detrended(uniform(SIDE, SIDE), weight)
    gram = torch.einsum("iyx,jyx->ij", planes, planes)  # weights of 1: their product is the weighted one
    count = {"corner": 3, "column": 2, "pixel": 1}[mask]
    assert gram.diagonal().sum() == pytest.approx(count, abs=1e-4)
    assert (gram - gram.diagonal().diag()).abs().max() < 1e-4
    assert (planes * kernel).sum((1, 2)).abs().max() < 1e-4
    assert kernel.square().sum() == pytest.approx(0.0 if mask == "pixel" else 1.0, abs=1e-3)


@pytest.mark.parametrize("spline", [False, True])
def test_a_rotated_image_is_what_the_frame_shows_at_that_angle(spline):
    """x = R(angle) x': what the template has at x' is found at x; blobs of 5 px, about any point."""
    blobs, middle = torch.tensor([[31.0, 20.0], [18.0, 27.0], [25.0, 38.0]]), torch.tensor([24.0, 26.0])

    def render(centres: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
        y, x = torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij")
        squares = (x - centres[:, 0, None, None]) ** 2 + (y - centres[:, 1, None, None]) ** 2
        return (torch.tensor([1.0, 2.0, 3.0])[:, None, None] * (-squares / 50).exp()).sum(0)

    angles, size = torch.tensor([0.0, 0.7, -2.0]), (33, 31)
    image = render(blobs, (52, 50))
    found = rotated(torch.stack((image, 2 * image))[:, None], angles, middle=middle, size=size, spline=spline)
    for a, angle in enumerate(angles):
        moved = (blobs - middle) @ rotation(angle).mT + torch.tensor([15.0, 16.0])
        assert (found[0, a] - render(moved, size)).abs().max() < (2e-3 if spline else 0.03)
    assert torch.allclose(found[1], 2 * found[0], atol=1e-5)


def test_beyond_its_border_a_rotated_image_is_zero():
    found = rotated(torch.ones(1, 1, 11, 21), torch.tensor([0.0, 0.5]), middle=torch.tensor([10.0, 5.0]), size=(25, 25))
    assert found[0, 0].sum() == 11 * 21
    assert found[0, 1].sum() == pytest.approx(10 * 20, rel=0.1)


def parabola(shape: tuple[int, ...], place: tuple[float, ...], height: float) -> torch.Tensor:
    """Values of height - sum 0.1 (x_k - place_k)^2 on a grid, one frame of cells wider on all sides."""
    axes = torch.meshgrid(*(torch.arange(-1.0, n + 1) for n in shape), indexing="ij")
    return height - sum(0.1 * (x - p) ** 2 for x, p in zip(axes, place, strict=True))


@pytest.mark.parametrize(
    ("shape", "place"), [((12, 15), (4.3, 9.6)), ((7, 12, 15), (2.8, 4.3, 9.6)), ((9,), (3.75,))], ids=len
)
def test_the_peak_of_a_parabola_is_exact(shape, place):
    found = peaks(torch.stack([parabola(shape, place, 0.9), parabola(shape, place, 0.4)]), 1)
    assert torch.allclose(found.place, torch.tensor(place).flip(0).expand(2, 1, -1), atol=1e-4)
    assert torch.allclose(found.score[:, 0], torch.tensor([0.9, 0.4]), atol=1e-5)
    flat = parabola(shape, place, 0.0)[(slice(1, -1),) * len(shape)].flatten().argmax()
    assert (found.cell == flat).all()


def test_peaks_are_local_maxima_with_the_highest_first():
    score = torch.full((1, 22, 32), -1.0)
    for x, y, height in [(3, 4, 0.5), (5, 4, 0.7), (6, 5, 0.6), (20, 17, 0.9)]:  # the third is the second's neighbour
        score[0, y + 1, x + 1] = height
    found = peaks(score, 3)
    assert found.place[0].round().tolist() == [[20, 17], [5, 4], [3, 4]]
    assert (found.score[0] - torch.tensor([0.9, 0.7, 0.5])).abs().max() < 0.02


@pytest.mark.parametrize("corner", [(0, 0), (4, 7)])
def test_at_the_border_a_peak_stays_on_its_cell(corner):
    y, x = corner
    framed = torch.full((1, 7, 10), -math.inf)
    framed[0, 1:-1, 1:-1] = parabola((5, 8), corner, 0.8)[1:-1, 1:-1]
    found = peaks(framed, 2)
    assert found.place[0, 0].tolist() == [x, y]
    assert found.score[0, 0] == pytest.approx(0.8)
    assert found.place.isfinite().all()
    assert found.score.isfinite().all()


def test_what_frames_the_map_is_no_peak():
    framed = parabola((6, 8), (2.0, 3.0), 0.5)
    framed[0, 0], framed[-1, 4] = 0.9, 0.8
    assert peaks(framed[None], 1).place[0, 0].tolist() == [3, 2]


def test_fast_lengths_are_even_and_have_no_large_factors():
    def largest_factor(n: int) -> int:
        return max(p for p in range(2, n + 1) if n % p == 0 and all(p % q for q in range(2, math.isqrt(p) + 1)))

    for n in range(2, 400):
        length = fast_length(n)
        assert length >= n
        assert length % 2 == 0
        assert largest_factor(length) <= 5
        assert all(largest_factor(k) > 5 for k in range(n + n % 2, length, 2))
