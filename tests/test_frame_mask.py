"""What is fixed to the camera, and masked, bears on no pose: it is out of sight, as what lies beyond the border."""

from __future__ import annotations

import copy
import io
import pickle

import cv2
import numpy as np
import pytest
import torch
from engines import BACKENDS
from torch import Tensor

from torch_ecc import Origin, Status, Tracker, suggest_frame_mask
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.track import Session
from torch_ecc.sim.scene.waves import PlaneWaves

SHAPE, SIZE = (150, 160), 81
SCENE = PlaneWaves.random(seed=3)
PATH = torch.tensor(
    [[79, 75, 0], [81.3, 73.8, 0.02], [84.1, 71.9, 0.05], [88.2, 70.4, 0.07], [91, 74.5, 0.04], [86.7, 80.2, 0.01]],
    dtype=torch.float64,
)
CENTER = [(79.0, 75.0)]
Y, X = (torch.arange(n, dtype=torch.float32) for n in SHAPE)
Y = Y[:, None]
SHOWN = {
    "aperture": torch.hypot(X - 80, Y - 75) < 42,
    "stripe": (X + 0.2 * Y - 100).abs() > 5,
    "dust": ((X % 40 - 20).square() + (Y % 40 - 20).square()) > 10,
}
backends = pytest.mark.parametrize("backend", BACKENDS)
marks = pytest.mark.parametrize("mark", SHOWN)


def noisy(frames: Tensor, seed: int = 0) -> Tensor:
    noise = torch.randn(frames.shape, generator=torch.Generator().manual_seed(seed))
    return (frames + 2 * noise).round().clamp(0, 255).to(torch.uint8)


def filmed(path: Tensor = PATH) -> Tensor:
    """Frames (F, H, W) with noise."""
    return noisy(SCENE.render(path, SHAPE)[:, 0].float())


def marked(frames: Tensor, shown: Tensor, mark: float | Tensor = 12) -> Tensor:
    return torch.where(shown, frames, torch.as_tensor(mark).to(frames.dtype))


def tracker(frames: Tensor, **options: object) -> Tracker:
    return Tracker(frames[0], CENTER, SIZE, **options)


@backends
@marks
@pytest.mark.parametrize("robust", [True, False])
def test_poses_are_right_behind_marks_of_the_camera(mark, robust, backend):
    frames = marked(filmed(), SHOWN[mark])
    track = tracker(frames, frame_mask=SHOWN[mark], robust=robust, backend=backend).track_sequence(frames[1:])
    error = (track.pose[:, 0] - PATH[1:]).abs()
    assert (track.status == Status.CONVERGED).all()
    assert error[:, :2].max() < 0.03
    assert error[:, 2].max() < 1.5e-3
    assert (error < 5 * track.sigma[:, 0]).all()
    assert (track.coverage > 0.95).all()  # of what is in sight


def test_they_are_not_without_the_mask():
    """Else the law above says nothing."""
    frames = marked(filmed(), SHOWN["stripe"])
    track = tracker(frames, robust=False).track_sequence(frames[1:])
    assert (track.pose[:, 0] - PATH[1:])[:, :2].abs().max() > 1


@backends
@marks
def test_what_a_mark_looks_like_bears_on_nothing(mark, backend):
    """But for what the sampler takes of it, px away."""
    clean, found = filmed(PATH[:4]), []
    changing = noisy(torch.full_like(clean, 128.0, dtype=torch.float32) + 60 * (X % 7 > 3), seed=1)
    for image in (12, 240, changing):
        frames = marked(clean, SHOWN[mark], image)
        found.append(tracker(frames, frame_mask=SHOWN[mark], backend=backend).track_sequence(frames[1:]))
    for other in found[1:]:
        torch.testing.assert_close(other.pose, found[0].pose, atol=5e-3, rtol=0)
        torch.testing.assert_close(other.score, found[0].score, atol=2e-3, rtol=0)


@backends
def test_a_mask_far_from_the_template_changes_nothing(backend):
    frames, shown = filmed(), torch.ones(SHAPE)
    shown[:8, :8] = 0
    plain, masked = (
        tracker(frames, frame_mask=mask, backend=backend).track_sequence(frames[1:]) for mask in (None, shown)
    )
    for name, value in plain._asdict().items():
        assert torch.equal(getattr(masked, name), value), name


@pytest.mark.parametrize("kind", [torch.bool, torch.uint8, torch.float32])
def test_more_than_zero_is_shown(kind):
    frames = marked(filmed(), SHOWN["dust"])
    one, other = (
        tracker(frames, frame_mask=mask).track_sequence(frames[1:3])
        for mask in (SHOWN["dust"], SHOWN["dust"].to(kind) * (1 if kind == torch.bool else 3))
    )
    assert torch.equal(one.pose, other.pose)


