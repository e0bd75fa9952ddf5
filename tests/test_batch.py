"""Many recordings: each done once and as by itself, whatever happens in between; one in parts as in one piece."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tifffile
import torch

import torch_ecc as te
from torch_ecc.commands import batch_cluster, batch_parts, batch_queue, batch_report
from torch_ecc.commands.batch_cluster import Guard, _misfit
from torch_ecc.commands.batch_list import read_list
from torch_ecc.commands.batch_parts import cut, do_join, do_part
from torch_ecc.commands.batch_queue import Queue, SchedulerGoneError, Task
from torch_ecc.commands.batch_unit import TICKET, WORK, Work, do
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.track import Session
from torch_ecc.io.output import claim
from torch_ecc.io.summary import versions
from torch_ecc.sim.scene.waves import PlaneWaves

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")

SETTINGS = {"centers": [(48.0, 40.0)], "size": 31}
FRAMES = 8


def film(seed: int, frames: int = FRAMES, turn: float = 0.02) -> np.ndarray:
    """(F, 80, 96) uint8, a scene that moves and turns."""
    poses = [(48 + 3 * math.sin(k / 5), 40 - 2 * math.sin(k / 7), turn * k) for k in range(frames)]
    stack = PlaneWaves.random(seed=seed).render(torch.tensor(poses, dtype=torch.float64), (80, 96))[:, 0]
    stack += torch.randn(stack.shape, generator=torch.Generator().manual_seed(seed))
    return stack.round().clamp(0, 255).to(torch.uint8).numpy()


@pytest.fixture
def archive(tmp_path):
    """A TIFF, a folder, a stack whose target is lost, and one that is broken."""
    folder = tmp_path / "archive"
    (folder / "pictures").mkdir(parents=True)
    tifffile.imwrite(folder / "pages.tif", film(1), photometric="minisblack")
    for number, frame in enumerate(film(2)):
        cv2.imwrite(str(folder / "pictures" / f"{number:03d}.png"), frame)
    lost = film(3)
    lost[5:] = 90
    np.save(folder / "lost.npy", lost)
    (folder / "broken.tif").write_bytes(b"no picture at all")
    return folder


@pytest.fixture
def one(tmp_path):
    """A recording."""
    np.save(tmp_path / "stack.npy", film(0))
    return tmp_path / "stack.npy"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The picture of each track takes longer than the track."""
    monkeypatch.setattr(Session, "_plot", lambda self: None)


@pytest.fixture(scope="module")
def client():
    """Two workers in this process."""
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    )
    with cluster, distributed.Client(cluster, set_as_default=False) as client:
        yield client


def statuses(done: te.Batch) -> dict[str, str]:
    return {row["folder"]: row["status"] for row in done.rows}


def assert_as_by_itself(folder: Path, recording: Path, alone: Path) -> None:
    """Byte for byte but for times."""
    Session(TrackJob(input=str(recording), out=str(alone), centers=((48.0, 40.0),), size=31)).run()
    assert {path.name for path in folder.iterdir()} - {path.name for path in alone.iterdir()} == {"batch.json"}
    for path in alone.iterdir():
        if path.name == "summary.json":
            ours, theirs = (json.loads((each / path.name).read_text()) for each in (folder, alone))
            assert ours | {"frames_per_s": 0} == theirs | {"frames_per_s": 0}
        else:
            assert (folder / path.name).read_bytes() == path.read_bytes(), path.name


# ---- done once -------------------------------------------------------------------------------------------------------


