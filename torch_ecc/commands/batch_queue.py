"""Calls handed out to a Dask cluster, a few more than there are workers at a time, until every one has come back.

A scheduler's memory does not grow with the number of calls, and whatever is lost, a worker or the scheduler itself, is
handed out again: to do the same twice does no harm. Dask blames all that a worker had when it died, the one it was at
and those that waited there; so what is blamed has a last try with nothing beside it.
"""

from __future__ import annotations

import math
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torch_ecc.commands.batch_cluster import CANCELLED, GPU
from torch_ecc.commands.batch_unit import FAILED, UNFINISHED, Row, Work, row_of

if TYPE_CHECKING:
    from distributed import Client, Future

TRIES = 5  # of a call that a worker gives up because it does not see who waits for it, or has other versions
LOOK = 5.0  # s after which workers are counted again
ENDING = 15.0  # s for workers to notice that nobody waits for them


class SchedulerGoneError(Exception):
    """The connection was lost; what was handed out is to be handed out again."""


@dataclass(eq=False)
class Task:
    """A call ``make(work, *rest)`` for a worker. ``then`` is another one that ``waits`` for it and for others;
    ``suspect`` if it has ended workers, or was beside one that has."""

    key: str
    make: Callable[..., Row]
    work: Work
    rest: tuple[Any, ...] = ()
    then: Task | None = None
    waits: int = 0
    tries: int = 0
    suspect: bool = False


def on_gpu(work: Work) -> bool:
    """Does it need a worker with a GPU?"""
    return (work.job.device or "").startswith("cuda")


class Queue:
    """The ``tasks``, made one by one when there is a worker for them; ``came`` is told of every row. It is an error to
    have no worker for more than ``patience`` seconds."""

    def __init__(self, tasks: Iterable[Task], came: Callable[[Row], None], *, patience: float = math.inf) -> None:
        self._tasks, self._came, self._patience = iter(tasks), came, patience
        self._again: deque[Task] = deque()  # what was lost, or has become possible
        self._suspects: deque[Task] = deque()
        self._out: dict[Future, Task] = {}
        self._most, self._look, self._seen = 0, 0.0, 0.0

    def run(self, client: Client, withdraw: Callable[[], object], guard: Callable[[], object] = lambda: None) -> None:
        """Until all have come back; ``guard`` is called whenever the workers are counted. SchedulerGoneError if the
        connection, or every worker, is lost: another call goes on with another client. A KeyboardInterrupt calls
        ``withdraw``, waits for the workers to notice, and is raised again."""
        self._look, self._seen = 0.0, time.monotonic()
        try:
            while self._hand_out(client, guard):
                for future in self._back(client):
                    self._settle(future)
        except KeyboardInterrupt:
            withdraw()
            self._wind_up()
            raise
        except (OSError, RuntimeError, *CANCELLED) as error:  # what Dask says before it knows that nobody is there
            if isinstance(error, RuntimeError) and client.status == "running":
                raise
            self._again.extend(self._out.values())
            self._out.clear()
            raise SchedulerGoneError from error

    def _hand_out(self, client: Client, guard: Callable[[], object]) -> int:
        """As many as are wanted; how many are out then."""
        if time.monotonic() > self._look:
            guard()
            self._count(client)
        while len(self._out) < self._most and (task := self._next()) is not None:
            # A scheduler remembers every group of keys that it has seen: all of ours are of one.
            name = (f"torch_ecc.{task.make.__name__}", task.key, secrets.token_hex(4))
            needs = {GPU: 1} if on_gpu(task.work) else None
            future = client.submit(task.make, task.work, *task.rest, key=name, pure=False, resources=needs)
            self._out[future] = task
        return len(self._out)

    def _count(self, client: Client) -> None:
        """The workers, which come and go."""
        now, threads = time.monotonic(), sum(client.nthreads().values())
        self._look, self._most = now + LOOK, 2 * max(threads, 1)
        if threads:
            self._seen = now
        elif now > self._seen + self._patience:
            raise ConnectionError("all workers are lost")

    def _next(self) -> Task | None:
        """What is handed out now, if anything: suspects come last, and one by one."""
        if self._again:
            return self._again.popleft()
        task = next(self._tasks, None)
        return self._suspects.popleft() if task is None and self._suspects and not self._out else task

    def _back(self, client: Client) -> list[Future]:
        """Those that have come back, or are lost; none if it is time to count the workers again."""
        from distributed import TimeoutError as Late
        from distributed import wait

        with suppress(Late), client.as_current():
            wait(list(self._out), timeout=LOOK, return_when="FIRST_COMPLETED")
        return [future for future in self._out if future.status != "pending"]

    def _settle(self, future: Future) -> None:
        """One has come back, or is lost."""
        if future.status not in ("finished", "error"):
            raise ConnectionError(f"{self._out[future].key} is lost")
        task = self._out.pop(future)
        row = self._row(task, future)
        if row is None:
            task.suspect = True
            self._suspects.append(task)
        elif row["status"] == UNFINISHED and task.tries < TRIES:
            task.tries, self._look = task.tries + 1, 0.0  # who did not do it?
            time.sleep(0.2)
            self._again.append(task)
        elif task.then is None or row["status"] == FAILED:
            self._came(row)
        else:
            task.then.waits -= 1
            if not task.then.waits:
                self._again.appendleft(task.then)

    def _row(self, task: Task, future: Future) -> Row | None:
        """What has come back; None if it has ended its workers, or was beside what has."""
        if future.status == "finished":
            return future.result()  # type: ignore[no-any-return]
        from distributed import KilledWorker

        error = future.exception()
        words = f"{type(error).__name__}: {error}"
        if isinstance(error, KilledWorker):
            if not task.suspect:
                return None
            words = f"it ended its worker {error.allowed_failures + 1} times, with nothing beside it"
        return row_of(task.work, FAILED, words=words)

    def _wind_up(self) -> None:
        """Rows that still come when nobody waits any more."""
        deadline = time.monotonic() + ENDING
        while time.monotonic() < deadline and not all(future.done() for future in self._out):
            time.sleep(0.05)
        for future, task in self._out.items():
            if future.status == "finished" and task.then is None and future.result()["status"] != UNFINISHED:
                self._came(future.result())
