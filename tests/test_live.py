"""Live cameras: the newest frame, what was lost is counted, poses are sent on; and a stage of Micro-Manager's."""

from __future__ import annotations

import gc
import itertools
import json
import os
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torch_ecc as te
from torch_ecc import cli
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.live import Latency, sender
from torch_ecc.commands.track import Session
from torch_ecc.io import open_frames
from torch_ecc.io.cameras import newest
from torch_ecc.io.cameras.newest import Newest, Shot
from torch_ecc.io.cameras.test_pattern import BUFFERS, moved, open_test
from torch_ecc.io.frames import Arrival, Frame
from torch_ecc.io.live import close_cameras
from torch_ecc.servo import Control, MicroManagerStage, StageJacobian, servo
from torch_ecc.sim.scene.waves import PlaneWaves


@pytest.fixture(scope="module", autouse=True)
def _closed():
    """What was opened does not go on beside other tests."""
    yield
    close_cameras()


def fed(numbers, numbered: bool = True) -> Newest:
    """A camera that has read all of these pictures before the first of them is grabbed."""
    numbers, done = iter([*numbers, None]), threading.Event()

    def read():
        number = next(numbers)
        return None if number is None else (np.full((4, 6), number, np.uint8), number if numbered else None)

    camera = Newest(read, done.set)
    threading.Thread(target=camera._go_on, daemon=True).start()
    camera._thread = threading.current_thread()  # it is running
    assert done.wait(20)
    return camera


def grabbed(camera: Newest) -> list[tuple[int, int]]:
    """The pictures and the losses of all that is left."""
    return [(int(shot.pixels[0, 0]), shot.lost) for shot in iter(camera.grab, None)]


def test_a_moment_is_waited_for_and_what_is_missed_is_counted():
    """A few pictures wait; who is slower than the camera gets the newest. By the camera's own numbers, or as many as
    came."""
    assert grabbed(fed([0, 1, 2, 5, 6])) == [(0, 0), (1, 0), (2, 0), (5, 2), (6, 0)]
    assert grabbed(fed([0, 1, 2, 5, 6], numbered=False)) == [(0, 0), (1, 0), (2, 0), (5, 0), (6, 0)]
    assert grabbed(fed(range(50))) == [(49, 0)]  # nobody has grabbed at all
    camera = Newest(lambda: None)
    for number in range(3):
        camera._append(Shot(np.full((1, 1), number), number, 0.0, 0))
    camera._thread = threading.current_thread()
    assert camera.grab().number == 0
    camera._append(Shot(np.full((1, 1), 3), 3, 1.0, 0))  # a second later nobody wants those before
    assert camera.grab()[1:] == (3, 1.0, 2)
    for number in range(4, 20):
        camera._append(Shot(np.full((1, 1), number), number, 1.0, 0))
    assert camera.grab()[1:] == (19, 1.0, 15)
    camera._append(Shot(np.full((1, 1), 20), 20, 1.0, 0))
    camera._append(Shot(np.full((1, 1), 21), 21, 1.0, 0))
    assert [camera.grab().number for _ in range(2)] == [20, 21]  # it keeps them again


def test_a_silent_camera_is_told_not_waited_for(monkeypatch, tmp_path):
    """A cable is out: what came before is kept, and whoever wants to stop is not kept waiting."""
    out, numbers, silent = tmp_path / "out", itertools.count(), threading.Event()
    picture = PlaneWaves.random(seed=2).render(torch.tensor([[45.0, 40.0, 0.0]]).double(), (80, 90))[0, 0].numpy()

    def read():
        number = next(numbers)
        if number == 4:
            silent.wait(20)
            return None
        return picture, number

    monkeypatch.setattr(newest, "SILENCE_S", 0.3)
    camera = Newest(read)
    job = TrackJob(input="a camera", centers=((45.0, 40.0),), size=31, out=str(out), overlay=False)
    with pytest.raises(ValueError, match=r"the camera has sent no picture for 0\.3 s"):
        Session(job, camera).run()
    assert len(np.load(out / "track.npz")["frame"]) > 0
    assert camera.ended
    monkeypatch.undo()
    closed, waiting = threading.Event(), Newest(lambda: closed.wait(5) and None)
    threading.Timer(0.05, lambda: (waiting.close(), closed.set())).start()
    assert waiting.grab() is None
    silent.set()


