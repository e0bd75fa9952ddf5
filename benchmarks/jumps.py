"""Jumps from one frame to the next, found near or in the whole frame: python benchmarks/jumps.py [DATA] [trials].

Random patches of four scenes and of the photographs in DATA/stills jump in a random direction and turn, before three
trackers in turn: without any search, with the search of the whole frame alone, and as shipped, where a small search
around the expected place comes first. "found": within 0.5 px in the very next frame; "wrong": believed, and farther
off. Mean time of that frame, on one thread, with what has to be prepared for a search in it. Then whole sequences: time
per frame with the search of the whole frame alone and as shipped, alternately.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from work import WORKS, data_folder, fine, waves

from torch_ecc import Status, Tracker, texture
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.pose import compose
from torch_ecc.core.reference import Reference
from torch_ecc.io import open_frames
from torch_ecc.sim import Camera, Pads, Scene, Speckle
from torch_ecc.sim.camera.still import image_scene
from torch_ecc.track.advance import PREDICTIONS
from torch_ecc.track.doubt import Past
from torch_ecc.track.recover import Recovery

MIDDLE = torch.tensor([320.0, 240.0, 0.0], dtype=torch.float64)
LENGTHS, TURNS = (4.0, 8.0, 12.0, 16.0, 24.0, 40.0), (0.0, 2.0, 5.0, 10.0)  # px, deg
SIDES = (121, 61)
console = Console(width=170)


class Nowhere(Recovery):
    """Looks at nothing near."""

    def search_near(self, image: Tensor, estimate: Estimate, start: Tensor, past: Past, due: list[int]) -> Estimate:
        return estimate


class WholeFrame(Tracker):
    """Searches only in the whole frame."""

    def _use(self, references: list[Reference]) -> None:
        super()._use(references)
        self._recovery = Nowhere(self.references[0], self.settings, self._recovery.budget, self.max_step)


def jump(scene: Scene, spread: tuple[float, float], seed: int, length: float, turn: float) -> Tensor:
    """Two frames (2, H, W) with the patch that is at MIDDLE in the first one, and where it is in the second, (3,)."""
    u = torch.rand(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    place = torch.cat(((u[:2] - 0.5) * torch.tensor(spread), torch.zeros(1)))
    angle, sign = math.tau * float(u[2]), 1 if u[3] > 0.5 else -1
    step = MIDDLE.new_tensor((length * math.cos(angle), length * math.sin(angle), sign * math.radians(turn)))
    poses = torch.stack((MIDDLE, MIDDLE + step))
    back = torch.cat((-place[:2], place[2:]))
    frames = Camera(noise_sigma=2.0).capture(scene, compose(poses, back.expand_as(poses)), seed=seed)
    return frames[:, 0], poses[1]


def textured(frame: Tensor, side: int) -> bool:
    return bool(texture(frame, MIDDLE[None, :2], side, noise=2.0).isfinite().all())


def outcomes(
    scene: Scene, spread: tuple[float, float], side: int, count: int, length: float, turn: float
) -> Iterator[tuple[int, bool, bool, float]]:
    """Of each tracker (0, 1, 2) in each trial: found, wrong and believed, and the seconds that it took."""
    seeds = iter(range(1000))
    for _ in range(count):
        frames, truth = jump(scene, spread, next(seeds), length, turn)
        while not textured(frames[0], side):
            frames, truth = jump(scene, spread, next(seeds), length, turn)
        for which, make in enumerate((lambda *a: Tracker(*a, search=False), WholeFrame, Tracker)):
            tracker = make(frames[0], MIDDLE[None, :2], side)
            begun = time.process_time()
            estimate = tracker(frames[1])
            taken = time.process_time() - begun
            step = estimate.pose[0] - truth
            near = float(step[:2].norm()) + float(step[2].abs()) * side / 2 < 0.5
            good = bool(Status.good(estimate.status[0]))
            yield which, good and near, good and not near, taken


def row(scene: Scene, spread: tuple[float, float], side: int, count: int) -> list[str]:
    cells, wrong, slow = [], [0, 0, 0], [[], [], []]
    for length in LENGTHS:
        found = [0, 0, 0]
        for turn in TURNS:
            for which, hit, bad, taken in outcomes(scene, spread, side, count, length, turn):
                found[which] += hit
                wrong[which] += bad
                slow[which].append(1e3 * taken)
        cells.append(" / ".join(f"{100 * n / (count * len(TURNS)):.0f}" for n in found))
    times = " / ".join(f"{sum(t) / len(t):.1f}" for t in slow)
    return [*cells, " / ".join(map(str, wrong)), times]


def sequence(name: str, prediction: str) -> list[str]:
    """A work of ``work.WORKS``: mean and worst time per frame, frames lost and rms error of both trackers."""
    work = WORKS[name].make(name, 0)
    trackers = [make(work.frames[0], [work.center], work.size, prediction=prediction) for make in (WholeFrame, Tracker)]
    times, poses, lost = [[], []], [[], []], [0, 0]
    for frame in work.frames[1:]:
        for k, tracker in enumerate(trackers):
            begun = time.process_time()
            estimate = tracker(frame)
            times[k].append(1e3 * (time.process_time() - begun))
            poses[k].append(estimate.pose[0])
            lost[k] += not bool(Status.good(estimate.status[0]))
    error = [(torch.stack(p) - work.truth)[:, :2].square().mean().sqrt() for p in poses]
    cells = ([f"{sum(t) / len(t):.2f}" for t in times], [f"{max(t):.1f}" for t in times], map(str, lost))
    return [name, prediction, *(" / ".join(cell) for cell in cells), " / ".join(f"{float(e):.4f}" for e in error)]


def main() -> None:
    data = data_folder(sys.argv[1] if len(sys.argv) > 1 else None)
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 10
    scenes: dict[str, tuple[Scene, tuple[float, float]]] = {
        "waves": (waves(), (0.0, 0.0)),
        "fine": (fine(), (0.0, 0.0)),
        "pads": (Pads.wafer(), (0.0, 0.0)),
        "speckle": (Speckle.random(), (0.0, 0.0)),
    }
    for path in sorted((data / "stills").glob("*.png")):
        h, w = open_frames(path).shape
        scenes[path.stem] = image_scene(path, reflected=False), (w - 500.0, h - 500.0)
    title = f"Found (%) without search / whole frame / as shipped, {count} patches x turns of {TURNS} deg"
    table = Table("scene", "px", *(f"{n:.0f} px" for n in LENGTHS), "wrong", "ms", title=title)
    for name, (scene, spread) in scenes.items():
        for side in SIDES:
            table.add_row(name, str(side), *row(scene, spread, side, count))
    console.print(table)
    columns = ("ms, mean", "ms, worst", "lost", "rms px")
    table = Table("work", "prediction", *columns, title="Sequences: whole frame / as shipped")
    for name in ("clean", "hard", "jumps"):
        for prediction in PREDICTIONS:
            table.add_row(*sequence(name, prediction))
    console.print(table)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
