"""torch_ecc beside its peers: time and error on the same frames, one thread.

python benchmarks/peers.py [--quick] [--only NAME]... [--rounds N] [--data FOLDER] [--out FILE.json]

NAME is a work (clean, noise5, hard, ...) or a part of a tracker's name. --out writes the figures, and a picture beside
them. README.md says how it is measured.
"""

from __future__ import annotations

import os
from pathlib import Path

import click
import cv2
import torch
from adapters import Peer
from comparison import Result, measure, together
from peers_report import draw, figures, table
from results import save
from rich.console import Console
from trackers import backends, trackers
from work import RECORDED, WORKS, Work, recorded

QUICK_FRAMES = 12
console = Console(width=150)


def chosen_works(only: tuple[str, ...], data: Path | None) -> list[str]:
    """The works named, or all; recorded ones if their folder is there."""
    known = [*WORKS, *(RECORDED if data is not None and data.is_dir() else ())]
    return [name for name in known if name in only] or known


def chosen_trackers(only: tuple[str, ...]) -> dict[str, Peer]:
    """Those with one of the words in their names, or all."""
    words = [word.lower() for word in only if word not in (*WORKS, *RECORDED)]
    found = {n: p for n, p in trackers().items() if not words or any(word in n.lower() for word in words)}
    if not found:
        raise click.UsageError(f"--only: expected works ({', '.join((*WORKS, *RECORDED))}) or words of trackers' names")
    return found


def make(name: str, seed: int, data: Path | None) -> Work:
    """A work's frames."""
    return recorded(data / name) if data is not None and name in RECORDED else WORKS[name].make(name, seed)


@click.command()
@click.option("--quick", is_flag=True, help=f"{QUICK_FRAMES} frames of every sequence, one round")
@click.option("--only", multiple=True, help="a work, or part of a tracker's name; may be repeated")
@click.option("--rounds", default=3, show_default=True, help="times that all is run, with the noise drawn anew")
@click.option("--data", type=click.Path(path_type=Path), default=os.environ.get("TORCH_ECC_DATA"))
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="figures as JSON; a picture beside it")
def main(quick: bool, only: tuple[str, ...], rounds: int, data: Path | None, out: Path | None) -> None:
    """Time and error of every tracker on every work."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for name, refused in backends().items():
        if refused:
            console.print(f"left out: backend {name!r}: {refused}")
    peers, works, found = chosen_trackers(only), {}, {}
    for name in chosen_works(only, data):
        runs: list[dict[str, Result]] = []
        for seed in range(1 if quick else rounds):
            works[name] = make(name, seed, data)
            frames = QUICK_FRAMES if quick else len(works[name].truth)
            runs.append(measure(works[name], peers, frames))
        found[name] = together(runs)
        console.print(table(works[name], found[name]))
    if out is not None:
        save(out, [f for name, results in found.items() for f in figures(name, results, peers)], rounds=str(len(runs)))
        draw(works, found, peers).savefig(out.with_suffix(".png"), dpi=150)
        console.print(f"written: {out}, {out.with_suffix('.png')}")


if __name__ == "__main__":
    main()
