"""The stage: hysteresis as published, linear dynamics against their analytic solutions, disturbances, bad commands."""

from __future__ import annotations

from itertools import pairwise
from math import exp, pi, radians, sqrt, tau

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torch_ecc.core.pose import transform
from torch_ecc.sim import Floor, Hysteresis, Stage, StageSettings, Vibration
from torch_ecc.sim.stage.hysteresis import play
from torch_ecc.sim.stage.plant import Plant, phi1, phi2, recur

IDEAL = {
    "hysteresis": Hysteresis(share=0.0),
    "compliance": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "creep": 0.0,
    "rotation_center_um": (0.0, 0.0),
    "floor": Floor(speed_um_s=0.0),
    "drift_um": 0.0,
    "drift_urad": 0.0,
}
QUIET = {name: IDEAL[name] for name in ("floor", "drift_um", "drift_urad")}


def rows(*axes: Tensor) -> Tensor:
    """A command (T, 3) from those of its axes that move."""
    return torch.stack([*axes, *[torch.zeros_like(axes[0])] * (3 - len(axes))], 1)


def clock(count: int, rate_hz: float) -> Tensor:
    return torch.arange(count, dtype=torch.float64) / rate_hz


def circle(rate_hz: float, radius: float = 12.0, turn_hz: float = 1.0, seconds: float = 2.0) -> Tensor:
    """A circle that grows from rest within its first half second."""
    t = clock(int(seconds * rate_hz) + 1, rate_hz)
    grow = (pi * t.clamp(max=0.5)).sin() ** 2
    return rows(radius * grow * (tau * turn_hz * t).cos(), radius * grow * (tau * turn_hz * t).sin())


# --- hysteresis


@settings(deadline=None)
@given(st.lists(st.floats(-20, 20), min_size=2, max_size=40), st.floats(0.1, 8))
def test_the_play_is_its_own_recursion(values, reach):
    u = torch.tensor(values, dtype=torch.float64)[:, None, None]
    state, expected = 0.0, []
    for value in values:
        state = max(value - reach, min(value + reach, state))
        expected.append(state)
    assert play(u - reach, u + reach).flatten().tolist() == expected


def triangle(amplitude: float, speed: float, rate_hz: float = 1000.0) -> Tensor:
    """Four legs up and down at one speed, (T, 1) um; the corners fall on samples."""
    corners = torch.tensor((0, 1, -1, 1, -1, 1), dtype=torch.float64) * amplitude
    legs = [
        torch.linspace(float(a), float(b), round(float(abs(b - a)) / speed * rate_hz) + 1, dtype=torch.float64)[:-1]
        for a, b in pairwise(corners)
    ]
    return torch.cat((*legs, corners[-1:]))[:, None]


@pytest.mark.parametrize("lag_s", [0.0, 1e-3])
@pytest.mark.parametrize("speed", [40.0, 1000.0])
def test_loop_closes_with_the_area_of_its_plays(lag_s, speed):
    """Area of a play's loop: 4 r (A - r). The published rate dependence: r grows by beta |du/dt|."""
    model, amplitude, rate = Hysteresis(lag_s=lag_s), 20.0, 1000.0
    u = triangle(amplitude, speed, rate)
    ramps = model.drive(u, 1 / rate)
    v = torch.cat((ramps.value, ramps.value[-1:] + (ramps.slope * ramps.duration).sum(-1)[-1:]))[:, 0]
    period = round(4 * amplitude / speed * rate)
    torch.testing.assert_close(v[-1], v[-1 - period], rtol=0, atol=1e-9)
    mean = ramps.value + (ramps.slope * ramps.duration**2).sum(-1) * rate / 2  # over each step
    area = float((mean * u.diff(dim=0))[-period:].sum())
    reach = model.spacing_um * torch.arange(1, model.plays + 1, dtype=torch.float64) + lag_s * speed
    expected = float((model.weights(reach)[1:] * 4 * reach * (amplitude - reach).clamp_min(0)).sum())
    assert area == pytest.approx(-expected, rel=1e-9)  # the loop is run so that it takes energy


