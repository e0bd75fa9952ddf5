"""The control law on poses alone: exact decay, delays, limits, wrong Jacobians, learning."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc.records.calibration import Calibration
from torch_ecc.servo import Control, Controller, StageJacobian, decay_rate
from torch_ecc.servo.jacobian import condition, learn, planned_move, pseudo_inverse

ENDLESS = (torch.full((3,), 1e9, dtype=torch.float64), torch.full((3,), 1e12, dtype=torch.float64))
TRUE = StageJacobian(Calibration(0.275))
PERIOD = 1 / 30


def ten(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def closed_loop(controller: Controller, start: torch.Tensor, frames: int, delay: int = 0, true=TRUE) -> torch.Tensor:
    """Poses (frames, 3) of a perfect stage, shown ``delay`` frames late; the desired pose is zero."""
    poses = [start] * (delay + 1)
    for _ in range(frames):
        velocity = controller.steer(poses[-1 - delay], torch.zeros(3, dtype=torch.float64))
        poses.append(poses[-1] + true(poses[-1]) @ velocity * controller.period)
    return torch.stack(poses[delay:])


@settings(max_examples=30, deadline=None)
@given(gain=st.floats(0.1, 60), period=st.floats(0.005, 0.2))
def test_the_error_decays_exactly(gain, period):
    """At every frame the error is e^(-lambda t) of the first, whatever lambda and the frame rate."""
    controller = Controller(TRUE, Control(gain=gain), ENDLESS, period)
    poses = closed_loop(controller, ten(40, -25, 0.7), 20)
    law = (-gain * period * torch.arange(21, dtype=torch.float64)).exp()[:, None] * poses[:1]
    torch.testing.assert_close(poses, law, atol=1e-9, rtol=1e-9)


def test_a_known_delay_does_not_change_the_decay():
    controller = Controller(TRUE, Control(gain=5.0, delay=3), ENDLESS, PERIOD)
    poses = closed_loop(controller, ten(40, -25, 0.7), 30, delay=3)
    law = (-5 * PERIOD * torch.arange(31, dtype=torch.float64)).exp()[:, None] * poses[:1]
    torch.testing.assert_close(poses, law, atol=1e-9, rtol=0)


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_an_unknown_delay_is_stable_as_far_as_promised(delay):
    """No overshoot below d^d / (d + 1)^(d + 1); unstable from g T = 2 sin(pi / (4 d + 2)) on."""

    def run(step: float, frames: int) -> torch.Tensor:
        controller = Controller(TRUE, Control(gain=-math.log(1 - step) / PERIOD), ENDLESS, PERIOD)
        return closed_loop(controller, ten(1, 1, 1), frames, delay)[:, 0]

    smooth = delay**delay / (delay + 1) ** (delay + 1)
    assert float(run(0.99 * smooth, 80).min()) > 0
    assert float(run(1.3 * smooth, 80).min()) < 0
    edge = 2 * math.sin(math.pi / (4 * delay + 2))
    if edge < 0.99:  # with one frame of delay, g T = 1 is the edge, and never reached
        assert float(run(0.9 * edge, 300)[-40:].abs().max()) < 0.1
        assert float(run(1.1 * edge, 300)[-40:].abs().max()) > 10


@settings(max_examples=40, deadline=None)
@given(
    errors=st.lists(st.tuples(*[st.floats(-300, 300)] * 2, st.floats(-3, 3)), min_size=2, max_size=8),
    gain=st.floats(0.5, 30),
)
def test_limits_are_kept_whatever_comes(errors, gain):
    speed, acceleration = ten(20, 30, 0.5), ten(100, 80, 2)
    controller = Controller(TRUE, Control(gain=gain), (speed, acceleration), PERIOD)
    last = torch.zeros(3, dtype=torch.float64)
    for number, error in enumerate(errors * 3):
        goal = torch.zeros(3, dtype=torch.float64)
        velocity = controller.hold() if number % 7 == 6 else controller.steer(ten(*error), goal)
        assert bool((velocity.abs() <= speed * (1 + 1e-12)).all())
        assert bool(((velocity - last).abs() <= acceleration * PERIOD * (1 + 1e-9)).all())
        last = velocity


def test_limits_leave_no_overshoot_and_a_straight_path():
    controller = Controller(TRUE, Control(gain=4.0), (ten(20, 20, 0.3), ten(60, 60, 1.0)), PERIOD)
    poses = closed_loop(controller, ten(80, -60, 1.0), 600)
    assert float(poses[-1].abs().max()) < 1e-6
    assert bool((poses * poses[0].sign() > -1e-9).all())
    torch.testing.assert_close(poses[:, 1] / poses[:, 0], torch.full((601,), -0.75).double(), atol=1e-6, rtol=0)


def test_wrong_scale_and_axes_change_the_rate_as_derived():
    """A scale off by s gives lambda s; axes off by a give lambda cos a and turn the path."""
    for believed, rate in ((Calibration(0.33), 1.2), (Calibration(0.22), 0.8)):
        controller = Controller(StageJacobian(believed), Control(gain=1.0), ENDLESS, 5e-3)
        poses = closed_loop(controller, ten(50, 20, 0.0), 200)
        assert float(poses[-1, 0] / poses[0, 0]) == pytest.approx(math.exp(-rate), rel=1e-2)
    controller = Controller(StageJacobian(Calibration(0.275, 0.5)), Control(gain=1.0), ENDLESS, 5e-3)
    poses = closed_loop(controller, ten(50, 20, 0.0), 200)
    assert float(poses[-1, :2].norm() / poses[0, :2].norm()) == pytest.approx(math.exp(-math.cos(0.5)), rel=1e-2)


def test_an_unknown_axis_of_rotation_still_converges():
    true = StageJacobian(Calibration(0.275), (150, -80))
    controller = Controller(TRUE, Control(gain=2.0), ENDLESS, PERIOD)
    poses = closed_loop(controller, ten(20, 20, 1.2), 600, true=true)
    assert float(poses[-1].abs().max()) < 1e-9
    assert float(poses[:, :2].norm(dim=1).max()) > 60  # by way of a detour


def test_broyden_learns_a_matrix_from_moves():
    """The last move is explained exactly, and three independent moves, each repeated, leave the true L."""
    g = torch.Generator().manual_seed(0)
    true = torch.randn(3, 3, generator=g, dtype=torch.float64) + 3 * torch.eye(3)
    L = torch.eye(3, dtype=torch.float64)
    for _ in range(60):
        move = torch.randn(3, generator=g, dtype=torch.float64)
        L = learn(L, move, true @ move, 1.0)
        torch.testing.assert_close(L @ move, true @ move)
    torch.testing.assert_close(L, true, atol=1e-3, rtol=0)


def test_learning_makes_a_wrong_belief_faster():
    """Axes off by 60 deg: the frames until the error is a thousandth, with and without Broyden's update."""

    def frames(weight: float) -> int:
        wrong = StageJacobian(Calibration(0.275, math.radians(60)))
        controller = Controller(wrong, Control(gain=3.0, learn=weight), ENDLESS, PERIOD)
        poses, goal = [ten(60, 30, 0.5)], torch.zeros(3, dtype=torch.float64)
        while float(poses[-1].norm()) > 0.06:
            if len(poses) > 1:
                controller.observe(poses[-1], poses[-2], 40.0)
            velocity = controller.steer(poses[-1], goal)
            poses.append(poses[-1] + TRUE(poses[-1]) @ velocity * PERIOD)
        return len(poses)

    assert frames(0.7) < 0.75 * frames(0.0)


