"""One recording of many, as a worker does it: tracked in a folder of its own beside the result, renamed when whole.

It may be done twice, by two workers, or again after one was killed: the outcome is the same. What stands in
``DIR/NAME`` is always whole, and says of which input, settings and versions it is.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import torch

from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.track import Finished, Session, given_settings
from torch_ecc.io.output import claim
from torch_ecc.io.stacks import Stack
from torch_ecc.io.summary import versions, write_json

Row: TypeAlias = dict[str, Any]
"""One line of the table, by the names in ``COLUMNS``."""

NUMBERS = ("frames", "templates", "lost", "damaged")
SIGMA = ("sigma_x_px", "sigma_y_px", "sigma_theta_rad")
DRIFT = ("drift_x_px", "drift_y_px", "drift_theta_rad")
COLUMNS = ("recording", "folder", "status", *NUMBERS, *SIGMA, *DRIFT, "wall_s", "words")
TRACKED, FAILED, UNFINISHED = "tracked", "failed", "unfinished"

WORK, TICKET, NOTE = ".unfinished", "ticket", "batch.json"
DECIDING = ("torch_ecc", "torch")  # versions that a result depends on
PERIOD = 1.0  # s between two words of a worker


class Withdrawn(Exception):  # noqa: N818 - nothing went wrong
    """Nobody waits for this work any more, or not for that of this worker."""


@dataclass(frozen=True)
class Work:
    """What a worker is told: the folder ``name`` in ``out`` is to hold the result of ``job``, whose paths are absolute;
    ``frames`` is what is tracked if it is no file. ``ticket`` is that of the run that waits for it, ``versions`` are
    those that it wants."""

    name: str
    job: TrackJob
    out: Path
    ticket: str
    versions: dict[str, str]
    frames: Stack | None = None

    @property
    def folder(self) -> Path:
        """Where the result stands once it is whole."""
        return self.out / self.name

    def session(self, folder: Path, **options: Any) -> Session:
        """The tracking run, into ``folder``."""
        return Session(replace(self.job, out=str(folder), **options), self.frames)


def do(work: Work) -> Row:
    """Track a recording, unless that is done already. Errors, other than ``Withdrawn``, are the row's words."""
    return told(work, lambda: found(work) or _track(work))


def told(work: Work, make: Callable[[], Row]) -> Row:
    """What ``make`` gives, or the row of what went wrong; ``lasting`` if the same would happen again."""
    try:
        Watch(work, None).check()
        check_versions(work.versions)
        with one_thread():
            return make()
    except Withdrawn as why:
        return row_of(work, UNFINISHED, words=str(why))
    except (Exception, SystemExit) as error:  # a recording that fails is a row, whatever a library has stumbled on
        lasting = isinstance(error, ValueError | FileNotFoundError)
        words = repr(error) if isinstance(error, SystemExit) else str(error).strip() or type(error).__name__
        return row_of(work, FAILED, words=words) | {"lasting": lasting, "inputs": inputs_of(work)}


def _track(work: Work) -> Row:
    with part_folder(work.out, work.name) as folder:
        inputs, started = inputs_of(work), time.perf_counter()
        session = work.session(folder, force=True)
        finished = session.run(Watch(work, session.source.length))
        row = finished_row(work, finished, folder, remarks=session.remarks())
        publish_whole(work, folder, row | {"wall_s": time.perf_counter() - started}, {"inputs": inputs})
    return read_json(work.folder / NOTE)["row"]  # type: ignore[no-any-return]


def publish_whole(work: Work, folder: Path, row: Row, beside: dict[str, Any]) -> None:
    """Rename what is whole, in place of an older result. Withdrawn if nobody waits for it any more."""
    write_json(folder / NOTE, {"row": row} | beside)
    Watch(work, None).check()
    old = folder.with_name(f"{folder.name}-old")
    if work.folder.exists():
        refuse_foreign(work.folder)
        os.rename(work.folder, old)
    os.rename(folder, work.folder)
    shutil.rmtree(old, ignore_errors=True)


def refuse_foreign(folder: Path) -> None:
    """ValueError for a folder that is there and was not made here: it may even be a recording."""
    if folder.exists() and not (folder / NOTE).is_file():
        raise ValueError(f"out: {folder} is there already and is no result of batch: choose another folder")


# ---- what is done --------------------------------------------------------------------------------------------------


def found(work: Work) -> Row | None:
    """The row of a result that is whole and of this input, these settings and versions; None if there is none."""
    note, summary = read_json(work.folder / NOTE), read_json(work.folder / "summary.json")
    settings = {k: v for k, v in summary.get("settings", {}).items() if k != "first_frame_crc32"}
    same = (
        summary.get("complete") is True
        and settings == given_settings(work.job)
        and same_versions(summary.get("versions", {}), work.versions)
        and note.get("inputs") == inputs_of(work)
    )
    return note.get("row") if same else None


