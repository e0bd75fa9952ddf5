"""Many recordings on Dask: python benchmarks/cluster.py [archive|speed|scheduler|parts|restart] [--help]

What is promised of ``torch-ecc batch``, tried with real processes: workers and a scheduler that are killed, two workers
beside one, 10,000 calls, a long recording in parts beside the whole.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import av
import click
import cv2
import numpy as np
import psutil
import tifffile
import torch
from numpy.typing import NDArray
from rich.console import Console

import torch_ecc as te
from torch_ecc.commands.batch_queue import Queue, Task
from torch_ecc.commands.batch_unit import TICKET, WORK, Work, do
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.track import Session
from torch_ecc.io.summary import versions
from torch_ecc.sim.scene.waves import PlaneWaves

console = Console(width=120, highlight=False)
SIZE, CENTER, TEMPLATE = (120, 160), (80.0, 60.0), 41
SETTINGS: dict[str, Any] = {"centers": [CENTER], "size": TEMPLATE}


def film(seed: int, frames: int) -> np.ndarray:
    """(F, 120, 160) uint8 under smooth motion, 1 grey level of noise."""
    k = torch.arange(frames, dtype=torch.float64)
    poses = torch.stack((80 + 6 * torch.sin(k / 9 + seed), 60 - 4 * torch.sin(k / 7), 0.05 * torch.sin(k / 11)), 1)
    stack = PlaneWaves.random(seed=seed).render(poses, SIZE)[:, 0]
    stack = stack + torch.randn(stack.shape, generator=torch.Generator().manual_seed(seed))
    return stack.round().clamp(0, 255).to(torch.uint8).numpy()


def write_video(path: Path, stack: np.ndarray) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=50)
        stream.height, stream.width = SIZE
        stream.pix_fmt, stream.options = "yuvj420p", {"q": "2"}
        for frame in stack:
            for packet in stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def write_archive(folder: Path, count: int, frames: int) -> list[Path]:
    """``count`` recordings of four kinds, in turn; the first of three kinds is broken, number 7 loses its target."""
    folder.mkdir(parents=True)
    for k in range(count):
        stack, path = film(k, frames), folder / f"{k:03d}"
        if k == 7:
            stack[frames // 2 :] = 90
        if k % 4 == 0:
            write_video(path.with_suffix(".avi"), stack)
        elif k % 4 == 1:
            tifffile.imwrite(path.with_suffix(".tif"), stack, photometric="minisblack")
        elif k % 4 == 2:
            path.mkdir()
            for number, frame in enumerate(stack):
                cv2.imwrite(str(path / f"{number:04d}.png"), frame)
        else:
            np.save(path.with_suffix(".npy"), stack)
    (folder / "000.avi").write_bytes((folder / "000.avi").read_bytes()[:100])
    (folder / "001.tif").write_bytes(b"no picture at all")
    np.save(folder / "003.npy", np.zeros((frames, 30, 40), np.uint8))  # too small for the template
    return sorted(folder.iterdir())


def workers_here() -> list[psutil.Process]:
    """The processes that Dask has started for us."""
    return [p for p in psutil.Process().children(recursive=True) if "spawn_main" in " ".join(p.cmdline())]


@contextmanager
def scratch() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="torch-ecc-cluster-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def differences(ours: Path, recording: Path, alone: Path) -> list[str]:
    """Which files of a result are not those of ``torch-ecc track`` byte for byte, times left out."""
    Session(TrackJob(input=str(recording), out=str(alone), centers=(CENTER,), size=TEMPLATE)).run()
    wrong = []
    for path in alone.iterdir():
        if path.name == "summary.json":
            a, b = (json.loads((folder / path.name).read_text()) | {"frames_per_s": 0} for folder in (ours, alone))
            same = a == b
        else:
            same = (ours / path.name).read_bytes() == path.read_bytes()
        wrong += [] if same else [f"{ours.name}/{path.name}"]
    return wrong


@click.group()
def app() -> None:
    """Experiments of many recordings on Dask."""


@app.command()
@click.option("--count", default=40)
@click.option("--frames", default=60)
def archive(count: int, frames: int) -> None:
    """Mixed kinds, three broken, one lost, a worker killed with -9 in the middle; again; with a changed setting."""
    with scratch() as folder:
        recordings, out, killed = write_archive(folder / "archive", count, frames), folder / "out", []

        def kill(done: int, of: int | None) -> None:
            if of and done > count * frames // 3 and not killed and len(workers_here()) == 2:
                victim = workers_here()[0]
                killed.append(victim.pid)
                os.kill(victim.pid, signal.SIGKILL)

        started = time.perf_counter()
        done = te.batch(recordings, out, workers=2, progress=kill, **SETTINGS)
        console.print(f"{time.perf_counter() - started:.0f} s; killed: {killed}; {done.tracked_now} tracked")
        for row in done.of("failed"):
            console.print(f"  failed: {row['folder']}: {row['words']}", soft_wrap=True)
        console.print(f"  lost: {[(row['folder'], row['lost']) for row in done.of('tracked') if row['lost']]}")
        console.print(f"  left over: {[p.name for p in out.iterdir() if p.name.startswith('.unf')]}")
        tracked = {row["folder"]: Path(row["recording"]) for row in done.of("tracked")}
        wrong = [each for name, path in tracked.items() for each in differences(out / name, path, folder / "a" / name)]
        console.print(f"  not as torch-ecc track: {wrong or 'none'} of {len(tracked)}")
        started = time.perf_counter()
        again = te.batch(recordings, out, workers=2, **SETTINGS)
        console.print(f"again: {again.tracked_now} tracked, {time.perf_counter() - started:.2f} s")
        changed = te.batch(recordings, out, workers=2, match={"01*": {"levels": 2}}, **SETTINGS)
        console.print(f"levels = 2 for 01*: {changed.tracked_now} tracked")


@app.command()
@click.option("--count", default=40, help="Recordings for each number of workers.")
@click.option("--frames", default=1000)
@click.option("--rounds", default=5, help="Of a recording as a worker does it.")
def speed(count: int, frames: int, rounds: int) -> None:
    """Two workers beside one, from the first word to the last; and what a recording costs beside its tracking."""
    with scratch() as folder:
        stack = film(0, frames)
        for k in range(count):
            np.save(folder / f"{k}.npy", stack)
        beside(folder, rounds)
        elapsed = {}
        for workers in (1, 2):
            heard: list[float] = []
            done = te.batch(
                f"{folder}/*.npy",
                folder / f"out{workers}",
                workers=workers,
                progress=lambda done, of, heard=heard: heard.append(time.perf_counter()),
                overlay=False,
                **SETTINGS,
            )
            elapsed[workers] = heard[-1] - heard[0]
            busy = sum(row["wall_s"] for row in done.rows) / workers / elapsed[workers]
            told = f"{elapsed[workers]:.1f} s for {count} recordings of {frames} frames"
            console.print(f"{workers} worker(s): {told}, each busy {100 * busy:.0f} % of it")
        ratio, load = elapsed[1] / elapsed[2], os.getloadavg()[0]
        console.print(f"two beside one: {ratio:.2f}; {os.cpu_count()} cores, load {load:.1f}")


def beside(folder: Path, rounds: int) -> None:
    """Processor time of a recording as a worker does it, and how much of that is not the run of ``torch-ecc track``."""
    out, within = folder / "beside", []
    (out / WORK).mkdir(parents=True)
    (out / WORK / TICKET).write_text("ours")
    job = TrackJob(input=str(folder / "0.npy"), centers=(CENTER,), size=TEMPLATE)
    run = Session.run

    def timed(session: Session, *args: Any) -> Any:
        before = time.process_time()
        finished = run(session, *args)
        within.append(time.process_time() - before)
        return finished

    with patch.object(Session, "run", timed):
        for k in range(rounds):
            before = time.process_time()
            row = do(Work(f"work{k}", job, out, "ours", versions()))
            whole = time.process_time() - before
            if row["status"] != "tracked":
                raise RuntimeError(row)
            more = whole - within[-1]
            console.print(f"processor time of a recording: {whole:.2f} s, of it beside its run {1e3 * more:.0f} ms")


def stub(work: Work) -> dict[str, Any]:
    """A call that does nothing."""
    return {"folder": work.name, "status": "tracked"}


@app.command()
@click.option("--count", default=10_000)
def scheduler(count: int) -> None:
    """Memory of a scheduler in a process of its own, and of the client, over calls of a stub."""
    from distributed import Client

    with cluster_of_processes(2) as (address, processes), Client(address) as client:
        watched = {"scheduler": psutil.Process(processes[0].pid), "client": psutil.Process()}
        seen = 0

        def came(row: dict[str, Any]) -> None:
            nonlocal seen
            seen += 1
            if seen in (1, 100) or seen % (count // 5) == 0:
                used = {name: f"{each.memory_info().rss / 2**20:.0f} MB" for name, each in watched.items()}
                console.print(f"{seen} calls: {used}")

        started = time.perf_counter()
        works = (Work(str(k), TrackJob(input="none"), Path(), "ours", {}) for k in range(count))
        Queue((Task(work.name, stub, work) for work in works), came).run(client, lambda: None)
        console.print(f"{1e3 * (time.perf_counter() - started) / count:.1f} ms per call")


class Stream:
    """``count`` frames of 64 x 64 px, each made when it is asked for: exact plane waves that drift, shake and turn,
    with 1 grey level of noise."""

    def __init__(self, count: int, turn: float = 2e-3) -> None:
        self.shape, self.turn, self.scene = (count, 64, 64), turn, PlaneWaves.random(24)

    def truth(self, index: NDArray[Any] | int) -> NDArray[np.float64]:
        """(..., 3) px, px, rad."""
        k = np.asarray(index, np.float64)
        x, y = 31.5 + 6 * np.sin(k / 31) + 3 * np.sin(k / 5000), 31.5 + 5 * np.sin(k / 43)
        return np.stack((x, y, self.turn * k), -1)

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        frame = self.scene.render(torch.from_numpy(self.truth(index))[None], self.shape[1:]).numpy()[0, 0]
        noise = np.random.Generator(np.random.Philox(index)).standard_normal(frame.shape, np.float32)
        return (frame + noise).round().clip(0, 255).astype(np.uint8)


class Memory:
    """The most that any of these processes has used, in MB, in each fifth of a run."""

    def __init__(self, processes: Callable[[], list[psutil.Process]]) -> None:
        self.processes, self.fifths = processes, [0.0] * 5

    def __call__(self, done: int, of: int | None) -> None:
        used = [0.0]
        for process in self.processes():
            with suppress(psutil.Error):
                memory = process.memory_info()
                used.append((memory.rss - memory.shared) / 2**20)  # what is mapped from files is not ours
        which = min(5 * done // (of or done or 1), 4)
        self.fifths[which] = max(self.fifths[which], *used)

    def __str__(self) -> str:
        return f"{[round(each) for each in self.fifths]} MB in each fifth of the run"


STREAM: dict[str, Any] = {"centers": [(31.5, 31.5)], "size": 31, "overlay": False}


@app.command()
@click.option("--count", default=100_000, help="Frames.")
@click.option("--parts", default=8)
@click.option("--workers", default=2)
@click.option("--whole/--no-whole", default=True, help="Beside the same in one piece.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder that stays; the same command goes on in it.")
def parts(count: int, parts: int, workers: int, whole: bool, out: Path | None) -> None:
    """A long stream in parts: its seams, memory, time, errors, and what is different in one piece."""
    with scratch() if out is None else nullcontext(out) as folder:
        stream, memory, started = Stream(count), Memory(workers_here), time.perf_counter()
        done = te.batch({"s": stream}, folder / "out", workers=workers, parts=parts, progress=memory, **STREAM)
        console.print(f"{count} frames in {parts} parts on {workers} workers: {time.perf_counter() - started:.0f} s")
        console.print(f"  {done.rows[0]}", soft_wrap=True)
        for seam in json.loads((folder / "out" / "s" / "batch.json").read_text())["seams"]:
            console.print(f"  {seam}")
        console.print(f"  memory of a worker: {memory}")
        tell_errors(folder / "out" / "s", stream)
        if whole:
            run_whole(folder / "whole", stream)
            tell_differences(folder / "out" / "s", folder / "whole")


def run_whole(folder: Path, stream: Stream) -> None:
    """The stream in one piece, as ``torch-ecc track`` would."""
    memory, started = Memory(lambda: [psutil.Process()]), time.perf_counter()
    job = TrackJob(input="s", out=str(folder), resume=(folder / "track.records.part").exists(), **STREAM)
    Session(job, stream).run(lambda done: memory(done, stream.shape[0]) if done % 1000 == 0 else None)
    console.print(f"in one piece: {time.perf_counter() - started:.0f} s; memory: {memory}")


def tell_errors(folder: Path, stream: Stream) -> None:
    """How far the poses are from the truth, at most and rms; the template's own noise is in it."""
    with np.load(folder / "track.npz") as track:
        error = track["pose"][:, 0] - stream.truth(track["frame"])
    rms, most = np.sqrt(np.nanmean(error**2, 0)), np.nanmax(np.abs(error), 0)
    console.print(f"  from the truth (px, px, rad): rms {rms.round(6)}, at most {most.round(6)}")


