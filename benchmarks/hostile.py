"""Is CONVERGED true where the world is hostile? python benchmarks/hostile.py [--rows WORDS]... [--scenes N] [--by NAME]...

Each row is a disturbance over four families of scenes (waves, pads, speckle, micrograph), N of each; the truth is
analytic. Wrong: CONVERGED, over 0.1 px or 0.1 deg in a component and over 5 of its sigma. Off: without the 5 sigma. Far:
over 2 px. After: wrong when nothing disturbs any more. Lost: with half of the template to be seen. Recovery: frames from
then until right again. Bound: rms error of frames that are believed and not wrong over the Cramer-Rao bound of what is
to be seen. Sigma: rms of error over sigma of all that are believed.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import click
import torch
from covers import KINDS, MOTIONS, cover
from films import SCENES, Film, Shot
from honesty import BY, Run, figures, follow, follow_peer, numbers
from results import save
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rivals import rivals

SHARES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
PEER = "OpenCV ECC, fastest fair"
console = Console(width=170)

Disturb = Callable[[Shot], Film]


def covers() -> dict[str, Disturb]:
    return {
        f"cover {100 * share:.0f} % {kind} {motion}": partial(cover, share=share, kind=kind, motion=motion)
        for share in SHARES
        for kind in KINDS
        for motion in MOTIONS
    }


def disturbances() -> dict[str, Disturb]:
    """Every row by name."""
    return {"none": lambda shot: shot.film(shot.clean), **covers()}


def shots(scenes: int) -> Iterator[tuple[str, Shot]]:
    """``scenes`` shots of every family."""
    for seed in range(scenes):
        for family, make in SCENES.items():
            yield family, Shot(make(seed), seed)


def chosen(words: tuple[str, ...]) -> dict[str, Disturb]:
    """The rows whose name holds one of ``words``; all if there are none. ValueError for words that no row has."""
    rows = disturbances()
    for word in words:
        if not any(word in name for name in rows):
            raise click.UsageError(f"no row has {word!r} in its name; known are {', '.join(rows)}")
    return {name: row for name, row in rows.items() if not words or any(word in name for word in words)}


def measured(rows: dict[str, Disturb], by: tuple[str, ...], scenes: int) -> dict[str, list[Run]]:
    """The runs of every row, a scene after the other, so that each is rendered once."""
    runs: dict[str, list[Run]] = {}
    for _, shot in track(list(shots(scenes)), "scenes", console=Console(stderr=True), transient=True):
        for name, disturb in rows.items():
            film = disturb(shot)
            for how in by:
                title = name if how == "default" else f"{name}, {how}"
                run = follow_peer(film, rivals()[PEER].start) if how == "opencv" else follow(film, **BY[how])
                runs.setdefault(title, []).append(run._replace(film=film._replace(frames=film.frames[:0])))
    return runs


COLUMNS = {
    "frames": "d",
    "converged": "d",
    "right": "d",
    "wrong": "d",
    "off": "d",
    "far": "d",
    "after": "d",
    "disbelieved": "d",
    "lost": "d",
    "recovery": ".0f",
    "bound": ".2f",
    "sigma": ".2f",
    "median": ".2f",
    "longest": ".0f",
}


def show(found: dict[str, dict[str, float]]) -> None:
    table = Table("row", box=None, pad_edge=False)
    for name in COLUMNS:
        table.add_column(name, justify="right")
    for title, row in found.items():
        table.add_row(title, *(f"{row[name]:{form}}" for name, form in COLUMNS.items()))
    console.print(table)


@click.command()
@click.option("--rows", "words", multiple=True, help="only rows with these words in their name")
@click.option("--scenes", default=1, show_default=True, help="of each family")
@click.option("--by", multiple=True, default=("default",), type=click.Choice([*BY, "opencv"]), show_default=True)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(words: tuple[str, ...], scenes: int, by: tuple[str, ...], out: Path | None) -> None:
    """Count what is believed and wrong."""
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    runs = measured(chosen(words), by, scenes)
    found = {title: figures(some) for title, some in runs.items()}
    show(found)
    if out is not None:
        save(out, [n for title, row in found.items() for n in numbers(title, row)])


if __name__ == "__main__":
    main()
