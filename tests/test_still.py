"""Laws of marks of a camera that nobody has told of: what stays put in the frame bears on no pose for long."""

from __future__ import annotations

import copy

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from torch_ecc import Status, Tracker
from torch_ecc.sim.scene.waves import PlaneWaves
from torch_ecc.track.still import Still

SHAPE, SIZE, CENTER = (150, 160), 81, [(79.0, 75.0)]
SCENE, BEHIND = PlaneWaves.random(seed=3), PlaneWaves.random(seed=8)
Y, X = (torch.arange(n, dtype=torch.float32) for n in SHAPE)
Y = Y[:, None]
SHOWN = {
    "aperture": torch.hypot(X - 80, Y - 75) < 36,
    "stripe": (X + 0.2 * Y - 100).abs() > 5,
    "dust": ((X % 40 - 20).square() + (Y % 40 - 20).square()) > 10,
}
marks = pytest.mark.parametrize("mark", SHOWN)


def path(count: int = 14, step: float = 1.1) -> Tensor:
    """From rest on, (F, 3) px, px, rad."""
    time = torch.arange(count, dtype=torch.float64)
    gone = step * time * (time / (time + 2))
    return torch.stack((79 + gone, 75 - 0.6 * gone, 0.004 * gone), 1)


def filmed(motion: Tensor, shown: Tensor | None = None, seed: int = 0) -> Tensor:
    """Frames (F, H, W) with noise, dark where the camera has not ``shown`` the scene."""
    clean = SCENE.render(motion, SHAPE)[:, 0].float()
    clean = clean if shown is None else torch.where(shown, clean, 12.0)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
    return (clean + 2 * noise).round().clamp(0, 255).to(torch.uint8)


def off(track, motion: Tensor) -> Tensor:
    """(F, 3)."""
    return (track.pose[:, 0] - motion[1:]).abs()


@marks
def test_marks_that_nobody_has_told_of_bend_no_pose(mark: str) -> None:
    """From the frame on in which they can be told; before it sigma covers what they do."""
    motion = path()
    frames = filmed(motion, SHOWN[mark])
    tracker = Tracker(frames[0], CENTER, SIZE, frame_mask="find")
    track = tracker.track_sequence(frames[1:])
    error, far = off(track, motion), torch.tensor([0.1, 0.1, 0.1 * torch.pi / 180])
    assert (track.status == Status.CONVERGED).all()
    assert not ((error > far) & (error > 5 * track.sigma[:, 0])).any()
    assert error[2:, :2].max() < 0.05
    told = tracker.marks > 0
    assert told.any()
    assert (told & SHOWN[mark]).sum() < 0.05 * SIZE**2
    plain = Tracker(frames[0], CENTER, SIZE, robust=False).track_sequence(frames[1:])
    assert off(plain, motion)[2:, :2].max() > 0.3  # else this says nothing


@marks
def test_marks_bring_a_pose_into_doubt_where_nobody_asks_for_them(mark: str) -> None:
    """Sigma covers what they do, and no other place is believed."""
    motion = path()
    frames = filmed(motion, SHOWN[mark])
    track = Tracker(frames[0], CENTER, SIZE).track_sequence(frames[1:])
    error, far = off(track, motion), torch.tensor([0.1, 0.1, 0.1 * torch.pi / 180])
    assert (track.status == Status.CONVERGED).all()
    assert not ((error > far) & (error > 5 * track.sigma[:, 0])).any()
    assert error[2:, :2].max() < 0.5
    assert (torch.linalg.eigvalsh(track.covariance) > 0).all()


def test_marks_cost_no_gradient() -> None:
    """Of what they bring into doubt the poses are as before, with their gradients."""
    motion = path()
    frames = filmed(motion, SHOWN["dust"]).float()
    tracker = Tracker(frames[0], CENTER, SIZE)
    tracker.track_sequence(frames[1:3])
    assert tracker.heed.tolist() == [2]
    estimate = tracker(frames[3].requires_grad_())
    estimate.pose.sum().backward()
    assert frames.grad is None
    assert estimate.pose.requires_grad


@pytest.mark.parametrize("light", [1.0, 0.7])
def test_a_camera_without_marks_has_none(light: float) -> None:
    """However the target moves, and where it is covered."""
    motion = path()
    frames = filmed(motion)
    frames = (frames * torch.linspace(1, light, len(frames))[:, None, None]).round().to(torch.uint8)
    covered = frames.clone()
    covered[5:, 60:90, 70:85] = 90
    for shown in (frames, covered, covered[4:5].expand(8, -1, -1), frames[:1].expand(8, -1, -1)):
        for asked in ("find", None):
            tracker = Tracker(shown[0], CENTER, SIZE, frame_mask=asked)
            track = tracker.track_sequence(shown[1:])
            assert not tracker.marks.any()
            assert not tracker.heed.any()
        told = Tracker(shown[0], CENTER, SIZE, frame_mask=torch.ones(SHAPE)).track_sequence(shown[1:])
        torch.testing.assert_close(track.covariance, told.covariance, atol=0, rtol=1e-6)