def test_pseudo_inverse_is_that_of_the_equation():
    L = StageJacobian(Calibration(0.3, 0.2), (100, 30), rotary=False)(ten(0, 0, 0.4))
    torch.testing.assert_close(pseudo_inverse(L), torch.linalg.inv(L.mT @ L) @ L.mT)
    torch.testing.assert_close(pseudo_inverse(L) @ L, torch.eye(2, dtype=torch.float64))


def test_planned_moves_are_those_of_the_stage():
    """For x, y, theta about an axis 100 px away: the exact difference of stage positions."""
    jacobian = StageJacobian(Calibration(0.5), (100, 0))
    move = planned_move(jacobian, ten(0, 0, 0), ten(0, 0, math.pi / 2))
    # The axis is at +100 x' of the template: for the template to stay, the axis has to go from (100, 0) to (0, -100).
    torch.testing.assert_close(move, ten(-50, -50, math.pi / 2), atol=5e-3, rtol=0)


def test_rates_of_known_decays():
    t = torch.arange(100, dtype=torch.float64) / 30
    error = torch.stack((5 * (-2 * t).exp(), -3 * (-0.7 * t).exp(), torch.zeros_like(t)), 1)
    rates = decay_rate(t, error, largest=0.9, smallest=0.01)
    assert rates[:2].tolist() == pytest.approx([2.0, 0.7])
    assert bool(rates[2].isnan())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain": -1.0}, "gain must be a finite number > 0, got -1.0"),
        ({"gain": math.inf}, "gain must be a finite number > 0, got inf"),
        ({"tolerance_px": 0.0}, "tolerance_px must be a finite number > 0, got 0.0"),
        ({"dwell": 0}, "dwell must be at least 1, got 0"),
        ({"delay": -1}, "delay must be at least 0, got -1"),
        ({"learn": 1.5}, r"learn must lie in \[0, 1\], got 1.5"),
    ],
)
def test_wrong_settings_have_words(settings, message):
    with pytest.raises(ValueError, match=message):
        Control(**settings)


@pytest.mark.parametrize(
    ("L", "message"),
    [
        (torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 0, 1]]), "must not be singular, but axis 1 moves nothing"),
        (torch.tensor([[1.0, 2], [2, 4], [0, 0]]), "must have independent, finite columns"),
        (torch.eye(4)[:3], "axis 3 moves nothing"),
        (torch.full((3, 3), math.nan), "must have independent, finite columns"),
    ],
)
def test_a_singular_jacobian_is_refused(L, message):
    with pytest.raises(ValueError, match=message):
        pseudo_inverse(L.double())
    assert condition(L.double()) > 1e6