def gap(model: Hysteresis, amplitude: float, frequency_hz: float) -> float:
    """Opening of a sine's loop in the middle, as a part of its height."""
    u = amplitude * (tau * clock(1201, 400)).sin()
    v = model.drive(u[:, None], 1 / (400 * frequency_hz)).value[:, 0]
    return float((v[1000] - v[800]) / (v[800:].max() - v[800:].min()))


def test_loops_have_the_size_that_makers_state_and_widen_with_the_rate():
    model = Hysteresis()
    assert 0.01 < gap(model, 1.5, 0.1) < 0.03
    assert 0.10 < gap(model, 15.0, 0.1) < 0.15
    widths = [gap(model, 15.0, f) for f in (0.1, 1, 10, 50, 100)]
    assert widths == sorted(widths)
    assert widths[-1] > 1.2 * widths[0]
    still = Hysteresis(lag_s=0.0)
    assert gap(still, 15.0, 100) == pytest.approx(gap(still, 15.0, 0.1), abs=1e-12)


def test_loops_identify_their_weights():
    """The output is linear in the weights: one decaying sine tells all of them by least squares."""
    model, rate = Hysteresis(), 1000.0
    t = clock(4001, rate)
    u = (20 * (-0.7 * t).exp() * (tau * 2 * t).sin())[:, None]
    v = model.drive(u, 1 / rate).value
    reach = model.thresholds(torch.cat((u[:1] * 0, u.diff(dim=0).abs() * rate)))
    basis = torch.cat((u[..., None], play(u[..., None] - reach, u[..., None] + reach)), -1)[:-1, 0]
    torch.testing.assert_close(torch.linalg.lstsq(basis, v).solution[:, 0], model.weights(u), rtol=0, atol=1e-9)


def test_minor_loops_are_congruent():
    """Wiping out and congruency, the marks of the Prandtl-Ishlinskii model: equal small loops wherever they lie."""
    small = 3 * (tau * clock(401, 100)).sin()
    outs = []
    for base in (-10.0, 0.0, 10.0):
        u = torch.cat((torch.linspace(0, base, 50, dtype=torch.float64), base + small))[:, None]
        outs.append(Hysteresis(lag_s=0.0).drive(u, 0.01).value[-200:, 0])
    for out in outs[1:]:
        torch.testing.assert_close(out - out[0], outs[0] - outs[0][0], rtol=0, atol=1e-12)


# --- dynamics


def test_phi_functions_meet_their_series_and_their_definition():
    x = torch.polar(torch.logspace(-12, 1, 200, dtype=torch.float64), torch.linspace(2, 4, 200, dtype=torch.float64))
    exact = x.numpy().astype(np.clongdouble)
    big = abs(exact) > 1e-4
    first, second = np.expm1(exact) / exact, (np.expm1(exact) - exact) / exact**2
    assert np.abs(phi1(x).numpy() - first).max() < 1e-13
    assert np.abs(phi2(x).numpy() - second)[big].max() < 1e-11
    assert np.abs(phi2(x).numpy() - 0.5)[~big].max() < 1e-4
    assert phi1(x[:1] * 0) == 1
    assert phi2(x[:1] * 0) == 0.5


def test_recursion_is_the_loop():
    g = torch.Generator().manual_seed(0)
    pushes = torch.randn(37, 2, generator=g, dtype=torch.complex128)
    factor, z = torch.tensor(0.9 + 0.3j, dtype=torch.complex128), torch.ones(2, dtype=torch.complex128)
    expected = [z]
    for push in pushes:
        expected.append(factor * expected[-1] + push)
    torch.testing.assert_close(recur(factor, z, pushes), torch.stack(expected))


