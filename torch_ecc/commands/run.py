"""A run of a tracker over frames: what each of them adds to the files and to the counts, and what it takes to go on."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.body.body import Body
from torch_ecc.commands.bodies import drawn_with
from torch_ecc.commands.live import Latency
from torch_ecc.core.estimate import Estimate, Reason, Status
from torch_ecc.io import Frame, OverlayWriter, TrackWriter
from torch_ecc.io.beside import batches
from torch_ecc.io.journal import Unfinished
from torch_ecc.io.stabilised import StabilisedWriter
from torch_ecc.track.lessons import LESSONS
from torch_ecc.track.lookahead import MOST
from torch_ecc.track.tracker import Tracker

Pictures: TypeAlias = OverlayWriter | StabilisedWriter

CONSTANT = ("template", "mask", "centre", "first", *LESSONS)  # of a state, or too large for a journal
PIXELS_AT_ONCE = 2**26  # of frames that wait in memory
SELDOM = ("marks", "heed")  # does it change: too large to be in a journal with every frame


class Looked(NamedTuple):
    """What was found in a ``frame``, as tracked and as ``shown`` in pictures; the ``state`` then, and the ``change`` of
    what seldom changes."""

    frame: Frame
    estimate: Estimate
    shown: Estimate
    state: bytes
    change: bytes


class Run:
    """The files and the counts of a run of a ``tracker``, and of the ``body`` of its templates if there is one."""

    def __init__(
        self, tracker: Tracker, body: Body | None, track: TrackWriter, films: list[Pictures], stop_at_damage: bool
    ) -> None:
        self.tracker, self.track, self.films, self.body = tracker, track, films, body
        self.stop_at_damage = stop_at_damage
        self.latency = Latency()
        self.damage = ""
        self.done, self.damaged, self.reasons = 0, 0, np.zeros(len(Reason), np.int64)
        self.lost, self.last = np.zeros(len(tracker.start), np.int64), np.zeros(len(tracker.start), np.int8)
        # What the next frame depends on: all of it goes into the journal with every frame.
        self._state = state_of(tracker)
        self._state += [] if self.body is None else list(self.body.buffers(recurse=False))
        self._views = [part.numpy() for part in self._state if part.device.type == "cpu"]  # they see what is written
        self._seldom = [tracker.get_buffer(name) for name in SELDOM]
        self._versions = [part._version for part in self._seldom]
        for film in films:
            film.film.resumable = True
        self._open = ExitStack()

    def __enter__(self) -> Self:
        for writer in (self.track, *self.films):
            self._open.enter_context(writer)
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.__exit__(*error)

    def through(
        self,
        frames: Iterable[Frame],
        progress: Callable[[int], None],
        *told: Callable[[Frame, Estimate], None],
        live: bool = False,
    ) -> None:
        """All of them; ``progress`` is told how many frames are done, before that each of ``told`` what was found.
        Unless they come ``live`` some are waited for before the first of them is tracked, if that takes no time."""
        most = min(MOST // len(self.lost), PIXELS_AT_ONCE // math.prod(self.tracker.frame_shape))
        for some in batches(frames, 1 if live else max(most, 1)):
            self.tracker.look_ahead([raw.pixels for raw in some])
            looks = list[Looked]()
            try:
                looks.extend(map(self.look, some))
            finally:  # those before one that ends the run
                for look in looks:
                    for tell in told:
                        tell(look.frame, look.estimate)
                    self.write(look)
                    progress(self.done)

    def look(self, frame: Frame) -> Looked:
        """What is found in one frame more, which may turn out to be damaged. ValueError if that is to be the end."""
        try:
            if frame.pixels is None:
                raise ValueError(frame.damage)
            estimate: Estimate = self.tracker(frame.pixels)
            self.latency.add(frame)
        except ValueError as error:
            if self.stop_at_damage:
                raise ValueError(f"frame {frame.number}: {error}") from error
            self.damage = self.damage or f"frame {frame.number} ({error})"
            frame, estimate = dataclasses.replace(frame, pixels=None, damage=str(error)), self.tracker.skip()
        shown = estimate if self.body is None else drawn_with(self.body(estimate), estimate, self.body.lens)
        views = self._views or [part.cpu().numpy() for part in self._state]
        return Looked(frame, estimate, shown, b"".join(view.tobytes() for view in views), self._change())

    def write(self, look: Looked) -> None:
        """Append what was found in a frame to all files."""
        frame, estimate = look.frame, look.estimate
        self.track.write(estimate, frame, look.state, look.change)
        for film in self.films:
            film.write(frame, look.shown if isinstance(film, OverlayWriter) else estimate)
        self._count(*(code.cpu().numpy()[None] for code in (estimate.status, estimate.reason)))

    def _change(self) -> bytes:
        """What seldom changes, if it has."""
        before, self._versions = self._versions, [part._version for part in self._seldom]
        return b"" if before == self._versions else b"".join(part.cpu().numpy().tobytes() for part in self._seldom)

    @property
    def counts(self) -> tuple[int, int, str, NDArray[np.int64], NDArray[np.int8], NDArray[np.int64]]:
        """Frames done, of which damaged, the first of these in words, in how many of the others each template was lost
        and why last (R,), and how many rows each reason stands in."""
        return self.done, self.damaged, self.damage, self.lost, self.last, self.reasons

    def _count(self, status: NDArray[np.int8], reason: NDArray[np.int8]) -> None:
        """Frames more with ``status`` and ``reason`` (F, R)."""
        self.done, self.last = self.done + len(status), reason[-1]
        self.reasons += np.bincount(reason.ravel(), minlength=len(Reason))
        if status.max() > Status.MAX_ITERATIONS:
            damaged = status == Status.DAMAGED
            self.damaged += int(damaged[:, 0].sum())
            self.lost += ((status > Status.MAX_ITERATIONS) & ~damaged).sum(0)

    def go_on(self, left: Unfinished, folder: Path) -> None:
        """After the frames that an unfinished run has left in ``folder``."""
        records = left.records(folder)
        restore(self._state, records["state"][-1].tobytes())
        if change := left.change(folder):
            restore(self._seldom, change)
            self.tracker.load_state_dict(self.tracker.state_dict())  # to what follows from it
            self._versions = [part._version for part in self._seldom]
        for film in self.films:
            pose, found = np.array(records["pose"]), records["status"] <= Status.MAX_ITERATIONS
            if self.body is not None and isinstance(film, OverlayWriter):  # the body, too, whose trail begins anew
                pose, found = np.pad(pose, ((0, 0), (0, 1), (0, 0))), np.pad(found, ((0, 0), (0, 1)))
            film.go_on(pose, found)
        for block in left.blocks(folder):
            self._count(block["status"], block["reason"])


def state_of(tracker: Tracker) -> list[Tensor]:
    """The parts of a tracker that change from frame to frame, in the order in which a journal has them."""
    return [part for name, part in tracker.named_buffers() if name not in CONSTANT + SELDOM]


def restore(parts: list[Tensor], state: bytes) -> None:
    """Write a journal's ``state`` into the parts that it is of."""
    for part in parts:
        size = part.numel() * part.element_size()
        value = np.frombuffer(state[:size], part.cpu().numpy().dtype).reshape(tuple(part.shape))
        part.copy_(torch.from_numpy(value.copy()))
        state = state[size:]