def read_json(path: Path) -> dict[str, Any]:
    """What a JSON file says, nothing if it is not there or broken."""
    with suppress(OSError, ValueError):
        told = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(told, dict):
            return told
    return {}


def same_versions(a: dict[str, str], b: dict[str, str]) -> bool:
    """Of all that a result depends on."""
    return all(a.get(name) == b.get(name) for name in DECIDING)


def check_versions(wanted: dict[str, str]) -> None:
    """Withdrawn if this worker has others."""
    here = versions()
    if not same_versions(here, wanted):
        told = ", ".join(f"{name} {here[name]} (wanted: {wanted.get(name)})" for name in DECIDING)
        raise Withdrawn(f"versions: they must be equal everywhere; a worker has {told}")


def inputs_of(work: Work) -> list[list[Any]]:
    """What tells whether any of the files that a result is made from has changed: sizes and times, or a checksum."""
    job, frames = work.job, work.frames
    files = [*([] if frames is not None else [job.input]), job.reference, job.frame_mask, *job.template]
    prints = [[path, *_stat(Path(path))] for path in files if path is not None]
    if frames is None:
        return prints
    ends = [zlib.crc32(np.ascontiguousarray(np.asarray(frames[k])).tobytes()) for k in (0, frames.shape[0] - 1)]
    return [[job.input, *(int(n) for n in frames.shape), *ends], *prints]


def _stat(path: Path) -> list[int]:
    """Number of files, bytes, and a checksum of their names and times."""
    files = [path] if not path.is_dir() else sorted(Path(top, name) for top, _, own in os.walk(path) for name in own)
    total, names = 0, 0
    for file in files:
        with suppress(OSError):  # what is not there has no size
            stat = file.stat()
            total, names = total + stat.st_size, zlib.crc32(f"{file.name} {stat.st_mtime_ns}".encode(), names)
    return [len(files), total, names]


# ---- rows ----------------------------------------------------------------------------------------------------------


def row_of(work: Work, status: str, **known: Any) -> Row:
    """A row of what is known."""
    return {"recording": work.job.input, "folder": work.name, "status": status, **known}


def finished_row(work: Work, finished: Finished, folder: Path, *, remarks: list[str]) -> Row:
    """The row of what was tracked. Sigma and drift are medians over the templates: of each one's usual sigma, and of
    where it was seen last, from where it began."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    names, each = ("median_sigma", "last_displacement"), summary["per_template"]
    sigma, drift = ([list(template[name].values()) for template in each] for name in names)
    numbers = (finished.frames, len(finished.lost), int(finished.lost.sum()), finished.damaged)
    medians = [*_medians(sigma), *_medians(drift)]
    known = dict(zip((*NUMBERS, *SIGMA, *DRIFT), (*numbers, *medians), strict=True))
    return row_of(work, TRACKED, **known, words="; ".join(remarks))


def _medians(values: Any) -> list[float | None]:
    """Of each column, without what is not known."""
    columns = np.array(values, dtype=np.float64).T
    kept = [column[np.isfinite(column)] for column in columns]
    return [float(np.median(column)) if len(column) else None for column in kept]


# ---- the folder of work in progress ----------------------------------------------------------------------------------


@contextmanager
def part_folder(out: Path, name: str) -> Iterator[Path]:
    """Where ``name`` is made: on the same file system, nobody else's, and gone afterwards if it was not renamed."""
    folder = out / WORK / f"{name}-{secrets.token_hex(4)}"
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def clean(out: Path) -> None:
    """Remove what work that was stopped or killed has left, but nothing that another process is writing."""
    for folder in (out / WORK).glob("*/"):
        with suppress(ValueError), claim(folder):
            shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        (out / WORK).rmdir()


@contextmanager
def one_thread() -> Iterator[None]:
    """Every core has a worker of its own."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


class Watch:
    """Is told of every frame of ``work``; says about once a second how far it is, of ``frames`` if that is known, and
    ends the work if nobody waits for it any more: its run was stopped, or another one began."""

    def __init__(self, work: Work, frames: int | None, key: str = "") -> None:
        self.work, self.frames, self.key, self._next = work, frames, key or work.name, 0.0

    def __call__(self, done: int) -> None:
        now = time.monotonic()
        if now >= self._next:
            self._next = now + PERIOD
            self.check()
            say(self.work.ticket, {"key": self.key, "done": done, "of": self.frames})

    def check(self) -> None:
        """Withdrawn if nobody waits."""
        with suppress(FileNotFoundError):
            if (self.work.out / WORK / TICKET).read_text() == self.work.ticket:
                return
        raise Withdrawn


def say(topic: str, message: dict[str, Any]) -> None:
    """To whoever listens to ``topic``, if this is a worker."""
    from distributed import get_worker

    with suppress(ValueError):  # it is none
        get_worker().log_event(topic, message)
