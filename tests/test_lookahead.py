"""Frames that are looked at ahead are tracked as they are without: all that changes is the time."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from torch_ecc import Status, Track, Tracker
from torch_ecc.core import align
from torch_ecc.core.native import engine
from torch_ecc.sim.scene.waves import PlaneWaves
from torch_ecc.track import lookahead

SIZE, FRAME, MIDDLE, COUNT = 61, (130, 140), (69.0, 64.0), 26
SCENE = PlaneWaves.random(seed=3)


def path(step: float = 0.7) -> Tensor:
    """Poses (F, 3) of a target that goes to and fro, the first one in the middle."""
    k = torch.arange(COUNT, dtype=torch.float64)
    moved = torch.stack((8 * step * (k / 7).sin(), 5 * step * (k / 9).sin(), 0.02 * step * (k / 5).sin()), 1)
    return moved + torch.tensor([*MIDDLE, 0.0], dtype=torch.float64)


def film(step: float = 0.7, noise: float = 2.0, contrast: float = 1.0) -> Tensor:
    """Frames (F, H, W) as a camera gives them."""
    frames = SCENE.render(path(step), FRAME)[:, 0].float()
    frames = frames.mean() + contrast * (frames - frames.mean())
    more = torch.randn(frames.shape, generator=torch.Generator().manual_seed(1))
    return (frames + noise * more).round().clamp(0, 255).to(torch.uint8)


def covered() -> Tensor:
    """A few blocks of the template are brighter, then a third is covered, and then all of it."""
    frames = film()
    frames[4:6, 60:70, 60:70] += 20
    frames[9:14, :, 50:75], frames[20:23, 30:100, 30:110] = 90, 90
    return frames


def jumping() -> Tensor:
    """It leaps by 15 px and back."""
    frames = film()
    frames[12:17] = frames[12:17].roll((9, 12), (1, 2))
    return frames


def leaving() -> Tensor:
    """A view into which a part of it only reaches at times."""
    return film(2.0)[:, 30:, 36:]


FILMS = {
    "plain": film(),
    "still": film(0.0),
    "without noise": film(noise=0.0),
    "dim": film(noise=1.0, contrast=0.03),
    "covered": covered(),
    "jumping": jumping(),
    "leaving": leaving(),
}
OPTIONS: dict[str, dict[str, Any]] = {
    "as it was": {"prediction": "hold", "robust": False},
    "without search": {"search": False, "interpolation": "bilinear", "criterion": "ssd"},
    "two at most": {"max_step": (2.0, 1.0), "max_iterations": 2},
    "torch": {"backend": "torch"},
}


def tracker_of(frames: Tensor, **options: Any) -> Tracker:
    """Of the template in the first frame."""
    centre = (MIDDLE[0] - 36, MIDDLE[1] - 30) if frames.shape[1:] != FRAME else MIDDLE
    return Tracker(frames[0], [centre], SIZE, **options)


def one_by_one(tracker: Tracker, frames: Iterator[Tensor] | list[Tensor]) -> Track:
    """As they come."""
    return Track.stack([tracker(frame) for frame in frames])


def assert_same(one: Tracker, other: Tracker, *tracks: Track) -> None:
    """Both have found the same, and know the same."""
    for a, b in zip(*tracks, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9, equal_nan=True)
    for (name, a), b in zip(one.named_buffers(), other.buffers(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9, msg=name)


def counted(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[int]:
    """Calls of a module's function, which goes on as before."""
    calls, function = [0], getattr(module, name)

    def counting(*args: Any, **kwargs: Any) -> Any:
        calls[0] += 1
        return function(*args, **kwargs)

    monkeypatch.setattr(module, name, counting)
    return calls


