"""Laws of the lens: OpenCV's model, its inverse, its slope, and the range in which it can be told."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torch_ecc import Lens
from torch_ecc.core.pose import transform

LENS = Lens((530.0, 500.0), (700.0, 690.0), 0.04, -0.01, 0.003, -0.002)
small = st.floats(-0.05, 0.05)


def points(count: int = 200, seed: int = 0) -> torch.Tensor:
    return 1024 * torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_is_opencvs():
    matrix, coefficients = (v.numpy() for v in LENS.to_opencv())
    straight = points()
    rays = np.concatenate(((straight.numpy() - matrix[:2, 2]) / (matrix[0, 0], matrix[1, 1]), np.ones((200, 1))), 1)
    there, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)
    torch.testing.assert_close(LENS.distort(straight), torch.from_numpy(there[:, 0]), rtol=0, atol=1e-9)
    assert Lens.from_opencv(*LENS.to_opencv()) == LENS


@given(small, small, st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.integers(0, 99))
def test_the_inverse_is_exact_and_the_slope_is_that_of_the_map(k1, k2, p1, p2, seed):
    lens = Lens((500.0, 520.0), 724.0, k1, k2, p1, p2)
    p = points(20, seed)
    torch.testing.assert_close(lens.undistort(lens.distort(p)), p, rtol=0, atol=1e-8)
    steps = 1e-3 * torch.eye(2).double()
    rise = [(lens.distort(p + step) - lens.distort(p - step)) / 2e-3 for step in steps]
    torch.testing.assert_close(lens.slope(p), torch.stack(rise, -1), rtol=0, atol=1e-7)


def test_poses_go_there_and_back_and_a_patch_is_turned_as_it_is_seen():
    pose = torch.cat((points(50), torch.linspace(-3, 3, 50).double()[:, None]), 1)
    torch.testing.assert_close(LENS.undistort_pose(LENS.distort_pose(pose)), pose, rtol=0, atol=1e-8)
    around = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]).double()
    seen = LENS.distort(transform(pose, around)) - LENS.distort(pose[:, None, :2])
    straight = transform(LENS.distort_pose(pose), around) - LENS.distort(pose[:, None, :2])
    cross = (seen[..., 0] * straight[..., 1] - seen[..., 1] * straight[..., 0]).sum(1)
    assert cross.abs().max() < 1e-5  # no turn is left
    _, scale = LENS.turn_and_scale(pose[:, :2])
    area = (seen[:, 0, 0] * seen[:, 1, 1] - seen[:, 0, 1] * seen[:, 1, 0]).abs()
    torch.testing.assert_close(scale.square(), area, rtol=1e-3, atol=0)


def test_covariances_are_those_of_undistorted_poses():
    pose = torch.tensor([[900.0, 100.0, 0.3]], dtype=torch.float64)
    error = 0.01 * torch.randn(20000, 3, generator=torch.Generator().manual_seed(0)).double()
    root = torch.tensor([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.001, 0.0, 0.01]], dtype=torch.float64)
    straight = LENS.undistort_pose(pose + error @ root.mT)
    told = LENS.undistort_covariance(1e-4 * root @ root.mT, pose[0])
    torch.testing.assert_close(straight.T.cov(), told, rtol=0.05, atol=1e-8)
    lost = torch.diag(torch.full((3,), math.inf)).double()
    assert LENS.undistort_covariance(lost, pose[0]).diagonal().isinf().all()


def test_a_lens_that_folds_back_tells_its_range():
    lens = Lens((500.0, 500.0), 700.0, -0.3)
    assert Lens((500.0, 500.0), 700.0, 0.3).range_px == math.inf
    fold = 700 / math.sqrt(0.9)
    assert lens.range_px == pytest.approx(fold * (1 - 0.3 * fold**2 / 700**2), rel=0.01)
    inside = torch.tensor([[500.0 + 0.99 * lens.range_px, 500.0]], dtype=torch.float64)
    torch.testing.assert_close(lens.distort(lens.undistort(inside)), inside, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match=r"one to one up to \d+ px from its centre, got a point at 7\d\d"):
        lens.undistort(torch.tensor([[1200.0, 500.0]]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Lens((1.0, math.nan), 700.0), "center must be"),
        (lambda: Lens((1.0, 1.0), -700.0), "focal must be"),
        (lambda: Lens((1.0, 1.0), 700.0, math.inf), "k1, k2, p1 and p2 must be finite"),
        (lambda: Lens.from_opencv(torch.eye(2), [0, 0, 0, 0]), r"camera_matrix must be \(3, 3\)"),
        (lambda: Lens.from_opencv(torch.eye(3), [0, 0, 0, 0, 0.1]), "no others but zero"),
        (lambda: Lens.from_opencv(torch.eye(3), [0, 0]), "coefficients must be k1, k2, p1, p2"),
    ],
)
def test_wrong_lenses(make, message):
    with pytest.raises(ValueError, match=message):
        make()
