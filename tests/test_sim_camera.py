"""The camera: light, optics, noise and quantisation do what they say, the same for any batch."""

from __future__ import annotations

from math import exp, pi, sin, tau

import pytest
import torch

from torch_ecc.sim import (
    Camera,
    Drift,
    FieldLight,
    GradientLight,
    LampDrift,
    Lights,
    Occluder,
    Pads,
    PlaneWaves,
    SpotLight,
    VignetteLight,
    harmonic,
    noise_sigma,
    placed,
)
from torch_ecc.sim.camera.optics import disc
from torch_ecc.sim.camera.sensor import generator
from torch_ecc.sim.scene.layout import Rectangle

SIZE = (60, 81)
SCENE = PlaneWaves.random(60, seed=2)
FLAT = Pads.of([], base=100.0)
POSES = placed(harmonic((5.0, 3.0, 0.2), 6), (40, 30))
STILL = POSES[:1]


def float_camera(**settings: object) -> Camera:
    return Camera(size=SIZE, bits=None, **settings)


def test_a_plain_camera_shows_the_scene():
    torch.testing.assert_close(float_camera().capture(SCENE, POSES), SCENE.render(POSES, SIZE))


@pytest.mark.parametrize(("bits", "dtype", "scale"), [(8, torch.uint8, 1), (16, torch.uint16, 257)])
def test_counts_are_rounded_grey_levels(bits, dtype, scale):
    frames = Camera(size=SIZE, bits=bits).capture(SCENE, POSES)
    assert frames.dtype == dtype
    assert float((frames.double() / scale - SCENE.render(POSES, SIZE)).abs().max()) <= 0.5 / scale + 1e-4
    bright = Camera(size=SIZE, bits=bits, gain=100.0).capture(SCENE, STILL)
    assert float(bright.double().max()) == 255 * scale


@pytest.mark.parametrize("bits", [8, 16, None])
def test_a_frame_depends_on_its_index_and_the_seed_only(bits):
    camera = Camera(size=SIZE, bits=bits, noise_sigma=3.0, full_well=5000.0, light=SpotLight(), drift=Drift(period=5.0))
    whole = camera.capture(SCENE, POSES, seed=4)
    parts = [camera.capture(SCENE, POSES[i : i + 1], seed=4, first=i) for i in range(len(POSES))]
    assert torch.equal(whole.float(), torch.cat(parts).float())
    assert not torch.equal(whole.float(), camera.capture(SCENE, POSES, seed=5).float())


def test_noise_of_neighbouring_frames_and_seeds_is_unrelated():
    draws = [torch.randn(20000, generator=generator(s, i)) for s, i in ((0, 0), (0, 1), (1, 0), (1, 1))]
    correlation = torch.corrcoef(torch.stack(draws)) - torch.eye(4)
    assert float(correlation.abs().max()) < 0.04


def test_noise_has_the_variance_of_the_paper():
    sigma = noise_sigma(0.002)
    noise = float_camera(noise_sigma=sigma).capture(FLAT, STILL.expand(8, 3)) - 100
    assert float((noise / 255).var()) == pytest.approx(0.002, rel=0.02)
    assert abs(float(noise.mean())) < 0.3


def test_shot_noise_is_the_root_of_the_electrons():
    noise = float_camera(full_well=2550.0).capture(FLAT, STILL.expand(8, 3)) - 100
    assert float(noise.std() * 10) == pytest.approx(1000**0.5, rel=0.02)


def test_gain_and_offset_and_their_drift():
    frames = float_camera(gain=0.7, offset=20.0).capture(FLAT, STILL)
    torch.testing.assert_close(frames, torch.full_like(frames, 90.0))
    drifted = float_camera(drift=Drift(gain=0.1, offset=5.0, period=8.0)).capture(FLAT, STILL.expand(3, 3))
    expected = [100 * (1 + 0.1 * sin(tau * i / 8)) + 5 * sin(tau * i / 8) for i in range(3)]
    assert drifted[:, 0, 0, 0].tolist() == pytest.approx(expected)


