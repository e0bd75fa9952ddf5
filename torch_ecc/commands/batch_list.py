"""Which recordings a batch is of, with which settings, and what the folders of their results are called."""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from fnmatch import fnmatch
from glob import glob
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from torch_ecc.commands.jobs import BatchJob, TrackJob
from torch_ecc.config import fill, read_toml
from torch_ecc.io.stacks import Stack

Recordings: TypeAlias = str | Path | Iterable[str | Path] | Mapping[str, Stack]

NOT_HERE = ("out", "force", "resume", "input")  # of TrackJob: each recording has its own
FILES = ("reference", "frame_mask")  # settings that name one
PATCHES = {"centers", "size", "polygons", "grid", "reference", "template"}  # what says which patches to follow
WAYS = {"polygons", "grid", "template"}
LONGEST = 100  # letters of a folder's name


class Recording(NamedTuple):
    """The folder's ``name``, what is done with it, and what is tracked if it is no file."""

    name: str
    job: TrackJob
    frames: Stack | None = None


def read_list(recordings: Recordings, values: Mapping[str, Any]) -> tuple[BatchJob, list[Recording]]:
    """The batch that ``values``, settings of ``BatchJob`` and ``TrackJob`` by their names, make of ``recordings``:
    paths, globs, one list in TOML, or arrays by name. ValueError for a setting that does not fit, or for none."""
    values, where, folder = dict(values), "batch", Path()
    given = [recordings] if isinstance(recordings, str | Path) else list(recordings)
    if len(given) == 1 and str(given[0]).endswith(".toml"):
        where, folder = str(given[0]), Path(given[0]).expanduser().parent
        values = _placed(read_toml(given[0]), folder) | values
        given = values.pop("recordings", [])
    given = [str(each) for each in given] if isinstance(given, list) else given
    batch_values = {name: values.pop(name) for name in _names(BatchJob) if name in values}
    job = fill(BatchJob, batch_values | {"recordings": given}, where)
    arrays = recordings if isinstance(recordings, Mapping) else {}
    paths = list(arrays) or [path for each in job.recordings for path in _expanded(each, folder)]
    if not paths:
        raise ValueError(f"{where}: recordings: expected at least one, got none")
    paths = list(dict.fromkeys(paths))
    jobs = _jobs(paths, values, job, where)
    if job.parts > 1 and any(each.average > 1 or each.renew or each.find_marks for each in jobs.values()):
        raise ValueError("average, renew, find_marks: not with parts, each of which would have learned something else")
    found = zip(_folder_names(paths), paths, strict=True)
    return job, [Recording(name, replace(jobs[path], input=path), arrays.get(path)) for name, path in found]


def _names(kind: type[Any]) -> list[str]:
    return [each.name for each in fields(kind) if each.name != "recordings"]


def _placed(values: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The values of a list whose paths begin at ``folder``, where it lies."""
    placed = dict(values)
    for name in (*FILES, "out"):
        if isinstance(placed.get(name), str):
            placed[name] = str(folder / Path(placed[name]).expanduser())
    if isinstance(placed.get("template"), list):
        placed["template"] = [str(folder / Path(str(each)).expanduser()) for each in placed["template"]]
    if isinstance(placed.get("match"), dict):
        tables = placed["match"].items()
        placed["match"] = {key: _placed(table, folder) if isinstance(table, dict) else table for key, table in tables}
    return placed


def _expanded(given: str, folder: Path) -> list[str]:
    """Each recording that a path or a glob means; what is not there stays, to be told of."""
    path = (folder / Path(given).expanduser()).absolute()
    if given.isdecimal() and not path.exists():
        raise ValueError(f"recordings: expected files and folders, got the camera {given}")
    if path.exists() or not any(wildcard in given for wildcard in "*?["):
        return [str(path)]
    matches = sorted(glob(str(path), recursive=True))
    if not matches:
        raise FileNotFoundError(f"recordings: no file matches {given!r}")
    return matches


def _folder_names(paths: list[str]) -> list[str]:
    """A name for each: the file's own without its ending where no other has it, else with a checksum of the path, so
    that it stays when the list grows."""
    plain = [re.sub(r"[^\w.-]+", "-", Path(path).stem).strip("-.")[:LONGEST] or "recording" for path in paths]
    count = Counter(name.casefold() for name in plain)
    return [
        name if count[name.casefold()] == 1 else f"{name}-{zlib.crc32(path.encode()):08x}"
        for name, path in zip(plain, paths, strict=True)
    ]


def _jobs(paths: list[str], values: Mapping[str, Any], job: BatchJob, where: str) -> dict[str, TrackJob]:
    """The settings of each recording; checked once for all that the same patterns fit."""
    checked: dict[tuple[str, ...], TrackJob] = {}
    jobs = {}
    for path in paths:
        fitting = tuple(each for each in job.match if fnmatch(Path(path).name, each) or fnmatch(path, each))
        if fitting not in checked:
            own = dict(values)
            for pattern in fitting:
                own = _replaced(own, job.match[pattern])
            if job.parts > 1:
                own["overlay"] = False
                if own.get("stabilise") is not None:
                    raise ValueError(f"stabilise: not with parts, which write no videos; got {own['stabilise']}")
            checked[fitting] = _job(path, own, f"{where}, {Path(path).name}")
        jobs[path] = checked[fitting]
    return jobs


def _replaced(own: dict[str, Any], table: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with those of a ``table``: one that says in another way which patches to follow says it alone."""
    if WAYS & table.keys() or ("size" in table and own.get("template")):
        own = {name: value for name, value in own.items() if name not in PATCHES}
    return own | dict(table)


def _job(path: str, own: dict[str, Any], where: str) -> TrackJob:
    for name in NOT_HERE:
        if name in own:
            raise ValueError(f"{where}: unknown key {name!r} (each recording has its own)")
    own |= {name: str(Path(own[name]).expanduser().absolute()) for name in FILES if isinstance(own.get(name), str)}
    if isinstance(own.get("template"), list | tuple):
        own["template"] = [str(Path(str(each)).expanduser().absolute()) for each in own["template"]]
    return fill(TrackJob, own | {"input": path}, where)
