"""What an experiment hands back: pictures, tables, numbers with their limits, and sentences that explain them."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import kornia
import matplotlib
import torch
from matplotlib.figure import Figure

Advance = Callable[[int, int], None]  # (done, total)


class Record(NamedTuple):
    """One number. ``better``: "lower" or "higher"; ``tolerance``: the limit it has to keep; ``paper``: the paper's."""

    name: str
    value: float
    unit: str
    better: str = "lower"
    tolerance: float | None = None
    paper: float | None = None

    @property
    def kept(self) -> bool:
        """Is the number within its limit (or without one)?"""
        if self.tolerance is None:
            return True
        return self.value <= self.tolerance if self.better == "lower" else self.value >= self.tolerance


class Table(NamedTuple):
    """Rows of words and numbers; the first column names the row."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


class Picture(NamedTuple):
    """A figure, the name of its file and its caption."""

    name: str
    figure: Figure
    caption: str


class Outcome(NamedTuple):
    """Everything that came out of one experiment."""

    name: str
    title: str
    pictures: Sequence[Picture]
    tables: Sequence[Table]
    records: Sequence[Record]
    remarks: Sequence[str]
    seed: int = 0


def counter(total: int, advance: Advance) -> Callable[[], None]:
    """A function that advances by one of ``total`` every time it is called."""
    done = iter(range(1, total + 1))
    return lambda: advance(next(done), total)


def environment() -> dict[str, str]:
    """Versions, threads and machine that numbers depend on."""
    return {
        "torch_ecc": version("torch-ecc"),
        "torch": torch.__version__,
        "kornia": kornia.__version__,
        "matplotlib": matplotlib.__version__,
        "python": platform.python_version(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "threads": str(torch.get_num_threads()),
    }


def _processor() -> str:
    """The processor's own name where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def save_records(outcome: Outcome, path: Path, about: Mapping[str, Any]) -> None:
    """Everything of an experiment but its pixels as JSON, with what the numbers depend on (``about``).

    A number that is not finite is null; whether a number keeps its limit is said beside it.
    """
    document = {
        "experiment": outcome.name,
        "title": outcome.title,
        "seed": outcome.seed,
        **about,
        "pictures": [{"file": f"{picture.name}.png", "caption": picture.caption} for picture in outcome.pictures],
        "tables": [table._asdict() for table in outcome.tables],
        "remarks": list(outcome.remarks),
        "records": [_row(record) for record in outcome.records],
    }
    path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _row(record: Record) -> dict[str, Any]:
    value = record.value if math.isfinite(record.value) else None
    return {k: v for k, v in record._asdict().items() if v is not None} | {"value": value, "kept": record.kept}


def load_records(path: Path) -> dict[str, Any]:
    """What ``save_records`` wrote."""
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return document