def test_each_is_done_as_by_itself_and_only_once(archive, tmp_path, client, monkeypatch):
    """A broken one is a row; nothing is done again but what has changed: a setting of some, an input."""
    monkeypatch.undo()
    out = tmp_path / "out"
    done = te.batch(f"{archive}/*", out, client=client, **SETTINGS)
    assert statuses(done) == dict.fromkeys(("lost", "pages", "pictures"), "tracked") | {"broken": "failed"}
    assert done.tracked_now == 3
    assert "cannot be read as TIFF" in done.of("failed")[0]["words"]
    for name in ("lost.npy", "pictures"):
        assert_as_by_itself(out / Path(name).stem, archive / name, tmp_path / "alone" / name)
    monkeypatch.setattr(Session, "_plot", lambda self: None)
    rows = {row["folder"]: row for row in csv.DictReader((out / "batch.csv").open())}
    assert [rows["lost"][name] for name in ("frames", "lost", "damaged")] == ["8", "3", "0"]
    with np.load(out / "pages" / "track.npz") as track:
        assert float(rows["pages"]["drift_x_px"]) == pytest.approx(track["displacement"][-1, 0, 0], rel=1e-5)
    assert sorted(p.name for p in out.iterdir() if p.is_file()) == [".failed.json", "batch.csv", "batch.png"]
    assert not (out / WORK).exists()

    again = te.batch(f"{archive}/*", out, client=None, **SETTINGS)  # no cluster is started for nothing
    assert again.tracked_now == 0
    assert again.rows == done.rows

    changed = te.batch(f"{archive}/*", out, client=client, match={"pag*": {"levels": 2}}, **SETTINGS)
    assert changed.tracked_now == 1
    cv2.imwrite(str(archive / "pictures" / "003.png"), film(2)[4])
    (archive / "broken.tif").unlink()
    tifffile.imwrite(archive / "broken.tif", film(8), photometric="minisblack")
    mended = te.batch(f"{archive}/*", out, client=client, match={"pag*": {"levels": 2}}, **SETTINGS)
    assert mended.tracked_now == 2
    assert statuses(mended)["broken"] == "tracked"


def test_a_mistake_in_the_settings_costs_no_result(one, tmp_path, client):
    """A recording that fails with new settings keeps the result of the old ones, which are done still."""
    path, out = one, tmp_path / "out"
    te.batch(path, out, client=client, **SETTINGS)
    wrong = te.batch(path, out, client=client, **SETTINGS | {"centers": [(2.0, 2.0)]})
    assert "must lie in the frame" in wrong.of("failed")[0]["words"]
    assert te.batch(path, out, **SETTINGS).tracked_now == 0
    assert te.batch(path, out, **SETTINGS).of("tracked")


def test_what_failed_is_tried_again_if_asked(archive, tmp_path, client):
    path, out = archive / "broken.tif", tmp_path / "out"
    assert te.batch(path, out, client=client, **SETTINGS).of("failed")
    assert te.batch(path, out, client="not used", **SETTINGS).of("failed")
    with pytest.raises(AttributeError):
        te.batch(path, out, client="used", retry=True, **SETTINGS)


def test_ctrl_c_keeps_what_is_done(archive, tmp_path, client):
    """It comes where the first row has come; frames are told of on another thread."""
    out, came = tmp_path / "out", []

    def stop(done: int, of: int | None) -> None:
        if threading.current_thread() is threading.main_thread() and not came:
            came.append(done)
            raise KeyboardInterrupt

    stopped = te.batch(f"{archive}/*", out, client=client, progress=stop, **SETTINGS)
    assert stopped.interrupted
    assert stopped.of("unfinished")
    assert not (out / WORK).exists()
    rest = te.batch(f"{archive}/*", out, client=client, **SETTINGS)
    assert not rest.interrupted
    assert not rest.of("unfinished")
    assert rest.tracked_now + stopped.tracked_now == 3


class Deadly:
    """Frames whose reader is killed, as long as a file is not there: that makes it."""

    def __init__(self, path: Path) -> None:
        self.path, self.shape, self.home = path, (FRAMES, 80, 96), os.getpid()

    def __getitem__(self, index: int) -> np.ndarray:
        if os.getpid() != self.home and not self.path.exists():
            self.path.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return film(0)[index]


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_killed_worker_is_replaced(tmp_path):
    """However long that takes: Dask would give up one that is not there again after 15 s."""
    films, lost = {"a": Deadly(tmp_path / "killed")}, []

    def progress(done: int, of: int | None) -> None:
        lost.append(dask.config.get("distributed.deploy.lost-worker-timeout"))

    done = te.batch(films, tmp_path / "out", workers=1, progress=progress, overlay=False, **SETTINGS)
    assert set(lost) == {"1 day"}
    assert (tmp_path / "killed").exists()
    assert statuses(done) == {"a": "tracked"}
    assert not (tmp_path / "out" / WORK).exists()