def test_what_reading_raises_is_raised_to_whoever_grabs():
    def read():
        raise OSError("the cable is out")

    closed = []
    camera = Newest(read, lambda: closed.append(True))
    with pytest.raises(OSError, match="the cable is out"):
        camera.grab()
    assert closed == [True]


class Mine:
    """Somebody's own camera: one method. Every third picture is lost on the way."""

    def __init__(self) -> None:
        self.numbers = itertools.count(40, 3)

    def grab(self) -> Shot:
        number = next(self.numbers)
        return Shot(np.full((8, 9), number, np.uint8), number, float(number), 2)


def test_a_camera_is_whatever_has_grab():
    source = open_frames(Mine())[:20]
    assert source.live
    frames = list(source)
    assert [frame.number for frame in frames] == [0, 3, 6, 9, 12, 15, 18]
    assert [frame.time_s for frame in frames] == [0, 3, 6, 9, 12, 15, 18]
    assert [frame.arrival.lost for frame in frames] == [0, 2, 2, 2, 2, 2, 2]


def test_the_test_camera_keeps_its_beat_and_its_word():
    camera, hz = open_test("64x48@200")
    shots = [camera.grab() for _ in range(20)]
    camera.close()
    first, last = shots[0], shots[-1]
    early = last.number - first.number - (last.time_s - first.time_s) * hz
    assert early < 2 + BUFFERS  # than the first one, which may itself have waited
    for shot in shots[1:]:
        x, y = np.subtract(moved(shot.number, hz), moved(first.number, hz))
        a = first.pixels[max(-y, 0) : 48 - max(y, 0), max(-x, 0) : 64 - max(x, 0)]
        b = shot.pixels[max(y, 0) : 48 + min(y, 0), max(x, 0) : 64 + min(x, 0)]
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("camera:", "KIND one of opencv, micromanager, basler, aravis, test, got 'camera:'"),
        ("camera:fax:1", "KIND one of opencv"),
        ("camera:opencv:front", "index must be 0 or more, got front"),
        ("camera:test:big", "a test camera is WIDTHxHEIGHT@HZ, got 'big'"),
    ],
)
def test_bad_addresses_are_told(address, words):
    with pytest.raises(ValueError, match=words):
        open_frames(address)


