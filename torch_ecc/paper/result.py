"""What an experiment hands back: pictures, tables, numbers with their limits, and sentences that explain them."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:  # benchmarks on a bare machine draw nothing
    from matplotlib.figure import Figure

Advance = Callable[[int, int], None]  # (done, total)


class Number(NamedTuple):
    """One number. ``better``: "lower" or "higher"; ``paper``: the paper's.

    ``tolerance``: in an experiment the limit that the number has to keep; in a benchmark the share by which a later
    one may be worse, None if it is only there to be read, as a peer's.
    """

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


class Experiment(NamedTuple):
    """Everything that came out of one experiment."""

    name: str
    title: str
    pictures: Sequence[Picture]
    tables: Sequence[Table]
    records: Sequence[Number]
    remarks: Sequence[str]
    seed: int = 0


def counter(total: int, advance: Advance) -> Callable[[], None]:
    """A function that advances by one of ``total`` every time it is called, and stays there if called more often."""
    done = count(1)
    return lambda: advance(min(next(done), total), total)


def cells(values: Iterable[float] | Tensor, form: str, sigma: Tensor | None = None) -> list[str]:
    """Numbers as a table shows them, with their standard deviations ``sigma`` where these are given."""
    texts = [f"{value:{form}}" for value in (values.tolist() if isinstance(values, Tensor) else values)]
    return texts if sigma is None else [f"{a} +- {b}" for a, b in zip(texts, cells(sigma, form), strict=True)]


def environment() -> dict[str, str]:
    """Versions, threads and machine that numbers depend on."""
    versions = {name: version_of(name) for name in ("torch_ecc", "torch", "kornia", "matplotlib")}
    return versions | {
        "python": platform.python_version(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "threads": str(torch.get_num_threads()),
    }


def version_of(name: str) -> str:
    """That of a package, if it is installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    """The processor's own name where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def save_records(experiment: Experiment, path: Path, about: Mapping[str, Any]) -> None:
    """Everything of an experiment but its pixels as JSON, with what the numbers depend on (``about``).

    A number that is not finite is null; whether a number keeps its limit is said beside it.
    """
    document = {
        "experiment": experiment.name,
        "title": experiment.title,
        "seed": experiment.seed,
        **about,
        "pictures": [{"file": f"{picture.name}.png", "caption": picture.caption} for picture in experiment.pictures],
        "tables": [table._asdict() for table in experiment.tables],
        "remarks": list(experiment.remarks),
        "records": [_row(number) for number in experiment.records],
    }
    path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _row(number: Number) -> dict[str, Any]:
    value = number.value if math.isfinite(number.value) else None
    return {k: v for k, v in number._asdict().items() if v is not None} | {"value": value, "kept": number.kept}


def load_records(path: Path) -> dict[str, Any]:
    """What ``save_records`` wrote. ValueError for a picture that does not lie beside it."""
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    for picture in document["pictures"]:
        beside = path.parent / picture["file"]
        if beside.resolve().parent != path.parent.resolve():
            raise ValueError(f"{path}: expected pictures beside it, got {picture['file']!r}")
    return document
