"""A benchmark's figures as a table and as JSON: name, value, unit, which is better, tolerance; versions, machine."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from torch_ecc.paper.result import Number, environment, version_of

PEERS = ("opencv-python-headless", "pystackreg", "SimpleITK")


class Result(NamedTuple):
    """Figures by name, and what they depend on."""

    about: dict[str, str]
    figures: dict[str, Number]


def show(title: str, header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """A table for people, under its title."""
    table = Table(*header, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    Console(width=150).print(table)


def save(path: Path, figures: Iterable[Number], **about: str) -> None:
    """Write a result: four digits, null for a number that is not finite, and nothing that is the default."""
    load = f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown"
    facts = environment() | {name: version_of(name) for name in PEERS} | {"load": load} | about
    rows = [_row(figure) for figure in figures]
    lines = ",\n".join(f"    {json.dumps(row, allow_nan=False)}" for row in rows)
    path.write_text(f'{{\n  "about": {json.dumps(facts)},\n  "figures": [\n{lines}\n  ]\n}}\n', encoding="utf-8")


def load(path: Path) -> Result:
    """Read what ``save`` wrote. ValueError for a file that is no result."""
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        figures = [Number(**row) for row in document["figures"]]
        about = dict(document["about"])
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: expected a benchmark's result (about, figures), got {error!r}") from error
    nan = math.nan
    return Result(about, {f.name: f if f.value is not None else f._replace(value=nan) for f in figures})


def _row(figure: Number) -> dict[str, Any]:
    value = float(f"{figure.value:.4g}") if math.isfinite(figure.value) else None
    default = Number._field_defaults
    return {k: v for k, v in figure._replace(value=value)._asdict().items() if k not in default or v != default[k]}
