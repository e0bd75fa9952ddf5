"""Time and memory over templates, their size, the frame and threads.

python benchmarks/scaling.py [--threads N] [--limit S] [--out FILE.json]

One frame after the other of eq. (11), default settings. The slope is that of a straight line through the logarithms:
1 is linear. Times are medians of alternating runs in one process, so that a busy machine bears on all alike.
"""

from __future__ import annotations

import math
import os
import resource
import statistics
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import click
import numpy as np
import torch
from results import save
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torch_ecc import Tracker
from torch_ecc.paper.result import Number
from torch_ecc.paper.scheme import Harmonic
from torch_ecc.sim import Camera, PlaneWaves

console = Console(width=110)
SCENE = PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0)
FRAMES = 8
MEMORY_MB = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20
LARGEST_SHARE = 0.25  # of it: the next point may need twice as much
COUNTS = tuple(2**k for k in range(13))
SIZES = (31, 61, 91, 121, 181, 251, 351, 501)
FRAME_SIZES = ((240, 320), (480, 640), (960, 1280), (1920, 2560))


def stack(size: tuple[int, int] = (480, 640), frames: int = FRAMES) -> Tensor:
    """Frames (F, H, W) of small motion with noise of 2 grey levels."""
    camera = Camera(size=size, noise_sigma=2.0)
    return camera.capture(SCENE, Harmonic(10.0, 2.0, 40).closed(size)[:frames])[:, 0]


def spread(count: int, size: int, frame: tuple[int, int]) -> Tensor:
    """Random places (count, 2) of templates that stay inside the frame."""
    room = torch.tensor([frame[1], frame[0]]) - size - 12.0
    return size / 2 + 6 + room.clamp(min=0) * torch.rand(count, 2, generator=torch.Generator().manual_seed(0))


Runs = dict[int, tuple[Tracker, Tensor]]


def times(runs: Runs) -> dict[int, float]:
    """Median seconds per frame of each tracker on its frames from the third on, taking turns."""
    taken: dict[int, list[float]] = {n: [] for n in runs}
    for k in range(3, FRAMES):
        for n, (tracker, frames) in runs.items():
            begun = time.perf_counter()
            tracker(frames[k])
            taken[n].append(time.perf_counter() - begun)
    return {n: statistics.median(values) for n, values in taken.items()}


def within(limit: float, values: Iterable[int], make: Callable[[int], tuple[Tracker, Tensor]]) -> Runs:
    """A warm tracker for each value, until making one takes longer than ``limit`` s or the memory might not do."""
    runs: Runs = {}
    for n in values:
        begun = time.perf_counter()
        runs[n] = make(n)
        for frame in runs[n][1][1:3]:
            runs[n][0](frame)
        if (taken := time.perf_counter() - begun) > limit or peak_mb() > LARGEST_SHARE * MEMORY_MB:
            console.print(f"stopped after {n}: {taken:.0f} s (--limit {limit:g}), peak memory {peak_mb():,.0f} MB")
            break
    return runs


def slope(x: Iterable[float], y: Iterable[float]) -> float:
    """Of the straight line through log y over log x."""
    return float(np.polyfit(np.log(list(x)), np.log(list(y)), 1)[0])


def state_mb(tracker: Tracker) -> float:
    """What a tracker keeps, MB: constant matrices of all pyramid levels and the poses."""
    tensors = [t for reference in tracker.references for t in reference[1:]] + list(tracker.buffers())
    return sum(t.numel() * t.element_size() for t in tensors) / 1e6