def test_lights_are_their_formulas():
    """At 20 px right of and 10 px below the centre of a 60 x 81 frame."""
    at, x, y = (..., 0, 39, 60), 19.5 / 40.5 + 0.5 / 40.5, 9.5 / 40.5
    index = torch.tensor([25])
    r2 = (x - 0.3 * 0.0) ** 2 + (y - 0.2) ** 2
    for light, expected in (
        (GradientLight(0.5, 0.3), 1 + 0.5 * x + 0.3 * y),
        (GradientLight(0.5, 0.3, scale_px=100.0), 1 + (0.5 * x + 0.3 * y) * 0.405),
        (SpotLight(period=100.0), 0.55 + 0.6 * exp(-r2 / 0.12)),
        (VignetteLight(0.2), (1 + 0.2 * (x * x + y * y)) ** -2),
        (LampDrift(0.1, 100.0), 1.1),
        (Lights((GradientLight(), LampDrift(0.1, 100.0))), 1.1 * (1 + 0.5 * x + 0.3 * y)),
        (FieldLight(torch.full((3, 4), 7.0)), 1.0),
    ):
        field = light.field(index, SIZE).expand(1, 1, *SIZE)
        assert float(field[at]) == pytest.approx(expected, rel=1e-5), light


def test_light_multiplies_and_moves():
    frames = float_camera(light=SpotLight(period=12.0)).capture(FLAT, STILL.expand(4, 3))
    bright = frames.flatten(1).argmax(1)
    assert len(set(bright.tolist())) == 4
    ramp = FieldLight(torch.linspace(0, 2, 5).expand(3, 5)).field(torch.tensor([0]), SIZE)
    assert float(ramp.mean()) == pytest.approx(1.0)
    assert float(ramp[0, 0, 0, 0]) < float(ramp[0, 0, 0, -1])


def test_blur_of_the_camera_adds_to_blur_of_the_scene():
    """Gaussians: the squares of their widths add; nothing shows at the borders."""
    sharp, soft = (Pads.of([Rectangle(2, 1, 50, 300, 80)], sigma=s, base=60) for s in (1.2, (1.2**2 + 2.0**2) ** 0.5))
    blurred = float_camera(blur_sigma=2.0).capture(sharp, STILL)
    torch.testing.assert_close(blurred, soft.render(STILL, SIZE), atol=0.05, rtol=0)


@pytest.mark.parametrize("radius", [0.4, 1.0, 3.7])
def test_defocus_is_a_disc(radius):
    kernel = disc(radius)
    assert float(kernel.sum()) == pytest.approx(1)
    torch.testing.assert_close(kernel, kernel.flip(0).mT)
    area = 1 / float(kernel.max())
    assert area == pytest.approx(max(1.0, pi * radius**2), rel=0.2)
    spread = float_camera(defocus_radius=radius).capture(FLAT, STILL)
    torch.testing.assert_close(spread, torch.full_like(spread, 100.0))


def test_exposure_smears_along_the_motion_and_keeps_the_pose():
    bar = Pads.of([Rectangle(0, 0, 4, 200, 80)], sigma=1.0)
    speed = torch.tensor([[12.0, 0.0, 0.0]], dtype=torch.float64)
    open_half = float_camera(exposure=0.5, exposure_steps=31).capture(bar, STILL, velocities=speed)[0, 0]
    short = float_camera().capture(bar, STILL)[0, 0]
    x = torch.arange(SIZE[1])

    def moments(frame: torch.Tensor) -> tuple[float, float]:
        profile = frame.sum(0) / frame.sum()
        mean = (profile * x).sum()
        return float(mean), float((profile * (x - mean) ** 2).sum())

    assert moments(open_half)[0] == pytest.approx(moments(short)[0], abs=1e-3)
    assert moments(open_half)[1] - moments(short)[1] == pytest.approx(6.0**2 / 12, rel=0.02)


