"""A tracking run on a thread of its own, to be watched."""

from __future__ import annotations

import threading
import time
from enum import StrEnum
from typing import Any

from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.live import Latency
from torch_ecc.commands.track import Session
from torch_ecc.core.estimate import Estimate
from torch_ecc.io.frames import Frame
from torch_ecc.io.journal import Unfinished
from torch_ecc.view.history import History


class State(StrEnum):
    """What a run is doing."""

    RUNNING = "running"
    STOPPED = "stopped"
    DONE = "done"
    FAILED = "failed"


class Run:
    """``torch-ecc track`` of a job: begun when it is made. ValueError or OSError, before anything is written, for a job
    that does not fit."""

    def __init__(self, job: TrackJob) -> None:
        left = Unfinished.of(job.folder()) if job.resume else None
        self._session = Session(job)
        start = self._session.tracker.start.cpu().numpy()
        self.history = History(start) if left is None else History.of(job.folder())
        self.folder, self.total = self._session.folder, self._session.source.length
        self.state, self.words = State.RUNNING, self._session.remarks()
        self.latency = Latency()
        self.frame: Frame | None = None  # the last one that can be shown
        self._stopping, self._begun, self._before = threading.Event(), time.perf_counter(), len(self.history)
        self._seconds: float | None = None
        self._thread = threading.Thread(target=self._track, name="track", daemon=True)
        self._thread.start()

    @property
    def rate(self) -> float:
        """Frames per second."""
        seconds = self._seconds or time.perf_counter() - self._begun
        return (len(self.history) - self._before) / max(seconds, 1e-3)

    def stop(self) -> None:
        """End it after the frame that it is in, and wait for its files."""
        self._stopping.set()
        self._thread.join()

    def counted(self) -> dict[str, Any]:
        """How far it is."""
        return {"state": self.state, "done": len(self.history), "total": self.total, "rate": self.rate}

    def told(self) -> dict[str, Any]:
        """What a page shows of it."""
        latency = self.latency.words() if self.state is State.RUNNING else []
        return self.counted() | {"words": self.words, "latency": latency}

    def _track(self) -> None:
        try:
            finished = self._session.run(self._go_on, self._watch)
        except Exception as error:  # whatever it is, people must read it
            state, words = State.FAILED, [str(error) or type(error).__name__]
        else:
            state, words = State.STOPPED if finished.interrupted else State.DONE, finished.words()
        self._seconds = time.perf_counter() - self._begun
        self.words = words
        self.state = state

    def _watch(self, frame: Frame, estimate: Estimate) -> None:
        self.latency.add(frame)
        self.history.add(frame, estimate)
        if frame.pixels is not None:
            self.frame = frame

    def _go_on(self, done: int) -> None:
        if self._stopping.is_set():
            raise KeyboardInterrupt