@backends
def test_what_moves_under_an_aperture_is_out_of_view_and_comes_back(backend):
    x = torch.tensor([79.0, 81, 85, 91, 98, 106, 114, 122, 130, 138, 146, 130, 115, 100, 90])
    away = torch.stack((x, 0 * x + 75, 0 * x), 1).double()
    shown = (X < 112).expand(SHAPE)
    frames = marked(filmed(away), shown)
    track = tracker(frames, frame_mask=shown, backend=backend).track_sequence(frames[1:])
    error, status, seen = (track.pose[:, 0] - away[1:])[:, :2].abs().amax(1), track.status[:, 0], 112 - x[1:] + SIZE / 2
    assert (status[seen > 0.4 * SIZE] == Status.CONVERGED).all()
    assert (status[seen < 0.2 * SIZE] == Status.OUT_OF_VIEW).all()
    assert error[track.ok[:, 0]].max() < 0.1


@backends
def test_a_search_knows_the_marks_too(backend):
    """The template jumps to where the half of it is hidden."""
    path = PATH[:2].clone()
    path[1] += torch.tensor([14.0, 9.0, 0.03])
    shown = (X < 105).expand(SHAPE)
    frames = marked(filmed(path), shown)
    found = tracker(frames, frame_mask=shown, backend=backend)(frames[1])
    assert found.status[0] == Status.CONVERGED
    assert found.origin[0] != Origin.TRACKED
    assert (found.pose[0] - path[1])[:2].abs().max() < 0.05


@backends
def test_templates_do_not_bear_on_each_other(backend):
    centers = [(60.0, 60.0), (100.0, 90.0), (79.0, 75.0)]
    frames, shown = marked(filmed(), SHOWN["stripe"]), SHOWN["stripe"]
    options = {"frame_mask": shown, "backend": backend}
    together = Tracker(frames[0], centers, 51, **options).track_sequence(frames[1:4])
    streams = Tracker(frames[:1].expand(3, -1, -1)[:, None], centers, 51, **options)
    for r, center in enumerate(centers):
        alone = Tracker(frames[0], [center], 51, **options).track_sequence(frames[1:4])
        torch.testing.assert_close(together.pose[:, r], alone.pose[:, 0], atol=1e-3, rtol=0)
    apart = streams(frames[1:2].expand(3, -1, -1)[:, None])
    torch.testing.assert_close(apart.pose, together.pose[0], atol=1e-3, rtol=0)


def test_copies_and_states_go_on_with_it():
    frames, shown = marked(filmed(), SHOWN["aperture"]), SHOWN["aperture"]
    used = tracker(frames, frame_mask=shown)
    used.track_sequence(frames[1:3])
    other = tracker(frames, frame_mask=shown)
    other.load_state_dict(copy.deepcopy(used.state_dict()))
    buffer = io.BytesIO(pickle.dumps(used))
    copies = [copy.deepcopy(used), pickle.load(buffer), other, copy.deepcopy(used).to("cpu").double()]
    expected = used.track_sequence(frames[3:]).pose
    for one in copies:
        assert torch.equal(one.frame_mask, shown)
        assert torch.equal(one.track_sequence(frames[3:]).pose, expected)


def test_the_caller_may_change_the_mask_afterwards():
    frames, shown = marked(filmed(), SHOWN["dust"]), SHOWN["dust"].clone()
    used, kept = (tracker(frames, frame_mask=mask) for mask in (shown, SHOWN["dust"]))
    shown.zero_()
    assert torch.equal(copy.deepcopy(used)(frames[1]).pose, kept(frames[1]).pose)


def test_a_template_is_found_behind_marks():
    frames, shown = filmed(), SHOWN["stripe"]
    template = filmed()[0, 35:116, 39:120]
    found, located = Tracker.find(template, marked(frames, shown)[2], frame_mask=shown)
    assert located.status[0] == Status.CONVERGED
    assert (found.pose[0] - PATH[2])[:2].abs().max() < 0.05
    assert (found(marked(frames, shown)[3]).pose[0] - PATH[3])[:2].abs().max() < 0.05