def test_step_response_is_the_analytic_one():
    """1 - exp(-zeta w t) (cos w_d t + zeta / sqrt(1 - zeta^2) sin w_d t), the step rising within 5 us."""
    settings = StageSettings(**IDEAL, natural_hz=(100.0, 120.0, 150.0), damping=(0.05, 0.05, 0.1))
    command = torch.tensor((5.0, -4.0, 1e-3), dtype=torch.float64).repeat(4001, 1)
    command[0] = 0
    motion = Stage(settings).run(command, 2e5)
    t = clock(4001, 2e5)[:, None]
    omega, zeta = tau * torch.tensor(settings.natural_hz), torch.tensor(settings.damping)
    swing = omega * (1 - zeta**2).sqrt()
    t = (t - 2.5e-6).clamp_min(0)
    response = 1 - (-zeta * omega * t).exp() * ((swing * t).cos() + zeta / (1 - zeta**2).sqrt() * (swing * t).sin())
    torch.testing.assert_close(motion.pose, response * command[-1], rtol=0, atol=1e-5)


@pytest.mark.parametrize("frequency", [5.0, 60.0, 100.0, 250.0])
def test_frequency_response_is_the_transfer_function(frequency):
    """Amplitude and phase behind creep and mode; straight pieces take sinc^2 of a sine."""
    fs, creep = 8192.0, 0.02
    settings = StageSettings(**{**IDEAL, "creep": creep}, creep_s=(0.01, 0.1), natural_hz=(100.0,) * 3)
    t = clock(int(fs), fs)
    motion = Stage(settings).run(rows(3 * (tau * frequency * t).sin()), fs)
    some = slice(int(fs * 0.6), None)
    basis = torch.stack(((tau * frequency * t).sin(), (tau * frequency * t).cos()), 1)[some]
    real, imaginary = torch.linalg.lstsq(basis, motion.pose[some, :1]).solution[:, 0].tolist()
    s, omega = 1j * tau * frequency, tau * 100.0
    expected = omega**2 / (s**2 + 2 * 0.04 * omega * s + omega**2) * (1 + sum(creep / (1 + a * s) for a in (0.01, 0.1)))
    expected *= 3 * float(torch.sinc(torch.tensor(frequency / fs, dtype=torch.float64))) ** 2
    assert abs(complex(real, imaginary) - expected) < 2e-3 * abs(expected)


def test_energy_only_falls_when_nothing_drives():
    """After a step the swing dies by exp(-zeta w t): no numerical damping, none gained."""
    settings = StageSettings(**IDEAL, natural_hz=(100.0,) * 3, damping=(0.01,) * 3)
    command = rows(torch.full((1025,), 5.0, dtype=torch.float64))
    command[0] = 0
    motion = Stage(settings).run(command, 1024.0)
    t = torch.linspace(0.01, 0.9, 2001, dtype=torch.float64)
    x = motion.at(t)[:, 0] - 5
    v = (motion.at(t + 1e-6)[:, 0] - motion.at(t - 1e-6)[:, 0]) / 2e-6
    energy = v**2 / 2 + (tau * 100) ** 2 * x**2 / 2
    assert float((energy.diff() / energy[0]).max()) < 1e-6
    swings = -torch.log(energy[::200] / energy[0]) / 2
    torch.testing.assert_close(swings, 0.01 * tau * 100 * (t[::200] - t[0]), rtol=2e-3, atol=2e-2)


def test_creep_is_logarithmic():
    """1.2 % per decade between 0.1 and 100 s."""
    settings = StageSettings(**{**IDEAL, "creep": 0.012})
    command = rows(torch.full((1001,), 10.0, dtype=torch.float64))
    command[0] = 0
    motion = Stage(settings).run(command, 10.0)
    at = torch.tensor((0.4, 4.0, 40.0), dtype=torch.float64)
    decades = motion.at(at)[:, 0].diff() / 10
    torch.testing.assert_close(decades, torch.full((2,), 0.012, dtype=torch.float64), rtol=0.1, atol=0)


