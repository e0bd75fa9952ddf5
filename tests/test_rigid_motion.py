"""Laws of motions: the centre of a rotation, and patches grouped by how they move."""

from __future__ import annotations

import math

import pytest
import torch
from crowds import Crowd, Draw
from torch import Tensor

from torch_ecc import Estimate, Status, Track, rigid_groups, rotation_centre
from torch_ecc.core.pose import compose, rotation

SIGMA = torch.tensor([0.003, 0.004, 1e-5], dtype=torch.float64)
CENTRE = torch.tensor([900.0, -300.0], dtype=torch.float64)


def turning(seed: int, frames: int = 60, degrees: float = 2.0, wander: float = 0.0) -> tuple[Tensor, Tensor]:
    """Poses of a body that turns about CENTRE, with noise of frames and, once for all, of the templates."""
    g = torch.Generator().manual_seed(seed)
    theta = math.radians(degrees) * torch.linspace(0, 2 * math.pi, frames, dtype=torch.float64).sin()
    arm = torch.tensor([320.0, 240.0], dtype=torch.float64) - CENTRE
    at = CENTRE + rotation(theta) @ arm + wander * torch.randn(frames, 2, generator=g).double()
    noise = SIGMA / 2**0.5 * torch.randn(frames + 1, 3, generator=g, dtype=torch.float64)
    pose = compose(torch.cat((at, theta[:, None]), 1), noise[:1].expand(frames, 3)) + noise[1:]
    return pose, torch.diag(SIGMA.square()).expand(frames, 3, 3)


def test_the_centre_and_its_sigma():
    squares, chi = [], []
    for seed in range(200):
        found = rotation_centre(*turning(seed))
        error = found.centre - CENTRE
        squares.append(float(error @ torch.linalg.solve(found.covariance, error)) / 2)
        chi.append(found.chi2 / found.freedom)
    assert 0.8 < torch.tensor(squares).mean() < 1.2
    assert 0.95 < torch.tensor(chi).mean() < 1.05
    assert found.fixed
    assert found.wander_px == 0


def test_a_centre_that_wanders_is_told_with_its_size():
    found = rotation_centre(*turning(0, wander=0.05))
    assert not found.fixed
    assert found.wander_px == pytest.approx(0.05, rel=0.2)
    assert ((found.centre - CENTRE).abs() < 4 * found.sigma).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, c: (p[:3], c[:3]), "expected 4 frames or more, got 3"),
        (lambda p, c: (p * torch.tensor([1.0, 1.0, 0.0]), c), "the body must turn"),
        (lambda p, c: (p[:, :2], c), r"expected poses \(F, 3\)"),
        (lambda p, c: (p * math.nan, c), "got 0 that are known"),
    ],
)
def test_what_is_no_rotation(change, message):
    with pytest.raises(ValueError, match=message):
        rotation_centre(*change(*turning(0)))


def scene(seed: int = 0, frames: int = 30) -> tuple[Track, list[list[int]]]:
    """Two moving bodies and a still frame, interleaved; two patches of nothing; some lost now and then."""
    g = torch.Generator().manual_seed(seed)
    start = torch.cat((torch.rand(40, 2, generator=g).double() * 600, torch.zeros(40, 1)), 1)
    time = torch.linspace(0, 2 * math.pi, frames, dtype=torch.float64)
    none = torch.zeros_like(time)
    first = torch.stack((6 * time.sin(), 3 * time.sin(), 0.05 * time.sin()), 1)
    second = torch.stack((none, 2 * (1 - time.cos()), none), 1)
    groups = [list(range(16)), list(range(16, 26)), list(range(26, 38))]
    pose = start.repeat(frames, 1, 1)
    for motion, group in zip((first, second), groups, strict=False):
        pose[:, group] = compose(motion[:, None].expand(-1, len(group), 3), pose[:, group])
    pose[:, 38:, :2] += torch.randn(frames, 2, 2, generator=g).double()
    sigma = torch.tensor([0.005, 0.005, 2e-4], dtype=torch.float64)
    pose = pose + sigma * torch.randn(frames, 40, 3, generator=g, dtype=torch.float64)
    none = torch.zeros(frames, 40, dtype=torch.float64)
    lost = torch.rand(frames, 40, generator=g) < 0.2
    pose[lost] = start.repeat(frames, 1, 1)[lost]
    status = torch.where(lost, int(Status.LOST), 0).to(torch.int8)
    covariance = torch.diag(sigma.square()).expand(frames, 40, 3, 3)
    codes = status * 0
    one = Estimate(pose, pose - start, none, status, codes, covariance, none, codes, none, codes)
    return Track(*one), groups


