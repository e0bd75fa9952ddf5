"""Motions: eq. (11) and its companions."""

from __future__ import annotations

from math import cos, tau

import pytest
import torch

from torch_ecc.sim import circle, from_rest, harmonic, placed, ramp, random_walk, steps, table
from torch_ecc.sim.camera.motion import velocity


def test_harmonic_is_equation_11():
    poses = harmonic((100.0, 50.0, 0.35), 160)
    assert poses.shape == (160, 3)
    assert poses.dtype == torch.float64
    for j in (1, 40, 77, 160):
        expected = [a * cos(tau / 160 * j) for a in (100.0, 50.0, 0.35)]
        assert poses[j - 1].tolist() == pytest.approx(expected)
    torch.testing.assert_close(harmonic((1, 1, 1), 10, cycles=2.5)[10:20], harmonic((1, 1, 1), 10))


def test_circle_keeps_its_radius_and_closes():
    poses = circle(30.0, 61, turns=3, spin=4 * tau)
    torch.testing.assert_close(poses[:, :2].norm(dim=1), torch.full((61,), 30.0, dtype=torch.float64))
    torch.testing.assert_close(poses[0, :2], poses[-1, :2])
    assert float(poses[-1, 2]) == pytest.approx(4 * tau)  # not wrapped


def test_ramp_is_even_and_steps_hold():
    torch.testing.assert_close(ramp((10.0, -5.0, 3 * tau), 11)[4], torch.tensor([4, -2, 1.2 * tau]).double())
    stairs = steps((1.0, 0.0, 0.1), 4, hold=3)
    assert stairs.shape == (12, 3)
    assert stairs[:, 0].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]


def test_random_walk_is_seeded_and_spreads_as_told():
    assert torch.equal(random_walk((1, 1, 1), 50, seed=2), random_walk((1, 1, 1), 50, seed=2))
    walk = random_walk((0.5, 2.0, 0.0), 20001, seed=1)
    torch.testing.assert_close(walk.diff(dim=0).std(0), torch.tensor([0.5, 2.0, 0.0]).double(), rtol=0.02, atol=0)
    assert walk[0].tolist() == [0, 0, 0]


def test_table_is_what_was_given():
    assert table([[1, 2, 3]]).tolist() == [[1, 2, 3]]


def test_placed_moves_only_the_position():
    torch.testing.assert_close(placed(table([[1, 2, 3]]), (10, 20)), table([[11, 22, 3]]))


def test_from_rest_leads_smoothly_to_the_first_pose():
    motion = harmonic((20.0, 10.0, 0.1), 40)
    whole = from_rest(motion, 25)
    assert whole[0].tolist() == [0, 0, 0]
    torch.testing.assert_close(whole[25:], motion)
    assert float(whole[:26, 0].diff().max()) < 2 * 20 / 25
    assert torch.equal(from_rest(motion, 0), motion)


def test_velocity_is_the_change_per_frame():
    torch.testing.assert_close(velocity(ramp((9.0, 0.0, 0.9), 10)), table([[1, 0, 0.1]]).expand(10, 3))
    assert velocity(table([[5, 5, 5]])).tolist() == [[0, 0, 0]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: harmonic((1, 2, 3), 0), "harmonic: the number of points must be at least 1, got 0"),
        (lambda: harmonic((1, 2)), r"harmonic: amplitudes must be three finite numbers \(px, px, rad\), got \(1, 2\)"),
        (lambda: harmonic((1, 2, 3), 10, cycles=0), "points x cycles must be at least 1"),
        (lambda: circle(-1), "circle: radius must be >= 0, got -1"),
        (lambda: ramp((float("nan"), 0, 0)), "ramp: end must be three finite numbers"),
        (lambda: steps((1, 0, 0), hold=0), "steps: hold must be at least 1 frame, got 0"),
        (lambda: random_walk((1, -1, 0)), "random_walk: sigmas must be >= 0"),
        (lambda: table([[1, 2]]), r"table: rows must be \(F, 3\) with F >= 1, got \(1, 2\)"),
        (lambda: table([[1, 2, float("inf")]]), "table: rows must be finite numbers"),
        (lambda: from_rest(table([[1, 2, 3]]), -1), "from_rest: frames must be >= 0, got -1"),
    ],
)
def test_wrong_motions_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