def test_against_a_brute_force_integration():
    """The whole nonlinear stage under sudden steps, against 2 us midpoint steps of its equations: to 0.1 nm."""
    settings = StageSettings(**QUIET, creep_s=(0.01,))
    rate, fine, count = 1024.0, 512, 10
    command = torch.zeros(count + 1, 3, dtype=torch.float64)
    command[2:], command[7:] = torch.tensor((8.0, 0.0, 6e-4)), torch.tensor((-3.0, 5.0, 0.0))
    stage = Stage(settings)
    got = stage.run(command, rate).pose[-1]
    to_stroke, mix = stage.geometry.numpy(), stage.mix.numpy()
    weights = settings.hysteresis.weights(torch.zeros((), dtype=torch.float64)).numpy()
    stroke = command.numpy() * (1, 1, settings.lever_um) @ to_stroke.T
    speed = np.concatenate((np.zeros((1, 3)), np.abs(np.diff(stroke, axis=0)) * rate))
    h, omega, zeta = 1 / rate / fine, tau * np.array(settings.natural_hz), np.array(settings.damping)
    plays, state = np.zeros((3, settings.hysteresis.plays)), np.zeros((3, 3))
    rest = settings.hysteresis.spacing_um * np.arange(1, settings.hysteresis.plays + 1)

    def rates(state, drive):
        x, v, slow = state
        force = omega**2 * (drive + settings.creep * slow - x) - 2 * zeta * omega * v
        return np.stack((v, force, (drive - slow) / 0.01))

    for k in range(count):
        for f in (np.arange(fine) + 0.5) / fine:
            u = stroke[k] + f * (stroke[k + 1] - stroke[k])
            reach = rest + settings.hysteresis.lag_s * (speed[k] + f * (speed[k + 1] - speed[k]))[:, None]
            plays = np.maximum(u[:, None] - reach, np.minimum(u[:, None] + reach, plays))
            drive = mix @ (weights[0] * u + plays @ weights[1:])
            state = state + h * rates(state + h / 2 * rates(state, drive), drive)
    x = state[0]
    c = torch.tensor(settings.rotation_center_um, dtype=torch.float64)
    assert float(got[2]) * settings.lever_um == pytest.approx(x[2], abs=1e-4)
    moved = transform(got, c[None])[0] - c
    assert moved.numpy() == pytest.approx(x[:2], abs=1e-4)


# --- the stage


def test_output_does_not_change_when_the_step_is_halved():
    """Commands sampled twice as finely move the poses by less than 0.1 nm; halved steps of one command by nothing."""
    stage = Stage(seed=3)
    coarse, fine = stage.run(circle(1024.0), 1024.0), stage.run(circle(2048.0), 2048.0)
    difference = (coarse.pose - fine.pose[::2]).abs().amax(0)
    assert float(difference[:2].max()) < 1e-4
    assert float(difference[2]) * 1e4 < 1e-4  # at 10 mm from the centre
    still = Stage(StageSettings(hysteresis=Hysteresis(lag_s=0.0)), seed=3)
    command = circle(256.0)
    halved = torch.stack((command[:-1], (command[:-1] + command[1:]) / 2), 1).reshape(-1, 3)
    halved = torch.cat((halved, command[-1:]))
    one, two = still.run(command, 256.0), still.run(halved, 512.0)
    torch.testing.assert_close(one.pose, two.pose[::2], rtol=0, atol=1e-10)
    torch.testing.assert_close(one.at(two.times_s), two.pose, rtol=0, atol=1e-10)


