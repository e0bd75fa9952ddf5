"""Capacitive sensors: the exact inverse, saturation, the error budget against what happens, calibration."""

from __future__ import annotations

from math import atan, pi, radians

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc.sim import (
    Floor,
    Mounting,
    Sensors,
    SensorSettings,
    Stage,
    StageSettings,
    calibrate_mounting,
    error_budget,
    nonlinear_modes,
)

IDEAL = {"noise_um": 0.0, "nonlinearity": 0.0, "resolution_um": 0.0}
SKEW = Mounting(
    place_um=(-14000.0, 16500.0, 3000.0),
    standoff_um=(105.0, 90.0, 110.0),
    tilt_rad=(0.01, -0.02, 0.03),
    normal_rad=(-pi / 2 + 0.02, pi - 0.05),
)


def workspace(count: int, seed: int = 0) -> torch.Tensor:
    """Poses (N, 3) anywhere in the workspace of Table II, um, um, rad."""
    g = torch.Generator().manual_seed(seed)
    half = torch.tensor((15.0, 15.0, radians(0.12)), dtype=torch.float64)
    return (2 * torch.rand(count, 3, generator=g, dtype=torch.float64) - 1) * half


@settings(max_examples=200, deadline=None)
@given(
    st.floats(-30, 30),
    st.floats(-30, 30),
    st.floats(-0.3, 0.3),
    st.tuples(*[st.floats(-3, 3)] * 2),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3),
)
def test_the_inverse_is_exact(x, y, theta, turns, tilts):
    """1e-9 um over far more than the workspace and for any mounting: faces turned and square or not, sensors askew."""
    mounting = Mounting(normal_rad=(turns[0], turns[0] + 1.0 + turns[1] / 3.5), tilt_rad=tilts)
    pose = torch.tensor((x, y, theta), dtype=torch.float64)
    back = mounting.pose(mounting.distance(pose))
    torch.testing.assert_close(back[:2], pose[:2], rtol=0, atol=1e-9)
    torch.testing.assert_close(back[2], pose[2], rtol=0, atol=1e-13)


@pytest.mark.parametrize("mounting", [Mounting(), SKEW])
def test_the_inverse_is_exact_over_the_workspace(mounting):
    poses = workspace(20000).reshape(4, 5000, 3)
    assert float((mounting.pose(mounting.distance(poses)) - poses).abs().max()) < 1e-9


def test_two_square_sensors_tell_the_tangent():
    """tan theta = (d_1 - d_2) / D, theta itself for small angles, and translations as they are."""
    mounting = Mounting()
    baseline = mounting.place_um[1] - mounting.place_um[0]
    for theta in (1e-4, 0.004, 0.1):
        d = mounting.distance(torch.tensor((0.0, 0.0, theta), dtype=torch.float64))
        assert atan(float(d[0] - d[1]) / baseline) == pytest.approx(theta, rel=1e-12)
        assert abs(float(d[0] - d[1]) / baseline / theta - 1) < theta**2
    move = torch.tensor(((3.0, -2.0, 0.0),), dtype=torch.float64)
    change = mounting.distance(move) - mounting.distance(0 * move)
    torch.testing.assert_close(change, torch.tensor(((2.0, 2.0, -3.0),)).double(), rtol=0, atol=1e-9)


def test_readings_are_the_distance_within_noise_bend_and_steps():
    poses = workspace(4000)
    exact = Mounting().distance(poses)
    torch.testing.assert_close(Sensors(SensorSettings(**IDEAL)).read(poses)[0], exact)
    steps = Sensors(SensorSettings(**{**IDEAL, "resolution_um": 0.01})).read(poses)[0]
    torch.testing.assert_close(steps, (exact * 100).round() / 100)
    assert float((steps - exact).std()) == pytest.approx(0.01 / 12**0.5, rel=0.02)
    noise = Sensors(SensorSettings(**{**IDEAL, "noise_um": 3e-3})).read(poses)[0] - exact
    assert float(noise.std()) == pytest.approx(3e-3, rel=0.03)
    assert float(torch.corrcoef(noise.T).fill_diagonal_(0).abs().max()) < 0.06
    y = torch.linspace(-99, 99, 400, dtype=torch.float64)
    poses = torch.stack((y, y, 0 * y), 1)  # the whole range
    bent = Sensors(SensorSettings(**{**IDEAL, "nonlinearity": 1e-3}), batch=50).read(poses)[0]
    bent = bent - Mounting().distance(poses)
    assert 0.18 < float(bent.abs().max()) <= 0.2  # 0.1 % of 200 um


def test_out_of_range_is_clipped_and_flagged():
    mounting = Mounting(standoff_um=(10.0, 100.0, 190.0))
    poses = torch.tensor(((0.0, 0.0, 0.0), (-15.0, 0.0, 0.0), (0.0, 15.0, 0.0)), dtype=torch.float64)
    value, saturated = Sensors(SensorSettings(mounting=mounting)).read(poses)
    assert saturated.tolist() == [[False] * 3, [False, False, True], [True, False, False]]
    assert float(value[1, 2]) == 200
    assert float(value[2, 0]) == 0
    assert bool(torch.isfinite(mounting.pose(value)).all())


