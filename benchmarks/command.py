"""Processor and wall time of ``torch-ecc track`` beside a plain OpenCV script, whole processes, alternating.

``python benchmarks/command.py [--frames N] [--rounds N] [--only mjpeg h264 tiff16] [--out FILE.json]``: 640 x 480, one
patch and 64 (in an eighth of the frames), with and without the overlay, on a quiet machine and with one core kept busy.
Of the whole process, and per frame: what a tenth of the frames takes, start-up and pictures at the end, is taken off.
Without the tracking, too (``command_rest.py``): less than that no tracker could take.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np
import torch
from results import save

from torch_ecc.paper.result import Number
from torch_ecc.sim.camera.motion import harmonic, placed
from torch_ecc.sim.scene.waves import PlaneWaves

SIZE, SIDE = 121, 41  # px, of one patch and of many
MANY = [(80.0 + 68.0 * i, 72.0 + 48.0 * j) for i in range(8) for j in range(8)]
PLAIN, REST = (Path(__file__).parent / name for name in ("plain_opencv.py", "command_rest.py"))


class Cost(NamedTuple):
    """Of a process, in s."""

    processor: float
    wall: float


def make(folder: Path, kind: str, frames: int) -> Path:
    """A sequence of ``frames`` with known motion as MJPEG, H.264 or 16-bit TIFF."""
    path = folder / f"{kind}-{frames}{'.tif' if kind == 'tiff16' else '.avi' if kind == 'mjpeg' else '.mp4'}"
    poses = placed(harmonic((10.0, 10.0, 0.035), 100), (320.0, 240.0))
    once = PlaneWaves.random(seed=3).render(poses, (480, 640))[:, 0].clamp(0, 255).numpy()
    noise = np.random.default_rng(0).normal(0, 2, (7, 480, 640))
    pages = ((once[k % 100] + noise[k % 7]).clip(0, 255) for k in range(frames))
    if kind == "tiff16":
        write_tiff(path, pages)
    else:
        write_video(path, kind, pages)
    return path


def write_tiff(path: Path, pages: Iterator[np.ndarray]) -> None:
    """Grey levels times 16, as of a camera of 12 bits."""
    import tifffile

    with tifffile.TiffWriter(path) as file:
        for page in pages:
            file.write((page * 16).astype(np.uint16), contiguous=True)


def write_video(path: Path, kind: str, pages: Iterator[np.ndarray]) -> None:
    """MJPEG as OpenCV writes it, H.264 as FFmpeg does."""
    import av

    if kind == "mjpeg":
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 100, (640, 480))
        for page in pages:
            writer.write(cv2.cvtColor(page.astype(np.uint8), cv2.COLOR_GRAY2BGR))
        writer.release()
        return
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=100, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        for page in pages:
            rgb = cv2.cvtColor(page.astype(np.uint8), cv2.COLOR_GRAY2RGB)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(rgb)))
        file.mux(stream.encode())


def timed(command: list[str]) -> Cost:
    """Run a command to its end, as one that is installed: compiled once. RuntimeError if it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment)
    said = process.stderr.read() if process.stderr else b""
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"{' '.join(command)}: {said.decode()}")
    return Cost(usage.ru_utime + usage.ru_stime, time.perf_counter() - started)


@contextmanager
def kept_busy(wanted: bool) -> Iterator[None]:
    """One core that also does something else."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if wanted else None
    try:
        yield
    finally:
        if process:
            process.kill()
            process.wait()


def commands(path: Path, centers: list[tuple[float, float]], size: int, out: str) -> dict[str, list[str]]:
    """The script, and the command without and with its overlay, tracking or not."""
    places = [f"{number:g}" for center in centers for number in center]
    options = [word for x, y in centers for word in ("--center", f"{x:g}", f"{y:g}")] + ["--size", str(size)]
    ours = ["track", str(path), *options, "--out"]
    found = {"script": [sys.executable, str(PLAIN), str(path), f"{out}/plain.csv", str(size), *places]}
    for rest, start in (("", ["-m", "torch_ecc"]), (" but tracking", [str(REST)])):
        found[f"track{rest}"] = [sys.executable, *start, *ours, f"{out}/a{rest}", "--no-overlay"]
        found[f"overlay{rest}"] = [sys.executable, *start, *ours, f"{out}/b{rest}"]
    return found


def race(paths: list[Path], centers: list[tuple[float, float]], size: int, rounds: int) -> dict[str, list[Cost]]:
    """Medians for each of the ``paths``, all commands one after the other in every round."""
    costs: dict[str, list[list[Cost]]] = {}
    for _ in range(rounds):
        for k, path in enumerate(paths):
            with tempfile.TemporaryDirectory() as out:
                for name, command in commands(path, centers, size, out).items():
                    costs.setdefault(name, [[] for _ in paths])[k].append(timed(command))
    return {name: [Cost(*map(median, zip(*e, strict=True))) for e in each] for name, each in costs.items()}


def figures(case: str, costs: dict[str, list[Cost]]) -> Iterator[Number]:
    """What a race over a short and a long sequence has shown, printed too."""
    script = costs["script"]
    for name in [name for name in costs if name != "script"]:
        for kind in Cost._fields:
            (a, b), (p, q) = ([getattr(cost, kind) for cost in each] for each in (costs[name], script))
            whole, frame = b / q, (b - a) / (q - p)
            print(
                f"{case:29} {name:20} {kind:10} {b:6.2f} s of {q:6.2f}: {whole:5.2f}   per frame {frame:5.2f}",
                flush=True,
            )
            yield Number(f"{case}, {name}: {kind} time over the script's", whole, "", "lower", 0.2)
            yield Number(f"{case}, {name}: {kind} time per frame over the script's", frame, "", "lower", 0.2)


def main() -> None:
    """All cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=["mjpeg", "h264", "tiff16"])
    parser.add_argument("--patches", nargs="*", type=int, default=[1, 64])
    parser.add_argument("--busy", nargs="*", type=int, default=[0, 1])
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    found: list[Number] = []
    with tempfile.TemporaryDirectory() as folder:
        for kind in asked.only:
            for patches in asked.patches:
                centers, size = ([(320.0, 240.0)], SIZE) if patches == 1 else (MANY, SIDE)
                frames = asked.frames // (1 if patches == 1 else 8)
                paths = [make(Path(folder), kind, n) for n in (frames // 10, frames)]
                for busy in asked.busy:
                    with kept_busy(bool(busy)):
                        costs = race(paths, centers, size, asked.rounds)
                    words = f"{kind}, {patches} patch{'es' * (patches > 1)}, {'one core busy' if busy else 'quiet'}"
                    found.extend(figures(words, costs))
                for path in paths:
                    path.unlink()
    if asked.out:
        save(asked.out, found, frames=str(asked.frames), threads=f"default ({torch.get_num_threads()})")


if __name__ == "__main__":
    main()