def work(path: Path, out: Path, ticket: str = "mine", **options: object) -> Work:
    """A recording that somebody waits for."""
    (out / WORK).mkdir(parents=True, exist_ok=True)
    (out / WORK / TICKET).write_text("mine")
    job = TrackJob(input=str(path), centers=((48.0, 40.0),), size=31, overlay=False, **options)
    return Work(path.stem, job, out, ticket, versions())


def test_nothing_comes_of_work_that_nobody_waits_for(one, tmp_path):
    """A worker of a run that was killed does not overwrite what a later one has made."""
    row = do(work(one, tmp_path, ticket="of another run"))
    assert row["status"] == "unfinished"
    assert {path.name for path in tmp_path.iterdir()} == {WORK, one.name}


def test_workers_of_other_versions_make_nothing(one, tmp_path):
    row = do(replace(work(one, tmp_path), versions={"torch_ecc": "0.0", "torch": "0.0"}))
    assert row["status"] == "unfinished"
    assert "versions: they must be equal everywhere" in row["words"]


def test_leftovers_are_removed_unless_somebody_writes(one, tmp_path, client):
    out = tmp_path / "out"
    stale, busy = out / WORK / "stack-12345678", out / WORK / "other-12345678"
    for folder in (stale, busy):
        folder.mkdir(parents=True)
        (folder / "track.csv.part").touch()
    with claim(busy):
        te.batch(one, out, client=client, **SETTINGS)
    assert not stale.exists()
    assert busy.exists()


# ---- in parts --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """A recording that turns by more than two whole turns, and its track in one piece."""
    folder = tmp_path_factory.mktemp("long")
    np.save(folder / "long.npy", film(5, 160, turn=0.09))
    Session(TrackJob(input=str(folder / "long.npy"), out=str(folder / "whole"), centers=((48.0, 40.0),), size=31,
                     overlay=False, fps=100.0)).run()  # fmt: skip
    return folder


def in_parts(folder: Path, monkeypatch: pytest.MonkeyPatch, **blind: float) -> tuple[Path, list[dict]]:
    """Its track in four parts, and the seams."""
    monkeypatch.setattr(batch_parts, "AHEAD", 10)
    out = folder / f"out-{len(list(folder.iterdir()))}"
    one = work(folder / "long.npy", out, fps=100.0)
    owns = cut(one, 4)
    assert [len(own) for own in owns] == [40, 40, 40, 40]
    for number, own in enumerate(owns):
        assert do_part(one, number, own)["frames"] == 40
    row = do_join(one, owns)
    assert (row["status"], row["frames"]) == ("tracked", 160)
    assert not (out / batch_parts.PIECES).exists()
    return out / "long", json.loads((out / "long" / "batch.json").read_text())["seams"]


def test_parts_are_joined_as_if_there_were_none(long, monkeypatch):
    """Seams far below what light allows, angles that go on through whole turns, in the table, too."""
    joined, seams = in_parts(long, monkeypatch)
    assert [seam["frame"] for seam in seams] == [40, 80, 120]
    assert not any(seam["tracked_through"] for seam in seams)
    assert all(seam["apart_px"] <= 1e-4 and seam["apart_rad"] <= 1e-6 for seam in seams)
    with np.load(joined / "track.npz") as ours, np.load(long / "whole" / "track.npz") as whole:
        assert ours.keys() == whole.keys()
        assert whole["pose"][-1, 0, 2] > 4 * math.pi
        for name in ("pose", "displacement"):
            assert np.abs(ours[name] - whole[name])[..., :2].max() < 1e-4
            assert np.abs(ours[name] - whole[name])[..., 2].max() < 1e-6
        for name in ("frame", "time_s", "status", "reason"):
            assert np.array_equal(ours[name], whole[name])
    a, b = (np.genfromtxt(each / "track.csv", delimiter=",", names=True) for each in (joined, long / "whole"))
    for name in ("x_px", "theta_rad", "dtheta_rad", "time_s"):
        assert np.abs(a[name] - b[name]).max() < 1e-4
    assert json.loads((joined / "summary.json").read_text())["complete"]


