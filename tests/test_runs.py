"""A run loses nothing: whatever ends it, what was done is there, and a later run ends as if nothing had happened."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.track import Session
from torch_ecc.io import open_frames, output
from torch_ecc.io.journal import Unfinished
from torch_ecc.sim.scene.waves import PlaneWaves

FRAMES, DIES = 60, 37
posix = pytest.mark.skipif(os.name == "nt", reason="signals")
undrawn = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A patch that moves fast enough for its velocity to matter, leaves for some frames, and comes back elsewhere."""
    poses = [(80 + 12 * math.sin(k / 5), 60 - 8 * math.sin(k / 7), 0.01 * k) for k in range(FRAMES)]
    stack = PlaneWaves.random(seed=2).render(torch.tensor(poses, dtype=torch.float64), (120, 160))[:, 0]
    stack += torch.randn(stack.shape, generator=torch.Generator().manual_seed(0))
    stack[20:24] = 90
    path = tmp_path_factory.mktemp("input") / "video.npy"
    np.save(path, stack.round().clamp(0, 255).to(torch.uint8).numpy())
    return path


def job(video: Path, out: Path, **options: object) -> TrackJob:
    return TrackJob(input=str(video), out=str(out), centers=((80.0, 60.0), (60.0, 50.0)), size=31, fps=50.0, **options)


@pytest.fixture(scope="module")
def whole(video, tmp_path_factory):
    """The result of a run that nothing has ended."""
    out = tmp_path_factory.mktemp("whole") / "out"
    Session(job(video, out)).run()
    return out


def track_of(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "track.npz") as track:
        return dict(track)


def assert_same(found: Path, wanted: Path) -> None:
    """To 1e-9 in numbers, to the letter in the table, and as many pictures."""
    a, b = track_of(found), track_of(wanted)
    assert a.keys() == b.keys()
    for name in a:
        if a[name].dtype.kind == "f":
            np.testing.assert_allclose(a[name], b[name], rtol=1e-9, atol=1e-9)
        else:
            np.testing.assert_array_equal(a[name], b[name])
    assert (found / "track.csv").read_text() == (wanted / "track.csv").read_text()
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (found, wanted)]
    assert summaries[0]["complete"]
    assert len({json.dumps(each["per_template"]) for each in summaries}) == 1
    assert {path.name for path in found.iterdir()} == {path.name for path in wanted.iterdir()}
    assert [len(list(open_frames(folder / "overlay.mp4"))) for folder in (found, wanted)] == 2 * [len(a["score"])]


def dying(video: Path, out: Path, how: str) -> subprocess.Popen[str]:
    """A process whose run ends itself at frame ``DIES`` by the statement ``how``."""
    code = (
        "import os, sys, signal, time; sys.path.insert(0, sys.argv[1]); from test_runs import *\n"
        f"def step(done):\n    if done == DIES: {how}\n"
        "Session(job(Path(sys.argv[2]), Path(sys.argv[3]))).run(step)"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parent), str(video), str(out)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


# ---- whatever ends it ----------------------------------------------------------------------------------------------


@posix
@undrawn
def test_killed_and_resumed(video, whole, tmp_path):
    """kill -9: only parts are left, they hold every frame, and the rest is tracked as if nothing had happened."""
    process = dying(video, tmp_path, "os.kill(os.getpid(), signal.SIGKILL)")
    assert process.wait(600) == -signal.SIGKILL, process.stderr.read()
    assert all(path.suffix == ".part" for path in tmp_path.iterdir())
    left = Unfinished.of(tmp_path)
    assert left.frames == DIES
    rows = list(csv.DictReader((tmp_path / "track.csv.part").open()))
    assert len(rows) == 2 * DIES
    with pytest.raises(ValueError, match="holds an unfinished run: --resume goes on with it, --force starts anew"):
        Session(job(video, tmp_path)).run()
    seen: list[int] = []
    assert Session(job(video, tmp_path, resume=True)).run(seen.append).frames == FRAMES
    assert DIES - 20 <= seen[0] <= DIES + 1
    assert_same(tmp_path, whole)