def test_a_camera_without_its_library_says_which(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pypylon", None)
    with pytest.raises(ValueError, match=r"a basler camera needs pypylon: pip install 'torch-ecc\[basler\]'"):
        open_frames("camera:basler")


def test_a_live_run(tmp_path):
    """Poses are where the texture was when the frame was taken, whatever was lost in between."""
    out = tmp_path / "out"
    job = TrackJob(
        input="camera:test:320x240@50", centers=((160.0, 120.0),), size=61, out=str(out), overlay=False, frames="0:30"
    )
    seen = []
    finished = Session(job).run(watch=lambda frame, estimate: seen.append((frame, estimate)))
    assert finished.frames == len(seen) > 3
    assert finished.latency.lost == 31 - finished.frames - (30 - seen[-1][0].number)
    assert not finished.interrupted
    apart = torch.stack([estimate.pose[0] for _, estimate in seen])
    assert np.load(out / "track.npz")["frame"].tolist() == [frame.number for frame, _ in seen]
    # Whole px, but for where the camera was when it was first looked at.
    steps = (apart - apart[0])[:, :2]
    assert (steps - steps.round()).abs().max() < 1e-3
    assert apart[:, :2].std() > 1
    assert "frames of the camera were lost" in " ".join(finished.words())
    with pytest.raises(ValueError, match="resume: a camera does not go back"):
        Session(TrackJob(**(vars(job) | {"resume": True, "out": str(tmp_path / "other")})))


def test_stopping_a_camera_is_no_failure(tmp_path):
    """And nothing is left of what a run changes while frames do not wait: its thread's precedence, what is garbage."""

    def stop(done):
        if done == 5:
            assert gc.get_freeze_count() > 10_000
            raise KeyboardInterrupt

    job = TrackJob(
        input="camera:test:320x240@50", centers=((160.0, 120.0),), size=61, out=str(tmp_path / "out"), overlay=False
    )
    finished = Session(job).run(stop)
    assert (finished.frames, finished.interrupted) == (5, False)
    assert gc.get_freeze_count() == 0
    if hasattr(os, "SCHED_RR"):
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    assert json.loads((tmp_path / "out/summary.json").read_text())["complete"]


@pytest.fixture
def estimate():
    frame = PlaneWaves.random(seed=2).render(torch.tensor([[45.0, 40.0, 0.0]]).double(), (80, 90))[0, 0]
    tracker = te.Tracker(frame, [(40.0, 40.0), (50.0, 42.0)], 31)
    return tracker.track(frame)


def test_poses_are_sent_as_lines_of_json(estimate, capfdbinary):
    lost = estimate._replace(
        status=torch.tensor([0, 2], dtype=torch.int8), reason=torch.tensor([0, 3], dtype=torch.int8)
    )
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(("127.0.0.1", 0))
    listener.settimeout(5)
    frame = Frame(7, None, 0.25, arrival=Arrival(time.perf_counter() - 0.003, 0))
    um = torch.diag(torch.tensor([0.5, -0.5], dtype=torch.float64))
    sender(f"udp://127.0.0.1:{listener.getsockname()[1]}", um)(frame, lost)
    told = json.loads(listener.recv(65536))
    assert (told["frame"], told["time_s"]) == (7, 0.25)
    assert 3 <= told["latency_ms"] < 1000
    one, two = told["patches"]
    assert one["x"] == estimate.pose[0, 0]
    assert one["sigma_theta"] == estimate.sigma[0, 2]
    assert one["dx_um"] == 0.5 * estimate.displacement[0, 0]
    assert (one["status"], one["reason"], two["status"], two["reason"]) == ("CONVERGED", "", "LOST", "UNLIKE")
    assert two["x"] is two["dx_um"] is None
    for address in ("udp://here", "tcp://127.0.0.1:9", "udp://127.0.0.1:0", "there"):
        with pytest.raises(ValueError, match="send: expected - or udp://HOST:PORT"):
            sender(address)


def test_the_command_line_sends_to_the_screen(tmp_path):
    words = [
        "track",
        "camera:test:320x240@50",
        "--center",
        "160",
        "120",
        "--size",
        "61",
        "--frames",
        "0:9",
        "--send",
        "-",
    ]
    done = CliRunner().invoke(cli.app, [*words, "--no-overlay", "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    lines = [json.loads(line) for line in done.output.splitlines() if line.startswith("{")]
    assert 1 <= len(lines) <= 10
    assert all(line["latency_ms"] > 0 for line in lines)


def test_latency_is_told_in_percentiles():
    latency = Latency()
    assert latency.words() == []
    for _ in range(3):
        latency.add(Frame(0, None, arrival=Arrival(time.perf_counter() - 0.05, 1)))
    assert latency.lost == 3
    assert all(50 <= ms < 1000 for ms in latency.milliseconds())


@pytest.fixture(scope="module")
def core():
    """Micro-Manager's camera and stage of demonstration: beads that move with the stage, 1 px per um."""
    pytest.importorskip("pymmcore_plus", reason="no pymmcore-plus")
    pytest.importorskip("mm_test_adapters", reason="no mm-test-adapters")
    from torch_ecc.io.cameras.micromanager import open_core

    core = open_core("demo")
    core.stopSequenceAcquisition()
    core.setExposure(5)
    return core


def test_a_loop_is_closed_on_a_stage_of_micromanager(core):
    """From 10 px off to below 0.05 px; no frame lost; by nothing but the picture."""
    plant = MicroManagerStage(core)
    core.setXYPosition(0.0, 0.0)
    first = plant.frame()
    tracker = te.Tracker(first, [(256.0, 256.0)], 121)
    core.setXYPosition(8.0, -6.0)
    plant = MicroManagerStage(core, travel=((-50.0, 50.0), (-50.0, 50.0)))
    jacobian = StageJacobian(te.Calibration((-1.1, -0.9)), rotary=False)  # signs right, sizes ten per cent off
    errors = []
    control = Control(gain=6.0, tolerance_px=0.05)
    result = servo(
        plant,
        tracker,
        (256.0, 256.0, 0.0),
        jacobian,
        control=control,
        observe=lambda f, e, step: errors.append(step.error),
    )
    assert result.aligned
    off = torch.stack(errors)[:, :2].norm(dim=1)
    assert off[0] == pytest.approx(10, abs=0.1)
    assert off[-5:].max() < 0.05
    assert (result.log.status == te.Status.CONVERGED).all()
    x, y = core.getXYPosition()
    assert abs(x) < 0.05
    assert abs(y) < 0.05


def test_the_shipped_file_closes_a_loop(core, tmp_path):
    """By the command line: what was looked at ends where it was to be, and what is wrong is told before a move."""
    config = Path(__file__).parents[1] / "configs/servo_micromanager.toml"
    done = CliRunner().invoke(cli.app, ["servo", str(config), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "at the desired pose" in done.output
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["aligned"]
    assert max(abs(summary["error"][name]) for name in ("x_px", "y_px")) < 0.05
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"log.csv", "overlay.mp4", "summary.json"}
    text = config.read_text()
    for change, words in [
        (("[belief]", "[belive]"), "unknown key 'belive'"),
        (('"demo"', '"nowhere.cfg"'), "Micro-Manager cannot load 'nowhere.cfg'"),
        (("266.0, 250.0", "266.0, 20.0"), "outside the view"),
        (("[[-100.0, 100.0]", "[[-9000.0, -8000.0]"), "desired pose is unreachable"),
    ]:
        (tmp_path / "wrong.toml").write_text(text.replace(*change))
        x, y = core.getXYPosition()
        wrong = CliRunner().invoke(cli.app, ["servo", str(tmp_path / "wrong.toml"), "--out", str(tmp_path / "wrong")])
        assert words in str(wrong.exception)
        assert core.getXYPosition() == pytest.approx([x, y], abs=1e-6)


def test_a_stage_is_asked_for_what_it_has(core):
    plant = MicroManagerStage(core, velocity=20.0, travel=((-5.0, 50.0), (-50.0, 50.0)))
    x, _ = core.getXYPosition()
    assert plant.limits[0] == (20.0, 20.0)
    assert plant.limits[2][0].tolist() == pytest.approx([-5 - x, 50 - x])

    class Bare:
        def getXYStageDevice(self):
            return ""

    with pytest.raises(ValueError, match="core must have an XY stage and a camera"):
        MicroManagerStage(Bare())


def test_a_camera_of_micromanager_is_tracked(core, tmp_path):
    core.setXYPosition(0.0, 0.0)
    core.setExposure(20)
    job = TrackJob(
        input="camera:micromanager:demo",
        centers=((256.0, 256.0),),
        size=121,
        frames="0:14",
        overlay=False,
        out=str(tmp_path / "out"),
    )
    finished = Session(job).run()
    assert finished.frames > 2
    assert finished.lost.tolist() == [0]
    assert len(finished.latency.milliseconds()) == 3


def test_a_basler_camera_is_tracked(monkeypatch, tmp_path):
    """The emulator's picture is a ramp that moves: frames come, and nothing is found in them, in words."""
    pytest.importorskip("pypylon", reason="no pypylon")
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    source = open_frames("camera:basler")[:5]
    frames = list(source)
    assert source.shape == (1040, 1024)
    assert 0 < len(frames) <= 5
    assert all(a.number < b.number for a, b in itertools.pairwise(frames))
    with pytest.raises(ValueError, match="no Basler camera 12345 can be opened"):
        open_frames("camera:basler:12345")


def test_an_aravis_camera_is_tracked():
    """Aravis's own fake camera, whose ramp moves: frames come in order, none of which another one overwrites."""
    pytest.importorskip("gi", reason="no PyGObject: pip install 'torch-ecc[aravis]'")
    try:
        source = open_frames("camera:aravis:Fake_1")[:12]
    except ValueError as error:
        pytest.skip(str(error))  # the library itself comes with the system
    frames = list(source)
    assert source.shape == (512, 512)
    assert 0 < len(frames) <= 12
    assert all(a.number < b.number and a.time_s < b.time_s for a, b in itertools.pairwise(frames))
    ramps = np.stack([frame.pixels[0].numpy() for frame in frames]).astype(int)
    moved = [(b - a) % 256 for a, b in itertools.pairwise(ramps)]
    assert all((step == step[0]).mean() > 0.9 and step[0] != 0 for step in moved)
    with pytest.raises(ValueError, match="no GenICam camera nobody can be opened"):
        open_frames("camera:aravis:nobody")
