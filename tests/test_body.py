"""Laws of rigid bodies: generalised least squares with honest covariances, and what a minority cannot break."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from torch_ecc import Body, Estimate, Status, Tracker
from torch_ecc.body.fusion import fuse
from torch_ecc.body.layout import Layout
from torch_ecc.core.pose import compose, inverse
from torch_ecc.sim import Camera, PlaneWaves, placed, ramp

SIGMA = torch.tensor([0.004, 0.006, 1e-4], dtype=torch.float64)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def square(side: int = 4, pitch: float = 200.0) -> Tensor:
    """Start poses (side^2, 3)."""
    at = pitch * torch.arange(side, dtype=torch.float64) + 100
    return torch.cat((torch.cartesian_prod(at, at), torch.zeros(side * side, 1)), 1)


def seen(layout: Layout, motion: Tensor, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Noisy poses (N, R, 3) of patches whose bodies are at ``motion`` (N, G, 3), and their covariances."""
    n, count = len(motion), len(layout.place)
    root = torch.diag(SIGMA) @ (torch.eye(3).double() + 0.3 * normal(count, 3, 3, seed=9))
    truth, _ = layout.predict(motion[:, layout.body])
    error = (root @ normal(n, count, 3, 1, seed=seed))[..., 0]
    return truth + error, (root @ root.mT).expand(n, count, 3, 3)


def moved(layout: Layout, n: int = 1, seed: int = 5) -> Tensor:
    spread = torch.tensor([20.0, 20.0, 0.3], dtype=torch.float64)
    return layout.start + spread * normal(n, len(layout.start), 3, seed=seed)


def estimate(pose: Tensor, covariance: Tensor, start: Tensor, status: Tensor | None = None) -> Estimate:
    none = torch.zeros(pose.shape[:-1], dtype=torch.float64)
    codes = none.to(torch.int8)
    status = codes if status is None else status
    return Estimate(pose, pose - start, none + 1, status, none.long(), covariance, none, codes, none + 1, codes)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    frame = Camera(size=(860, 860)).capture(PlaneWaves.random(), torch.zeros(1, 3).double())[0, 0]
    return Tracker(frame, square()[:, :2], 21)


def test_errors_are_as_large_as_sigma_tells_and_chi_square_is_honest():
    layout = Layout.of(square(), [range(16)])
    motion = moved(layout, 2000)
    found = fuse(*seen(layout, motion), torch.ones(2000, 16, dtype=torch.bool), layout)
    error = (found.pose - motion)[:, 0]
    squares = (error[:, None] @ torch.linalg.solve(found.covariance[:, 0], error[..., None])).flatten() / 3
    assert 0.93 < squares.mean() < 1.07
    assert 0.97 < (found.chi2 / found.freedom).mean() < 1.03
    assert found.weight.mean() > 0.995


def test_theta_of_the_patches_and_their_places_both_count():
    """The covariance is that of all components together, and less than of either alone."""
    layout = Layout.of(square(2, 40.0), [range(4)])
    pose, covariance = seen(layout, moved(layout))
    good = torch.ones(1, 4, dtype=torch.bool)
    whole = fuse(pose, covariance, good, layout).covariance[0, 0, 2, 2]
    blind = covariance.clone()
    blind[..., 2, 2] += 1e6  # of theta
    loose = covariance + torch.diag(torch.tensor([1e6, 1e6, 0.0])).double()  # of x and y
    for less in (blind, loose):
        assert whole < 0.9 * fuse(pose, less, good, layout).covariance[0, 0, 2, 2]


def test_one_patch_is_the_patch_itself():
    layout = Layout.of(square(1), [[0]])
    pose, covariance = seen(layout, moved(layout))
    found = fuse(pose, covariance, torch.ones(1, 1, dtype=torch.bool), layout)
    torch.testing.assert_close(found.pose, pose, rtol=1e-13, atol=1e-12)
    torch.testing.assert_close(found.covariance, covariance, rtol=1e-9, atol=1e-18)
    assert found.freedom == 0


@pytest.mark.parametrize("kind", ["another place", "another body", "scattered", "a little", "another turn"])
def test_five_of_sixteen_cannot_break_it(kind):
    layout = Layout.of(square(), [range(16)])
    motion = moved(layout, 100)
    pose, covariance = seen(layout, motion)
    pose, wrong = pose.clone(), [0, 1, 4, 5, 10]
    if kind == "another place":
        pose[:, wrong] += torch.tensor([12.0, 0.0, 0.0])
    elif kind == "another body":
        other, _ = layout.predict(moved(layout, 100, seed=77)[:, layout.body])
        pose[:, wrong] = other[:, wrong] + SIGMA * normal(100, 5, 3, seed=3)
    elif kind == "scattered":
        pose[:, wrong] += 5 * normal(100, 5, 3, seed=3)
    elif kind == "a little":
        pose[:, wrong] += torch.tensor([0.0, 0.1, 0.0])
    else:
        pose[:, wrong, 2] += math.pi
    found = fuse(pose, covariance, torch.ones(100, 16, dtype=torch.bool), layout)
    left = torch.ones(16, dtype=torch.bool)
    left[wrong] = False
    assert (found.weight[:, ~left] < 0.5).all()
    assert (found.weight[:, left] >= 0.5).float().mean() > 0.995
    best = fuse(pose, covariance, left.expand(100, 16), layout)
    ratio = (found.pose - motion).square().mean(0).sqrt() / (best.pose - motion).square().mean(0).sqrt()
    assert (ratio < 1.15).all()


