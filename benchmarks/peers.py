"""torch_ecc beside its peers: time and error on the same frames, one thread.

python benchmarks/peers.py [--quick] [--only NAME]... [--data FOLDER] [--out FILE.json] [--picture FILE.png]

NAME is a work (clean, noise5, hard, ...) or a part of a tracker's name. README.md says how it is measured.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from pathlib import Path
from typing import NamedTuple

import click
import cv2
import torch
from adapters import Peer
from rich.console import Console
from rich.table import Table
from torch import Tensor
from trackers import backends, trackers
from work import RECORDED, WORKS, Work, recorded

LOST_PX = 0.5  # a pose farther off than this, or none, is a lost frame
console = Console(width=140)


class Result(NamedTuple):
    """Of one tracker on one work: ``wall`` and ``cpu`` s per frame (the first frame left out) and ``error`` (n, 3) px,
    px, deg, NaN where it gave no pose."""

    wall: list[float]
    cpu: list[float]
    error: Tensor

    @property
    def lost(self) -> int:
        """Frames without a pose, or with a wrong one."""
        return int((~self._good).sum())

    @property
    def _good(self) -> Tensor:
        return self.error[:, :2].abs().amax(1) <= LOST_PX  # NaN is not

    def rms(self) -> tuple[float, float]:
        """Root mean square error of the worse of x and y, px, and of theta, deg, in the frames that were not lost."""
        x, y, theta = self.error[self._good].square().mean(0).sqrt().tolist()
        return max(x, y), theta

    def largest(self) -> tuple[float, float]:
        """The same of the largest error."""
        good = self.error[self._good].abs()
        x, y, theta = good.amax(0).tolist() if len(good) else [math.nan] * 3
        return max(x, y), theta


def measure(work: Work, peers: dict[str, Peer], frames: int) -> dict[str, Result]:
    """All trackers through the frames side by side: each frame goes to every one of them before the next one comes."""
    follow = {name: peer.start(work.frames[0], work.center, work.size) for name, peer in peers.items()}
    results = {name: Result([], [], torch.full((0, 3), math.nan)) for name in peers}
    for k in range(min(frames, len(work.truth))):
        names = [name for name, peer in peers.items() if k < peer.frames]
        turn = k % len(names) if names else 0
        for name in names[turn:] + names[:turn]:  # nobody always comes first
            wall, cpu = time.perf_counter(), time.thread_time()
            pose = follow[name](work.frames[k + 1])
            wall, cpu = time.perf_counter() - wall, time.thread_time() - cpu
            results[name] = _append(results[name], wall, cpu, _error(pose, work.truth[k]))
    return {name: Result(r.wall[1:], r.cpu[1:], r.error) for name, r in results.items()}


def _append(result: Result, wall: float, cpu: float, error: Tensor) -> Result:
    return Result([*result.wall, wall], [*result.cpu, cpu], torch.cat((result.error, error[None])))


def _error(pose: tuple[float, float, float] | None, truth: Tensor) -> Tensor:
    """Pose minus truth (3,) px, px, deg; whole turns do not count, since the peers do not."""
    if pose is None:
        return torch.full((3,), math.nan)
    error = torch.tensor(pose, dtype=torch.float64) - truth
    error[2] = math.degrees(math.remainder(float(error[2]), math.tau))
    return error


def show(work: Work, results: dict[str, Result]) -> None:
    """One table: time and error, tracker by tracker."""
    bound = ""
    if work.bound is not None:
        x, y, theta = work.bound.tolist()
        bound = f"; bound {max(x, y):.5f} px, {math.degrees(theta):.5f} deg"
    table = Table(title=f"{work.name}: {work.title}{bound}", title_justify="left")
    for column in ("tracker", "ms per frame (IQR)", "cpu ms", "rms px", "rms deg", "largest px", "largest deg", "lost"):
        table.add_column(column, justify="left" if column == "tracker" else "right")
    for name, result in results.items():
        table.add_row(name, *cells(result))
    console.print(table)


def cells(result: Result) -> tuple[str, ...]:
    """Time, errors and lost frames in words."""
    low, middle, high = (1e3 * v for v in statistics.quantiles(result.wall, n=4))
    time_cell = f"{middle:.2f} ({low:.2f}-{high:.2f})"
    errors = (f"{v:.5f}" for v in (*result.rms(), *result.largest()))
    cpu = f"{1e3 * statistics.median(result.cpu):.2f}"
    return (time_cell, cpu, *errors, f"{result.lost} of {len(result.error)}")


def chosen_works(only: tuple[str, ...], data: Path | None) -> list[Work]:
    """The works named, or all; the recorded ones if their folder is there."""
    makers = dict(WORKS)
    if data is not None and data.is_dir():
        makers |= {name: lambda name=name: recorded(data / name) for name in RECORDED}
    named = [name for name in makers if name in only]
    return [makers[name]() for name in named or makers]


@click.command()
@click.option("--quick", is_flag=True, help="12 frames of every sequence")
@click.option("--only", multiple=True, help="a work, or part of a tracker's name; may be repeated")
@click.option("--data", type=click.Path(path_type=Path), default=os.environ.get("TORCH_ECC_DATA"))
def main(quick: bool, only: tuple[str, ...], data: Path | None) -> None:
    """Time and error of every tracker on every work."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for name, refused in backends().items():
        if refused:
            console.print(f"left out: backend {name!r}: {refused}")
    every = trackers()
    wanted = [word for word in only if word not in WORKS and word not in RECORDED]
    peers = {n: p for n, p in every.items() if not wanted or any(word.lower() in n.lower() for word in wanted)}
    for work in chosen_works(only, data):
        show(work, measure(work, peers, 12 if quick else len(work.truth)))


if __name__ == "__main__":
    main()