def test_occluders_cover_move_and_leave():
    probe = Occluder((10, 20), (8, 5), level=30.0, velocity=(10.0, 0.0), first=1, last=3)
    frames = float_camera(occluders=(probe,)).capture(FLAT, STILL.expand(4, 3))[:, 0]
    assert [float(f.min()) for f in frames] == [100, 30, 30, 100]
    assert float(frames[1][20, 20]) == 30
    assert float(frames[2][20, 30]) == 30
    assert float((100 - frames[1]).sum()) == pytest.approx(70 * 16 * 10, rel=0.02)
    oval = float_camera(occluders=(Occluder((40, 30), (12, 9), shape="ellipse", level=0.0),)).capture(FLAT, STILL)
    assert float((100 - oval).sum()) == pytest.approx(100 * pi * 12 * 9, rel=0.02)


def test_devices_agree(device):
    camera = Camera(size=SIZE, noise_sigma=2.0, light=GradientLight(), blur_sigma=1.0)
    frames = camera.capture(SCENE, POSES.to(device), seed=3)
    assert frames.device.type == device.type
    assert float((frames.cpu().float() - camera.capture(SCENE, POSES, seed=3).float()).abs().max()) <= 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Camera(noise_sigma=-1.0), "Camera: noise_sigma must be >= 0, got -1.0"),
        (lambda: Camera(size=(0, 5)), r"Camera: size must be \(h, w\) of at least 1 px, got \(0, 5\)"),
        (lambda: Camera(bits=12), "Camera: bits must be 8, 16 or None, got 12"),
        (lambda: Camera(gain=0.0), "Camera: gain must be > 0, got 0.0"),
        (lambda: Camera(full_well=0.0), "Camera: full_well must be > 0 electrons, got 0.0"),
        (lambda: Camera(exposure=1.5), "Camera: exposure must be at most 1 frame time, got 1.5"),
        (lambda: Camera(exposure_steps=0), "Camera: exposure_steps must be at least 1, got 0"),
        (lambda: Camera(blur_sigma=float("nan")), "Camera: blur_sigma must be >= 0, got nan"),
        (lambda: Camera().capture(SCENE, POSES[0]), r"capture: poses must be \(B, 3\), got \(3,\)"),
        (
            lambda: Camera(exposure=0.5).capture(SCENE, POSES),
            r"an exposure needs velocities of shape \(6, 3\), got None",
        ),
        (lambda: noise_sigma(-0.001), "noise_sigma: variance must be >= 0, got -0.001"),
        (lambda: Drift(gain=1.0), r"Drift: gain must be in \(-1, 1\), got 1.0"),
        (lambda: Drift(period=0.0), "Drift: period must be > 0 frames, got 0.0"),
        (lambda: GradientLight(scale_px=0.0), "GradientLight: scale_px must be > 0, got 0.0"),
        (lambda: SpotLight(spread=0.0), "SpotLight: spread must be > 0, got 0.0"),
        (lambda: SpotLight(floor=-0.1), "SpotLight: floor and floor \\+ height must be >= 0"),
        (lambda: VignetteLight(edge=-0.1), "VignetteLight: edge must be >= 0, got -0.1"),
        (lambda: LampDrift(amplitude=1.1), r"LampDrift: amplitude must be in \[0, 1\], got 1.1"),
        (lambda: FieldLight(torch.zeros(3, 4)), "FieldLight: image must be finite, not negative and not dark"),
        (lambda: FieldLight(torch.ones(3)), r"FieldLight: image must be \(h, w\), got \(3,\)"),
        (lambda: Occluder((0, 0), (0, 1)), r"Occluder: half_size must be > 0, got \(0, 1\)"),
        (lambda: Occluder((0, 0), (1, 1), shape="star"), "shape must be 'ellipse' or 'rectangle', got 'star'"),
    ],
)
def test_wrong_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