def peak_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def show(title: str, header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> None:
    """A table of right-aligned numbers."""
    table = Table(title=title, title_justify="left")
    for name in header:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def over_templates(limit: float) -> list[Number]:
    """1 to 4,096 templates of 121 px in one frame, so far from its border that none comes near it and takes longer."""
    frames = stack()
    runs = within(limit, COUNTS, lambda n: (Tracker(frames[0], spread(n, 121 + 40, (480, 640)), 121), frames))
    found, kept = times(runs), {n: state_mb(tracker) for n, (tracker, _) in runs.items()}
    rows = [(f"{n:,}", f"{1e3 * s:.1f}", f"{1e3 * s / n:.3f}", f"{kept[n] / n:.2f}") for n, s in found.items()]
    show("Templates of 121 x 121 px", ("templates", "ms per frame", "ms per template", "MB per template"), rows)
    most = max(found)
    large = {n: s for n, s in found.items() if n >= min(8, most)}
    linear = slope(large, large.values()) if len(large) > 1 else math.nan
    console.print(f"slope from {min(large)} templates on: {linear:.2f}; peak while preparing {peak_mb():,.0f} MB\n")
    return [
        Number("one template of 121 px", 1e3 * found[1], "ms", "lower", 0.5),
        Number("per template of many", 1e3 * found[most] / most, "ms", "lower", 0.5),
        Number("slope over templates", linear, "", "lower", 0.15),
        Number("memory per template of 121 px", kept[most] / most, "MB", "lower", 0.1),
    ]


def over_pixels(limit: float) -> list[Number]:
    """Templates of 31 to 501 px, 4 of each."""
    frame = (720, 960)
    frames = stack(frame)
    runs = within(limit, SIZES, lambda n: (Tracker(frames[0], spread(4, n, frame), n), frames))
    found = times(runs)
    rows = [(f"{n}", f"{1e3 * s / 4:.2f}", f"{1e9 * s / (4 * n * n):.1f}") for n, s in found.items()]
    show("Sizes, 4 templates in 960 x 720 px", ("side, px", "ms per template", "ns per pixel"), rows)
    large = {n * n: s for n, s in found.items() if n >= 91}
    linear = slope(large, large.values())
    console.print(f"slope over pixels from 91 x 91 on: {linear:.2f}\n")
    return [Number("slope over pixels", linear, "", "lower", 0.15)]


def over_frames(limit: float) -> list[Number]:
    """One template in frames of 320 x 240 to 2560 x 1920."""
    frames = {h * w: stack((h, w)) for h, w in FRAME_SIZES}
    runs = within(
        limit, frames, lambda n: (Tracker(frames[n][0], spread(1, 121, tuple(frames[n].shape[1:])), 121), frames[n])
    )
    found = times(runs)
    shapes = {n: "{1} x {0}".format(*frames[n].shape[1:]) for n in found}
    show("Frame sizes, one template", ("frame, px", "ms"), [(shapes[n], f"{1e3 * s:.2f}") for n, s in found.items()])
    added = 1e3 * (max(found.values()) - min(found.values())) / (max(found) - min(found)) * 1e6
    console.print(f"{added:.2f} ms more per million pixels of frame\n")
    return [Number("per million pixels of frame", added, "ms", "lower", 0.5)]


def over_threads() -> list[Number]:
    """64 templates on 1, 2, 4, ... threads."""
    before, frames, found = torch.get_num_threads(), stack(), {}
    cores = torch.multiprocessing.cpu_count()
    for n in [2**k for k in range(cores.bit_length()) if 2**k <= cores]:
        torch.set_num_threads(n)
        found[n] = times({64: (Tracker(frames[0], spread(64, 121 + 40, (480, 640)), 121), frames)})[64]
    torch.set_num_threads(before)
    rows = [(str(n), f"{1e3 * s:.1f}", f"{64 / s:,.0f}", f"{found[1] / s:.2f}") for n, s in found.items()]
    show("Threads, 64 templates", ("threads", "ms per frame", "templates per s", "faster by"), rows)
    most = max(found)
    return [Number(f"64 templates, {n} threads", 64 / found[n], "1/s", "higher", None) for n in {1, most}]


def over_time(frames: int = 5000) -> list[Number]:
    """Memory over a long stream."""
    images = stack(frames=41)
    tracker = Tracker(images[0], [(320.0, 240.0)], 121)
    for k in range(200):
        tracker(images[k % 41])  # everything is allocated that will be
    before, begun = peak_mb(), time.perf_counter()
    for k in range(frames):
        tracker(images[k % 41])
    rate, grown = frames / (time.perf_counter() - begun), peak_mb() - before
    console.print(f"{frames:,} frames: peak memory {before:.1f} MB and {grown:.1f} more, {rate:.0f} frames/s")
    console.print()
    return [Number(f"memory growth over {frames} frames", grown, "MB", "lower", None)]


@click.command()
@click.option("--threads", default=1, show_default=True)
@click.option("--limit", default=10.0, show_default=True, help="s that one point may take before the rest is left out")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(threads: int, limit: float, out: Path | None) -> None:
    """Print how time and memory grow."""
    torch.set_num_threads(threads)
    console.print(f"{threads} thread{'s' if threads > 1 else ''}")
    found = over_time() + over_templates(limit) + over_pixels(limit) + over_frames(limit) + over_threads()
    if out is not None:
        save(out, found)


if __name__ == "__main__":
    main()