def test_the_default_sees_the_whole_workspace():
    corners = torch.cartesian_prod(*[torch.tensor((-e, e), dtype=torch.float64) for e in (30.0, 30.0, radians(0.24))])
    assert not bool(Sensors().read(corners)[1].any())


def test_records_keep_their_own_clock():
    t = torch.arange(401, dtype=torch.float64) / 200
    command = torch.stack((5 * (3 * t).sin(), 0 * t, 0 * t), 1)
    motion = Stage(StageSettings(floor=Floor(speed_um_s=0.0))).run(command, 200.0)
    record = Sensors(SensorSettings(**IDEAL)).record(motion, start_s=0.3)
    assert float(record.times_s[0]) == 0.3
    assert len(record.times_s) == int(1.7 * 1024) + 1
    torch.testing.assert_close(record.times_s.diff(), torch.full_like(record.times_s[1:], 1 / 1024))
    torch.testing.assert_close(Mounting().pose(record.distance_um), motion.at(record.times_s), rtol=0, atol=1e-9)
    assert not bool(record.saturated.any())


def test_batches_equal_singles_and_seeds_reproduce():
    poses = workspace(50)
    whole = Sensors(batch=3, seed=4).read(poses)[0]
    for i in range(3):
        assert torch.equal(whole[i], Sensors(seed=4, first=i).read(poses)[0])
    assert torch.equal(whole, Sensors(batch=3, seed=4).read(poses)[0])
    assert not torch.equal(whole, Sensors(batch=3, seed=5).read(poses)[0])
    assert not torch.equal(whole[0], whole[1])


def test_budget_is_what_happens():
    """Monte Carlo: each cause by itself, over many sets of sensors."""
    pose = torch.tensor(((9.0, -11.0, 0.0015),), dtype=torch.float64)
    both = torch.cat((torch.zeros_like(pose), pose))
    causes = SensorSettings(resolution_um=3e-3, noise_um=2e-3, nonlinearity=1e-3)
    budget = error_budget(causes, pose)
    mounting = causes.mounting

    noisy = SensorSettings(**{**IDEAL, "noise_um": causes.noise_um})
    told = mounting.pose(Sensors(noisy, seed=1).read(pose.expand(20000, 3))[0])
    torch.testing.assert_close(told.std(0), budget.noise[0], rtol=0.03, atol=0)

    bent = SensorSettings(**{**IDEAL, "nonlinearity": causes.nonlinearity})
    told = mounting.pose(Sensors(bent, batch=4000, seed=1).read(both)[0])
    error = told[:, 1] - told[:, 0] - pose
    torch.testing.assert_close(error.square().mean(0).sqrt(), budget.nonlinearity[0], rtol=0.05, atol=0)

    near = pose + 0.05 * workspace(20000) / torch.tensor((1.0, 1.0, 10.0))
    stepped = SensorSettings(**{**IDEAL, "resolution_um": causes.resolution_um})
    error = mounting.pose(Sensors(stepped).read(near)[0]) - near
    torch.testing.assert_close(error.std(0), budget.resolution[0], rtol=0.03, atol=0)

    parts = torch.stack((budget.resolution, budget.noise, budget.nonlinearity, budget.mounting))
    torch.testing.assert_close(parts.square().sum(0).sqrt(), budget.total)
    assert float(budget.mounting.abs().max()) == 0
    torch.testing.assert_close(budget.noise[0, 2] * 30000 / 2**0.5, torch.tensor(2e-3).double(), rtol=1e-4, atol=0)


def test_one_set_of_sensors_bends_all_its_poses_alike():
    """Covariance of the errors at different poses, over many sets of sensors."""
    poses = torch.tensor(((4.0, -9.0, 0.001), (9.0, -11.0, 0.004), (-3.0, 0.0, -0.002)), dtype=torch.float64)
    settings = SensorSettings(**{**IDEAL, "nonlinearity": 1e-3})
    told = settings.mounting.pose(Sensors(settings, batch=20000, seed=1).read(torch.cat((0 * poses[:1], poses)))[0])
    error = (told[:, 1:] - told[:, :1] - poses).flatten(1)
    modes = nonlinear_modes(settings, poses).flatten(0, 1)
    scale = modes.square().sum(1).sqrt()
    likeness = modes @ modes.mT / torch.outer(scale, scale)
    assert likeness.triu(1).abs().max() > 0.9
    torch.testing.assert_close((error / scale).mT @ (error / scale) / len(error), likeness, rtol=0, atol=0.05)


