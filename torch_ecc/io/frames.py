"""What every medium becomes: a stream of frames, each with its own time, and with the reason where it is damaged.

The media (video, images, TIFF pages, stacks) say how their frames are read one after the other; what is made of them,
grey levels of one size and kind, is decided here.
"""

from __future__ import annotations

import sys
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, NamedTuple, TypeAlias, overload

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.io.output import printable

Pixels: TypeAlias = NDArray[Any]
"""One frame as it was stored: (H, W) or (H, W, channels), RGB or RGBA order, any real dtype."""

ALL = range(sys.maxsize)
"""The numbers of all frames, however many there are."""


class FrameError(ValueError):
    """A source ends before its time: nothing can be read from ``frame`` on (from 0); what came before it is good."""

    def __init__(self, frame: int, reason: str) -> None:
        super().__init__(f"frame {frame}: {reason}")
        self.frame = frame


class Arrival(NamedTuple):
    """When a live camera's frame arrived, by ``time.perf_counter``, and how many were lost since the one before."""

    time_s: float
    lost: int


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of a source, or what is known of it if it is damaged.

    ``number`` counts from 0 in the source. ``pixels`` are its grey levels (H, W), uint8, uint16 or float32, in
    memory of their own; None exactly where ``damage`` says in words why there are none. ``time_s`` is its own time by
    the source's clock, None where the source has none; ``name`` is that of its file, in a folder, and "" elsewhere;
    ``arrival`` is None but for live cameras.
    """

    number: int
    pixels: Tensor | None
    time_s: float | None = None
    name: str = ""
    damage: str | None = None
    colours: Callable[[], Pixels] | None = None
    arrival: Arrival | None = None

    def picture(self) -> Tensor:
        """For people: (3, H, W) RGB, or (H, W) where the source has no colours; made when it is asked for.
        ValueError if the frame is damaged."""
        if self.pixels is None:
            raise ValueError(self.damage)
        if self.colours is None:
            return self.pixels
        picture = torch.from_numpy(_convert(self.colours()))
        return picture.permute(2, 0, 1) if picture.dim() == 3 else picture


class Raw(NamedTuple):
    """A frame as its medium gives it: ``pixels`` as stored, or the reason why it cannot be read. ``colours``: if
    ``pixels`` are its grey levels only."""

    number: int
    pixels: Pixels | str
    time_s: float | None = None
    name: str = ""
    colours: Callable[[], Pixels] | None = None
    arrival: Arrival | None = None


class Medium(NamedTuple):
    """How a source is read: ``read(numbers)`` gives the frames of these numbers, which ascend, and ends where there
    are no more. FrameError from it means that more was promised. ``length`` is ``exact`` or an estimate. ``um_per_px``
    (x, y) and ``fps`` are None where the source does not tell; ``notes`` are sentences for people. A ``live`` one does
    not wait: reading again begins with what there is then."""

    read: Callable[[range], Iterator[Raw]]
    length: int | None = None
    fps: float | None = None
    um_per_px: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()
    exact: bool = True
    live: bool = False


class FrameSource:
    """A stream of ``Frame`` that holds one of them at a time: iterate it, as often as the medium allows.

    ``length`` is the number of frames, None when it is not known (a camera, a raw stream); for a video it is what the
    container declares, so use it for progress and not for allocation. ``len()`` raises TypeError where it is None.
    ``fps`` is the nominal rate in Hz and ``um_per_px`` the pixel size (x, y), both None where the source does not tell;
    ``first`` holds the pixels of the first good frame, ``shape`` is their (h, w) and ``dtype`` theirs; ``name`` is for
    titles and file names; ``timed`` and ``named`` say whether frames have times and names; ``notes`` are sentences
    that people should read.

    ``source[10:100:2]`` is the source of these frames, which keep their numbers and times, and ``source[7]`` is one of
    them; images, pages and arrays are gone to at once, a video is decoded up to there.

    A frame that is damaged, whose size or dtype is not that of the first good one, or that holds NaN comes with
    ``damage``, and the stream goes on. It raises FrameError, a ValueError, where nothing can be read any more although
    more was promised.
    """

    def __init__(self, name: str, medium: Medium, *, fps: float | None = None, numbers: range | None = None) -> None:
        self._medium, self._rate = medium, fps
        self._numbers = _numbers(medium, slice(None)) if numbers is None else numbers
        self.name, self.notes, self.um_per_px, self.live = printable(name), medium.notes, medium.um_per_px, medium.live
        self.fps, self.length = medium.fps if fps is None else fps, _length(medium, self._numbers)
        # Frames are read up to the first good one, for its shape, and not read again: a camera goes on.
        stream, begun = medium.read(self._numbers), []
        for raw in stream:
            begun.append(raw)
            frame = self._frame(raw)
            if frame.pixels is not None:
                break
        else:
            if not begun and numbers is not None:
                raise ValueError(f"open_frames: {name} holds none of the frames that were asked for")
            reason = f" ({self._frame(begun[0]).damage})" if begun else ""
            raise ValueError(f"open_frames: {name} holds no frame that can be read{reason}")
        self.first, self._first = frame.pixels, frame.name or f"frame {frame.number}"
        self.dtype, self.shape = self.first.dtype, (self.first.shape[0], self.first.shape[1])
        self.timed, self.named = frame.time_s is not None, bool(frame.name)
        self._opened: Iterator[Raw] | None = None if medium.live else chain(begun, stream)

    def __len__(self) -> int:
        if self.length is None:
            raise TypeError(f"the number of frames of {self.name} is not known")
        return self.length

    def __iter__(self) -> Iterator[Frame]:
        stream, self._opened = self._opened or self._medium.read(self._numbers), None
        for raw in stream:
            yield self._checked(self._frame(raw))

    @overload
    def __getitem__(self, which: int) -> Frame: ...
    @overload
    def __getitem__(self, which: slice) -> FrameSource: ...
    def __getitem__(self, which: int | slice) -> Frame | FrameSource:
        """A frame by its number, or the source of some: IndexError and ValueError where there are none."""
        if isinstance(which, slice):
            return FrameSource(self.name, self._medium, fps=self._rate, numbers=_numbers(self._medium, which))
        for raw in self._medium.read(_numbers(self._medium, slice(which, which + 1 or None))):
            return self._checked(self._frame(raw))
        raise IndexError(f"{self.name} has no frame {which}")

    @property
    def numbers(self) -> range | None:
        """Those of all frames, None where what tells their number may be wrong (a video, a camera)."""
        return self._numbers if self._medium.exact and self.length is not None else None

    def between(self, first: int, last: int | None = None) -> Iterator[Frame]:
        """The frames from number ``first`` to ``last``, both included; all the others from there on without one."""
        if self.length is None:  # a camera does not begin again
            yield from (frame for frame in self if frame.number >= first)
            return
        stop = None if last is None else bisect_right(self._numbers, last)
        for raw in self._medium.read(self._numbers[bisect_left(self._numbers, first) : stop]):
            yield self._checked(self._frame(raw))

    def _frame(self, raw: Raw) -> Frame:
        """What a raw frame is by itself."""
        time_s = raw.time_s if self._rate is None else raw.number / self._rate
        frame = Frame(raw.number, None, time_s, raw.name, arrival=raw.arrival)
        stored = raw.pixels
        if isinstance(stored, str):
            return replace(frame, damage=stored)
        try:
            if stored.ndim not in (2, 3) or 0 in stored.shape:
                raise ValueError(f"is no picture, but of the shape {stored.shape}")
            pixels = _gray(_convert(stored))
        except ValueError as error:
            return replace(frame, damage=f"{raw.name or 'it'} {error}")
        colours = (lambda: stored[..., :3]) if stored.ndim == 3 and stored.shape[2] > 2 else raw.colours
        return replace(frame, pixels=torch.from_numpy(pixels), colours=colours)

    def _checked(self, frame: Frame) -> Frame:
        """The same beside the first good one."""
        if frame.pixels is None:
            return frame
        (h, w), (h0, w0) = frame.pixels.shape, self.shape
        this, first, damage = frame.name or "it", self._first, None
        if (h, w) != (h0, w0):
            damage = f"{this} is {w} x {h} px, but {first} is {w0} x {h0} px"
        elif frame.pixels.dtype != self.dtype:
            damage = f"{this} is {_name(frame.pixels.dtype)}, but {first} is {_name(self.dtype)}"
        return frame if damage is None else replace(frame, pixels=None, damage=damage)


def _numbers(medium: Medium, which: slice) -> range:
    """The numbers that a slice means, in ascending order. ValueError if it asks for what only a known end tells."""
    every = ALL if medium.length is None or not medium.exact else range(medium.length)
    if every is ALL and any(each is not None and each < 0 for each in (which.start, which.stop)):
        raise ValueError(f"frames: the number of frames is not known, so they cannot be counted from the end: {which}")
    if which.step is not None and which.step < 1:
        raise ValueError(f"frames: expected a step of 1 or more, got {which.step}")
    return every[which]


def _length(medium: Medium, numbers: range) -> int | None:
    if medium.length is None:
        return len(numbers) if numbers.stop < ALL.stop else None
    return len(range(numbers.start, min(numbers.stop, medium.length), numbers.step))


MOST_PIXELS = 1 << 28  # of one frame: beyond it a header is a mistake or an attack
_LONGEST = 160  # letters of an error


def check_size(where: str, width: int, height: int) -> None:
    """ValueError for a frame beyond ``MOST_PIXELS``, before its memory is asked for."""
    if width * height > MOST_PIXELS:
        most = f"{MOST_PIXELS >> 20} Mpx"
        raise ValueError(f"{where} claims {width} x {height} px; frames of up to {most} can be read")


def brief(error: BaseException) -> str:
    """The error of a library in one short line, by its name if it has no words."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0] if len(lines[0]) <= _LONGEST else f"{lines[0][:_LONGEST]} ..."