@pytest.mark.parametrize("seed", range(3))
def test_bodies_are_told_apart_by_their_motion(seed):
    track, groups = scene(seed)
    found = rigid_groups(track, 2)
    assert found.groups == groups
    assert found.still
    assert found.misfit[38:].isinf().all()
    assert found.misfit[:38].max() < 8


def test_no_more_bodies_than_there_are_and_no_less_than_asked_for():
    track, groups = scene()
    assert rigid_groups(track, 5).groups == groups
    assert rigid_groups(track, 1).groups == [groups[0], groups[2]]


def test_a_frame_that_drifts_is_one_of_the_bodies():
    track, groups = scene()
    drift = torch.linspace(0, 1.5, len(track.pose), dtype=torch.float64)[:, None, None] * torch.tensor([1.0, 0.5, 0.0])
    moved = track._replace(pose=track.pose + drift, displacement=track.displacement + drift)
    found = rigid_groups(moved, 3)
    assert sorted(found.groups) == sorted(groups)
    assert not found.still


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("wide", "rogues"), [(600, 2), (600, 10), (600, 30), (4000, 2)])
def test_a_patch_whose_angle_is_not_known_hides_no_small_body(seed, wide, rogues):
    """It explains whatever is far enough from it, as what goes its own way: neither is a body. The large one's patches
    may be so far apart that a single one knows little of the others."""
    g, frames = torch.Generator().manual_seed(seed), 30
    place = torch.rand(19 + rogues, 2, generator=g).double() * wide
    place[16:19] = wide / 2 + 60 * place[16:19] / wide
    time = torch.linspace(0, 2 * math.pi, frames, dtype=torch.float64)
    start, none = torch.nn.functional.pad(place, (0, 1)), torch.zeros_like(time)
    large = torch.stack((6 * time.sin(), 3 * time.sin(), 0.05 * time.sin()), 1)
    small = torch.stack((none, 2 * (1 - time.cos()), none), 1)
    pose = compose(large[:, None].expand(-1, len(start), 3), start.expand(frames, -1, 3))
    pose[:, 16:19] = compose(small[:, None].expand(-1, 3, 3), start[16:19].expand(frames, -1, 3))
    ways = torch.randn(frames, rogues, 2, generator=g).double().cumsum(0) * 0.3
    pose[:, 19:] = start[19:] + torch.nn.functional.pad(ways - ways[:1], (0, 1))
    sigma = torch.tensor([0.005, 0.005, 2e-4], dtype=torch.float64)
    pose = pose + sigma * torch.randn(pose.shape, generator=g, dtype=torch.float64)
    covariance = torch.diag(sigma.square()).repeat(frames, len(start), 1, 1)
    covariance[:, 19, 2, 2] = 0.3**2
    none, codes = torch.zeros_like(pose[..., 0]), torch.zeros_like(pose[..., 0], dtype=torch.int8)
    track = Track(*Estimate(pose, pose - start, none, codes, codes, covariance, none, codes, none, codes))
    assert rigid_groups(track, 2).groups[:2] == [list(range(16)), [16, 17, 18]]


@pytest.mark.parametrize("seed", range(12))
def test_bodies_are_put_together_whatever_they_are(seed):
    """Few or many, small or all over the view, with strays and lost frames between them."""
    crowd = Crowd.drawn(seed)
    assert crowd.right(rigid_groups(crowd.track, crowd.bodies)) > 0.97


def test_strays_alone_are_no_body():
    """Neither are two that agree by chance."""
    draw = Draw(torch.Generator().manual_seed(0))
    start = draw.places(60, 2000.0, 2000.0)
    steps = draw.normal(40, 60, 3) * torch.tensor([0.5, 0.5, 0.002], dtype=torch.float64)
    with pytest.raises(ValueError, match="no two patches move together"):
        rigid_groups(draw.seen(start + steps.cumsum(0) - steps[:1], start), 3)


def test_wrong_calls():
    track, _ = scene()
    for call, message in (
        (lambda: rigid_groups(Estimate(*(v[0] for v in track)), 2), r"track must be \(F, R, ...\)"),
        (lambda: rigid_groups(track, 0), "bodies must be a whole number of at least 1"),
        (lambda: rigid_groups(track, True), "bodies must be a whole number of at least 1"),
        (lambda: rigid_groups(Track(*(v[:, 38:] for v in track)), 2), "no two patches move together"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
