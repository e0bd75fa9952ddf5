"""Scenes from stills, and Retinex."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from torch_ecc.core.pose import inverse, transform
from torch_ecc.sim import ImageScene, Pads, PlaneWaves, multi_scale, single_scale
from torch_ecc.sim.camera.still import image_light, image_scene, read_still

ANALYTIC = {
    "waves": PlaneWaves.random(seed=3),
    "fine": PlaneWaves.random(spectrum="fine", seed=4),
    "pads": Pads.wafer(pitch=50, sigma=1.5),
}


def grid(half: int, phase: tuple[float, float] = (0.0, 0.0)) -> torch.Tensor:
    axis = torch.arange(-half, half + 1, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis + phase[0], axis + phase[1], indexing="xy"), -1)


@pytest.mark.parametrize("name", ANALYTIC)
def test_a_sampled_scene_renders_like_the_scene(name):
    """Under 0.001 px in every pixel (error over the rms gradient), and far under in the position of a template."""
    analytic = ANALYTIC[name]
    still = ImageScene.of(analytic.value(grid(100)))
    for phase in ((0.5, 0.5), (0.25, 0.1), (0.0, 0.7)):
        points = grid(80, phase).reshape(-1, 2)
        error, slope = still.value(points) - analytic.value(points), analytic.gradient(points)
        assert float(error.abs().max() / slope.square().sum(1).mean().sqrt()) < 1e-3
        assert float(torch.linalg.lstsq(slope, error[:, None]).solution.abs().max()) < 2e-5
        assert float((still.gradient(points) - slope).abs().max()) < 0.05


def test_the_still_itself_comes_back():
    image = ANALYTIC["waves"].value(grid(30))
    still = ImageScene.of(image)
    torch.testing.assert_close(still.value(grid(30)), image, atol=1e-4, rtol=0)


@pytest.mark.parametrize("theta", [0.0, 0.4, -2.5])
def test_render_is_value_at_every_pixel(theta, device):
    still = ImageScene.of(ANALYTIC["waves"].value(grid(40)), scale=1.7, origin=(35.0, 50.0))
    pose = torch.tensor([[30.2, 21.7, theta]], dtype=torch.float64)
    frame = still.render(pose.to(device), (50, 70)).cpu()
    y, x = torch.meshgrid(torch.arange(50.0), torch.arange(70.0), indexing="ij")
    points = transform(inverse(pose[0]), torch.stack((x, y), -1).reshape(-1, 2).double())
    torch.testing.assert_close(frame.flatten().double(), still.value(points), atol=1e-3, rtol=0)


def test_gradient_is_the_derivative_of_value_even_where_mirrored():
    still = ImageScene.of(ANALYTIC["waves"].value(grid(20)), scale=0.8)
    points = (100 * torch.rand(60, 2, dtype=torch.float64) - 50).requires_grad_()
    (derivative,) = torch.autograd.grad(still.value(points).sum(), points)
    torch.testing.assert_close(still.gradient(points.detach()), derivative, atol=1e-9, rtol=1e-9)


def test_beyond_its_borders_a_still_is_mirrored():
    still = ImageScene.of(ANALYTIC["waves"].value(grid(20)))
    points = 3 * torch.rand(20, 2, dtype=torch.float64)
    inside, outside = points.clone(), points.clone()
    inside[:, 0] = 20 - points[:, 0]
    outside[:, 0] = 20 + points[:, 0]
    torch.testing.assert_close(still.value(inside), still.value(outside))


@pytest.mark.parametrize(
    ("image", "settings", "message"),
    [
        (torch.zeros(3, 20, 20), {}, r"must be \(h, w\) of at least 8 x 8 px, got \(3, 20, 20\)"),
        (torch.zeros(20, 5), {}, r"at least 8 x 8 px, got \(20, 5\)"),
        (torch.full((20, 20), float("nan")), {}, "must be finite"),
        (torch.zeros(20, 20), {"scale": 0.0}, "scale must be > 0, got 0.0"),
    ],
)
def test_wrong_stills_are_refused(image, settings, message):
    with pytest.raises(ValueError, match=message):
        ImageScene.of(image, **settings)


def lit_surface() -> torch.Tensor:
    x = torch.linspace(-1, 1, 240, dtype=torch.float64)
    light = torch.exp(-(x[:, None] ** 2 + x**2))
    surface = PlaneWaves.random(seed=2, rms_gradient=4).render(torch.tensor([[120.0, 120.0, 0.0]]), (240, 240))
    return surface.double() * light


@pytest.mark.parametrize("split", [single_scale, multi_scale])
def test_reflected_times_incident_is_the_image(split):
    image = torch.cat((lit_surface(), torch.zeros(1, 1, 240, 240, dtype=torch.float64)))
    image[0, 0, 3:9] = 0  # black pixels have no logarithm
    parts = split(image)
    torch.testing.assert_close(parts.reflected * parts.incident, image, atol=1e-9, rtol=0)
    assert float(parts.incident.min()) > 0


def test_incident_light_is_smooth_and_takes_the_shading_out():
    image = lit_surface()
    parts = single_scale(image, 40.0)

    def shading(x: torch.Tensor) -> float:
        blocks = torch.nn.functional.avg_pool2d(x, 60)
        return float(blocks.std() / blocks.mean())

    assert float(parts.incident.diff(dim=-1).abs().max()) < 0.1 * float(image.diff(dim=-1).abs().max())
    assert shading(parts.reflected) < 0.4 * shading(image)


def test_retinex_is_blind_to_the_gain_of_the_light():
    dim, bright = multi_scale(lit_surface()), multi_scale(3 * lit_surface())
    torch.testing.assert_close(dim.reflected, bright.reflected)
    torch.testing.assert_close(3 * dim.incident, bright.incident)
    assert float(dim.surface(200.0).max()) <= 255


@pytest.mark.parametrize(
    ("image", "settings", "message"),
    [
        (torch.ones(9, 9), {}, r"must be \(B, 1, h, w\), got \(9, 9\)"),
        (-torch.ones(1, 1, 9, 9), {}, "finite and not negative"),
        (torch.ones(1, 1, 9, 9), {"sigmas": ()}, r"sigmas must be > 0 px, got \(\)"),
        (torch.ones(1, 1, 9, 9), {"sigmas": (3.0, -1.0)}, "sigmas must be > 0 px"),
        (torch.ones(1, 1, 9, 9), {"weights": (1.0,)}, "weights must be 3 numbers > 0"),
    ],
)
def test_wrong_retinex_is_refused(image, settings, message):
    with pytest.raises(ValueError, match=message):
        multi_scale(image, **settings)


def test_stills_of_8_and_16_bit_are_the_same_scene(tmp_path):
    grey = np.random.default_rng(0).integers(0, 256, (40, 50), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    cv2.imwrite(str(tmp_path / "b.png"), grey.astype(np.uint16) * 257)
    torch.testing.assert_close(read_still(tmp_path / "a.png"), read_still(tmp_path / "b.png"))
    whole = image_scene(tmp_path / "a.png", reflected=False)
    centre = whole.value(torch.tensor([[0.5, 0.5]], dtype=torch.float64))
    assert float(centre) == pytest.approx(float(grey[20, 25]), abs=1e-3)
    assert image_light(tmp_path / "a.png", sigma=5.0).image.shape == (40, 50)


def test_stills_that_are_none(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ValueError, match="not an image"):
        read_still(tmp_path / "text.png")
    with pytest.raises(ValueError, match="no such still"):
        image_scene(tmp_path / "missing.png")


@pytest.mark.parametrize("name", ["circuit_die_m1", "circuit_mclk", "circuit_pad_die"])
def test_real_micrographs_split_into_surface_and_light(data, name):
    image = read_still(data / "stills" / f"{name}.png")[None, None]
    parts = single_scale(image)
    assert float((parts.reflected * parts.incident - image).abs().max()) < 1e-5
    rms = [float(x.diff(dim=-1).square().mean().sqrt()) for x in (image, parts.incident)]
    assert rms[1] < 0.02 * rms[0]
