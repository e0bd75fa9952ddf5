"""Work beside the tracking, on one thread each: frames are read ahead of it, pictures are drawn behind it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

T = TypeVar("T")

_AHEAD, _BEHIND = 4, 16  # frames in memory at most: of the first, twice so many


def ahead(items: Iterable[T]) -> Iterator[T]:
    """The same ``items``, a few of them made before they are asked for; what making one raises is raised here.

    Several at once: two threads that meet at every frame take a tenth more of a busy processor's time.
    """
    source, thread = iter(items), ThreadPoolExecutor(1, "ahead")
    waiting = deque(thread.submit(_some, source, _AHEAD) for _ in range(2))
    try:
        while True:
            made, error = waiting.popleft().result()
            waiting.append(thread.submit(_some, source, _AHEAD))
            yield from made
            if error is not None:
                raise error
            if len(made) < _AHEAD:
                return
    finally:
        # Not waited for: what is left behind with an error is closed by the garbage collector, which may run in a
        # thread that is just being started, and holds the lock that one that ends has to take.
        thread.shutdown(wait=False, cancel_futures=True)


def batches(items: Iterable[T], count: int) -> Iterator[list[T]]:
    """The same ``items``, so many at once, the last time fewer; those before an error come before it is raised."""
    source = iter(items)
    while True:
        made, error = _some(source, count)
        if made:
            yield made
        if error is not None:
            raise error
        if len(made) < count:
            return


def _some(source: Iterator[T], count: int) -> tuple[list[T], Exception | None]:
    """The next items, so many or all that come before an error, with that."""
    made = list[T]()
    try:
        made.extend(islice(source, count))
    except Exception as error:
        return made, error
    return made, None


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
