"""Stacks of frames in .npy files and in .npz archives, read one frame at a time from the (compressed) stream.

Reading goes through the file and not through a memory map: one way for both, a page cache that is not counted as the
program's memory, and a file cut in the middle still gives the frames that are there.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias
from zipfile import BadZipFile, ZipFile

import numpy as np

from torch_ecc.io.frames import FrameError, Medium, Pixels, check_dtype, counted

_SHAPES = "(F, H, W), (F, H, W, channels) or (F, channels, H, W) with 1, 3 or 4 channels"
_DAMAGE = (OSError, EOFError, BadZipFile, zlib.error)
_Opener: TypeAlias = Callable[[], Any]


class _Layout(NamedTuple):
    frames: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    channels_first: bool


def open_npy(path: Path) -> Medium:
    """The frames of one .npy file, (F, H, W) or with 1, 3 or 4 channels, first or last."""
    return _medium(lambda: path.open("rb"), str(path))


def open_npz(path: Path) -> Medium:
    """The array ``frames``, or the only one, of an .npz archive, compressed or not."""
    try:
        with ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    except BadZipFile as error:
        raise ValueError(f"open_frames: {path} cannot be read as .npz ({error})") from error
    if "frames" not in names and len(names) != 1:
        raise ValueError(f"open_frames: {path} must hold one array, or one named 'frames'; it holds {names}")
    key = "frames" if "frames" in names else names[0]
    return _medium(lambda: _open_member(path, key), f"{path} [{key}]")


@contextmanager
def _open_member(path: Path, key: str) -> Iterator[IO[bytes]]:
    with ZipFile(path) as archive, archive.open(f"{key}.npy") as stream:
        yield stream


def _medium(opener: _Opener, where: str) -> Medium:
    with opener() as stream:
        layout = _read_header(stream, where)
    return Medium(counted(lambda: _read(opener, where)), layout.frames)


def _read_header(stream: IO[bytes], where: str) -> _Layout:
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, fortran, dtype = read[np.lib.format.read_magic(stream)](stream)
    except (ValueError, KeyError, *_DAMAGE) as error:
        raise ValueError(f"open_frames: {where} cannot be read as a numpy array ({error})") from error
    check_dtype(dtype, where)
    if fortran and math.prod(shape) > 0:
        raise ValueError(f"open_frames: {where} is in Fortran order: save numpy.ascontiguousarray(frames) instead")
    first = len(shape) == 4 and shape[1] in (1, 3, 4) and shape[3] not in (1, 3, 4)
    last = len(shape) == 4 and shape[3] in (1, 3, 4) and shape[1] not in (1, 3, 4)
    if 0 in shape[1:] or not (len(shape) == 3 or first or last):
        raise ValueError(f"open_frames: {where} must be {_SHAPES}, got {shape}")
    return _Layout(shape[0], shape[1:], dtype, first)


def _read(opener: _Opener, where: str) -> Iterator[Pixels]:
    with opener() as stream:
        layout = _read_header(stream, where)
        for index in range(layout.frames):
            yield _read_frame(stream, layout, index)


def _read_frame(stream: IO[bytes], layout: _Layout, index: int) -> Pixels:
    size = math.prod(layout.shape) * layout.dtype.itemsize
    try:
        data = stream.read(size)
    except _DAMAGE as error:
        raise FrameError(index, f"the file is damaged ({error})") from error
    if len(data) < size:
        raise FrameError(index, f"the file ends here, {layout.frames} frames were promised")
    array = np.frombuffer(data, layout.dtype).reshape(layout.shape).astype(layout.dtype.newbyteorder("="))
    return np.moveaxis(array, 0, -1) if layout.channels_first else array
