"""Laws of rolling shutters: what each row sees at a time of its own is seen as one pose, whatever moves how."""

from __future__ import annotations

import math

import pytest
import torch
from engines import BACKENDS
from torch import Tensor

from torch_ecc import Body, BodyEstimate, Status, Tracker
from torch_ecc.core.pose import rotation
from torch_ecc.sim import PlaneWaves
from torch_ecc.track.shutter import NODES, Shutter

FRAME, SIZE, FPS = (120, 140), 61, 29.97
READ = 0.9  # of a frame's time, for all its rows
LINE = READ / FRAME[0]
SCENE = PlaneWaves.random(seed=2)


def sway(time: float, center: tuple[float, float] = (70.0, 58.0)) -> Tensor:
    """Pose (3,): at rest until 0, and then up to 3.5 px per frame in x, and up and down."""
    t = max(time, 0.0)
    x, y = center
    return torch.tensor((x + 5 * math.sin(0.7 * t), y + 3 * math.sin(0.5 * t), 0.0), dtype=torch.float64)


def drift(time: float) -> Tensor:
    """A constant speed along a slope, turned."""
    return torch.tensor((50 + 2.1 * max(time, 0), 50 + 1.3 * max(time, 0), 0.0), dtype=torch.float64)


def exposed(path, time: float) -> Tensor:
    """A frame (h, w) whose rows see the scene at poses of their own."""
    rows = []
    for row in range(FRAME[0]):
        pose = path(time + LINE * (row - FRAME[0] / 2) if time else 0.0)
        rows.append(SCENE.render((pose - torch.tensor((0.0, row, 0.0)))[None], (1, FRAME[1]))[0, 0])
    return torch.cat(rows)


def truth(path, time: float) -> Tensor:
    """The pose (3,) when the row of the target's centre is exposed."""
    pose = path(time)
    for _ in range(8):
        pose = path(time + LINE * (float(pose[1]) - FRAME[0] / 2))
    return pose


def errors(path, times: list[float], frames: list[Tensor | None], **options) -> tuple[Tensor, Tensor]:
    """Of the poses (F, 3), and statuses (F,)."""
    tracker = Tracker(exposed(path, 0.0), [path(0.0)[:2].tolist()], SIZE, search=False, **options)
    track = tracker.track_sequence(frames)
    return track.pose[:, 0] - torch.stack([truth(path, t) for t in times]), track.status[:, 0]


SWAY = [exposed(sway, float(k)) for k in range(1, 25)]
TIMES = [float(k) for k in range(1, 25)]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_sway_is_no_turn(backend: str) -> None:
    """0.02 degrees where it was a quarter of one; x and y no worse."""
    known, _ = errors(sway, TIMES, SWAY, line_time=LINE / FPS, fps=FPS, backend=backend)
    plain, _ = errors(sway, TIMES, SWAY, backend=backend)
    rms = [float(e[5:, 2].square().mean().sqrt().rad2deg()) for e in (known, plain)]
    assert rms[1] > 0.3
    assert rms[0] < 0.04
    assert bool((known[5:, :2].square().mean(0) < 1.1 * plain[5:, :2].square().mean(0)).all())


def test_what_moves_evenly_is_seen_exactly() -> None:
    """Once it is no longer seen that it began there is nothing to be wrong about."""
    times = [float(k) for k in range(1, 14)]
    error, _ = errors(drift, times, [exposed(drift, t) for t in times], line_time=LINE / FPS, fps=FPS)
    assert float(error[4:, :2].abs().max()) < 5e-3
    assert float(error[4:, 2].abs().max().rad2deg()) < 0.02
    assert float(error[9:, 2].abs().max().rad2deg()) < 5e-3


def test_what_turns_is_bent_and_stays_where_it_is() -> None:
    """Without the bend it would be 0.02 px off."""

    def spin(time: float) -> Tensor:
        return torch.tensor((70.0, 58.0, 0.03 * max(time, 0.0)), dtype=torch.float64)

    times = [float(k) for k in range(1, 12)]
    frames = [exposed(spin, t) for t in times]
    error, _ = errors(spin, times, frames, line_time=LINE / FPS, fps=FPS)
    plain, _ = errors(spin, times, frames)
    assert float(error[4:, :2].abs().max()) < 0.4 * float(plain[4:, :2].abs().max())