def test_motion_is_smooth_between_its_samples_and_any_order_of_times_gives_the_same():
    motion = Stage(seed=1).run(circle(1024.0), 1024.0)
    torch.testing.assert_close(motion.at(motion.times_s), motion.pose, rtol=0, atol=1e-12)
    t = torch.linspace(0.3, 0.31, 1001, dtype=torch.float64)
    assert float(motion.at(t).diff(dim=0).diff(dim=0).abs().max()) < 1e-5
    mixed = torch.randperm(len(t), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(motion.at(t[mixed]), motion.at(t)[mixed], rtol=0, atol=1e-12)


def test_circles_come_out_as_smaller_ellipses():
    motion = Stage(StageSettings(**QUIET)).run(circle(1024.0, turn_hz=0.5, seconds=6.0), 1024.0)
    points = motion.pose[2048:, :2]
    a, b = (float(v) * sqrt(2 / len(points)) for v in torch.linalg.svdvals(points - points.mean(0)))
    assert 8 < b < a < 11.5
    assert a / b > 1.02


def test_static_gain_is_the_compliance():
    """Units: um of x, y and of lever theta; mirrored commands give mirrored poses."""
    settings = StageSettings(**{**IDEAL, "compliance": StageSettings().compliance}, damping=(0.5,) * 3)
    gains = torch.tensor(settings.compliance, dtype=torch.float64)
    for command in ((10.0, 0.0, 0.0), (0.0, -7.0, 0.0), (4.0, 2.0, 1e-3)):
        end = torch.tensor(command, dtype=torch.float64)
        told = end.expand(2048, 3).clone()
        told[0] = 0
        scale = end.new_tensor((1, 1, settings.lever_um))
        for sign in (1, -1):
            pose = Stage(settings).run(sign * told, 1024.0).pose[-1]
            torch.testing.assert_close(pose * scale, sign * gains @ (end * scale), rtol=0, atol=1e-9)


def test_theta_leaves_the_rotation_center_where_it_is():
    settings = StageSettings(**{**IDEAL, "rotation_center_um": (700.0, -300.0)})
    theta = torch.linspace(0, radians(0.24), 300, dtype=torch.float64)
    pose = Stage(settings).run(rows(0 * theta, 0 * theta, theta), 100.0).pose
    center = torch.tensor(((700.0, -300.0),), dtype=torch.float64)
    torch.testing.assert_close(transform(pose, center), center.expand(300, 1, 2), rtol=0, atol=1e-9)
    lever = pose[-1, :2].norm() / pose[-1, 2]
    assert float(lever) == pytest.approx(float(center.norm()), rel=1e-5)


def test_disturbances_have_their_sizes():
    """Drift settles with its time constant; vibration is that of the floor, not random from sample to sample."""
    still = torch.zeros(3001, 3, dtype=torch.float64)
    settings = StageSettings(**{**IDEAL, "drift_um": 0.3, "drift_urad": 5.0})
    pose = Stage(settings, batch=400, seed=1).run(still, 1.0).pose
    spread = pose[:, -1].std(0) / (1 - exp(-3000 / 600))
    torch.testing.assert_close(spread, torch.tensor((0.3, 0.3, 5e-6)).double(), rtol=0.12, atol=0)
    torch.testing.assert_close(pose[:, 600], pose[:, -1] * (1 - exp(-1)) / (1 - exp(-5)), rtol=1e-9, atol=0)


def test_vibration_is_the_floor_times_the_transmission():
    """A stiff thing feels (f / f_0)^2 of the floor, a soft one all of it; speed per third of an octave as set."""
    sources = [torch.Generator().manual_seed(i) for i in range(200)]
    one = torch.full((3,), 0.5, dtype=torch.float64)
    soft = Vibration.on(Floor(6.25), 0.01 * one, one, sources=sources)
    speed = soft.amplitudes[..., 0] * tau * soft.frequency_hz.repeat(2)
    near = (soft.frequency_hz.repeat(2) / 20).log2().abs() < 1 / 6
    power = speed[:, near].square().sum(1).mean() / 2
    assert float(power.sqrt()) == pytest.approx(6.25, rel=0.15)
    sources = [torch.Generator().manual_seed(i) for i in range(200)]
    stiff = Vibration.on(Floor(6.25), 2e5 * one, one, sources=sources)
    q = (stiff.frequency_hz / 1e5).repeat(2)[:, None]
    torch.testing.assert_close(stiff.amplitudes, soft.amplitudes * q**2, rtol=1e-3, atol=1e-15)


def test_batches_equal_singles_and_seeds_reproduce():
    commands = torch.stack((circle(512.0), circle(512.0, radius=8.0), 0.5 * circle(512.0)))
    batch = Stage(batch=3, seed=5).run(commands, 512.0)
    times = torch.linspace(0.1, 1.9, 57, dtype=torch.float64)
    for i, command in enumerate(commands):
        single = Stage(seed=5, first=i).run(command, 512.0)
        torch.testing.assert_close(batch.pose[i], single.pose, rtol=0, atol=1e-12)
        torch.testing.assert_close(batch.at(times)[i], single.at(times), rtol=0, atol=1e-12)
    again = Stage(batch=3, seed=5).run(commands, 512.0)
    assert torch.equal(again.pose, batch.pose)
    assert not torch.equal(Stage(batch=3, seed=6).run(commands, 512.0).pose, batch.pose)
    shared = Stage(batch=2, seed=5).run(commands[0], 512.0)
    torch.testing.assert_close(shared.pose[0], batch.pose[0], rtol=0, atol=1e-12)


def test_everything_stays_on_the_device_of_the_command(device):
    command = circle(256.0)
    here = Stage(seed=2).run(command, 256.0)
    there = Stage(seed=2).run(command.to(device), 256.0)
    assert there.pose.device.type == device.type
    torch.testing.assert_close(there.pose.cpu(), here.pose, rtol=0, atol=1e-9)
    times = torch.linspace(0, 2, 33, dtype=torch.float64, device=device)
    torch.testing.assert_close(there.at(times).cpu(), here.at(times.cpu()), rtol=0, atol=1e-9)


def test_plant_without_creep_is_the_mode_alone():
    plant = Plant.of(torch.tensor((100.0,)).double(), torch.tensor((0.1,)).double())
    assert plant.poles.shape == (1,)
    assert Stage(StageSettings(creep_s=())).run(circle(64.0), 64.0).pose.isfinite().all()
    settled = plant.output(plant.rest(torch.tensor((2.5,)).double()))
    torch.testing.assert_close(settled, torch.tensor((2.5,)).double())
    assert float(plant.poles[0].imag / plant.poles[0].real) == pytest.approx(-sqrt(1 - 0.01) / 0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Hysteresis(share=1.0), r"Hysteresis: share must be in \[0, 1\), got 1.0"),
        (lambda: Hysteresis(plays=0), "Hysteresis: plays must be at least 1, got 0"),
        (lambda: Hysteresis(spacing_um=0), "Hysteresis: spacing_um must be > 0, got 0"),
        (lambda: Hysteresis(lag_s=-1), "Hysteresis: lag_s must be >= 0, got -1"),
        (lambda: Floor(speed_um_s=-1), "Floor: speed_um_s must be >= 0, got -1"),
        (lambda: Floor(rocking_um=0), "Floor: rocking_um must be > 0, got 0"),
        (lambda: StageSettings(lever_um=0), "workspace, lever, natural_hz and times must be > 0"),
        (lambda: StageSettings(damping=(1, 0.1, 0.1)), r"StageSettings: damping must be in \(0, 1\)"),
        (lambda: StageSettings(creep=-0.1), "StageSettings: creep must be >= 0, got -0.1"),
        (lambda: StageSettings(compliance=((1, 0), (0, 1))), "StageSettings: compliance must be 3 x 3"),
        (lambda: Stage(batch=0), "Stage: batch must be >= 1, seed and first >= 0, got 0, 0, 0"),
        (lambda: Stage().run(torch.zeros(3), 1.0), r"command must be \(..., T, 3\) with T >= 2, got \(3,\)"),
        (lambda: Stage().run(torch.zeros(5, 3), 0.0), "run: rate_hz must be > 0, got 0.0"),
        (lambda: Stage().run(torch.full((5, 3), float("nan")), 1.0), "run: command must be finite"),
        (
            lambda: Stage(batch=2).run(torch.zeros(3, 5, 3), 1.0),
            r"command for 2 stages must be \(T, 3\) or \(2, T, 3\)",
        ),
        (
            lambda: Stage().run(16 * rows((tau * clock(9, 8.0)).sin()), 8.0),
            "command must stay in the workspace, 30 um of x, got 32 um",
        ),
        (
            lambda: Stage().run(torch.tensor(((0.0, 0.0, 0.0), (0.0, 0.0, radians(0.3)))), 8.0),
            "command must stay in the workspace, 4188.79 urad of theta, got 5235.99 urad",
        ),
        (lambda: Stage().run(torch.zeros(5, 3), 1.0).at(torch.tensor((5.0,))), "between 0 and 4 s, got 5 to 5 s"),
        (lambda: Stage().run(torch.zeros(5, 3), 1.0).at(torch.zeros(2, 2)), r"times_s must be \(N,\)"),
    ],
)
def test_messages(call, message):
    with pytest.raises(ValueError, match=message):
        call()