def test_a_seam_that_does_not_fit_is_tracked_through(long, monkeypatch):
    """As exactly as in one piece, since it goes on from its neighbour's state."""
    monkeypatch.setattr(batch_parts, "SEAM", (-1.0, -1.0, -1.0))
    joined, seams = in_parts(long, monkeypatch)
    assert all(seam["tracked_through"] for seam in seams)
    for name in ("track.csv", "track.npz"):
        assert (joined / name).read_bytes() == (long / "whole" / name).read_bytes()


def test_a_part_that_begins_without_its_target_is_tracked_through(long, tmp_path, monkeypatch):
    frames = np.load(long / "long.npy")
    frames[75:85] = 90  # across a seam
    (tmp_path / "lost").mkdir()
    np.save(tmp_path / "lost" / "long.npy", frames)
    joined, seams = in_parts(tmp_path / "lost", monkeypatch)
    assert [seam["tracked_through"] for seam in seams] == [False, True, False]
    with np.load(joined / "track.npz") as track:
        assert np.isnan(track["pose"][75:85]).all()
        assert np.isfinite(track["pose"][86:]).all()


def test_short_ones_and_videos_are_not_cut(one, tmp_path):
    assert cut(work(one, tmp_path), 4) == []


def test_a_batch_in_parts(long, tmp_path, client, monkeypatch):
    """Parts that were done before a run was stopped are not done again."""
    monkeypatch.setattr(batch_parts, "AHEAD", 10)
    options = SETTINGS | {"fps": 100.0, "parts": 4}
    owns = cut(work(long / "long.npy", tmp_path, fps=100.0), 4)
    part = work(long / "long.npy", tmp_path, fps=100.0)
    do_part(part, 1, owns[1])
    marker = tmp_path / batch_parts.PIECES / "long" / "1" / "batch.json"
    before = marker.stat().st_mtime_ns, marker.stat().st_ino
    do_part(part, 1, owns[1])
    assert (marker.stat().st_mtime_ns, marker.stat().st_ino) == before
    done = te.batch(long / "long.npy", tmp_path, client=client, **options)
    assert statuses(done) == {"long": "tracked"}


# ---- which recordings, and how ---------------------------------------------------------------------------------------


def test_a_list_names_recordings_and_their_settings(archive):
    (archive / "list.toml").write_text(
        'recordings = ["*.npy", "pictures"]\nout = "results"\nsize = 31\ncenters = [[48, 40]]\n'
        '[match."lost*"]\ntemplate = ["crop.png"]\n[match."*/pictures"]\nfps = 9.0\n'
    )
    job, found = read_list([str(archive / "list.toml")], {"levels": 2})
    assert job.out == str(archive / "results")
    assert [each.name for each in found] == ["lost", "pictures"]
    assert [each.job.size for each in found] == [None, 31]  # a template tells its size
    assert [each.job.fps for each in found] == [None, 9.0]
    assert found[0].job.template == (str(archive / "crop.png"),)
    assert {each.job.levels for each in found} == {2}
    assert Path(found[1].job.input) == archive / "pictures"


def test_names_that_clash_are_told_apart(tmp_path):
    paths = [tmp_path / "a" / "run.npy", tmp_path / "b" / "Run.tif", tmp_path / "b" / "other.tif"]
    names = [each.name for each in read_list(paths, SETTINGS)[1]]
    assert names[2] == "other"
    assert len({name.casefold() for name in names}) == 3
    assert names[0] == read_list(paths[:2], SETTINGS)[1][0].name