def tell_differences(joined: Path, whole: Path) -> None:
    """What is joined beside what was tracked in one piece."""
    tracks = [np.load(each / "track.npz") for each in (joined, whole)]
    apart = np.abs(tracks[0]["pose"] - tracks[1]["pose"]).reshape(-1, 3)
    same = (tracks[0]["status"] == tracks[1]["status"]).mean()
    console.print(
        f"  joined beside whole: at most {apart[:, :2].max():.1e} px, {apart[:, 2].max():.1e} rad; statuses equal in "
        f"{100 * same:.2f} %; turned {tracks[1]['pose'][-1, 0, 2] / 2 / np.pi:.1f} times"
    )
    lines = [sum(1 for _ in (folder / "track.csv").open("rb")) for folder in (joined, whole)]
    console.print(f"  lines of track.csv, joined and whole: {lines}")


@contextmanager
def cluster_of_processes(workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Its address; the scheduler and its workers, started as a user would on other machines."""
    address, folder = "tcp://127.0.0.1:18786", Path(tempfile.mkdtemp(prefix="torch-ecc-dask-"))
    processes = [start_scheduler(folder)]
    try:
        processes += [start_worker(address, folder) for _ in range(workers)]
        yield address, processes
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()
        shutil.rmtree(folder, ignore_errors=True)


def start_scheduler(folder: Path) -> subprocess.Popen[bytes]:
    """``dask scheduler``."""
    command = ["dask", "scheduler", "--host", "127.0.0.1", "--port", "18786", "--no-dashboard"]
    return start(command, folder)


def start_worker(address: str, folder: Path) -> subprocess.Popen[bytes]:
    """``dask worker``."""
    return start(["dask", "worker", address, "--nthreads", "1", "--no-dashboard"], folder)


def start(command: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """A process that says what it says into a file."""
    tool = Path(sys.executable).with_name(command[0])
    with (folder / f"{command[1]}.log").open("ab") as log:
        return subprocess.Popen([str(tool), *command[1:]], stdout=log, stderr=log, cwd=folder)


@app.command()
@click.option("--count", default=12)
@click.option("--frames", default=200)
def restart(count: int, frames: int) -> None:
    """``dask scheduler`` and ``dask worker`` as processes of their own; the scheduler is killed in between."""
    with scratch() as folder, cluster_of_processes(2) as (address, processes):
        for k in range(count):
            np.save(folder / f"{k}.npy", film(k, frames))
        restarted, over = threading.Event(), threading.Event()

        def supervise() -> None:
            """As a batch system would: what has ended is started again."""
            while not over.wait(0.5):
                for k, process in enumerate(processes):
                    if process.poll() is not None:
                        console.print(f"  {'worker' if k else 'scheduler'} has ended, and is started again")
                        processes[k] = start_worker(address, folder) if k else start_scheduler(folder)

        def progress(done: int, of: int | None) -> None:
            if of and done > of // 3 and not restarted.is_set():
                restarted.set()
                processes[0].kill()

        supervisor = threading.Thread(target=supervise)
        supervisor.start()
        started = time.perf_counter()
        try:
            done = te.batch(
                f"{folder}/*.npy",
                folder / "out",
                scheduler=address,
                progress=progress,
                say=lambda words: console.print(f"  {words}"),
                **SETTINGS,
            )
        finally:
            over.set()
            supervisor.join()
        console.print(f"{len(done.of('tracked'))} of {count} tracked, {time.perf_counter() - started:.0f} s")
        console.print(f"again: {te.batch(f'{folder}/*.npy', folder / 'out', **SETTINGS).tracked_now} tracked")


if __name__ == "__main__":
    app()