def test_frames_in_between_are_lost() -> None:
    """Two that are missing, one without the target: time goes on."""
    frames: list[Tensor | None] = list(SWAY)
    frames[8], frames[9], frames[15] = None, None, torch.full_like(SWAY[0], 90)
    error, status = errors(sway, TIMES, frames, line_time=LINE / FPS, fps=FPS)
    good = Status.good(status)
    assert int(good.sum()) >= len(frames) - 5
    assert float(error[20:, 2].abs().max().rad2deg()) < 0.06


def test_a_shutter_that_reads_upwards_has_a_negative_time() -> None:
    """The picture upside down, which turns x and y of the motion as well."""
    frames = [frame.flip(0) for frame in SWAY]
    first = exposed(sway, 0.0).flip(0)
    center = (70.0, FRAME[0] - 1 - 58.0)
    tracker = Tracker(first, [center], SIZE, search=False, line_time=-LINE / FPS, fps=FPS)
    theta = tracker.track_sequence(frames).pose[5:, 0, 2]
    assert float(theta.square().mean().sqrt().rad2deg()) < 0.04


def history(past: Tensor, ages: Tensor) -> dict[str, Tensor]:
    """A state with earlier poses (R, n, 3) of so many frames ago (R, n)."""
    more = past.new_zeros(len(past), NODES + 1 - past.shape[1], 3)
    past, ages = torch.cat((past, more), 1), torch.cat((ages, more[:, :, 0]), 1)
    return {"past_poses": past, "past_ages": ages, "past_missing": 0 * past, "past_noise": 0 * past[:, 0]}


def test_a_velocity_is_that_of_a_polynomial() -> None:
    """Of one of the fourth degree exactly, with frames that are missing; of fewer poses that of a lower degree."""
    shutter = Shutter(0.0)
    ages = torch.tensor([[1.0, 2.0, 5.0, 6.0, 7.0], [1.0, 3.0, 0.0, 0.0, 0.0]], dtype=torch.float64)

    def path(t: Tensor, degree: int) -> Tensor:
        return torch.stack([sum((k + 1.5) * (c - k) * t**k for k in range(degree + 1)) for c in (1, 2, 4)], -1)

    past = torch.stack((path(-ages[0], 4), path(-ages[1], 2)))
    now = torch.stack((path(torch.zeros(()).double(), 4), path(torch.zeros(()).double(), 2)))
    found = shutter.motion(now, history(past, ages))
    expected = torch.tensor([[2.5 * (c - 1) for c in (1, 2, 4)]] * 2, dtype=torch.float64)
    torch.testing.assert_close(found.velocity, expected)
    torch.testing.assert_close(found.acceleration[0], torch.tensor([2 * 3.5 * (c - 2.0) for c in (1, 2, 4)]).double())
    assert float(found.of_velocity[0].max()) < 1e-3
    assert float(found.of_velocity[1].max()) > 0  # no pose more tells what a higher degree would add