def test_seven_of_fifteen_that_agree_cannot_break_it_and_no_majority_is_told():
    layout = Layout.of(square()[:15], [range(15)])
    motion = moved(layout, 20)
    pose, covariance = seen(layout, motion)
    pose = pose.clone()
    pose[:, :7] += torch.tensor([3.0, 1.0, 0.0])
    good = torch.ones(20, 15, dtype=torch.bool)
    found = fuse(pose, covariance, good, layout)
    assert (found.weight[:, :7] == 0).all()
    assert ((found.pose - motion).abs() < torch.tensor([0.01, 0.01, 1e-4])).all()
    two = fuse(pose[:, 6:8], covariance[:, 6:8], good[:, :2], Layout.of(square()[6:8], [[0, 1]]))
    assert (two.chi2 > 100 * two.freedom).all()
    assert (two.covariance[..., 0, 0].sqrt() > 0.3).all()  # of two that contradict each other nobody knows which


def test_patches_that_all_disagree_are_all_used_and_sigma_tells():
    """As behind a lens that nobody told of."""
    layout = Layout.of(square(), [range(16)])
    motion = moved(layout, 200)
    pose, covariance = seen(layout, motion)
    pose = pose + torch.tensor([0.1, 0.1, 1e-3]) * normal(200, 16, 3, seed=8)
    found = fuse(pose, covariance, torch.ones(200, 16, dtype=torch.bool), layout)
    assert found.weight.mean() > 0.9
    error = (found.pose - motion)[:, 0]
    squares = (error[:, None] @ torch.linalg.solve(found.covariance[:, 0], error[..., None])).flatten() / 3
    assert 0.5 < squares.mean() < 2.5  # sigma is within 1.6, told 100 times too small by the patches


