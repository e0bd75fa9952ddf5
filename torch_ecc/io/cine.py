"""Phantom .cine files: FFmpeg reads their frames, but knows the rate only that the camera was set to, which is wrong
where every tenth frame was saved. The file holds a time for each frame. Of the two flips that a user may ask for FFmpeg
does one, and so shows a picture that is turned over as a mirrored one.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.frames import Medium, Raw, nominal_rate
from torch_ecc.io.video import open_video

# Mark, size, compression, version, first and count of the movie, first and count of this file, offsets of three parts.
_HEADER = struct.Struct("<2s3HiIiI3I")
_BLOCK = struct.Struct("<I2H")  # size, with these eight bytes, kind, reserved
_TIMES = 1002  # the kind of block that holds one time for each frame, and then the trigger's as in the header
_UNIT = 2.0**-32  # s
_FLIP = 756  # where that stands in the second part


def open_cine(path: Path) -> Medium:
    """The frames of a .cine file at their own times, in s from the trigger on. ValueError if it is none."""
    medium, times, mirrored = open_video(path), read_times(path), _is_mirrored(path)

    def read(numbers: range) -> Iterator[Raw]:
        for raw in medium.read(numbers):
            shown = _mirror(raw) if mirrored else raw
            if times is not None:
                shown = shown._replace(time_s=float(times[raw.number]) if raw.number < len(times) else None)
            yield shown

    if times is None:
        return medium._replace(read=read)
    return medium._replace(read=read, length=len(times), fps=nominal_rate(times) or medium.fps)


def _mirror(raw: Raw) -> Raw:
    pixels, colours = raw.pixels, raw.colours
    return raw._replace(
        pixels=pixels if isinstance(pixels, str) else pixels[:, ::-1],
        colours=None if colours is None else lambda: colours()[:, ::-1],
    )


def _is_mirrored(path: Path) -> bool:
    """Whether its user has flipped it from left to right."""
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size or head[:2] != b"CI":
            return False
        file.seek(_HEADER.unpack(head)[-2] + _FLIP)
        return any(file.read(4))


def read_times(path: Path) -> NDArray[np.float64] | None:
    """Seconds from the trigger on of each frame (F,); None if the file does not hold them."""
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size or head[:2] != b"CI":
            return None
        *_, count, _, setup, offsets = _HEADER.unpack(head)
        trigger = np.frombuffer(file.read(8), "<u8")
        file.seek(setup + 142)  # where the part that the blocks follow tells its own length
        (length,) = struct.unpack("<H", file.read(2).ljust(2, b"\0"))
        place = setup + length
        while place + _BLOCK.size <= offsets:
            file.seek(place)
            size, kind, _ = _BLOCK.unpack(file.read(_BLOCK.size).ljust(_BLOCK.size, b"\0"))
            if kind == _TIMES and size == _BLOCK.size + 8 * count:
                times = np.frombuffer(file.read(8 * count), "<u8")
                # As whole numbers: of seconds since 1970 a float64 only holds a quarter of a microsecond.
                return (times - trigger).astype(np.int64) * _UNIT if len(times) == count else None
            if size < _BLOCK.size:
                return None
            place += size
    return None