def test_most_frames_are_judged_together(monkeypatch: pytest.MonkeyPatch):
    """Sixteen by one verdict, and none is solved twice; also of a tracker that is made anew in between."""
    together, alone = counted(monkeypatch, lookahead, "judge"), counted(monkeypatch, align, "judge")
    solved, frames = counted(monkeypatch, engine, "solve"), FILMS["plain"]
    tracker_of(frames).track_sequence(frames)
    assert (alone[0], together[0]) == (0, -(-COUNT // lookahead.MOST))
    if solved[0]:
        assert solved[0] == COUNT
    tracker = tracker_of(frames)
    tracker.look_ahead(frames)
    for k, frame in enumerate(frames):  # another object than the one before, in the same place
        if k == 5:
            tracker.load_state_dict(tracker.state_dict())
        tracker(frame)
    assert (alone[0], together[0]) == (0, 2 + 3)


@pytest.mark.parametrize(("what", "how"), [*((f, "as ever") for f in FILMS), *(("covered", o) for o in OPTIONS)])
def test_it_is_found_as_without(what: str, how: str, monkeypatch: pytest.MonkeyPatch):
    """Poses, covariances, status, and what the tracker knows in the end; and where little is ordinary frames are solved
    hardly more often."""
    frames, options = FILMS[what], OPTIONS.get(how, {})
    frames = frames[:12] if how == "torch" else frames
    steps, here, there = counted(monkeypatch, lookahead, "ahead"), *(tracker_of(frames, **options) for _ in range(2))
    there.look_ahead(some := list(frames))
    assert_same(here, there, one_by_one(here, list(frames)), one_by_one(there, some))
    assert steps[0] <= COUNT + lookahead.MOST


def test_a_tracker_that_is_told_where_to_look_looks_there(monkeypatch: pytest.MonkeyPatch):
    """What was seen from elsewhere means nothing then, and one stops looking."""
    steps, frames, which = counted(monkeypatch, lookahead, "ahead"), list(FILMS["plain"]), torch.ones(1).bool()
    here, there, tracks = tracker_of(FILMS["plain"]), tracker_of(FILMS["plain"]), ([], [])
    there.look_ahead(frames)
    for frame in frames:
        for tracker, track in zip((here, there), tracks, strict=True):
            track.append(tracker(frame))
            tracker.expect(tracker.pose + 0.1, tracker.velocity, which)
    assert_same(here, there, *map(Track.stack, tracks))
    assert steps[0] <= 2 * COUNT


def test_frames_may_be_left_out_or_be_others():
    """What was told of is no promise: every second frame, one twice, and some of another film."""
    frames, others = list(FILMS["plain"]), list(film(noise=3.0))
    came = [*frames[:9:2], frames[8], frames[8].clone(), *others[10:13], *frames[13:]]
    here, there = tracker_of(FILMS["plain"]), tracker_of(FILMS["plain"])
    there.look_ahead(frames)
    assert_same(here, there, one_by_one(here, came), one_by_one(there, came))


def test_a_frame_that_has_changed_since_is_another_one():
    """As one that is filled anew."""
    frames = [frame.clone() for frame in FILMS["plain"]]
    here, there = tracker_of(FILMS["plain"]), tracker_of(FILMS["plain"])
    there.look_ahead(frames)
    tracks = ([], [])
    for k, frame in enumerate(frames):
        if k % 5 == 3:
            frame.add_(20)
        for tracker, track in zip((here, there), tracks, strict=True):
            track.append(tracker(frame))
    assert_same(here, there, *map(Track.stack, tracks))


def test_a_look_ahead_in_inference_mode_leaves_nothing_behind():
    """Whatever mode the frames come in: what is found outside of it may be written to."""
    frames = list(FILMS["plain"])
    here, there = tracker_of(FILMS["plain"]), tracker_of(FILMS["plain"])
    there.look_ahead(frames)
    tracks = one_by_one(here, frames), []
    for k, frame in enumerate(frames):
        with torch.inference_mode(k % 7 < 4):
            tracks[1].append(there(frame))
        assert all(value.is_inference() == (k % 7 < 4) for value in tracks[1][-1])
    assert_same(here, there, tracks[0], Track.stack(tracks[1]))


def test_damaged_frames_are_where_they_are():
    """Missing, of another size, not finite: each is skipped in its turn, as it is by who does not look ahead."""
    frames = list(FILMS["plain"])
    frames[5], frames[9], frames[14], frames[15] = None, frames[9][:-3], frames[14] * torch.nan, None
    here, there = tracker_of(FILMS["plain"]), tracker_of(FILMS["plain"])
    tracks = here.track_sequence(iter(frames)), there.track_sequence(frames)
    assert_same(here, there, *tracks)
    damaged = (tracks[1].status[:, 0] == Status.DAMAGED).nonzero()[:, 0].tolist()
    assert damaged == [5, 9, 14, 15]


def test_a_camera_may_fill_one_frame_again_and_again():
    """Such frames come one after the other, and are not there before it is their turn."""
    frames, one = FILMS["plain"], torch.empty_like(FILMS["plain"][0])
    here, there = tracker_of(frames), tracker_of(frames)
    assert_same(here, there, here.track_sequence(frames), there.track_sequence(one.copy_(frame) for frame in frames))


@pytest.mark.parametrize("again", [copy.deepcopy, lambda tracker: pickle.loads(pickle.dumps(tracker))])
def test_a_copy_goes_on(again: Callable[[Tracker], Tracker]):
    """It knows nothing of the frames, and finds the same."""
    frames = list(FILMS["plain"])
    one = tracker_of(FILMS["plain"])
    one.look_ahead(frames)
    one_by_one(one, frames[:11])
    other = again(one)
    assert_same(one, other, one_by_one(one, frames[11:]), one_by_one(other, frames[11:]))


def test_poses_of_frames_that_require_grad_have_theirs():
    """Among others that do not."""
    frames = [frame.float() for frame in FILMS["plain"][:12]]
    for k in (3, 4, 9):
        frames[k].requires_grad_()
    tracker = tracker_of(FILMS["plain"])
    tracker.look_ahead(frames)
    poses = []
    for k, frame in enumerate(frames):
        poses.append(tracker(frame.requires_grad_(k in (3, 4, 6, 9))).pose[0, 0])  # of the third nobody knew
    for k in (3, 4, 6, 9):
        (slope,) = torch.autograd.grad(poses[k], frames[k])
        assert slope.abs().max() > 0


class FromDisk(Sequence[Tensor]):
    """Frames that are read when they are asked for."""

    def __init__(self, frames: Tensor, read: list[int]) -> None:
        self.frames, self.read = frames, read

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k: int) -> Tensor:
        self.read.append(k)
        return self.frames[k]


def test_frames_that_are_read_one_by_one_are_not_read_all_at_once():
    """More of them than memory holds are tracked as ever."""
    frames, read, seen = FILMS["plain"], [], []
    tracker = tracker_of(frames)
    track = tracker.track
    tracker.track = lambda frame: seen.append(len(read)) or track(frame)
    tracker.track_sequence(FromDisk(frames, read))
    assert seen == list(range(1, COUNT + 1))


def test_frames_that_are_not_there_are_refused():
    """A generator may have no end."""
    with pytest.raises(ValueError, match="look_ahead: expected a list or a tensor of frames, got generator"):
        tracker_of(FILMS["plain"]).look_ahead(frame for frame in FILMS["plain"])


@pytest.mark.parametrize("options", [{"average": 4}, {"levels": 2}, {"line_time": 1e-5, "fps": 50.0}])
def test_what_needs_more_than_a_frame_is_not_looked_at_ahead(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch):
    """It is tracked as ever."""
    together, frames = counted(monkeypatch, lookahead, "judge"), FILMS["plain"][:6]
    track = tracker_of(frames, **options).track_sequence(frames)
    assert (track.status == Status.CONVERGED).all()
    assert together[0] == 0
