"""Does it last? Frames without end, in which covers, darkness and jumps come and go.

python benchmarks/soak.py [--family NAME]... [--seed N]... [--frames N] [--size N] [--by NAME]
                          [--states FOLDER] [--first N] [--out FILE.json]

Columns as those of hostile.py, and ``longest``: the longest frame's processor time; ``memory``: by how much the
largest resident memory has grown after the first tenth. Many short soaks of different seeds, in processes of their own,
are as good as a long one. ``--states`` keeps the tracker's state now and then; ``--first`` goes on from one of them.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import click
import torch
from films.shot import SCENES, Shot, eq11, frames, sense
from films.soak import Moment, moments, shown, soak_film
from honesty import BY, Run, figures, numbers
from results import save
from rich.console import Console
from rich.table import Table
from scaling import peak_mb

from torch_ecc import Origin, Track, Tracker
from torch_ecc.paper.result import Number

FRAME, CENTER = (240, 320), (160.0, 120.0)
EVERY = 2000  # frames between two states, and two lines
COUNTS = ("frames", "converged", "right", "off", "wrong", "far", "disbelieved", "lost")
console = Console(width=160)


class Soak(NamedTuple):
    """A ``tracker`` of a ``shot``, and what it told of the frames from ``first`` to ``last``, excluded."""

    name: str
    shot: Shot
    tracker: Tracker
    first: int
    last: int

    @staticmethod
    def of(family: str, seed: int, span: tuple[int, int], size: int, **options: Any) -> Soak:
        """A template of ``size`` px of a scene, and the frames of a ``span``."""
        shot = Shot(SCENES[family](seed), seed, eq11(frames(), CENTER), size, FRAME)
        tracker = Tracker(sense(shot.clean[:1], shot.seed)[0], shot.path[:1, :2], size, **options)
        return Soak(f"{family} {seed}", shot, tracker, *span)

    def state(self, states: Path, n: int) -> Path:
        """Where its state before frame ``n`` is kept."""
        return states / f"{self.name.replace(' ', '-')}-{n:06d}.pt"

    def run(self, states: Path | None = None) -> tuple[list[Run], float]:
        """What the tracker told, part by part, and by how many MB its peak memory grew after the first tenth."""
        if states is not None and self.first:
            self.tracker.load_state_dict(torch.load(self.state(states, self.first)))
        runs: list[Run] = []
        settled, coming = 0.0, moments(self.shot.seed)
        for _ in islice(coming, self.first):  # have been
            pass
        for n in range(self.first, self.last, EVERY):
            if states is not None:
                torch.save(self.tracker.state_dict(), self.state(states, n))
            runs.append(self.part(n, list(islice(coming, min(EVERY, self.last - n)))))
            if settled == 0 and n + EVERY >= self.first + (self.last - self.first) / 10:
                settled = peak_mb()
            tell(self.name, runs, n)
        return runs, peak_mb() - settled

    def part(self, first: int, coming: list[Moment]) -> Run:
        """The frames of the moments ``coming``, the number ``first`` and on."""
        estimates, seconds = [], []
        for n, moment in enumerate(coming, first):
            frame = shown(self.shot, moment, n)
            begun = time.process_time()
            estimates.append(self.tracker(frame))
            seconds.append(time.process_time() - begun)
        truth = torch.stack([self.shot.path[moment.place] for moment in coming])
        film = soak_film(self.shot, truth, torch.tensor([moment.seen for moment in coming]))
        return Run.of(film, Track.stack(estimates), torch.tensor(seconds))


def tell(name: str, runs: list[Run], first: int) -> None:
    """What is wrong in the last of the ``runs``, which begins with frame ``first``, and a line of all so far."""
    run, found = runs[-1], figures(runs)
    for k in (run.wrong & run.believed)[:, 0].nonzero()[:, 0].tolist():
        error, sigma = (" ".join(f"{v:.3f}" for v in values[k, 0].tolist()) for values in (run.error, run.sigma))
        how = f"score {float(run.score[k]):.3f}, {Origin(int(run.origin[k])).name}"
        console.print(f"{name} frame {first + k}: WRONG by {error}, sigma {sigma}, {how}")
    counts = ", ".join(f"{column} {found[column]}" for column in COUNTS)
    console.print(f"{name}: {counts}, sigma {found['sigma']:.2f}, {peak_mb():.0f} MB, {found['longest']:.0f} ms")


@click.command()
@click.option("--family", "families", multiple=True, default=("waves", "pads"), type=click.Choice(list(SCENES)))
@click.option("--seed", "seeds", multiple=True, default=(0,), help="of the scene, its noise and what happens")
@click.option("--frames", "count", default=2000, show_default=True)
@click.option("--size", default=61, show_default=True, help="of the template, px")
@click.option("--by", default="default", type=click.Choice(list(BY)), show_default=True)
@click.option("--states", type=click.Path(file_okay=False, path_type=Path), help="folder of the trackers' states")
@click.option("--first", default=0, help="frame that there is a state of")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(
    families: tuple[str, ...],
    seeds: tuple[int, ...],
    count: int,
    size: int,
    by: str,
    states: Path | None,
    first: int,
    out: Path | None,
) -> None:
    """Count what is believed and wrong in frames without end."""
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    if states is not None:
        states.mkdir(parents=True, exist_ok=True)
    results: list[Number] = []
    table = Table("soak", *COUNTS, "sigma", "memory, MB", "median, ms", "longest, ms", box=None, pad_edge=False)
    for family in families:
        for seed in seeds:
            soak = Soak.of(family, seed, (first, count), size, **BY[by])
            runs, grown = soak.run(states)
            found = figures(runs)
            figured = (f"{found['sigma']:.2f}", f"{grown:.1f}", f"{found['median']:.2f}", f"{found['longest']:.0f}")
            table.add_row(soak.name, *(str(found[name]) for name in COUNTS), *figured)
            results += [*numbers(soak.name, found), Number(f"{soak.name} / memory growth", grown, "MB", "lower")]
    console.print(table)
    if out is not None:
        save(out, results)


if __name__ == "__main__":
    main()