def test_budget_of_the_mounting_is_what_happens():
    sigma = torch.tensor((30.0, 30.0, 30.0, 0.5, 0.5, 0.5, 1e-3, 1e-3), dtype=torch.float64)
    pose = torch.tensor(((9.0, -11.0, 0.0015),), dtype=torch.float64)
    budget = error_budget(SensorSettings(), pose, mounting_covariance=torch.diag(sigma**2))
    g = torch.Generator().manual_seed(0)
    nominal, zero = Mounting().distance(pose), Mounting().distance(0 * pose)
    errors = []
    for _ in range(1500):
        numbers = Mounting().numbers()
        numbers[[0, 1, 2, 3, 4, 5, 9, 10]] += sigma * torch.randn(8, generator=g, dtype=torch.float64)
        wrong = Mounting.of(numbers)
        errors.append(wrong.pose(nominal) - wrong.pose(zero) - pose)
    spread = torch.cat(errors).std(0)
    torch.testing.assert_close(spread, budget.mounting[0], rtol=0.06, atol=0)


def test_calibration_finds_the_mounting_within_its_sigma():
    poses = workspace(400)
    distance = Sensors(SensorSettings(**{**IDEAL, "noise_um": 1e-3}, mounting=SKEW), seed=2).read(poses)[0]
    drawing = Mounting(tilt_rad=SKEW.tilt_rad, normal_rad=(-pi / 2, pi))
    fit = calibrate_mounting(distance, poses, drawing)
    free = [0, 1, 2, 3, 4, 5, 9, 10]
    wrong = (fit.mounting.numbers() - SKEW.numbers())[free] / fit.covariance.diagonal().sqrt()
    assert float(wrong.abs().max()) < 4
    assert 0.3 < float(wrong.square().mean().sqrt()) < 2
    torch.testing.assert_close(fit.residual_um, torch.full((3,), 1e-3).double(), rtol=0.15, atol=0)
    other = workspace(1000, seed=9)
    far = fit.mounting.pose(SKEW.distance(other)) - other
    before = drawing.pose(SKEW.distance(other)) - other
    assert float(far[:, :2].abs().max()) < 2e-3 < 0.1 * float(before[:, :2].abs().max())
    allowed = error_budget(SensorSettings(mounting=fit.mounting), other, mounting_covariance=fit.covariance).mounting
    moved = far - (fit.mounting.pose(SKEW.distance(0 * other)))
    assert float((moved / allowed).square().mean().sqrt()) < 2.5


def test_tilts_of_the_drawing_hardly_matter():
    """Why calibration leaves them out: 1 mrad of tilt changes displacements by less than the resolution of 0.2 nm."""
    poses = workspace(500)
    tilted = Mounting(tilt_rad=(1e-3, -1e-3, 1e-3))
    fit = calibrate_mounting(tilted.distance(poses), poses, Mounting())
    assert float(fit.residual_um.max()) < 2e-4


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Mounting(place_um=(1.0, 1.0, 0.0)), "Mounting: sensors 1 and 2 must stand apart"),
        (lambda: Mounting(normal_rad=(0.0, pi)), "Mounting: the two faces must not be parallel"),
        (lambda: Mounting(tilt_rad=(1.0, 0.0, 0.0)), "Mounting: tilt_rad must be below 45 degrees"),
        (lambda: Mounting().distance(torch.zeros(4, 2)), r"distance: pose must be \(..., 3\), got \(4, 2\)"),
        (lambda: Mounting().pose(torch.zeros(4, 2)), r"pose: distance_um must be \(..., 3\), got \(4, 2\)"),
        (lambda: SensorSettings(range_um=(5.0, 5.0)), r"SensorSettings: range_um must be \(low, high\)"),
        (lambda: SensorSettings(rate_hz=0.0), "SensorSettings: rate_hz must be > 0, got 0.0"),
        (lambda: SensorSettings(noise_um=-1.0), "SensorSettings: noise_um must be >= 0, got -1.0"),
        (lambda: Sensors(batch=0), "Sensors: batch must be >= 1"),
        (lambda: Sensors().read(torch.zeros(3)), r"read: poses must be \(..., T, 3\), got \(3,\)"),
        (lambda: Sensors(batch=2).read(torch.zeros(3, 5, 3)), r"read: poses for 2 sets must be \(2, T, 3\)"),
        (
            lambda: Sensors().record(Stage().run(torch.zeros(5, 3), 1.0), start_s=5.0),
            "record: start_s must be between 0 and 4 s, got 5.0",
        ),
        (lambda: error_budget(SensorSettings(), torch.zeros(3)), r"error_budget: poses must be \(N, 3\), got \(3,\)"),
        (
            lambda: error_budget(SensorSettings(), torch.zeros(1, 3), mounting_covariance=torch.eye(3)),
            r"mounting_covariance must be \(8, 8\), got \(3, 3\)",
        ),
        (
            lambda: calibrate_mounting(torch.zeros(5, 3), torch.zeros(4, 3), Mounting()),
            r"distances and poses must both be \(N, 3\), got \(5, 3\) and \(4, 3\)",
        ),
        (
            lambda: calibrate_mounting(torch.full((5, 3), float("nan")), torch.zeros(5, 3), Mounting()),
            "distances and poses must be finite",
        ),
        (
            lambda: calibrate_mounting(torch.zeros(9, 3), workspace(9) * torch.tensor((1, 1, 0)), Mounting()),
            "9 poses must be 4 or more that move in x, y and theta",
        ),
    ],
)
def test_messages(call, message):
    with pytest.raises(ValueError, match=message):
        call()
