"""Laws of the pose algebra: a group, the paper's sign, exact converters."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc import pose as P

lengths = st.floats(-1e3, 1e3)
angles = st.floats(-20.0, 20.0)
poses = st.tuples(lengths, lengths, angles).map(lambda t: torch.tensor(t, dtype=torch.float64))
shapes = st.lists(st.integers(1, 3), max_size=3)


def test_sign_is_the_papers():
    quarter = torch.tensor([10.0, 20.0, math.pi / 2], dtype=torch.float64)
    points = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    # Eq. (2): x = cos x' + sin y' + t_x; y = -sin x' + cos y' + t_y
    assert torch.allclose(P.transform(quarter, points), torch.tensor([[10.0, 19.0], [11.0, 20.0]], dtype=torch.float64))


@given(poses, poses, poses)
def test_group_laws(a, b, c):
    assert torch.allclose(P.compose(P.compose(a, b), c), P.compose(a, P.compose(b, c)), atol=1e-9)
    assert torch.allclose(P.compose(a, P.inverse(a)), torch.zeros(3, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(P.matrix(P.compose(a, b)), P.matrix(a) @ P.matrix(b), atol=1e-9)
    assert torch.allclose(P.retract(a, b), P.compose(a, P.inverse(b)), atol=1e-9)
    points = torch.tensor([[3.0, -4.0], [0.5, 9.0]], dtype=torch.float64)
    assert torch.allclose(P.transform(P.compose(a, b), points), P.transform(a, P.transform(b, points)), atol=1e-9)
    assert torch.allclose(torch.tensor(P.warp(*a.tolist()), dtype=torch.float64), P.matrix(a)[:2], atol=1e-9)


@given(shapes, st.integers(0, 2**31))
def test_any_batch_shape(shape, seed):
    generator = torch.Generator().manual_seed(seed)
    batch = torch.randn(*shape, 3, dtype=torch.float64, generator=generator)
    assert P.matrix(batch).shape == (*shape, 3, 3)
    assert P.compose(batch, batch).shape == batch.shape
    flat = batch.reshape(-1, 3)
    assert torch.equal(P.inverse(batch).reshape(-1, 3), P.inverse(flat))
    assert torch.allclose(P.compose(batch, batch).reshape(-1, 3), P.compose(flat, flat))


@given(poses)
def test_converters_round_trip(p):
    wrapped = P.from_matrix(P.matrix(p))
    assert torch.allclose(wrapped[:2], p[:2])
    assert torch.allclose(P.unwrap(wrapped[2], p[2]), p[2], atol=1e-9)
    for there, back in ((P.to_se2, P.from_se2),):
        again = back(there(p[None])).detach()[0]
        assert torch.allclose(P.unwrap(again[2], p[2]), p[2], atol=1e-9)
        assert torch.allclose(again[:2], p[:2])
    again = P.from_opencv(P.to_opencv(p, (40, 31)), (40, 31))
    assert torch.allclose(P.unwrap(again[2], p[2]), p[2], atol=1e-9)
    assert torch.allclose(again[:2], p[:2], atol=1e-9)


def test_turns_are_kept():
    step = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    p = torch.zeros(3, dtype=torch.float64)
    for _ in range(20):
        p = P.compose(p, step)
    assert p[2] == pytest.approx(20.0)


@given(st.floats(-50, 50), st.floats(-50, 50))
def test_unwrap_is_within_half_a_turn(theta, reference):
    a, b = torch.tensor(theta, dtype=torch.float64), torch.tensor(reference, dtype=torch.float64)
    unwrapped = P.unwrap(a, b)
    assert abs(float(unwrapped - b)) <= math.pi + 1e-9
    assert math.cos(float(unwrapped - a)) == pytest.approx(1.0)


@settings(deadline=None, max_examples=10)
@given(st.integers(5, 40), st.integers(5, 40), st.floats(-3, 3))
def test_opencv_warp_is_the_same_warp(h, w, theta):
    """cv2.warpAffine with our matrix cuts out exactly the pixels that eq. (2) names."""
    image = np.zeros((120, 120), np.float32)
    image[:] = np.arange(120)[None, :] + 1000 * np.arange(120)[:, None]
    p = torch.tensor([60.0, 55.0, theta], dtype=torch.float64)
    warp = P.to_opencv(p, (h, w)).numpy()
    patch = cv2.warpAffine(image, warp, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    y, x = np.mgrid[:h, :w]
    points = torch.from_numpy(np.stack((x - (w - 1) / 2, y - (h - 1) / 2), -1).reshape(-1, 2))
    expected = P.transform(p, points)
    # OpenCV rounds sub-pixel positions to 1/32 px
    assert np.abs(patch.ravel() - (expected[:, 0] + 1000 * expected[:, 1]).numpy()).max() < 1000 / 32 + 1


def test_from_matrix_names_a_wrong_shape():
    with pytest.raises(ValueError, match=r"from_matrix: matrix must be \(..., 2, 3\) or \(..., 3, 3\), got \(3,\)"):
        P.from_matrix(torch.zeros(3))


def test_poses_are_double_where_there_is_double():
    assert P.pose_dtype("cpu") == P.pose_dtype("cuda") == torch.float64
    assert P.pose_dtype("mps") == torch.float32


@given(poses, poses)
def test_one_step_further_is_the_same_motion_again(last, pose):
    """The motion that led from one pose to the next, applied to that: W(p) W(l)^-1 W(p)."""
    further = P.compose(P.compose(pose, P.inverse(last)), pose)
    torch.testing.assert_close(P.ahead(pose, pose - last), further, rtol=0, atol=1e-9)


@given(poses, st.floats(-3, 3), st.tuples(lengths, lengths))
def test_a_constant_turn_about_any_point_is_foreseen(pose, angle, point):
    """Wherever that point is."""
    pivot, turn = torch.tensor([*point, 0.0]).double(), torch.tensor([0.0, 0.0, angle]).double()
    motion = P.compose(P.compose(pivot, turn), P.inverse(pivot))
    path = [pose]
    for _ in range(2):
        path.append(P.compose(motion, path[-1]))
    torch.testing.assert_close(P.ahead(path[1], path[1] - path[0]), path[2], rtol=0, atol=1e-9)
