"""Time over the number of templates, and memory over a long stream: python benchmarks/scaling.py [threads].

Times are the median of alternating runs in one process, so that a busy machine bears on all alike.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time

import torch
from rich.console import Console
from rich.table import Table

from torch_ecc import Tracker
from torch_ecc.experiments.accuracy import Harmonic
from torch_ecc.sim.camera import Camera
from torch_ecc.sim.waves import PlaneWaves

console = Console(width=100)
SCENE = PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0)


def sequence(frames: int) -> torch.Tensor:
    camera = Camera(noise_sigma=2.0)
    path = Harmonic(10.0, 2.0, 40).path(camera)[:frames]
    return camera.capture(SCENE, path)[:, 0]


def times(counts: tuple[int, ...], rounds: int) -> dict[int, float]:
    """Median seconds per frame for each number of 121 x 121 templates, spread over the frame."""
    stack = sequence(rounds + 1)
    generator = torch.Generator().manual_seed(0)
    spread = torch.rand(max(counts), 2, generator=generator) * torch.tensor([440.0, 280.0]) + 100
    trackers = {n: Tracker(stack[0], spread[:n], 121) for n in counts}
    taken: dict[int, list[float]] = {n: [] for n in counts}
    for frame in stack[1:]:
        for n, tracker in trackers.items():
            begun = time.perf_counter()
            tracker(frame)
            taken[n].append(time.perf_counter() - begun)
    return {n: statistics.median(values[2:]) for n, values in taken.items()}


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    torch.set_num_threads(int(sys.argv[1]) if len(sys.argv) > 1 else torch.get_num_threads())
    table = Table(
        "templates", "ms per frame", "ms per template", title=f"121x121 px, {torch.get_num_threads()} threads"
    )
    for n, seconds in times((1, 2, 4, 8, 16, 32, 64), 16).items():
        table.add_row(str(n), f"{1e3 * seconds:.2f}", f"{1e3 * seconds / n:.3f}")
    console.print(table)
    stack = sequence(41)
    tracker = Tracker(stack[0], [(320.0, 240.0)], 121)
    for k in range(200):
        tracker(stack[k % 41])
    before, begun = peak_mb(), time.perf_counter()
    for k in range(5000):
        tracker(stack[k % 41])
    rate = 5000 / (time.perf_counter() - begun)
    console.print(f"5,000 frames: peak memory {before:.1f} -> {peak_mb():.1f} MB, {rate:.0f} frames/s")


if __name__ == "__main__":
    main()
