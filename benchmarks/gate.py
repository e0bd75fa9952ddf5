"""Compare two results of a benchmark: python benchmarks/gate.py OLD.json NEW.json

Every figure of OLD with a tolerance must be in NEW and no worse than OLD by more than that share (and by more than the
least difference that means anything in its unit). Times in ms are compared only within one machine and number of
threads; ratios of times and errors always. Exit status: 0 if nothing got worse, 1 if something did, 2 for a file that
is no result.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import click
from results import Result, load
from rich.console import Console
from rich.table import Table

from torch_ecc.paper.result import Number

LEAST = {"px": 1e-4, "deg": 1e-4}  # differences below are the rounding of another processor
MACHINE_BOUND = ("ms", "us", "MB")  # units that mean the same only on one machine


class Regression(NamedTuple):
    """A figure that got worse: old and new value, the limit that it broke, and why in words."""

    figure: Number
    new: float
    limit: float
    why: str


def limit(figure: Number) -> float:
    """The worst value that still passes."""
    slack = abs(figure.value) * (figure.tolerance or 0.0) + LEAST.get(figure.unit, 0.0)
    return figure.value + slack if figure.better == "lower" else figure.value - slack


def compare(old: Result, new: Result) -> tuple[list[Regression], list[str]]:
    """What got worse, and the names of what could not be compared because the machine or the threads differ."""
    same = all(old.about.get(key) == new.about.get(key) for key in ("machine", "threads"))
    worse, skipped = [], []
    for name, figure in old.figures.items():
        if figure.tolerance is None or math.isnan(figure.value):
            continue
        if figure.unit in MACHINE_BOUND and not same:
            skipped.append(name)
            continue
        bound, now = limit(figure), new.figures.get(name)
        if now is None:
            worse.append(Regression(figure, math.nan, bound, "missing"))
        elif (now.unit, now.better) != (figure.unit, figure.better):
            worse.append(Regression(figure, now.value, bound, f"was in {figure.unit}, is in {now.unit}"))
        elif not _keeps(now.value, bound, figure.better):
            worse.append(Regression(figure, now.value, bound, "worse"))
    return worse, skipped


def _keeps(value: float, bound: float, better: str) -> bool:
    return value <= bound if better == "lower" else value >= bound  # NaN keeps nothing


@click.command()
@click.argument("old", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("new", type=click.Path(exists=True, dir_okay=False, path_type=Path))
def main(old: Path, new: Path) -> None:
    """Exit with status 1 if a figure of OLD got worse in NEW."""
    try:
        before, after = load(old), load(new)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    worse, skipped = compare(before, after)
    console = Console(width=120)
    if skipped:
        machines = f"{before.about.get('machine')} and {after.about.get('machine')}"
        console.print(f"{len(skipped)} figures not compared: other machine or threads ({machines})")
    if worse:
        table = Table("figure", "old", "limit", "new", "unit", "why", title="Got worse", title_justify="left")
        for r in worse:
            values = (f"{v:.4g}" for v in (r.figure.value, r.limit, r.new))
            table.add_row(r.figure.name, *values, r.figure.unit, r.why)
        console.print(table)
    gated = sum(f.tolerance is not None for f in before.figures.values()) - len(skipped)
    console.print(f"{gated} figures compared, {len(worse)} worse")
    raise SystemExit(1 if worse else 0)


if __name__ == "__main__":
    main()
