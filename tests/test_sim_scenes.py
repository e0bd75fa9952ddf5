"""Scenes: value, gradient and rendering are one function; layouts are reproducible and stay within the scale."""

from __future__ import annotations

from math import pi, sqrt

import pytest
import torch

from torch_ecc.core.pose import compose, inverse, transform
from torch_ecc.sim import Pads, PlaneWaves, Speckle, Sum, micrograph
from torch_ecc.sim.scene.layout import Rectangle

SIZE = (90, 120)
SMALL = Pads.of([Rectangle(3, -5, 40, 22, 60, 0.3), Rectangle(-20, 10, 3, 30, -40)], sigma=1.2, base=90)
SCENES = {
    "waves": PlaneWaves.random(seed=3),
    "fine": PlaneWaves.random(spectrum="fine", seed=4),
    "pads": SMALL,
    "wafer": Pads.wafer(seed=2),
    "speckle": Speckle.random(6000, seed=5),
    "micrograph": micrograph(),
    "sum": Sum((SMALL, PlaneWaves.random(40, mean=0.0, seed=6))),
}


@pytest.fixture(params=SCENES)
def scene(request):
    return SCENES[request.param]


def points(count: int, reach: float = 60.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(count)
    return reach * (2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1)


def pose(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


@pytest.mark.parametrize("theta", [0.0, 0.3, pi / 2, -2.0, 13.0])
def test_render_is_value_at_every_pixel(scene, theta, device):
    where = pose(61.3, 40.8, theta)
    frame = scene.render(where.to(device), SIZE).cpu()
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    pixels = torch.stack((x, y), -1)[::7, ::5].reshape(-1, 2).double()
    exact = scene.value(transform(inverse(where[0]), pixels))
    torch.testing.assert_close(frame[0, 0, ::7, ::5].flatten().double(), exact, atol=2e-3, rtol=0)


def test_gradient_is_the_derivative_of_value(scene):
    where = points(40).requires_grad_()
    (derivative,) = torch.autograd.grad(scene.value(where).sum(), where)
    torch.testing.assert_close(scene.gradient(where.detach()), derivative, atol=1e-9, rtol=1e-9)


def test_shapes_follow_the_points(scene):
    where = points(6).reshape(2, 3, 2)
    assert scene.value(where).shape == (2, 3)
    assert scene.gradient(where).shape == (2, 3, 2)
    assert scene.value(where).dtype == torch.float64


def test_batches_render_as_single_frames(scene):
    poses = torch.cat((pose(60, 45, 0.1), pose(70, 30, -0.4), pose(-5000, 0, 0)))
    frames = scene.render(poses, SIZE)
    assert frames.shape == (3, 1, *SIZE)
    assert frames.dtype == torch.float32
    torch.testing.assert_close(frames[1:2], scene.render(poses[1:2], SIZE))
    assert scene.render(poses[:0], SIZE).shape == (0, 1, *SIZE)


@pytest.mark.parametrize("spectrum", ["natural", "fine"])
def test_waves_have_the_gradient_asked_for(spectrum):
    scene = PlaneWaves.random(rms_gradient=5.0, spectrum=spectrum, seed=1)
    rms = scene.gradient(points(20000, 4000.0)).square().mean(0).sqrt()
    torch.testing.assert_close(rms, torch.full_like(rms, 5.0), rtol=0.05, atol=0)
    frequency = scene.waves.norm(dim=1) / (2 * pi)
    assert float(frequency.max()) <= 0.25


@pytest.mark.parametrize("name", ["waves", "fine", "wafer", "speckle", "micrograph"])
def test_default_scenes_stay_clear_of_clipping(name):
    frame = SCENES[name].render(pose(320, 240, 0.2), (480, 640))
    assert float(frame.min()) > 2
    assert float(frame.max()) < 253


def test_seeds_decide():
    for make in (PlaneWaves.random, Pads.wafer, micrograph):
        where = points(10)
        assert torch.equal(make(seed=7).value(where), make(seed=7).value(where))
        assert not torch.equal(make(seed=7).value(where), make(seed=8).value(where))


def test_blur_keeps_the_light():
    """A blurred rectangle has the integral of the sharp one."""
    scene = Pads.of([Rectangle(0.3, -0.2, 20, 12, 50, 0.4)], sigma=1.5)
    assert float(scene.render(pose(50, 40, 0), SIZE).sum()) == pytest.approx(50 * 20 * 12, rel=1e-5)


def test_rectangles_that_share_an_edge_join_without_a_seam():
    whole = Pads.of([Rectangle(0, 0, 40, 10, 50)])
    halves = Pads.of([Rectangle(-10, 0, 20, 10, 50), Rectangle(10, 0, 20, 10, 50)])
    torch.testing.assert_close(whole.value(points(200)), halves.value(points(200)))


def test_a_turned_rectangle_is_a_turned_scene():
    turn = torch.tensor([2.0, -3.0, 0.7], dtype=torch.float64)
    upright, turned = Pads.of([Rectangle(0, 0, 30, 12, 50)]), Pads.of([Rectangle(2, -3, 30, 12, 50, 0.7)])
    torch.testing.assert_close(turned.value(transform(turn, points(100))), upright.value(points(100)))
    torch.testing.assert_close(
        turned.render(pose(60, 45, 0.2), SIZE), upright.render(compose(pose(60, 45, 0.2), turn[None]), SIZE)
    )


def test_an_edge_has_the_slope_of_its_gaussian():
    edge = Pads.of([Rectangle(50, 0, 100, 500, 80)], sigma=1.3)
    slope = edge.gradient(torch.zeros(1, 2, dtype=torch.float64))[0]
    torch.testing.assert_close(slope, torch.tensor([80 / (sqrt(2 * pi) * 1.3), 0], dtype=torch.float64))


EMPTY = torch.zeros(0, 3, dtype=torch.float64)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PlaneWaves.random(0), "count must be at least 1, got 0"),
        (lambda: PlaneWaves.random(fmax=0.7), r"fmax must be in \(0, 0.5\] cycles per px, got 0.7"),
        (lambda: PlaneWaves.random(rms_gradient=-1), "rms_gradient must be > 0, got -1"),
        (lambda: PlaneWaves.random(rms_gradient=70), "leave 0..255"),
        (lambda: PlaneWaves.random(spectrum="pink"), "spectrum must be 'natural' or 'fine', got 'pink'"),
        (lambda: PlaneWaves(EMPTY, EMPTY, EMPTY), r"must be \(J, 2\), \(J,\), \(J,\), got"),
        (lambda: Pads.of([], sigma=0), "sigma must be > 0, got 0"),
        (lambda: Pads(EMPTY, EMPTY, EMPTY), r"must be \(N, 3\), \(N, 2\), \(N,\), got"),
        (lambda: Pads.wafer(pitch=0), "pitch must be > 0, got 0"),
        (lambda: Speckle.random(sigmas=(2, 1)), "sigmas 0 < low <= high"),
        (lambda: Speckle(EMPTY[:, :2], EMPTY, EMPTY), r"must be \(N, 2\), \(N,\), \(N,\), got"),
        (lambda: Sum(()), "parts must hold at least one scene"),
    ],
)
def test_wrong_scenes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_an_empty_layout_is_its_base():
    assert Pads.of([], base=80).render(pose(10, 10, 0), (4, 5)).unique().tolist() == [80]
    assert Pads.of([], base=80).value(points(3)).tolist() == [80] * 3