@pytest.mark.parametrize("stage", ["half a row", "half a record", "half a picture", "no picture"])
@undrawn
def test_resumed_whatever_is_half_there(video, whole, tmp_path, stage):
    stop_at(video, tmp_path, 30)
    (tmp_path / "track.csv").rename(tmp_path / "track.csv.part")
    for name in ("track.npz", "summary.json", "track.png", "overlay.mp4"):
        (tmp_path / name).unlink()
    names = {"half a row": "track.csv", "half a record": "track.records"}
    part = tmp_path / f"{names.get(stage, 'overlay.h264')}.part"
    cut = 0 if stage == "no picture" else part.stat().st_size - 40
    with part.open("r+b") as file:
        file.truncate(cut)
    Session(job(video, tmp_path, resume=True)).run()
    assert_same(tmp_path, whole)


def stop_at(video: Path, out: Path, frame: int, **options: object) -> None:
    def step(done: int) -> None:
        if done == frame:
            raise KeyboardInterrupt

    assert Session(job(video, out, **options)).run(step).interrupted


@undrawn
def test_stopped_twice_and_resumed(video, whole, tmp_path):
    """What was done has its final names in between, and says that it is not all."""
    stop_at(video, tmp_path, 22)  # in the middle of the frames without the patch
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["complete"], summary["reason"], summary["frames"]) == (False, "interrupted by the user", 22)
    assert len(track_of(tmp_path)["score"]) == 22
    assert len(list(open_frames(tmp_path / "overlay.mp4"))) == 22
    stop_at(video, tmp_path, 40, resume=True)
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 40
    Session(job(video, tmp_path, resume=True)).run()
    assert_same(tmp_path, whole)


@undrawn
def test_marks_of_the_camera_are_resumed(video, tmp_path):
    """Those that were found before, and which templates they concern."""
    stack = np.load(video)[:18]
    stack[:, :, 64:68] = 20
    np.save(tmp_path / "striped.npy", stack)
    striped, out = tmp_path / "striped.npy", tmp_path / "stopped"
    session = Session(job(striped, tmp_path / "whole"))
    session.run()
    assert session.tracker.heed.any()
    stop_at(striped, out, 10)
    assert (out / "track.changes.part").is_file()
    Session(job(striped, out, resume=True)).run()
    assert_same(out, tmp_path / "whole")


@undrawn
def test_what_is_resumed_must_be_the_same_run(video, tmp_path):
    stop_at(video, tmp_path, 10)
    with pytest.raises(ValueError, match=r"resume: levels was 1 in the run in .*, and is 2 now"):
        Session(job(video, tmp_path, resume=True, levels=2)).run()
    frames = np.load(video)
    np.save(tmp_path / "video.npy", frames)
    stop_at(tmp_path / "video.npy", tmp_path / "out", 10)
    frames[0, 0, 0] ^= 1
    np.save(tmp_path / "video.npy", frames)
    with pytest.raises(ValueError, match="resume: first_frame_crc32 was"):
        Session(job(tmp_path / "video.npy", tmp_path / "out", resume=True)).run()


@undrawn
def test_records_of_another_version_are_not_misread(video, tmp_path):
    stop_at(video, tmp_path, 10)
    records = tmp_path / "track.records.part"
    records.write_bytes(records.read_bytes().replace(b"coverage", b"covered_", 1))  # a field of another name
    with pytest.raises(ValueError, match="was written by another version of torch_ecc; --force starts anew"):
        Session(job(video, tmp_path, resume=True)).run()
    assert Session(job(video, tmp_path, force=True)).run().frames == FRAMES


@undrawn
def test_resume_without_anything_to_resume_begins(video, whole, tmp_path):
    Session(job(video, tmp_path / "out", resume=True)).run()
    assert_same(tmp_path / "out", whole)


HELD = """
import runpy, signal, time
signal.signal(signal.{name}, signal.{handler})
from torch_ecc.io.track import TrackWriter
write = TrackWriter.write
def held(self, *given):
    write(self, *given)
    if self.frames == 20:
        print("held", flush=True)
        time.sleep(600)
TrackWriter.write = held
runpy.run_module("torch_ecc", run_name="__main__")
"""


