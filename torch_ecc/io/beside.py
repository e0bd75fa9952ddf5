"""Work beside the tracking, on one thread each: frames are read ahead of it, pictures are drawn behind it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")

_AHEAD, _BEHIND = 4, 16  # frames in memory at most


def ahead(items: Iterable[T]) -> Iterator[T]:
    """The same ``items``, a few of them made before they are asked for; what making one raises is raised here."""
    end, source = object(), iter(items)
    with ThreadPoolExecutor(1, "ahead") as thread:
        waiting: deque[Future[Any]] = deque(thread.submit(next, source, end) for _ in range(_AHEAD))
        try:
            while (item := waiting.popleft().result()) is not end:
                waiting.append(thread.submit(next, source, end))
                yield item
        finally:
            thread.shutdown(cancel_futures=True)


class Behind:
    """Calls one after the other, later; ``do`` waits where too many have not been made yet, and raises what one of
    those before has raised."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "behind")
        self._waiting: deque[Future[None]] = deque()

    def do(self, call: Callable[[], None]) -> None:
        """Have ``call`` made after all those before it."""
        while self._waiting and (self._waiting[0].done() or len(self._waiting) >= _BEHIND):
            self._settle()
        self._waiting.append(self._thread.submit(call))

    def finish(self) -> None:
        """Wait for all calls; the first error is raised, and what comes after it is not called."""
        try:
            while self._waiting:
                self._settle()
        finally:
            self._thread.shutdown(cancel_futures=True)

    def _settle(self) -> None:
        """The oldest call: if it has failed it stays, and so do all that would come after it."""
        self._waiting[0].result()
        self._waiting.popleft()
