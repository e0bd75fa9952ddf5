"""Templates that learn, and rolling shutters: python benchmarks/lasting.py [--quick] [--out FILE.json].

A surface that loses 1/400 of its texture in each of 400 frames, with and without ``renew``: the largest and the rms
error in x and y, over sigma, and frames lost; and what nobody can know better from the images, after some frames, of a
texture that dissolves. A still scene over 10,000 frames with ``renew``: how far the mean of a thousand frames goes from
that of the first thousand. Dim pictures with ``average``: errors over the Cramer-Rao bound with a template free of
noise. A sway by 5 px at 0.7 rad per frame, read out over 0.9 of it, with and without ``line_time``. Times are medians
per frame of one thread.
"""

from __future__ import annotations

import math
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import click
import torch
from films import ageing
from films.ageing import CENTER, FRAME, READ, SIZE
from films.shot import NOISE
from results import save
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torch_ecc import Status, Tracker
from torch_ecc.paper.bound import cramer_rao, rounding
from torch_ecc.paper.result import Number
from torch_ecc.sim import PlaneWaves
from torch_ecc.sim.camera import sensor

DIM = 10.0  # grey levels of noise
FPS = 100.0
RENEW, AVERAGE = 10, 20
AFTER = (40, 80, 160)  # frames
console = Console(width=150)


class Run(NamedTuple):
    """``error`` and ``sigma`` (F, 3) px, px, rad, what was ``found`` (F,) and ``ms`` (F,) of a tracker's frames."""

    error: Tensor
    sigma: Tensor
    found: Tensor
    ms: Tensor

    def figures(self, name: str) -> Iterator[Number]:
        """Of x and y, but for theta in degrees."""
        good, ratio = self.error[self.found], self.error[self.found] / self.sigma[self.found]
        yield Number(f"{name} / largest", float(good[:, :2].abs().max()), "px", tolerance=0.2)
        yield Number(f"{name} / rms", float(good[:, :2].square().mean().sqrt()), "px", tolerance=0.2)
        yield Number(f"{name} / theta", float(good[:, 2].rad2deg().square().mean().sqrt()), "deg", tolerance=0.2)
        yield Number(f"{name} / over sigma", float(ratio.square().mean().sqrt()), "", tolerance=0.2)
        yield Number(f"{name} / lost", float((~self.found).sum()), "frames", tolerance=0.0)
        yield Number(f"{name} / time", float(self.ms.median()), "ms")


def joined(runs: Iterable[Run]) -> Run:
    return Run(*map(torch.cat, zip(*runs, strict=True)))


def follow(film: Iterator[tuple[Tensor, Tensor]], size: int = SIZE, **options) -> Run:
    """A tracker over a film, whose first frame is the template's."""
    first, _ = next(film)
    tracker, rows = Tracker(first, [CENTER], size, search=False, **options), []
    for frame, truth in film:
        begun = time.perf_counter()
        estimate = tracker(frame)
        ms = 1e3 * (time.perf_counter() - begun)
        good = Status.good(estimate.status[0])
        rows.append((estimate.pose[0] - truth, estimate.sigma[0], good, torch.tensor(ms)))
    return Run(*(torch.stack(values) for values in zip(*rows, strict=True)))


def surfaces(frames: int, seeds: int, families: Iterable[str], size: int) -> Iterator[Number]:
    for family in families:
        for change in ageing.CHANGES:
            if change == "wave by wave" and family != "waves":
                continue
            if change == "dissolves":
                for after in AFTER:
                    bound = ageing.least(family, 0, after, RENEW, size)
                    yield Number(f"{family} {change}, least known to anyone / after {after}", bound, "px")
            films = [list(ageing.changing(family, change, seed, frames)) for seed in range(seeds)]
            for title, options in (("as it was", {}), (f"renew {RENEW}", {"renew": RENEW})):
                runs = [follow(iter(film), size, **options) for film in films]
                yield from joined(runs).figures(f"{family} {change}, {title}")