def test_a_velocity_is_of_the_degree_that_noise_allows() -> None:
    """Of what hardly moves that of two poses, of what sways that of many."""
    shutter, time = Shutter(0.0), -torch.arange(8, dtype=torch.float64)
    sway = torch.stack([5 * (0.7 * time).sin(), 0 * time, 0 * time], -1)
    still = torch.randn(8, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.01
    values = torch.stack((sway, still))
    state = history(values[:, 1:], -time[1:].expand(2, -1))
    state["past_noise"] += 1e-4
    found = shutter.motion(values[:, 0], state)
    assert abs(float(found.velocity[0, 0]) - 3.5) < 3 * float(found.of_velocity[0, 0].sqrt()) < 1.0
    assert float(found.of_velocity[1, :2].max().sqrt()) < 0.03


def test_rows_lie_where_the_distortion_says() -> None:
    """A point is seen where it is when its row is exposed."""
    pose, velocity = torch.tensor([[70.0, 50.0, 0.4]], dtype=torch.float64), torch.tensor((3.0, -2.0)).double()
    past = torch.stack([pose[0] - k * torch.tensor((3.0, -2.0, 0.0)).double() for k in range(1, 5)])
    shutter = Shutter(0.01)
    state = history(past[None], torch.tensor([[1.0, 2.0, 3.0, 4.0]], dtype=torch.float64))
    turn = rotation(pose[:, 2])[0]
    speed = shutter.motion(pose, state).velocity[0, :2]
    torch.testing.assert_close(speed, velocity / 0.98)  # two rows higher up in each frame, so a little earlier
    point = torch.tensor((20.0, -13.0), dtype=torch.float64)
    seen = turn @ (torch.eye(2).double() + shutter.distorted(pose, state)[0]) @ point
    torch.testing.assert_close(seen, turn @ point + 0.01 * seen[1] * speed)


def test_what_is_not_known_of_the_velocity_is_in_sigma() -> None:
    """Errors of a sway are what sigma says, which knew noise alone before."""
    frames = [sense(frame, k) for k, frame in enumerate(SWAY)]
    tracker = Tracker(sense(exposed(sway, 0.0), 99), [(70.0, 58.0)], SIZE, search=False, line_time=LINE / FPS, fps=FPS)
    track = tracker.track_sequence(frames)
    ratio = (track.pose[:, 0] - torch.stack([truth(sway, t) for t in TIMES]))[5:] / track.sigma[5:, 0]
    assert 0.6 < float(ratio.square().mean().sqrt()) < 1.5


def sense(frame: Tensor, seed: int) -> Tensor:
    """With 2 grey levels of noise."""
    return frame + 2 * torch.randn(frame.shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"line_time": 1e-5}, "fps: expected a rate > 0 in frames per second with line_time, got None"),
        ({"line_time": 1e-5, "fps": 0}, "fps: expected a rate > 0 in frames per second with line_time, got 0"),
        ({"line_time": "fast", "fps": 30}, "line_time: expected seconds from one row to the next, got 'fast'"),
        ({"line_time": math.nan, "fps": 30}, "line_time: expected seconds from one row to the next, got nan"),
        ({"line_time": 1e-3, "fps": 30}, "line_time: expected the 120 rows of a frame to be read out before the next"),
    ],
)
def test_times_that_no_camera_has_are_refused(options: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Tracker(torch.rand(FRAME), [(70.0, 58.0)], SIZE, **options)


@pytest.mark.parametrize("whole", [False, True])
def test_a_body_is_where_it_is_at_one_instant(whole: bool) -> None:
    """Its patches are on rows that see it a third of a frame's time apart, and 1 px: a turn, if nobody knew."""
    times = [float(k) for k in range(1, 10)]
    frames = [exposed(drift, t) for t in times]
    places = [(40.0, 34.0), (72.0, 36.0), (42.0, 72.0), (74.0, 70.0)]
    found = []
    for options in ({"line_time": LINE / FPS, "fps": FPS}, {}):
        tracker = Tracker(exposed(drift, 0.0), places, 27, search=False, **options)
        body = Body(tracker)
        if whole:
            found.append(body(tracker.track_sequence(frames)))
        else:
            each = [body(tracker(frame)) for frame in frames]
            found.append(BodyEstimate(*(torch.stack(values) for values in zip(*each, strict=True))))
    middle = torch.tensor(places).double().mean(0) - drift(0.0)[:2]
    along = torch.stack([truth(lambda t: drift(t) + torch.cat((middle, middle[:1] * 0)), t) for t in times])
    error, without = (bodies.pose[6:, 0] - along[6:] for bodies in found)
    assert float(error[:, :2].abs().max()) < 5e-3
    assert float(error[:, 2].abs().max()) < 2e-4
    assert float(without[:, 2].abs().max()) > 1e-3
    assert bool((found[0].chi2[6:] < 0.1 * found[1].chi2[6:]).all())