WRONG = {
    "a list": ([[1]], "frame_mask must be a torch tensor"),
    "another shape": (torch.ones(3, 4), r"frame_mask must be \(150, 160\), as the frame, got \(3, 4\)"),
    "channels": (torch.ones(1, *SHAPE), r"frame_mask must be \(150, 160\)"),
    "complex": (torch.ones(SHAPE, dtype=torch.complex64), "frame_mask must be of bool, integers or float"),
    "NaN": (torch.full(SHAPE, torch.nan), "frame_mask must be finite"),
    "nothing": (torch.zeros(SHAPE), "frame_mask must show the scene somewhere"),
    "no template": (torch.hypot(X - 79, Y - 75) > 70, r"at least one pixel of each template, got none for \[0\]"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_no_mask_is_refused(what):
    mask, words = WRONG[what]
    with pytest.raises(ValueError, match=words):
        tracker(filmed(PATH[:1]), frame_mask=mask)


def test_the_command_line_takes_a_picture(tmp_path):
    """Its brighter half is shown, whatever JPEG or a scan have made of black."""
    frames, shown = marked(filmed(), SHOWN["stripe"]), SHOWN["stripe"]
    np.save(tmp_path / "video.npy", frames.numpy())
    cv2.imwrite(str(tmp_path / "mask.png"), (20 + 200 * shown.numpy()).astype(np.uint8))
    options = {"centers": (CENTER[0],), "size": SIZE, "out": str(tmp_path / "out"), "overlay": False}
    session = Session(TrackJob(input=str(tmp_path / "video.npy"), frame_mask=str(tmp_path / "mask.png"), **options))
    assert torch.equal(session.tracker.frame_mask, shown)
    session.run()
    with np.load(tmp_path / "out" / "track.npz") as track:
        assert np.abs(track["pose"][:, 0] - PATH.numpy()).max() < 0.03
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((150, 170), np.uint8))
    with pytest.raises(ValueError, match=r"frame_mask must be \(150, 160\), as the frame, got \(150, 170\)"):
        Session(
            TrackJob(input=str(tmp_path / "video.npy"), frame_mask=str(tmp_path / "mask.png"), force=True, **options)
        )


def swung(count: int = 20, reach: float = 10) -> Tensor:
    """A path (F, 3) that comes back."""
    angle = torch.arange(count, dtype=torch.float64) / (count - 1) * 2 * torch.pi
    return torch.stack((79 + reach * angle.sin(), 75 + reach * (1 - angle.cos()), 0.04 * angle.sin()), 1)


@pytest.mark.parametrize("mark", ["stripe", "dust"])
def test_marks_are_told_from_a_track_that_they_have_bent(mark):
    """By tracking twice; what is right then is right to what noise makes of it."""
    path, shown = swung(), SHOWN[mark]
    frames, mask = marked(filmed(path), shown), None
    for _ in range(2):
        track = tracker(frames, frame_mask=mask).track_sequence(frames[1:])
        mask = suggest_frame_mask(frames[1:], track, SIZE)
    crossed = (X - 79).abs().maximum((Y - 85).abs()) < 35
    assert (mask & ~shown & crossed).sum() < 0.1 * (~shown & crossed).sum()
    assert (~mask & shown).sum() < 0.05 * (~shown).sum()
    error = (tracker(frames, frame_mask=mask).track_sequence(frames[1:]).pose[:, 0] - path[1:])[:, :2]
    assert error.abs().max() < 0.05


@pytest.mark.parametrize("light", [0.6])
def test_a_camera_without_marks_gets_no_mask(light):
    """However it moves or does not, and whatever the light does."""
    for reach in (0, 10):
        frames = SCENE.render(swung(reach=reach), SHAPE)[:, 0].float()
        frames = noisy(frames * torch.linspace(1, light, len(frames))[:, None, None])
        track = tracker(frames).track_sequence(frames[1:])
        assert suggest_frame_mask(frames[1:], track, SIZE).all()


def test_what_covers_the_template_for_some_frames_is_no_mark():
    """But for the rim, which few frames tell of."""
    frames = filmed(swung())
    frames[4:8, :, 60:75] = 12
    track = tracker(frames).track_sequence(frames[1:])
    assert (~suggest_frame_mask(frames[1:], track, SIZE)).sum() < 0.01 * SIZE**2


def test_frames_that_are_not_the_tracks_are_refused():
    frames = filmed()
    track = tracker(frames).track_sequence(frames[1:])
    for some, words in (
        (frames, "frames must be 5, as many as the track has, got 6"),
        (frames[1:4], "frames must be 5, as many as the track has, got 3"),
        ([*frames[1:5], frames[5, :90]], "frame 4 must be one of the first one's size"),
        ([[1]], "frame 0 must be a torch tensor"),
    ):
        with pytest.raises(ValueError, match=words):
            suggest_frame_mask(some, track, SIZE)
    with pytest.raises(ValueError, match=r"track must be \(F, R, ...\)"):
        suggest_frame_mask(frames, tracker(frames)(frames[1]), SIZE)
    with pytest.raises(ValueError, match="size must be"):
        suggest_frame_mask(frames[1:], track, 2)
