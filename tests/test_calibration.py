"""Laws of the calibration: eq. (3), round trips, mirrored views, what moves can and cannot tell."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torch_ecc import Calibration, calibrate
from torch_ecc.core.pose import rotation

scales = st.floats(0.01, 10.0) | st.floats(-10.0, -0.01)


def moves(count: int = 30, seed: int = 0) -> torch.Tensor:
    return 50 * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_equation_3():
    physical = Calibration((0.2, 0.3)).to_physical(torch.tensor([10.0, 20.0, 0.5]))
    assert torch.allclose(physical, torch.tensor([2.0, 6.0, 0.5]))


@given(scales, scales, st.floats(-4, 4))
def test_round_trip_and_covariance(fx, fy, angle):
    calibration, d = Calibration((fx, fy), angle), moves()
    assert torch.allclose(calibration.to_pixels(calibration.to_physical(d)), d, atol=1e-9)
    spread = d.T @ d / len(d)
    physical = calibration.to_physical(d)
    assert torch.allclose(calibration.covariance(spread), physical.T @ physical / len(d), rtol=1e-9, atol=1e-9)


def test_the_axis_angle_turns_like_theta():
    d = torch.tensor([3.0, 4.0, 0.1], dtype=torch.float64)
    turned = Calibration(1.0, 0.3).to_physical(d)
    assert torch.allclose(turned[:2], rotation(torch.tensor(0.3).double()) @ d[:2])
    assert turned[2] == d[2]


def test_a_mirrored_view_turns_the_other_way():
    assert Calibration((1.0, -1.0)).to_physical(torch.tensor([0.0, 0.0, 0.1]))[2] == pytest.approx(-0.1)


@given(st.floats(0.05, 5), scales, st.floats(-1.5, 1.5), st.integers(0, 99))
def test_recovers_the_camera_from_moves(fx, fy, angle, seed):
    truth, d = Calibration((fx, fy), angle), moves(seed=seed)
    fit = calibrate(d, truth.to_physical(d)[:, :2] + torch.tensor([5.0, -3.0]))
    assert fit.residual_um < 1e-6
    assert torch.allclose(fit.calibration.to_physical(d), truth.to_physical(d), atol=1e-5)


def test_sigma_agrees_with_the_scatter():
    truth, d = Calibration((0.2, -0.21), 0.05), moves(20)
    fits = []
    for seed in range(200):
        noise = 0.1 * torch.randn(20, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        fits.append(calibrate(d, truth.to_physical(d)[:, :2] + noise))
    values = torch.tensor([(*f.calibration.scales, f.calibration.axis_angle) for f in fits])
    ratio = values.std(0) / torch.stack([f.sigma for f in fits]).square().mean(0).sqrt()
    assert ((ratio > 0.85) & (ratio < 1.15)).all()
    assert math.isclose(float(values[:, 2].mean()), 0.05, abs_tol=1e-3)
