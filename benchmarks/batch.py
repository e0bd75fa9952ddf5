"""Many templates in one frame, beside a loop over OpenCV's ECC: python benchmarks/batch.py [--count N] [--threads N]

Templates of 121 px spread over 640 x 480, inside the frame, under eq. (11) with 10 px and 2 deg, everyone starting from
the previous pose.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import click
import cv2
import torch
from comparison import BLOCK
from results import save
from rich.console import Console
from rich.table import Table
from rivals import rivals
from scaling import SCENE, spread
from torch import Tensor
from trackers import options

from torch_ecc import Tracker
from torch_ecc.paper.result import Number
from torch_ecc.paper.scheme import SIZE, Harmonic
from torch_ecc.sim import Camera, Sequence

YARDSTICK = "OpenCV ECC, fastest fair"
MOTION = Harmonic(10.0, 2.0, 20)
ROUNDS = 2  # through the motion
ROOM = 64  # px, so that no template comes to the border: what that costs is another question
console = Console(width=120)
Follow = Callable[[Tensor], Tensor]


def loop(first: Tensor, centers: Tensor) -> Follow:
    """OpenCV's ECC, one template after the other; NaN where it gave up."""
    follow = [rivals()[YARDSTICK].start(first, (x, y), SIZE) for x, y in centers.tolist()]
    nothing = (math.nan,) * 3
    return lambda frame: torch.tensor([one(frame) or nothing for one in follow], dtype=torch.float64)


def batch(first: Tensor, centers: Tensor, **chosen: str) -> Follow:
    """One Tracker of all templates."""
    tracker = Tracker(first, centers, SIZE, prediction="hold", **chosen)
    return lambda frame: tracker(frame).pose


def iteration(frames: list[Tensor], sampler: str, chosen: dict[str, str]) -> float:
    """Time in us of one more iteration of one template on all its pixels: from what many take longer than few."""
    centers, least = [(320.0, 240.0)], {"tolerance": 1e-12, "prediction": "hold", "search": False}
    short, long = (
        Tracker(frames[0], centers, SIZE, interpolation=sampler, max_iterations=n, **least, **chosen) for n in (12, 144)
    )
    found = []
    for frame in frames[1:]:
        times, spent = [], []
        for tracker in (short, long):
            begun = time.perf_counter()
            estimate = tracker(frame)
            times.append(time.perf_counter() - begun)
            spent.append(int(estimate.iterations[0]))
        found.append(1e6 * (times[1] - times[0]) / (spent[1] - spent[0]))
    return statistics.median(found)


@click.command()
@click.option("--count", default=64, show_default=True)
@click.option("--threads", default=2, show_default=True)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(count: int, threads: int, out: Path | None) -> None:
    """Templates per second, time of one iteration of a template, and errors, side by side."""
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    sequence = Sequence(SCENE, MOTION.closed(), Camera())
    frames, centers = list(sequence), spread(count, SIZE + ROOM, (480, 640)).round()
    each: dict[str, float] = {}
    follow = {YARDSTICK: loop(frames[0], centers)}
    for backend, chosen in options().items():
        for sampler in ("bilinear", "bspline3"):
            title = ", ".join(filter(None, (f"torch_ecc {sampler}", backend)))
            follow[title] = batch(frames[0], centers, interpolation=sampler, **chosen)
            each[title] = iteration(frames, sampler, chosen)
    taken: dict[str, list[float]] = {name: [] for name in follow}
    errors: dict[str, list[Tensor]] = {name: [] for name in follow}
    truth = sequence.truth(centers)
    order = [k for _ in range(ROUNDS) for k in range(1, len(frames))]  # a whole cycle: the first follows the last
    for first in range(0, len(order), BLOCK):  # in turns, of which the first frame is not timed: comparison.measure
        for name, one in follow.items():
            for i, k in enumerate(order[first : first + BLOCK]):
                begun = time.perf_counter()
                pose = one(frames[k])
                if i > 0:
                    taken[name].append(time.perf_counter() - begun)
                errors[name].append(pose - truth[k])
    _show(f"{count} templates, {threads} threads", taken, errors, each, out)


Times = dict[str, list[float]]


def _show(title: str, taken: Times, errors: dict[str, list[Tensor]], each: dict[str, float], out: Path | None) -> None:
    table = Table(title=title, title_justify="left")
    for column in ("tracker", "templates per s", "over OpenCV's", "us/iteration", "rms px", "rms deg", "lost"):
        table.add_column(column, justify="left" if column == "tracker" else "right")
    count = len(next(iter(errors.values()))[0])
    rate = {name: count / statistics.median(values) for name, values in taken.items()}
    figures = []
    for name, parts in errors.items():
        error = torch.cat(parts)
        good = error[:, :2].abs().amax(1) < 0.5
        x, y, theta = error[good].square().mean(0).sqrt().tolist()
        ratio, lost = rate[name] / rate[YARDSTICK], f"{int((~good).sum())} of {len(good)}"
        cells = (
            f"{rate[name]:,.0f}",
            f"{ratio:.1f}",
            f"{each[name]:.1f}" if name in each else "",
            f"{max(x, y):.5f}",
            f"{math.degrees(theta):.5f}",
            lost,
        )
        table.add_row(name, *cells)
        mine = None if name == YARDSTICK else 0.5
        figures.append(Number(f"{title} / {name} / over OpenCV's", ratio, "x", "higher", mine))
        figures.append(Number(f"{title} / {name} / rms", max(x, y), "px", "lower", mine and 0.15))
    console.print(table)
    if out is not None:
        save(out, figures)


if __name__ == "__main__":
    main()
