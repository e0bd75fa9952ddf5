"""The simulated workstation: stage dynamics against analytic solutions, geometry, what its camera shows."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc.core.pose import compose, inverse, transform
from torch_ecc.records.calibration import Calibration
from torch_ecc.servo import StageJacobian
from torch_ecc.sim import Camera, PlaneWaves
from torch_ecc.sim.scene.probe import Probe
from torch_ecc.sim.stage.axes import Axis, MultiAxisStage
from torch_ecc.sim.stage.workstation import Microscope, Mount, Workstation

SCENE = PlaneWaves.random(30, seed=3)
FREE = {"step": 0.0, "speed": 1e3}


def ten(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_lag_of_first_order():
    """T u' + u = c from rest: u = c (1 - e^(-t/T)), q = c t - c T (1 - e^(-t/T))."""
    stage, lag, c, t = MultiAxisStage([Axis(lag=0.2, **FREE)], [1.0]), 0.2, 30.0, 0.37
    stage.advance(ten(c), t)
    rise = 1 - math.exp(-t / lag)
    assert float(stage.velocity) == pytest.approx(c * rise, rel=1e-12)
    assert float(stage.position) == pytest.approx(1 + c * t - c * lag * rise, rel=1e-12)


def test_lag_of_second_order():
    """An underdamped lag overshoots as the textbook's step response says."""
    lag, zeta, c, t = 0.1, 0.4, 20.0, 0.25
    stage = MultiAxisStage([Axis(lag=lag, damping=zeta, **FREE)], [0.0])
    stage.advance(ten(c), t)
    w = 1 / lag
    wd = w * math.sqrt(1 - zeta**2)
    u = c * (1 - math.exp(-zeta * w * t) * (math.cos(wd * t) + zeta * w / wd * math.sin(wd * t)))
    assert float(stage.velocity) == pytest.approx(u, rel=1e-10)


@settings(max_examples=20, deadline=None)
@given(
    lag=st.sampled_from([0.0, 0.01, 0.3]),
    damping=st.sampled_from([None, 0.3, 1.0, 2.0]),
    cut=st.floats(0.01, 0.99),
    c=st.floats(-50, 50),
)
def test_time_may_be_cut_anywhere(lag, damping, cut, c):
    axis = Axis(lag=lag, damping=damping, **FREE)
    whole, parts = MultiAxisStage([axis], [0.0]), MultiAxisStage([axis], [0.0])
    whole.advance(ten(c), 0.5)
    parts.advance(ten(c), 0.5 * cut)
    parts.advance(ten(c), 0.5 * (1 - cut))
    torch.testing.assert_close(whole.position, parts.position, atol=1e-9, rtol=0)
    torch.testing.assert_close(whole.velocity, parts.velocity, atol=1e-9, rtol=0)


def test_end_stops_speed_and_steps():
    stage = MultiAxisStage([Axis(low=-1, high=1, speed=2.0, lag=0.0, step=0.25)], [0.0])
    stage.advance(ten(100.0), 0.2)  # cut to 2 um/s: 0.4 um, shown as a whole number of steps
    assert stage.position.tolist() == [0.5]
    assert stage.velocity.tolist() == [2.0]
    for _ in range(5):
        stage.advance(ten(100.0), 0.2)
    assert stage.position.tolist() == [1.0]
    assert stage.velocity.tolist() == [0.0]
    speed, acceleration, travel = stage.limits
    assert (speed.tolist(), acceleration.tolist(), travel.tolist()) == ([2.0], [500.0], [[-2.0, 0.0]])


def test_noise_is_there_only_while_moving():
    axis = Axis(noise=0.5, lag=0.0, step=0.0, low=-1e6, high=1e6)
    stage = MultiAxisStage([axis] * 400, [0.0] * 400, seed=1)
    stage.advance(torch.zeros(400), 1.0)
    assert not stage.position.any()
    stage.advance(torch.full((400,), 10.0), 1.0)
    assert float(stage.position.mean()) == pytest.approx(10, abs=0.1)
    assert float(stage.position.std()) == pytest.approx(0.5, rel=0.15)


@settings(max_examples=25, deadline=None)
@given(
    angle=st.floats(-30, 30),
    scale=st.floats(0.1, 2),
    axis=st.tuples(st.floats(-200, 200), st.floats(-200, 200)),
    position=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3)),
)
def test_geometry(angle, scale, axis, position):
    """Mounts invert, and the image Jacobian is the derivative of the pose by the stage's position."""
    mount = Mount(home=(100, 80), home_deg=20, um_per_px=scale, axis_angle_deg=angle, axis=axis)
    q = ten(*position)
    pose = mount.pose(q)
    torch.testing.assert_close(mount.position(pose), q, atol=1e-9, rtol=0)
    derivative = torch.autograd.functional.jacobian(mount.pose, q)
    jacobian = StageJacobian(Calibration(scale, math.radians(angle)), axis)
    torch.testing.assert_close(jacobian(pose), derivative, atol=1e-8, rtol=1e-9)


def test_home_and_the_axis_of_rotation():
    mount = Mount(home=(100, 80), axis=(30, -10))
    assert mount.pose(ten(0, 0, 0)).tolist() == pytest.approx([100, 80, 0])
    turned = mount.pose(ten(0, 0, 2.0))
    still = transform(turned, ten(30, -10)[None])[0]
    assert still.tolist() == pytest.approx([130, 70])


