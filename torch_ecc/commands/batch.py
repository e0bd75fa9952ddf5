"""Many recordings, on the cores here or on a Dask cluster: what ``torch-ecc batch`` and ``torch_ecc.batch`` do."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from torch_ecc.commands.batch_cluster import (
    check_cluster,
    connected,
    cores,
    dashboard_of,
    leave_bootstrapping,
    need_dask,
)
from torch_ecc.commands.batch_list import Recording, Recordings, read_list
from torch_ecc.commands.batch_parts import cut, do_join, do_part, forget_parts
from torch_ecc.commands.batch_queue import Queue, SchedulerGoneError, Task, on_gpu
from torch_ecc.commands.batch_report import Failures, check_report, table_of, write_report
from torch_ecc.commands.batch_unit import (
    FAILED,
    TICKET,
    TRACKED,
    UNFINISHED,
    WORK,
    Row,
    Work,
    clean,
    do,
    found,
    refuse_foreign,
    row_of,
)
from torch_ecc.commands.jobs import BatchJob
from torch_ecc.io.output import check_folder, claim
from torch_ecc.io.summary import versions

if TYPE_CHECKING:
    from distributed import Client

Progress: TypeAlias = Callable[[int, "int | None"], None]
"""Is told how many frames are done, and about how many there are."""
Say: TypeAlias = Callable[[str], None]

RECONNECT = 120.0  # s to wait for a scheduler that is gone


@dataclass
class Batch:
    """What became of a batch: a row for each recording, by the names of the table's columns; in which ``folder``; how
    many were tracked now, and whether it was stopped from the keyboard or by a signal."""

    rows: list[Row]
    folder: Path
    tracked_now: int
    interrupted: bool

    def of(self, status: str) -> list[Row]:
        """The rows with this status: "tracked", "failed" or "unfinished"."""
        return [row for row in self.rows if row["status"] == status]

    def __str__(self) -> str:
        return table_of(self.rows)


def batch(
    recordings: Recordings,
    out: str | Path | None = None,
    *,
    client: Client | None = None,
    progress: Progress = lambda done, of: None,
    say: Say = lambda words: None,
    **settings: Any,
) -> Batch:
    """Track many recordings: each into a folder of its own in ``out``, as ``torch-ecc track`` does, and a table of all.

    ``recordings``: paths and globs, a list in TOML, or a mapping of names to anything indexed like a stack of frames.
    ``client``: a Dask client of your own; without it there is one worker per core here, or what ``scheduler`` names
    (a script that starts workers here needs ``if __name__ == "__main__":``). ``progress`` is told how many frames are
    done and about how many there are, ``say`` what people should know. ``settings``: those of ``torch-ecc track`` and
    ``torch-ecc batch`` by their names, and ``match={pattern: settings}`` for some of the recordings.

    What is there already, whole and of the same input, settings and versions, is not done again. A recording that
    cannot be tracked is a row that says why. Ctrl-C ends it; the same call goes on. Raises ValueError before any work
    for what does not fit.
    """
    leave_bootstrapping()
    need_dask()
    job, listed = read_list(recordings, settings | ({} if out is None else {"out": str(out)}))
    check_report(job)
    folder = check_folder(job.out, "batch").absolute()
    with claim(folder):
        return _Run(job, folder, listed, progress).run(client, say)


class _Tally:
    """How many frames are done, and about how many there are of so many ``recordings``."""

    def __init__(self, recordings: int, progress: Progress) -> None:
        self.recordings, self.progress = recordings, progress
        self.done: dict[str, int] = {}
        self.of: dict[str, int] = {}

    def hear(self, event: tuple[float, dict[str, Any]]) -> None:
        """A worker's word."""
        told = event[1]
        self.done[told["key"]] = told["done"]
        if told["of"] is not None:
            self.of[told["key"]] = told["of"]
        self._tell()

    def came(self, row: Row) -> None:
        """A recording is done, all of it, or has failed and counts nothing."""
        name = row["folder"]
        for key in [key for key in self.done if key.split("/")[0] == name]:
            self.done.pop(key)
            self.of.pop(key, None)
        self.done[name] = self.of[name] = row.get("frames") or 0
        self._tell()

    def _tell(self) -> None:
        known = len({key.split("/")[0] for key in self.of})
        total = round(sum(self.of.values()) * max(self.recordings, known) / known) if known else None
        self.progress(sum(self.done.values()), total)