@posix
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_signals_are_one_and_the_same(tmp_path, name):
    """It comes after 20 of 40 frames, for which the run waits."""
    np.save(tmp_path / "long.npy", np.random.default_rng(0).integers(0, 255, (1, 120, 160), np.uint8).repeat(40, 0))
    out, handler = tmp_path / "out", "default_int_handler" if name == "SIGINT" else "SIG_DFL"
    command = [sys.executable, "-c", HELD.format(name=name, handler=handler)]
    command += ["track", str(tmp_path / "long.npy"), "--center", "80", "60", "--size", "41", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert "held\n" in iter(process.stdout.readline, "")
    process.send_signal(getattr(signal, name))
    said, errors = process.communicate(timeout=600)
    assert process.returncode == 130, errors
    assert "Stopped after" in said
    assert "--resume goes on from there" in said
    assert "Traceback" not in errors
    summary = json.loads((out / "summary.json").read_text())
    assert summary["complete"] is False
    assert summary["frames"] == 20


IMPORTED = """
import os, runpy, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
def told(event, given):
    if event == "import" and given[0] == "{module}":
        os.kill(os.getpid(), signal.SIGINT)
sys.addaudithook(told)
runpy.run_module("torch_ecc", run_name="__main__")
"""


@posix
@pytest.mark.parametrize("module", ["torch", "torch.nn", "torch_ecc.commands.jobs"])
def test_interrupted_while_torch_is_imported(module):
    """The signal comes just when a module is asked for."""
    command = [sys.executable, "-c", IMPORTED.format(module=module), "demo", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


# ---- a full disk ---------------------------------------------------------------------------------------------------


@contextmanager
def small_disk(folder: Path, size: str):
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a small disk takes the right to mount one")
    try:
        yield folder
    finally:
        # FFmpeg does not close a file whose last bytes it could not write: the disk goes with the process.
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting a disk takes root")
@pytest.mark.parametrize("size", ["16k", "32k", "64k", "100k", "160k"])
def test_full_disk(video, whole, tmp_path, size):
    """Wherever it happens: what has a final name is whole, and with more room the run ends as if nothing was."""
    with small_disk(tmp_path / "disk", size) as disk:
        out = disk / "out"
        with suppress(OSError):  # it may be large enough
            Session(job(video, out)).run()
        assert_whole(out)
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        Session(job(video, out, resume=True, force=not Unfinished.of(out))).run()
        assert_same(out, whole)


def assert_whole(folder: Path) -> None:
    """What bears a final name."""
    names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    if "track.npz" in names:
        frames = len(track_of(folder)["score"])
        assert len(list(csv.DictReader((folder / "track.csv").open()))) == 2 * frames
    if "summary.json" in names:
        json.loads((folder / "summary.json").read_text())
    if "overlay.mp4" in names:
        with av.open(str(folder / "overlay.mp4")) as film:
            assert sum(1 for _ in film.decode(video=0)) > 0
    assert not names & {"track.npz.part", "overlay.mp4.part", "track.png.part"}


@undrawn
def test_disk_full_in_the_middle_of_a_frame(video, whole, tmp_path, monkeypatch):
    written, plain = [0], output.append

    def append(file, data):
        written[0] += len(data)
        if written[0] > 20_000:
            plain(file, data[: len(data) // 2])
            raise OSError(28, "No space left on device")
        plain(file, data)

    monkeypatch.setattr("torch_ecc.io.journal.append", append)
    with pytest.raises(OSError, match=r"No space left on device\. \d+ frames are done: .* --resume goes on"):
        Session(job(video, tmp_path)).run()
    monkeypatch.undo()
    Session(job(video, tmp_path, resume=True)).run()
    assert_same(tmp_path, whole)


# ---- one folder, one run -------------------------------------------------------------------------------------------


@posix
@undrawn
def test_two_at_once(video, tmp_path):
    process = dying(video, tmp_path, "print('there', flush=True); time.sleep(600)")
    assert process.stdout.readline() == "there\n", process.stderr.read()
    for options in ({}, {"force": True}, {"resume": True}):
        with pytest.raises(ValueError, match=f"out: another run is writing into {tmp_path}"):
            Session(job(video, tmp_path, **options)).run()
    process.kill()
    process.communicate()
    assert Session(job(video, tmp_path, resume=True)).run().frames == FRAMES  # a dead one holds nothing


@undrawn
def test_a_result_is_not_overwritten(video, tmp_path):
    Session(job(video, tmp_path)).run()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"holds a result already \(track.csv\): .* --force replaces it"):
        Session(job(video, tmp_path))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    with pytest.raises(ValueError, match="holds a result already"):  # it is whole: there is nothing to resume
        Session(job(video, tmp_path, resume=True))
    assert Session(job(video, tmp_path, force=True, frames="0:9", overlay=False)).run().frames == 10
    assert not (tmp_path / "overlay.mp4").exists()  # it would be of the result before


def test_links_are_not_followed(video, tmp_path):
    """Neither by parts, nor by results, nor by what is resumed."""
    out, secret = tmp_path / "out", tmp_path / "secret"
    out.mkdir()
    secret.write_text("mine")
    names = ["track.csv", "track.records", "track.npz", "summary.json", "track.png", "overlay.mp4", "overlay.h264"]
    for name in names:
        (out / f"{name}.part").symlink_to(secret)
    Session(job(video, out)).run()
    assert secret.read_text() == "mine"
    assert not [path for path in out.iterdir() if path.is_symlink()]


def test_the_folder_is_named_after_the_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run 3").mkdir()
    for given, name in {
        "a/film.one.mp4": "film.one-track",
        "run 3": "run-3-track",
        "run 3/f*.png": "f-track",
        "0": "camera-0-track",
    }.items():
        assert str(TrackJob(input=given).folder()) == name
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert TrackJob(input="x", out="~/r").folder() == tmp_path / "home" / "r"


# ---- frames that are damaged, and some frames only -----------------------------------------------------------------


@undrawn
def test_damaged_frames_are_rows(tmp_path):
    """Of another size, with NaN: the run goes on, and the neighbours are as they would have been."""
    frames = np.stack(
        [PlaneWaves.random(seed=2).render(torch.tensor([[80.0 + k, 60, 0]]), (120, 160))[0, 0] for k in range(8)]
    )
    np.save(tmp_path / "good.npy", frames)
    frames[3, 60, 80] = np.nan
    frames[5] = np.inf
    np.save(tmp_path / "bad.npy", frames)
    for name in ("good", "bad"):
        done = Session(job(tmp_path / f"{name}.npy", tmp_path / name, stabilise=0)).run()
        assert (done.frames, done.damaged) == (8, 0 if name == "good" else 2)
    good, bad = track_of(tmp_path / "good"), track_of(tmp_path / "bad")
    np.testing.assert_allclose(bad["pose"][[1, 2, 4, 6, 7]], good["pose"][[1, 2, 4, 6, 7]], atol=2e-3)
    assert np.isnan(bad["pose"][[3, 5]]).all()
    rows = list(csv.DictReader((tmp_path / "bad" / "track.csv").open()))
    assert [row["status"] for row in rows[::2]] == ["CONVERGED"] * 3 + ["DAMAGED", "CONVERGED", "DAMAGED"] + [
        "CONVERGED"
    ] * 2
    assert "NaN" in rows[6]["damage"]
    assert rows[4]["damage"] == ""
    assert json.loads((tmp_path / "bad" / "summary.json").read_text())["damaged_frames"] == 2
    for film in ("overlay.mp4", "stabilised.mp4"):
        assert len(list(open_frames(tmp_path / "bad" / film))) == 8
    with pytest.raises(ValueError, match=r"frame 3: .*NaN"):
        Session(job(tmp_path / "bad.npy", tmp_path / "old way", stop_at_damage=True)).run()
    assert json.loads((tmp_path / "old way" / "summary.json").read_text())["frames"] == 3


@undrawn
def test_some_frames(video, tmp_path):
    """They keep their numbers and times; a run of them can be resumed too."""
    Session(job(video, tmp_path / "a", frames="30:50:4")).run()
    track = track_of(tmp_path / "a")
    assert track["frame"].tolist() == [30, 34, 38, 42, 46, 50]
    np.testing.assert_allclose(track["time_s"], track["frame"] / 50)
    stop_at(video, tmp_path / "b", 3, frames="30:50:4")
    Session(job(video, tmp_path / "b", frames="30:50:4", resume=True)).run()
    assert (tmp_path / "a" / "track.csv").read_text() == (tmp_path / "b" / "track.csv").read_text()


@pytest.mark.parametrize("text", ["a", "1:2:3:4", "-1", "::0", "1.5"])
def test_bad_frames_option(text):
    with pytest.raises(ValueError, match="frames: expected FIRST:LAST:STEP, whole numbers from 0 on"):
        TrackJob(input="x", frames=text)