def workstation(delay: int = 0, noise: float = 0.0, height: float = 0.0) -> Workstation:
    microscope = Microscope(camera=Camera(size=(100, 130), noise_sigma=noise, bits=None), delay=delay)
    mounts = {"substrate": Mount(home=(50, 50)), "probe": Mount(home=(105, 50))}
    return Workstation((SCENE, Probe.infinity(scale=0.5)), mounts, microscope, height=height)


def test_the_camera_is_late():
    """With a delay of 2 the same commands give the same frames two frames later."""
    prompt, late = workstation(), workstation(delay=2)
    frames: dict[str, list[torch.Tensor]] = {"prompt": [], "late": []}
    for name, station in (("prompt", prompt), ("late", late)):
        plant = station.plant("substrate")
        for k in range(6):
            frames[name].append(plant.frame())
            plant.command(ten(10.0 * k, 5.0, 0.1))
    for k in range(4):
        assert torch.equal(frames["late"][k + 2], frames["prompt"][k])
    assert not torch.equal(frames["prompt"][5], frames["prompt"][4])


def test_commands_move_only_what_they_name():
    station = workstation()
    before = station.truth("probe")
    plant = station.plant("substrate")
    plant.command(ten(30.0, 0.0, 0.0))
    for _ in range(30):
        plant.frame()
    moved = station.truth("substrate") - ten(50, 50, 0)
    assert float(moved[0]) == pytest.approx(30 * (1 - 0.005) / 0.275, rel=1e-3)
    assert moved[1:].tolist() == [0, 0]
    assert torch.equal(station.truth("probe"), before)


def test_the_probe_hides_the_substrate():
    """What is drawn is the exact scene: the probe's grey where it is opaque, the substrate's elsewhere."""
    probe, relative = Probe.infinity(scale=0.5), ten(3.3, -2.0, 0.3)
    scene = probe.over(SCENE, relative, 4.0)
    pose = ten(40, 30, -0.2)
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (60, 80)), indexing="ij")
    points = transform(inverse(pose), torch.stack((x, y), -1).reshape(-1, 2))
    drawn = scene.render(pose[None], (60, 80)).flatten().double()
    torch.testing.assert_close(drawn, scene.value(points), atol=2e-3, rtol=0)
    own = transform(inverse(compose(pose, relative)), torch.stack((x, y), -1).reshape(-1, 2))
    cover = scene.cover.value(own)
    below = SCENE.render(pose[None], (60, 80)).flatten().double()
    assert float((drawn - below).abs()[cover < 1e-9].max()) < 2e-3
    head = (own.abs() < 3).all(1)
    assert float((cover[head] - 1).abs().max()) < 1e-6
    probed = scene.value(points.requires_grad_())
    (slope,) = torch.autograd.grad(probed.sum(), points)
    torch.testing.assert_close(scene.gradient(points.detach()), slope, atol=1e-6, rtol=0)


def test_defocus_blurs_the_probe_alone():
    """Out of focus the head's straight edge has the slope of a wider Gaussian; the substrate stays as it is."""
    probe, edge = Probe.infinity(scale=0.5, defocus=0.3), ten(6, -26)[None]
    for height, sigma in ((0.0, 1.0), (10.0, math.hypot(1, 3))):
        scene = probe.over(SCENE, ten(0, 0, 0), height)
        slope = float(scene.cover.gradient(edge).norm())
        assert slope == pytest.approx(1 / (sigma * math.sqrt(math.tau)), rel=1e-3)
        assert float(scene.value(edge - 200)) == pytest.approx(float(SCENE.value(edge - 200)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Axis(low=1, high=1), "low must be below high, got 1 and 1"),
        (lambda: Axis(speed=0), "speed must be > 0, got 0"),
        (lambda: Axis(acceleration=-1), "acceleration must be > 0, got -1"),
        (lambda: Axis(lag=-0.1), "lag must be >= 0, got -0.1"),
        (lambda: Axis(damping=0), "damping must be > 0 or None, got 0"),
        (lambda: MultiAxisStage([Axis()], [0.0, 1.0]), r"one value per axis \(1\), got \(2,\)"),
        (lambda: MultiAxisStage([Axis()], [200.0]), "axis 0 reaches from -150 to 150, got position 200"),
        (lambda: Mount(home=(0, 0), um_per_px=0), "um_per_px must be > 0, got 0"),
        (lambda: Microscope(period=0), "period must be > 0 s, got 0"),
        (lambda: Microscope(delay=-1), "delay must be >= 0 frames, got -1"),
        (lambda: Microscope(camera=Camera(exposure=0.5)), "exposure must be 0, got 0.5"),
        (lambda: Probe.infinity(scale=0), "scale must be > 0 and defocus >= 0, got 0"),
        (
            lambda: Workstation(
                (SCENE, Probe.infinity()),
                {"substrate": Mount(home=(0, 0)), "probe": Mount(home=(0, 0))},
                Microscope(),
                start={"probe": (0, 0, 0.1)},
            ),
            "the probe cannot turn, got a start at 0.1 rad",
        ),
    ],
)
def test_wrong_settings_have_words(make, message):
    with pytest.raises(ValueError, match=message):
        make()
