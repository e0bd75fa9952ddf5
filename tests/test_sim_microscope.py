"""The microscope: um to px as Calibration has it, optics, exposure, frames along the stage's motion."""

from __future__ import annotations

from math import asin, hypot, radians, tan, tau

import pytest
import torch

from torch_ecc.core.pose import transform
from torch_ecc.records.calibration import Calibration, calibrate
from torch_ecc.sim import Floor, Microscope, PlaneWaves, Sensors, SensorSettings, Stage, StageSettings

STILL = Floor(speed_um_s=0.0)
SMALL = Microscope(region_px=(48, 64), floor=STILL, wavelength_um=0.05)
WAVES = PlaneWaves.random(40, seed=1)


def motion(seconds: float = 0.5, rate_hz: float = 400.0, floor: Floor = STILL):
    t = torch.arange(int(seconds * rate_hz) + 1, dtype=torch.float64) / rate_hz
    command = torch.stack((4 * (tau * 2 * t).sin(), 3 * (tau * t).sin(), 1e-3 * (tau * t).sin()), 1)
    return Stage(StageSettings(floor=floor), seed=1).run(command, rate_hz)


def test_scale_and_field_are_those_of_table_ii():
    near, far = Microscope(zoom=3.55), Microscope(zoom=0.7, region_px=(2048, 2048))
    assert near.um_per_px == pytest.approx(5.5 / 35.5)
    assert far.field_um == pytest.approx((2048 * 5.5 / 7,) * 2)


def test_poses_are_those_of_calibration():
    """Calibration with the same scale and angle gives the stage's moves back; theta has its sign."""
    scope = Microscope(axis_angle=0.05)
    poses = motion().pose
    pixels = scope.poses_px(poses)
    back = Calibration(scope.um_per_px, scope.axis_angle).to_physical(pixels - scope.poses_px(torch.zeros(3).double()))
    torch.testing.assert_close(back, poses, rtol=0, atol=1e-10)
    fit = calibrate(pixels, poses[:, :2])
    assert fit.calibration.axis_angle == pytest.approx(0.05, abs=1e-9)


def test_every_point_of_the_part_is_seen_where_it_is():
    """A rigid motion: the image of any point of the part, not just of the one in the middle."""
    scope = Microscope(axis_angle=-0.1, view_um=(800.0, -500.0))
    pose = torch.tensor((3.0, -2.0, 0.004), dtype=torch.float64)
    g = torch.Generator().manual_seed(0)
    marks = 100 * torch.randn(20, 2, generator=g, dtype=torch.float64)  # in scene px
    calibration = Calibration(scope.um_per_px, scope.axis_angle)
    on_part = calibration.to_physical(torch.nn.functional.pad(marks, (0, 1)))[:, :2] + torch.tensor(scope.view_um)
    seen = transform(scope.poses_px(pose), marks)
    moved = torch.nn.functional.pad(transform(pose, on_part) - torch.tensor(scope.view_um), (0, 1))
    middle = torch.tensor((320.0, 240.0), dtype=torch.float64)
    torch.testing.assert_close(seen, calibration.to_pixels(moved)[:, :2] + middle, rtol=0, atol=1e-9)


def test_parasitic_translation_is_lever_times_angle():
    """Fig. 9: the template is off the rotation centre by r and moves by 2 r sin(theta / 2)."""
    scope = Microscope(zoom=0.7, view_um=(900.0, -600.0), axis_angle=0.0)
    theta = torch.linspace(0, radians(0.24), 7, dtype=torch.float64)
    pixels = scope.poses_px(torch.stack((0 * theta, 0 * theta, theta), 1))
    chord = (pixels[:, :2] - pixels[0, :2]).norm(dim=1) * scope.um_per_px
    torch.testing.assert_close(chord, 2 * hypot(900, 600) * (theta / 2).sin(), rtol=0, atol=1e-9)


