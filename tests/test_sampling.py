"""Laws of the samplers: interpolation, polynomial reproduction, coordinates, gradients, pyramid, noise."""

from __future__ import annotations

import kornia
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc.core import filters
from torch_ecc.core import sampling as S
from torch_ecc.core.frame import as_gray
from torch_ecc.core.noise import noise_level

BOX = torch.tensor([[-10.0, 10.0, 10.0, -10.0], [-8.0, -8.0, 8.0, 8.0], [1.0, 1.0, 1.0, 1.0]])
INTERPOLATIONS = ["bilinear", "bspline3", "bspline5"]


def warp_at(x: float, y: float, theta: float = 0.0) -> torch.Tensor:
    c, s = torch.cos(torch.tensor(theta)), torch.sin(torch.tensor(theta))
    return torch.tensor([[[c, s, x], [-s, c, y]]], dtype=torch.float64)


def pixels(count: int = 50, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    offsets = (torch.rand(2, count, generator=generator) - 0.5) * torch.tensor([[20.0], [16.0]])
    return torch.cat((offsets, torch.ones(1, count)))


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
@pytest.mark.parametrize("size", [(60, 81), (61, 80)])
def test_interpolates_the_pixels(interpolation, size):
    image = noise(1, 1, *size)
    whole = torch.tensor([[-3.0, 0.0, 4.0], [2.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    values = S.make_sampler(interpolation, image, warp_at(40, 30), BOX)(warp_at(40, 30), whole)
    expected = torch.stack([image[0, 0, 30 + int(y), 40 + int(x)] for x, y in whole[:2].T])
    assert torch.allclose(values[0], expected, atol=2e-5)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_interpolates_the_pixels_at_the_border_too(interpolation):
    image = noise(1, 1, 21, 27)
    y, x = torch.meshgrid(torch.arange(21.0) - 10, torch.arange(27.0) - 13, indexing="ij")
    whole = torch.stack((x.flatten(), y.flatten(), torch.ones(21 * 27)))
    box = torch.tensor([[-13.0, 13, 13, -13], [-10.0, -10, 10, 10], [1.0, 1, 1, 1]])
    values = S.make_sampler(interpolation, image, warp_at(13, 10), box)(warp_at(13, 10), whole)
    assert torch.allclose(values.view(21, 27), image[0, 0], atol=5e-5)


@pytest.mark.parametrize(("interpolation", "degree"), [("bilinear", 1), ("bspline3", 3), ("bspline5", 5)])
def test_reproduces_polynomials(interpolation, degree):
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(140.0), indexing="ij")
    p = pixels()
    warp = warp_at(70.3, 60.7, 0.4)
    points = warp[0].float() @ p
    for power in range(degree + 1):
        image = (((x - 70) / 10) ** power * ((y - 60) / 10 + 1))[None, None]
        values = S.make_sampler(interpolation, image, warp, BOX)(warp, p)[0]
        expected = ((points[0] - 70) / 10) ** power * ((points[1] - 60) / 10 + 1)
        assert (values - expected).abs().max() < 3e-5 * image.abs().max() ** 0.5


@settings(deadline=None, max_examples=20)
@given(st.floats(30, 110), st.floats(25, 95), st.floats(-7, 7), st.sampled_from(["bspline3", "bspline5"]))
def test_the_neighbourhood_is_as_good_as_the_frame(x, y, theta, interpolation):
    image = noise(1, 1, 120, 140)
    warp, p = warp_at(x, y, theta), pixels()
    local = S.make_sampler(interpolation, image, warp, BOX)
    whole = S.Sampler.of(image, interpolation)
    assert local.values.numel() < whole.values.numel()
    assert (local(warp, p) - whole(warp, p)).abs().max() < 1e-3


def test_taps_agree_with_the_definition():
    """Pairs of taps as bilinear lookups give the same as the sum over all taps."""
    image = noise(1, 1, 40, 40)
    for interpolation, degree in (("bspline3", 3), ("bspline5", 5)):
        coefficients = S.prefilter(image, interpolation)
        point = torch.tensor([[17.3], [21.8]])
        floor = point.floor()
        pairs = S.SAMPLERS[interpolation].pairs(point - floor)
        weights = torch.stack([w for _, total, second in pairs for w in (total - second, second)])
        assert torch.allclose(weights.sum(0), torch.ones(2, 1))
        taps = torch.arange(-(degree // 2), degree // 2 + 2)
        block = coefficients[0, 0][floor[1].long() + taps][:, floor[0].long() + taps]
        expected = weights[:, 1, 0] @ block @ weights[:, 0, 0]
        sampler = S.Sampler.of(image, interpolation)
        value = sampler(warp_at(17.3, 21.8), torch.tensor([[0.0], [0.0], [1.0]]))
        assert value[0, 0] == pytest.approx(float(expected), abs=1e-4)


def test_gradients_are_the_slope_of_the_spline():
    image = noise(1, 1, 50, 60)
    g = S.gradients(image)
    sampler = S.Sampler.of(image, "bspline3")
    step = 1e-2
    at = torch.tensor([[0.0, 5.0], [0.0, -7.0], [1.0, 1.0]])
    for axis in range(2):
        shift = [0.0, 0.0]
        shift[axis] = step
        ahead = sampler(warp_at(30 + shift[0], 25 + shift[1]), at)
        behind = sampler(warp_at(30 - shift[0], 25 - shift[1]), at)
        slope = (ahead - behind)[0] / (2 * step)
        assert torch.allclose(slope, g[0, axis, [25, 18], [30, 35]], atol=3e-3)


def test_padding_keeps_the_slope_at_the_border():
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    ramp = (2 * x - 3 * y)[None, None]
    wide = filters.pad(ramp, 8)
    assert torch.equal(wide[:, :, 8:-8, 8:-8], ramp)
    inner = S.gradients(wide)[0, :, 8:-8, 8:-8]
    assert torch.allclose(inner[0], torch.full_like(inner[0], 2.0), atol=1e-3)
    assert torch.allclose(inner[1], torch.full_like(inner[1], -3.0), atol=1e-3)


@pytest.mark.parametrize("size", [(40, 50), (41, 51)])
def test_halving_keeps_every_second_pixel_in_place(size):
    y, x = torch.meshgrid(torch.arange(float(size[0])), torch.arange(float(size[1])), indexing="ij")
    half = filters.downsample((x + 10 * y)[None, None])
    rows, columns = half.shape[-2:]
    yy, xx = torch.meshgrid(2 * torch.arange(float(rows)), 2 * torch.arange(float(columns)), indexing="ij")
    assert torch.allclose(half[0, 0, 3:-3, 3:-3], (xx + 10 * yy)[3:-3, 3:-3], atol=1e-3)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_noise_gain(interpolation):
    image = noise(1, 1, 400, 400)
    generator = torch.Generator().manual_seed(1)
    p = torch.cat((torch.rand(2, 40000, generator=generator) * 340 - 170, torch.ones(1, 40000)))
    box = torch.tensor([[-170.0, 170, 170, -170], [-170.0, -170, 170, 170], [1.0, 1, 1, 1]])
    values = S.make_sampler(interpolation, image, warp_at(200, 200), box)(warp_at(200, 200), p)
    assert float(values.var() / image.var()) == pytest.approx(S.SAMPLERS[interpolation].noise_gain, rel=0.03)


def test_noise_level_sees_noise_and_not_ramps_or_edges():
    y, x = torch.meshgrid(torch.arange(100.0), torch.arange(100.0), indexing="ij")
    kept = torch.ones(1, 1, 100, 100)
    for scene in (torch.zeros(100, 100), 3 * x - y, 100 * (x > 50)):
        assert float(noise_level(scene[None, None], kept)) == 0
        noisy = (scene + 4 * noise(100, 100))[None, None]
        assert float(noise_level(noisy, kept)) == pytest.approx(4.0, rel=0.08)


def test_templates_share_one_image_without_copies():
    image = noise(1, 1, 64, 64)
    sampler = S.make_sampler("bilinear", image, warp_at(30, 30).expand(7, 2, 3), BOX)
    assert sampler.values.data_ptr() == image.data_ptr()
    assert sampler(warp_at(30, 30).expand(7, 2, 3), pixels()).shape == (7, 50)


@pytest.mark.parametrize(("sigma", "shape"), [(0.7, (2, 1, 40, 33)), (1.0, (1, 1, 300, 400)), (3.0, (1, 1, 64, 30))])
def test_blur_is_a_gaussian_mirrored_at_the_border(sigma, shape):
    """As another library has it."""
    image = 255 * torch.rand(shape, generator=torch.Generator().manual_seed(0))
    size = 2 * int(4 * sigma + 0.5) + 1
    theirs = kornia.filters.gaussian_blur2d(image, (size, size), (sigma, sigma), border_type="reflect")
    torch.testing.assert_close(filters.blur(image, sigma), theirs, rtol=0, atol=2e-4)


def test_colours_become_grey_as_another_library_has_it():
    image = 255 * torch.rand(2, 3, 20, 30, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(as_gray("test", "image", image), kornia.color.rgb_to_grayscale(image), rtol=0, atol=1e-4)


@pytest.mark.parametrize("interpolation", S.SAMPLERS)
def test_slopes_of_taps(interpolation):
    """Those of the weights are what autograd makes of them."""
    kernel, f = S.SAMPLERS[interpolation], torch.linspace(0.01, 0.99, 20, dtype=torch.float64).requires_grad_()
    for (_, *weights), slopes in zip(kernel.pairs(f), kernel.slopes(f.detach()), strict=True):
        for weight, slope in zip(weights, slopes, strict=True):
            true = torch.autograd.grad(weight.sum() + 0 * f.sum(), f, retain_graph=True)[0]
            torch.testing.assert_close(slope, true)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_rounding_moves_no_patch_as_a_whole(interpolation):
    """Pixels are rounded, each by itself; together they lie where the warp says, far from the frame's corner too."""
    p = pixels(2000)
    sampler = S.Sampler.of(torch.zeros(1, 1, 300, 400), interpolation)
    warp = torch.cat([warp_at(90.1 + 29.3 * k, 60.7 + 21.1 * k, 0.3 + k) for k in range(10)])
    apart = sampler.points(warp, p).double() - sampler.points(warp, p.double())
    if sampler.kernel.ring == 0:
        apart = apart / sampler.scale()
    assert apart.mean(2).abs().max() < 1.5e-6  # float32 holds such places to 1e-5 px
    assert apart.abs().max() < 5e-5


@pytest.mark.parametrize("n", [40, 300])
def test_no_filter_holds_what_processors_are_slow_with(n):
    """Far off the diagonal there are zeros in place of subnormal numbers; near it all is as it is."""
    made = [S._slope_matrix(n, torch.device("cpu")), *(S._alias(n, name, torch.device("cpu")) for name in S.SAMPLERS)]
    for kernel in S.SAMPLERS.values():
        if kernel.ring:
            for dtype in (torch.float32, torch.float64):
                made.append(S.prefilter_matrix(n, kernel.taps, kernel.ring, dtype, torch.device("cpu")))
                inverse = made[-1][kernel.ring : n + kernel.ring].double()
                restored = S._band(n, kernel.taps, 1, torch.device("cpu")) @ inverse
                torch.testing.assert_close(restored, torch.eye(n, dtype=torch.float64), rtol=0, atol=1e-6)
    for matrix in made:
        assert (matrix[matrix != 0].abs() > 1e-25).all()