def nominal_rate(times: Iterable[float]) -> float | None:
    """Frames per second of most of them, at ``times`` in s: gaps, and a time that is wrong, do not count."""
    steps = np.diff(np.asarray(list(times)))
    step = float(np.median(steps)) if len(steps) else 0.0
    return 1 / step if step > 0 else None


def check_dtype(dtype: np.dtype[Any], where: str) -> None:
    """ValueError unless ``dtype`` holds real numbers or booleans."""
    if dtype.kind not in "buif":
        raise ValueError(f"open_frames: {where} must hold real numbers (integer, float or bool), got dtype {dtype}")


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _gray(array: Pixels) -> Pixels:
    """(H, W) or (H, W, channels) -> (H, W) of the same dtype, colours by ITU-R 601; alpha is dropped."""
    if array.ndim == 2:
        return array
    return np.ascontiguousarray(
        cv2.cvtColor(array[..., :3], cv2.COLOR_RGB2GRAY) if array.shape[2] > 2 else array[..., 0]
    )


def _convert(array: Pixels) -> Pixels:
    """The same numbers as uint8, uint16 or float32: exact for integers, rounded for float64; booleans become 0, 255.
    ValueError, told of the frame, for what does not fit or is not finite."""
    if array.dtype == np.bool_:
        return array.astype(np.uint8) * np.uint8(255)
    native = array.dtype.newbyteorder("=")
    if native in (np.uint8, np.uint16):
        return np.ascontiguousarray(array, native)
    with np.errstate(over="ignore"):  # what overflows becomes infinite, which is refused below
        floats = np.ascontiguousarray(array, np.float32)
    if array.dtype.kind in "iu" and not np.array_equal(floats.astype(np.float64), array.astype(np.float64)):
        raise ValueError(f"holds {array.dtype} values beyond 2^24, which float32 does not hold: scale them to uint16")
    if array.dtype.kind == "f" and not np.isfinite(floats.sum(dtype=np.float64)):
        raise ValueError("holds NaN or infinite values")
    return floats