def test_camera_has_the_optics_of_the_lens():
    camera = Microscope(defocus_um=4.0, exposure_s=0.004).camera(noise_sigma=2.0)
    assert camera.size == (480, 640)
    assert camera.noise_sigma == 2.0
    assert camera.exposure == pytest.approx(0.4)
    assert camera.defocus_radius * 5.5 / 35.5 == pytest.approx(4 * tan(asin(0.28)))
    assert camera.blur_sigma * 5.5 / 35.5 == pytest.approx(0.21 * 0.55 / 0.28)
    assert Microscope(zoom=0.7).camera().blur_sigma < 0.6


def test_frames_follow_the_stage():
    moved = motion()
    camera = SMALL.camera(bits=None)
    film = SMALL.film(WAVES, moved, start_s=0.013, camera=camera)
    times = SMALL.times(moved, start_s=0.013)
    assert len(film) == len(times) == 49
    assert float(times[0]) == pytest.approx(0.013 + 0.001)
    torch.testing.assert_close(film.poses, SMALL.poses_px(moved.at(times)), rtol=0, atol=1e-12)
    # A brute-force exposure of 40 instants along the true motion.
    instants = times[7] + (torch.arange(40, dtype=torch.float64) + 0.5 - 20) / 40 * SMALL.exposure_s
    sharp = SMALL.camera(bits=None, exposure=0.0)
    mean = sharp.capture(WAVES, SMALL.poses_px(moved.at(instants))).mean(0)
    assert float((film.batch(7, 8)[0] - mean).abs().max()) < 0.05
    assert float((sharp.capture(WAVES, film.poses[7:8])[0] - mean).abs().max()) > 0.05


def test_no_exposure_needs_no_velocity():
    scope = Microscope(region_px=(24, 32), exposure_s=0.0, floor=STILL)
    film = scope.film(WAVES, motion(0.1))
    assert film.velocities is None
    assert film.batch(0, 2).shape == (2, 1, 24, 32)


def test_the_lens_shakes_in_the_images_only():
    """The column's vibration is in the frames, seeded, and not in what sensors at the stage read."""
    moved = motion()
    scope = Microscope(floor=Floor(), region_px=(48, 64))
    film, still = scope.film(WAVES, moved, seed=3), SMALL.film(WAVES, moved)
    shake = (film.poses - still.poses) * scope.um_per_px
    assert 0.01 < float(shake[:, :2].std()) < 0.5
    assert float(shake[:, 2].abs().max()) == 0
    assert torch.equal(film.poses, scope.film(WAVES, moved, seed=3).poses)
    assert not torch.equal(film.poses, scope.film(WAVES, moved, seed=4).poses)
    exact = SensorSettings(noise_um=0.0, nonlinearity=0.0, resolution_um=0.0)
    record = Sensors(exact).record(moved)
    torch.testing.assert_close(exact.mounting.pose(record.distance_um), moved.at(record.times_s), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Microscope(zoom=0.0), "Microscope: zoom must be between 0.7 and 3.55, got 0.0"),
        (lambda: Microscope(objective=0.0), "Microscope: objective must be > 0, got 0.0"),
        (lambda: Microscope(aperture=1.2), r"Microscope: aperture must be in \(0, 1\), got 1.2"),
        (lambda: Microscope(exposure_s=0.02), "Microscope: exposure_s must be between 0 and 0.01 s, got 0.02"),
        (
            lambda: Microscope(region_px=(4096, 640)),
            r"Microscope: region_px must fit \(2048, 2048\), got \(4096, 640\)",
        ),
        (lambda: SMALL.poses_px(torch.zeros(5, 2)), r"poses_px: poses must be \(..., 3\), got \(5, 2\)"),
        (lambda: SMALL.times(motion(), start_s=0.6), "times: start_s must leave room for a frame"),
        (
            lambda: SMALL.film(WAVES, motion(), camera=Microscope().camera()),
            r"film: the camera must have the size \(48, 64\) of the region, got \(480, 640\)",
        ),
        (
            lambda: SMALL.film(WAVES, Stage(batch=2).run(torch.zeros(9, 3), 1.0)),
            r"film: the motion must be of one stage, \(T, 3\), got \(2, 9, 3\)",
        ),
    ],
)
def test_messages(call, message):
    with pytest.raises(ValueError, match=message):
        call()