def test_templates_that_marks_do_not_bend_do_not_heed_them() -> None:
    """A still background is no mark to a template that is cut from it."""
    motion = path()
    frames, still = filmed(motion), BEHIND.render(torch.zeros(1, 3).double(), SHAPE)[0, 0].round().to(torch.uint8)
    frames = torch.where(X < 90, frames, still)  # what moves vanishes behind it
    noise = 2 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(4))
    frames = (frames + noise).round().clamp(0, 255).to(torch.uint8)
    both = Tracker(frames[0], [(70.0, 75.0), (125.0, 75.0)], 61, frame_mask="find")
    track = both.track_sequence(frames[1:])
    assert both.heed.tolist() == [1, 0]
    alone = Tracker(frames[0], [(125.0, 75.0)], 61, frame_mask="find").track_sequence(frames[1:])
    torch.testing.assert_close(track.pose[:, 1], alone.pose[:, 0], atol=1e-5, rtol=0)
    torch.testing.assert_close(track.coverage[:, 1], alone.coverage[:, 0], atol=1e-3, rtol=0)


def test_copies_and_states_know_the_marks() -> None:
    motion = path()
    frames = filmed(motion, SHOWN["stripe"])
    used = Tracker(frames[0], CENTER, SIZE, frame_mask="find")
    used.track_sequence(frames[1:6])
    assert used.heed.any()
    other = Tracker(filmed(motion)[0], CENTER, SIZE, frame_mask="find")
    other.load_state_dict(copy.deepcopy(used.state_dict()))
    copies = [copy.deepcopy(used), other, copy.deepcopy(used).to("cpu")]
    expected = used.track_sequence(frames[6:])
    for one in copies:
        for name, value in one.track_sequence(frames[6:])._asdict().items():
            torch.testing.assert_close(value, getattr(expected, name), atol=1e-6, rtol=1e-5)


def test_a_template_of_another_picture_is_told_of_marks_too() -> None:
    motion = path()
    clean = filmed(motion, seed=5)
    frames = filmed(motion, SHOWN["dust"])
    tracker, _ = Tracker.find(clean[0, 35:116, 39:120], frames[0])
    track = tracker.track_sequence(frames[1:])
    assert off(track, motion)[2:, :2].max() < 0.05


def test_a_told_mask_is_the_last_word() -> None:
    motion = path()
    frames = filmed(motion, SHOWN["stripe"])
    tracker = Tracker(frames[0], CENTER, SIZE, frame_mask=SHOWN["stripe"])
    tracker.track_sequence(frames[1:])
    assert not tracker.marks.any()


def test_a_coder_brings_no_pose_into_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it leaves stands still, too, next to where a template was cut; but all blocks say the same of the pose, and
    none looks like a mark: it is never tracked without."""
    tried = []
    monkeypatch.setattr(Still, "trial", lambda *_: tried.append(0))
    motion = path(count=8, step=0.2)
    frames = torch.from_numpy(np.stack([through_jpeg(frame.numpy()) for frame in filmed(motion)]))
    track = Tracker(frames[0], CENTER, SIZE).track_sequence(frames[1:])
    error = off(track, motion)
    assert not tried
    assert (track.sigma[:, 0, :2] < 0.1).all()
    assert (error < 5 * track.sigma[:, 0]).all()


@marks
def test_marks_in_front_of_a_coder_are_told_all_the_same(mark: str) -> None:
    """Though nothing fits there as noise lets expect."""
    motion = path(count=20)
    frames = torch.from_numpy(np.stack([through_jpeg(frame.numpy()) for frame in filmed(motion, SHOWN[mark])]))
    track = Tracker(frames[0], CENTER, SIZE).track_sequence(frames[1:])
    error, far = off(track, motion), torch.tensor([0.1, 0.1, 0.1 * torch.pi / 180])
    assert not ((error > far) & (error > 5 * track.sigma[:, 0]) & (track.status == Status.CONVERGED)).any()
    assert (track.status == Status.CONVERGED).all()
    assert error[5:, :2].max() < 0.1


def through_jpeg(frame: np.ndarray) -> np.ndarray:
    """As a coder leaves it."""
    return cv2.imdecode(cv2.imencode(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, 70))[1], cv2.IMREAD_GRAYSCALE)
