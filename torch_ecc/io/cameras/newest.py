"""What a live camera is, and the policy of all of them.

A few pictures wait for whoever is held up for a moment, whoever is slower than the camera gets the newest one, and what
was missed is counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from torch_ecc.io.cameras.precedence import before_others
from torch_ecc.io.frames import Pixels

WAITING, WAIT_S = 8, 0.1  # pictures that wait at most, and how long
SILENCE_S = 10.0  # after which there is none to be expected: a cable is out, a trigger does not come


class Shot(NamedTuple):
    """A picture: ``pixels`` (H, W) or (H, W, 3) in RGB order, its ``number`` by the camera's count, the time at which
    it arrived by ``time.perf_counter``, and how many were ``lost`` since the one that was grabbed before."""

    pixels: Pixels
    number: int
    time_s: float
    lost: int


@runtime_checkable
class Camera(Protocol):
    """Whatever can give pictures as they come."""

    def grab(self) -> Shot | None:
        """A picture that was not given yet, waited for; None once there will be none any more."""
        ...


class Newest:
    """A camera of whatever can be read picture by picture. ``read`` waits for the next one and gives it with the
    camera's own number, if it has one; None at the end. It is called on a thread of its own, from the first grab on.

    ``close`` is called when there is no more, or after ``Newest.close``.
    """

    def __init__(
        self, read: Callable[[], tuple[Pixels, int | None] | None], close: Callable[[], None] = lambda: None
    ) -> None:
        self._read, self._close = read, close
        self._news = threading.Condition()
        self._shots, self._keeping = deque[Shot](), True
        self._given = self._count = -1
        self._ended = False
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None

    def grab(self) -> Shot | None:
        """The next of the pictures that wait, in their order. Raises what reading has raised, after them."""
        with self._news:
            if self._thread is None:
                self._thread = threading.Thread(target=self._go_on, name="camera", daemon=True)
                self._thread.start()
            if not self._news.wait_for(lambda: self._shots or self._ended, SILENCE_S):
                self._ended, self._error = True, ValueError(f"the camera has sent no picture for {SILENCE_S:g} s")
            if not self._shots:
                if self._error is not None:
                    raise self._error
                return None
            shot, self._keeping = self._shots.popleft(), True
            lost, self._given = (0 if self._given < 0 else shot.number - self._given - 1), shot.number
            return shot._replace(lost=max(lost, 0))

    @property
    def ended(self) -> bool:
        """Whether there will be no picture any more."""
        return self._ended

    def close(self) -> None:
        """End it, for whoever waits too."""
        with self._news:
            self._ended = True
            self._news.notify_all()
        if self._thread is not None:
            self._thread.join(timeout=5)

    def _go_on(self) -> None:
        with before_others():
            self._read_on()

    def _read_on(self) -> None:
        try:
            while not self._ended and (read := self._read()) is not None:
                arrived, (pixels, number) = time.perf_counter(), read
                self._count = self._count + 1 if number is None else number
                self._append(Shot(pixels, self._count, arrived, 0))
        except Exception as error:  # told to whoever grabs
            self._error = error
        finally:
            with self._news:
                self._ended = True
                self._news.notify_all()
            self._close()

    def _append(self, shot: Shot) -> None:
        """To what waits; instead of it once it is too much or too old, until somebody grabs again."""
        with self._news:
            waiting = self._shots
            if waiting and (len(waiting) == WAITING or shot.time_s - waiting[0].time_s > WAIT_S):
                self._keeping = False
            if not self._keeping:
                waiting.clear()
            waiting.append(shot)
            self._news.notify()