@given(st.integers(0, 999))
def test_moving_the_camera_moves_the_body(seed):
    """A rigid motion of all poses moves the body's pose along, and turns its covariance."""
    layout = Layout.of(square(), [range(7), range(8, 16)])
    pose, covariance = seen(layout, moved(layout), seed)
    by = torch.tensor([30.0, -20.0, 1.0], dtype=torch.float64) * normal(3, seed=seed)
    turn = torch.eye(3, dtype=torch.float64)
    turn[:2, :2] = compose(by, by)[2] * 0 + torch.stack(
        (torch.stack((by[2].cos(), by[2].sin())), torch.stack((-by[2].sin(), by[2].cos())))
    )
    good = torch.ones(1, 16, dtype=torch.bool)
    one = fuse(pose, covariance, good, layout)
    other = fuse(compose(by.expand_as(pose), pose), turn @ covariance @ turn.mT, good, layout)
    torch.testing.assert_close(other.pose, compose(by.expand_as(one.pose), one.pose), rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(other.covariance, turn @ one.covariance @ turn.mT, rtol=1e-6, atol=1e-13)
    torch.testing.assert_close(other.chi2, one.chi2, rtol=1e-6, atol=1e-6)
    assert one.weight[0, 7] == 0  # of no body


def test_frames_and_bodies_together_are_as_each_alone(device):
    layout = Layout.of(square(), [[0, 1, 4, 5], [2, 3, 6, 7, 11], [9]])
    pose, covariance = seen(layout, moved(layout, 6))
    pose, good = pose.clone(), torch.rand(6, 16, generator=torch.Generator().manual_seed(1)) > 0.2
    pose[3, 3] += 4.0
    whole = fuse(*(v.to(device) for v in (pose, covariance, good)), layout.to(device))
    for k in range(6):
        for g, members in enumerate(([0, 1, 4, 5], [2, 3, 6, 7, 11], [9])):
            if not good[k, members].any():
                assert whole.freedom[k, g] < 0
                continue
            own = layout.select(torch.tensor(members))
            alone = fuse(pose[k : k + 1, members], covariance[k : k + 1, members], good[k : k + 1, members], own)
            torch.testing.assert_close(whole.pose[k, g].cpu(), alone.pose[0, 0], rtol=1e-12, atol=1e-9)
            torch.testing.assert_close(whole.weight[k, members].cpu(), alone.weight[0], rtol=1e-6, atol=1e-6)


def test_turns_are_counted():
    layout = Layout.of(square(), [range(16)])
    motion = layout.start + torch.tensor([1.0, 2.0, 6 * math.pi + 0.1])
    pose, covariance = seen(layout, motion[None])
    pose = pose.clone()
    pose[0, 3, 2] -= 2 * math.pi  # one that was found again after a turn
    found = fuse(pose, covariance, torch.ones(1, 16, dtype=torch.bool), layout)
    assert found.pose[0, 0, 2] == pytest.approx(6 * math.pi + 0.1, abs=1e-3)
    assert found.weight.min() == 1


def test_a_body_without_patches_keeps_its_last_pose(tracker):
    body, start = Body(tracker, [[0, 1], [2, 3]]), tracker.start
    layout = body.layout
    pose, covariance = seen(layout, moved(layout, 3))
    status = torch.zeros(3, 16, dtype=torch.int8)
    status[1:, :2] = int(Status.LOST)
    whole = body(estimate(pose, covariance, start, status))
    each = [body(estimate(pose[k], covariance[k], start, status[k])) for k in range(3)]
    for k in range(3):
        torch.testing.assert_close(whole.pose[k], each[k].pose, rtol=0, atol=1e-12)
    assert whole.status[:, 0].tolist() == [Status.CONVERGED, Status.LOST, Status.LOST]
    assert (whole.pose[1:, 0] == whole.pose[0, 0]).all()
    assert whole.covariance[1, 0, 0, 0] == math.inf
    assert whole.pose.isfinite().all()
    assert whole.residual[1, 0].isnan().all()
    assert not whole.used[1, 0]


def test_other_points_and_relative_poses(tracker):
    """The pose of a point is that of the body there, and errors are as large as the covariances tell."""
    body = Body(tracker, [range(8), range(8, 16)])
    layout = body.layout
    motion = moved(layout, 1500, seed=2)
    found = body(estimate(*seen(layout, motion), tracker.start))
    points = torch.tensor([[0.0, 0.0], [900.0, 50.0]], dtype=torch.float64)
    arms = torch.cat((points - layout.start[:, :2], torch.zeros(2, 1)), 1)
    for (pose, covariance), truth in (
        (found.at(points), compose(motion, arms.expand_as(motion))),
        (found.relative(0, 1), _relative(motion, layout)),
    ):
        error = pose - truth
        squares = (error[..., None, :] @ torch.linalg.solve(covariance, error[..., None])).flatten() / 3
        assert 0.93 < squares.mean() < 1.07
    drifted = compose(torch.tensor([5.0, -3.0, 0.02]).double().expand_as(motion), motion)
    again = body(estimate(*seen(layout, drifted), tracker.start))
    assert (again.relative(0, 1)[0] - _relative(motion, layout)).abs().max() < 0.1


def _relative(motion: Tensor, layout: Layout) -> Tensor:
    back = compose(layout.start[1].expand(len(motion), 3), inverse(motion[:, 1]))
    return compose(back, motion[:, 0])


def test_a_lost_patch_is_looked_for_where_its_body_says():
    """Covered while the stage goes away: found by tracking alone as soon as it can be seen, without a search."""
    scene, centers = PlaneWaves.random(), square(2, 120.0)[:, :2]
    path = placed(ramp((60.0, 30.0, 0.1), 16), (160.0, 160.0))
    frames = Camera(size=(360, 360), noise_sigma=2.0).capture(scene, path)[:, 0]
    frames[3:13, 60:200, 60:160] = 128  # over patch 0 and its way
    for guided in (False, True):
        tracker = Tracker(frames[0], centers, 41, prediction="hold", search=False)
        body = Body(tracker)
        found = []
        for frame in frames[1:]:
            estimate = tracker(frame)
            if guided:
                pose = body(estimate)
            found.append(bool(estimate.status[0] == Status.CONVERGED))
        assert found[-1] is guided
    truth = compose(path[-1], compose(inverse(path[0]), body.layout.start[0]))
    assert ((pose.pose[0] - truth).abs() < 6 * pose.sigma[0]).all()
    assert pose.used.all()


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([], "groups must be one list of patch numbers per body, got none"),
        ([0, 1], r"groups must be one list of patch numbers per body, got \[0, 1\]"),
        (3, "groups must be one list of patch numbers per body, got 3"),
        ([[0], []], "group 1 must hold at least one patch"),
        ([[0, 16]], "group 0 must hold numbers of patches from 0 to 15, got 16"),
        ([[0, 1], [1]], "patch 1 must be in one group, got it in 0 and 1"),
    ],
)
def test_groups_that_are_none(tracker, groups, message):
    with pytest.raises(ValueError, match=message):
        Body(tracker, groups)


def test_what_is_no_tracker_lens_or_estimate(tracker):
    for make, message in (
        (lambda: Body(None), "tracker must be a Tracker, got NoneType"),
        (lambda: Body(tracker, lens=0.1), "lens must be a Lens, got float"),
        (lambda: Body(tracker)(torch.ones(16, 3)), "estimate must be an Estimate or a Track, got Tensor"),
    ):
        with pytest.raises(ValueError, match=f"Body: {message}"):
            make()


def test_estimates_of_other_patches(tracker):
    other = estimate(square(2), torch.eye(3).double().expand(4, 3, 3), square(2))
    with pytest.raises(ValueError, match="estimate must be of 16 patches"):
        Body(tracker)(other)