def drifts(frames: int) -> Iterator[Number]:
    """Of the mean of a tenth of the frames from that of the first one, in a still scene."""
    film = ageing.still(5, frames)
    tracker = Tracker(next(film), [CENTER], SIZE, search=False, renew=20)
    poses = torch.stack([tracker(frame).pose[0, :2] for frame in film])[20:]
    means = torch.stack([part.mean(0) for part in poses.split(len(poses) // 10)[:10]])
    name = f"still for {frames} frames, renew 20"
    yield Number(f"{name} / drift", float((means - means[0]).norm(dim=1).max()), "px", tolerance=0.5)


def dim(draws: int) -> Iterator[Number]:
    """Errors in the frames after the mean is made, over draws of all noise, of a target that was still, went evenly or
    swayed before; and their scatter within a track, in which what is constant does not count. Poses count from the
    first frame: where the template lies is known as well as the frames of the mean tell where that one was, one frame's
    scatter times 1/n if it stood still, (4 n - 2) / (n^2 + n), the intercept of a line, or 1; with the new frame's own,
    ``least`` is what nobody can fall below."""
    scene = PlaneWaves.random(seed=5)
    bound = cramer_rao(scene, (SIZE, SIZE), DIM**2 + rounding(8))
    wander, number = ageing.wander(40), torch.arange(20.0)[:, None].double()
    ways = {
        "still": wander[:1].expand(20, 3),
        "evenly": wander[:1] + number * torch.tensor((0.7, 0.3, 0.001)).double(),
        "to and fro": wander[:20],
    }
    place = {"still": 1 / AVERAGE, "evenly": (4 * AVERAGE - 2) / (AVERAGE * (AVERAGE + 1)), "to and fro": 1.0}
    for name, way in ways.items():
        path = torch.cat((way, way[-1] + wander[20:28] - wander[19]))
        clean = [scene.render(pose[None], FRAME) for pose in path]
        for average in (1, AVERAGE):
            runs = []
            for draw in range(draws):
                noise = (sensor.read(image, DIM, sensor.generator(draw, k)) for k, image in enumerate(clean))
                film = zip((sensor.quantise(image, 8)[0, 0] for image in noise), path, strict=True)
                runs.append(Run(*(value[19:] for value in follow(iter(film), average=average))))
            error = torch.stack([run.error for run in runs])
            title, both = f"noise {DIM:g}, {name} at first, average {average}", joined(runs)
            over = error.square().mean((0, 1)).sqrt() / bound
            within = error.std(1).square().mean(0).sqrt() / bound
            least = math.sqrt(1 + (place[name] if average > 1 else 1.0))
            yield Number(f"{title} / least", least, "")
            yield Number(f"{title} / over bound", float(over.square().mean().sqrt()), "", tolerance=0.15)
            yield Number(f"{title} / within a track", float(within.square().mean().sqrt()), "", tolerance=0.15)
            ratio = (both.error / both.sigma).square().mean().sqrt()
            yield Number(f"{title} / over sigma", float(ratio), "", tolerance=0.15)


def shutters(frames: int) -> Iterator[Number]:
    film, line = list(ageing.swaying(3, frames)), READ / FRAME[0] / FPS
    for title, options in (("without", {}), ("line_time", {"line_time": line, "fps": FPS})):
        run = follow(iter(film), **options)
        yield from Run(*(value[5:] for value in run)).figures(f"rolling shutter, {title}")


def show(numbers: list[Number]) -> None:
    rows: dict[str, dict[str, str]] = {}
    for number in numbers:
        title, _, name = number.name.partition(" / ")
        rows.setdefault(title, {})[name] = f"{number.value:.4g} {number.unit}".strip()
    columns = list(dict.fromkeys(name for row in rows.values() for name in row))
    table = Table("", *columns, box=None, pad_edge=False)
    for title, row in rows.items():
        table.add_row(title, *(row.get(name, "") for name in columns))
    console.print(table)


@click.command()
@click.option("--scenes", default=2, show_default=True, help="of each family")
@click.option("--only", multiple=True, type=click.Choice(["shutter", "dim", "surface", "still"]), help="one part")
@click.option("--size", default=SIZE, show_default=True, help="px of the patches of surfaces")
@click.option("--quick", is_flag=True, help="waves only, and some frames")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(scenes: int, only: tuple[str, ...], size: int, quick: bool, out: Path | None) -> None:
    """Measure all of it."""
    torch.set_num_threads(1)
    families = ("waves",) if quick else ("waves", "pads", "speckle")
    parts = {
        "shutter": partial(shutters, 10 if quick else 60),
        "dim": partial(dim, 2 if quick else 40),
        "surface": partial(surfaces, 12 if quick else ageing.LIFE, 1 if quick else scenes, families, size),
        "still": partial(drifts, 60 if quick else 10_000),
    }
    numbers = [number for name in only or parts for number in parts[name]()]
    show(numbers)
    if out is not None:
        save(out, numbers, noise=f"{NOISE:g}")


if __name__ == "__main__":
    main()
