"""What every medium becomes: a stream of tensors.

A frame is (H, W) grey or (3, H, W) in RGB order, of dtype uint8, uint16 or float32, and owns its memory. The media
(video, images, TIFF pages, array stacks) only have to say how their arrays are read one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Pixels: TypeAlias = NDArray[Any]
"""One frame as it was stored: (H, W) or (H, W, channels), RGB or RGBA order, any real dtype."""


class FrameError(ValueError):
    """A frame in the middle of a source that cannot be used; what came before it is good. ``frame`` counts from 0."""

    def __init__(self, frame: int, reason: str) -> None:
        super().__init__(f"frame {frame}: {reason}")
        self.frame = frame


class Medium(NamedTuple):
    """How a source is read: ``arrays()`` starts over from the first frame, as far as the medium can."""

    arrays: Callable[[], Iterator[Pixels]]
    length: int | None = None
    fps: float | None = None
    label: Callable[[int], str] = "frame {}".format


class FrameSource:
    """A stream of frames that holds one of them at a time: iterate it, as often as the medium allows.

    ``length`` is the number of frames, None when it is not known (a camera, a raw stream); for a video it is what the
    container declares, so use it for progress and not for allocation. ``len()`` raises TypeError where it is None.
    ``fps`` is in Hz or None, ``shape`` is (h, w) in px, ``name`` is for titles and file names.

    Iterating raises FrameError, a ValueError with the number of the frame, at a frame that is damaged, or whose size
    or dtype is not that of the first one.
    """

    def __init__(self, name: str, medium: Medium) -> None:
        self.name, self.length, self.fps = name, medium.length, medium.fps
        self._medium = medium
        arrays = medium.arrays()
        first = next(arrays, None)
        if first is None:
            raise ValueError(f"open_frames: {name} holds no frame that can be read")
        # The first frame is wanted for its shape; a camera must not be opened twice for it, so the stream goes on.
        self._opened: Iterator[Pixels] | None = chain((first,), arrays)
        frame = _to_tensor(first, 0)
        self.dtype, self.shape = frame.dtype, (frame.shape[-2], frame.shape[-1])

    def __len__(self) -> int:
        if self.length is None:
            raise TypeError(f"the number of frames of {self.name} is not known")
        return self.length

    def __iter__(self) -> Iterator[Tensor]:
        arrays, self._opened = self._opened or self._medium.arrays(), None
        for index, array in enumerate(arrays):
            frame = _to_tensor(array, index)
            self._check(frame, index)
            yield frame

    def _check(self, frame: Tensor, index: int) -> None:
        (h, w), (h0, w0) = frame.shape[-2:], self.shape
        label = self._medium.label
        if (h, w) != (h0, w0):
            raise FrameError(index, f"{label(index)} is {w} x {h} px, but {label(0)} is {w0} x {h0} px")
        if frame.dtype != self.dtype:
            raise FrameError(index, f"{label(index)} is {_name(frame.dtype)}, but {label(0)} is {_name(self.dtype)}")


def check_dtype(dtype: np.dtype[Any], where: str) -> None:
    """ValueError unless ``dtype`` holds real numbers or booleans."""
    if dtype.kind not in "buif":
        raise ValueError(f"open_frames: {where} must hold real numbers (integer, float or bool), got dtype {dtype}")


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _to_tensor(array: Pixels, index: int) -> Tensor:
    """(H, W) or (H, W, channels) of any real dtype -> (H, W) or (3, H, W) uint8, uint16 or float32; alpha dropped."""
    check_dtype(array.dtype, f"frame {index}")
    tensor = torch.from_numpy(_convert(array, index))
    if tensor.dim() == 2:
        return tensor
    colour = tensor.permute(2, 0, 1)
    return (colour[:3] if len(colour) >= 3 else colour[0]).contiguous()


def _convert(array: Pixels, index: int) -> Pixels:
    """The same numbers as uint8, uint16 or float32: exact for integers, rounded for float64; booleans become 0, 255."""
    if array.dtype == np.bool_:
        return array.astype(np.uint8) * np.uint8(255)
    native = array.dtype.newbyteorder("=")
    if native in (np.uint8, np.uint16, np.float32):
        return np.ascontiguousarray(array, native)
    with np.errstate(over="ignore"):  # what overflows becomes inf, and whoever takes the frame refuses that
        floats = array.astype(np.float32)
    if array.dtype.kind in "iu" and not np.array_equal(floats.astype(np.float64), array.astype(np.float64)):
        raise FrameError(index, f"{array.dtype} values beyond 2^24 do not fit float32 exactly; scale them to uint16")
    return floats