@pytest.mark.parametrize(
    ("recordings", "settings", "words"),
    [
        ([], {}, "recordings: expected at least one, got none"),
        (["0"], {}, "expected files and folders, got the camera 0"),
        (["a.npy"], {"centres": [(1, 2)]}, "unknown key 'centres' .did you mean 'centers'"),
        (["a.npy"], {"resume": True}, "unknown key 'resume' .each recording has its own"),
        (["a.npy"], {"workers": 0}, "workers: expected 1 or more, got 0"),
        (["a.npy"], {"scheduler": "here"}, "scheduler: expected an address as tcp://10.0.0.1:8786, got 'here'"),
        (["a.npy"], {"parts": 2, "stabilise": 0}, "stabilise: not with parts"),
        (["a.npy"], {"match": {"a*": {"sizes": 3}}}, "unknown key 'sizes'"),
        (["a.npy"], {"match": {"a*": {"stabilise": 0}}, "parts": 2}, "stabilise: not with parts"),
    ],
)
def test_bad_settings_have_words(recordings, settings, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        te.batch(recordings, tmp_path / "out", **settings)
    assert not (tmp_path / "out").exists()


def test_a_pattern_that_fits_nothing(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"recordings: no file matches '.*nothing\*'"):
        te.batch(f"{tmp_path}/nothing*", tmp_path / "out")


def test_a_folder_that_is_no_result_is_not_touched(archive):
    """Above all if it is a recording."""
    with pytest.raises(ValueError, match="pictures is there already and is no result of batch"):
        te.batch(archive / "pictures", archive, **SETTINGS)
    assert len(list((archive / "pictures").iterdir())) == FRAMES


# ---- the cluster -----------------------------------------------------------------------------------------------------


def test_without_dask_or_pyarrow_there_is_a_sentence(one, tmp_path, monkeypatch):
    monkeypatch.setattr(batch_report, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"parquet: pyarrow is not installed: pip install 'torch-ecc\[parquet\]'"):
        te.batch(one, tmp_path / "out", parquet=True, **SETTINGS)
    monkeypatch.setattr(batch_cluster, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"batch: Dask is not installed: pip install 'torch-ecc\[cluster\]'"):
        te.batch(one, tmp_path / "out", **SETTINGS)


def test_without_a_scheduler_there_is_a_sentence(one, tmp_path, monkeypatch):
    monkeypatch.setattr(batch_cluster, "PATIENCE", 0.5)
    with pytest.raises(ValueError, match=r"scheduler: nobody answers at tcp://127.0.0.1:9 \(dask scheduler starts one"):
        te.batch(one, tmp_path / "out", scheduler="tcp://127.0.0.1:9", **SETTINGS)


def test_workers_that_do_not_fit_are_told_of(tmp_path):
    good = {"versions": versions(), "seen": True, "resources": []}
    other = good | {"versions": versions() | {"torch": "1.0"}}
    assert _misfit("tcp://a:1", good, tmp_path) is None
    for seen, words in (
        (other, r"the worker tcp://a:1 has torch_ecc .* and torch 1.0 \(here: "),
        (good | {"seen": False}, r"out: the worker tcp://a:1 does not see .* a folder that all computers share"),
        (ModuleNotFoundError("No module named 'torch_ecc'"), r"cannot import torch_ecc .* install it there, too"),
    ):
        assert re.search(words, _misfit("tcp://a:1", seen, tmp_path))


def test_workers_that_join_and_do_not_fit_are_sent_away(tmp_path, client, monkeypatch):
    """They would give up all that there is before the others are done with one."""
    (tmp_path / WORK).mkdir()
    said, sent = [], []
    monkeypatch.setattr(client, "retire_workers", sent.extend)
    guard = Guard(client, tmp_path, said.append, known=set())
    guard()
    assert not said
    guard.known = set()  # as if they had just joined
    monkeypatch.setattr(batch_cluster, "same_versions", lambda a, b: False)
    guard()
    guard()
    assert sorted(sent) == sorted(client.nthreads())
    assert all(words.startswith("Sent away: scheduler: the worker") for words in said)


def test_a_gpu_is_asked_of_the_cluster(one, tmp_path, client):
    with pytest.raises(ValueError, match=r"device: no worker has the resource GPU: dask worker .* --resources GPU=1"):
        te.batch(one, tmp_path / "out", client=client, device="cuda", **SETTINGS)
    assert not (tmp_path / "out").exists()


def stub(work: Work) -> dict[str, object]:
    return {"folder": work.name, "status": "tracked"}


JOINED, BLAMED = threading.Event(), {"1": 1, "2": 9}  # workers in this process see them


def patient(work: Work) -> dict[str, object]:
    return {"folder": work.name, "status": "tracked" if JOINED.wait(20) else "failed"}


def deadly(work: Work) -> dict[str, object]:
    if BLAMED.get(work.name, 0) > 0:
        BLAMED[work.name] -= 1
        raise distributed.KilledWorker(work.name, SimpleNamespace(address="tcp://a:1"), 3)
    return stub(work)


def stubs(count: int) -> list[Task]:
    """Calls that do nothing."""
    job = TrackJob(input="none")
    return [Task(str(k), stub, Work(str(k), job, Path(), "mine", {})) for k in range(count)]


def test_few_calls_are_out_at_a_time(client):
    """A scheduler's memory does not depend on how many there are."""
    most, rows = [], []

    def came(row: dict[str, object]) -> None:
        most.append(len(client.futures))
        rows.append(row["folder"])

    Queue(stubs(60), came).run(client, lambda: None)
    assert sorted(rows, key=int) == [str(k) for k in range(60)]
    assert max(most) <= 2 * 2


def test_workers_that_join_are_given_work_while_nothing_has_come_back(client, monkeypatch):
    """Recordings may take an hour, and workers come one by one from a queue of their own."""
    counts = iter(({"a": 1}, {"a": 1, "b": 1}))

    def tasks() -> Iterator[Task]:
        for k, task in enumerate(stubs(4)):
            if k == 3:  # two at a time are out for a worker
                JOINED.set()
            yield replace(task, make=patient)

    rows = []
    monkeypatch.setattr(batch_queue, "LOOK", 0.05)
    monkeypatch.setattr(client, "nthreads", lambda: next(counts, {"a": 1, "b": 1}))
    Queue(tasks(), rows.append).run(client, lambda: None)
    assert [row["status"] for row in rows] == ["tracked"] * 4


def test_what_was_beside_a_deadly_call_is_not_blamed(client):
    """Dask blames everything that a worker had when it died."""
    rows, out = [], []

    def came(row: dict[str, object]) -> None:
        rows.append(row)
        out.append(len(queue._out))

    queue = Queue([replace(task, make=deadly) for task in stubs(5)], came)
    queue.run(client, lambda: None)
    failed = {row["folder"]: row["words"] for row in rows if row["status"] != "tracked"}
    assert list(failed) == ["2"]
    assert "it ended its worker 4 times, with nothing beside it" in failed["2"]
    assert [len(rows), *out[-2:]] == [5, 0, 0]


def test_without_workers_for_long_the_cluster_is_given_up(client, monkeypatch):
    """Those here do not come back by themselves; what was out is handed out again on the next one."""
    rows = []
    monkeypatch.setattr(batch_queue, "LOOK", 0.01)
    queue = Queue(stubs(3), rows.append, patience=-1.0)
    with monkeypatch.context() as nobody:
        nobody.setattr(client, "nthreads", dict)
        with pytest.raises(SchedulerGoneError):
            queue.run(client, lambda: None)
    queue.run(client, lambda: None)
    assert len(rows) == 3


def test_what_was_out_when_the_scheduler_went_is_handed_out_again(client):
    rows = []

    def came(row: dict[str, object]) -> None:
        rows.append(row["folder"])
        if len(rows) == 3:
            client.cancel(list(queue._out))

    queue = Queue(stubs(12), came)
    with pytest.raises(SchedulerGoneError):
        queue.run(client, lambda: None)
    queue.run(client, lambda: None)
    assert set(rows) == {str(k) for k in range(12)}


def test_all_poses_in_one_table(one, archive, tmp_path, client):
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "out"
    te.batch([one, archive / "pictures"], out, client=client, parquet=True, **SETTINGS)
    table = parquet.read_table(out / "poses.parquet").to_pydict()
    assert table["recording"] == ["stack"] * FRAMES + ["pictures"] * FRAMES
    assert table["file"] == [None] * FRAMES + [f"{k:03d}.png" for k in range(FRAMES)]
    rows = list(csv.DictReader((out / "pictures" / "track.csv").open()))
    assert table["x_px"][FRAMES:] == [float(row["x_px"]) for row in rows]


def test_the_command_says_what_became_of_it(one, archive, tmp_path, client, monkeypatch, capsys):
    from torch_ecc import cli

    out = tmp_path / "out"
    scheduler = ["--scheduler", client.scheduler.address]
    argv = ["torch-ecc", "batch", str(one), str(archive / "broken.tif"), *scheduler]
    monkeypatch.setattr(sys, "argv", [*argv, "--center", "48", "40", "--size", "31", "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    said = capsys.readouterr().out
    assert "2 of 2 recordings are to be tracked" in said
    assert f"Failed: {archive}/broken.tif: open_frames:" in said
    assert "Tracked 1 now; 1 of 2 are done, 1 have failed" in said