class _Run:
    """One run over all recordings, the folder being ours."""

    def __init__(self, job: BatchJob, folder: Path, listed: list[Recording], progress: Progress) -> None:
        self.job, self.folder, self.ticket = job, folder, secrets.token_hex(8)
        self.works = [Work(r.name, r.job, folder, self.ticket, versions(), r.frames) for r in listed]
        for work in self.works:
            refuse_foreign(work.folder)
        self.failures = Failures.read(folder)
        self.rows: dict[str, Row] = {}
        self.todo = self._left()
        self.tally = _Tally(len(self.todo), progress)
        self.gpu = any(map(on_gpu, self.todo))

    def run(self, client: Client | None, say: Say) -> Batch:
        """Do what is to be done, and report whatever comes."""
        clean(self.folder)
        forget_parts(self.folder, {work.name for work in self.todo} if self.job.parts > 1 else set())
        say(f"{len(self.todo)} of {len(self.works)} recordings are to be tracked")
        interrupted = False
        try:
            if self.todo:
                with self._waiting():
                    self._hand_out(client, say)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            clean(self.folder)
            rows = [self.rows.get(work.name) or row_of(work, UNFINISHED) for work in self.works]
            if self.rows:
                self._report(rows)
        now = sum(self.rows.get(work.name, {}).get("status") == TRACKED for work in self.todo)
        return Batch(rows, self.folder, now, interrupted)

    def _left(self) -> list[Work]:
        """What is not done yet, nor has failed before and would again."""
        for work in self.works:
            row = found(work) or (None if self.job.retry else self.failures.of(work))
            if row is not None:
                self.rows[work.name] = row
        return [work for work in self.works if work.name not in self.rows]

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        """The time in which somebody waits for the work."""
        self._ticket.parent.mkdir(exist_ok=True)
        self._ticket.write_text(self.ticket)
        try:
            yield
        finally:
            self._withdraw()

    @property
    def _ticket(self) -> Path:
        return self.folder / WORK / TICKET

    def _withdraw(self) -> None:
        self._ticket.unlink(missing_ok=True)

    def _hand_out(self, client: Client | None, say: Say) -> None:
        """All of it, on another scheduler if one is lost and comes back in time."""
        here = client is None and self.job.scheduler is None
        queue, deadline = Queue(self._tasks(), self._came, patience=RECONNECT if here else math.inf), 0.0
        while True:
            try:
                with nullcontext(client) if client is not None else self._cluster() as cluster:
                    self._use(cluster, queue, say)
                return
            except SchedulerGoneError:
                if client is not None:
                    raise ConnectionError("scheduler: it is gone; the same call goes on when there is one") from None
                say("The scheduler is gone: waiting for it to come back")
                deadline = time.monotonic() + RECONNECT
            except (ValueError, OSError):
                if time.monotonic() > deadline:
                    raise
                time.sleep(1.0)

    def _cluster(self) -> Any:
        most = self.job.workers or (1 if self.gpu else cores())
        return connected(self.job.scheduler, min(most, len(self.todo) * self.job.parts), gpu=self.gpu)

    def _use(self, cluster: Client, queue: Queue, say: Say) -> None:
        guard = check_cluster(cluster, self.folder, say, gpu=self.gpu)
        if link := dashboard_of(cluster):
            say(f"Dask's dashboard: {link}")
        cluster.subscribe_topic(self.ticket, self.tally.hear)
        queue.run(cluster, self._withdraw, guard)

    def _tasks(self) -> Iterator[Task]:
        for work in self.todo:
            try:
                parts = cut(work, self.job.parts) if self.job.parts > 1 else []
            except (ValueError, OSError):  # the worker will say what is wrong
                parts = []
            if parts:
                join = Task(work.name, do_join, work, (parts,), waits=len(parts))
                for number, own in enumerate(parts):
                    yield Task(f"{work.name}/{number}", do_part, work, (number, own), then=join)
            else:
                yield Task(work.name, do, work)

    def _came(self, row: Row) -> None:
        self.rows[row["folder"]] = row
        self.tally.came(row)

    def _report(self, rows: list[Row]) -> None:
        """The table and the pictures, of what there is."""
        self.failures.write([row for row in rows if row["status"] == FAILED], self.works)
        write_report(self.folder, rows, self.job, anew=bool(self.todo))
