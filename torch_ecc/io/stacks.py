"""Stacks of frames: .npy files, .npz archives, and anything in memory or elsewhere that is indexed like an array.

Files are read through the (compressed) stream and not through a memory map: one way for both, a page cache that is not
counted as the program's memory, and a file cut in the middle still gives the frames that are there.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol, TypeAlias
from zipfile import BadZipFile, ZipFile

import numpy as np

from torch_ecc.io.frames import FrameError, Medium, Pixels, Raw, brief, check_dtype, check_size

_SHAPES = "(F, H, W), (F, H, W, channels) or (F, channels, H, W) with 1, 3 or 4 channels"
_DAMAGE = (OSError, EOFError, BadZipFile, zlib.error, NotImplementedError, RuntimeError)
_Opener: TypeAlias = Callable[[], Any]


class Stack(Protocol):
    """(F, H, W), or with 1, 3 or 4 channels, first or last: numpy, torch, dask, zarr, HDF5."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    def __getitem__(self, index: int, /) -> Any: ...


class _Layout(NamedTuple):
    frames: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    channels_first: bool
    offset: int = 0


def open_stack(stack: Stack, where: str) -> Medium:
    """One frame per first index of anything indexed like an array. ValueError for another shape or dtype."""
    shape = tuple(stack.shape)
    if len(shape) < 3 or 0 in shape:
        raise ValueError(f"open_frames: {where} must be {_SHAPES} and not empty, got {shape}")
    layout = _layout(shape, np.asarray(stack[0]).dtype, where)

    def read(numbers: range) -> Iterator[Raw]:
        for number in range(numbers.start, min(numbers.stop, layout.frames), numbers.step):
            yield Raw(number, _one(stack, layout, number))

    return Medium(read, layout.frames)


def _one(stack: Stack, layout: _Layout, number: int) -> Pixels | str:
    try:
        array = np.asarray(stack[number]).copy()  # what is in memory may be changed while it is read
    except Exception as error:  # whatever a lazy array stumbles on when it is computed
        return f"it cannot be read ({brief(error)})"
    return np.moveaxis(array, 0, -1) if layout.channels_first else array


def open_npy(path: Path) -> Medium:
    """The frames of one .npy file, (F, H, W) or with 1, 3 or 4 channels, first or last."""
    return _medium(lambda: path.open("rb"), str(path))


def open_npz(path: Path) -> Medium:
    """The array ``frames``, or the only one, of an .npz archive, compressed or not."""
    try:
        with ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    except _DAMAGE as error:
        raise ValueError(f"open_frames: {path} cannot be read as .npz ({brief(error)})") from error
    if "frames" not in names and len(names) != 1:
        raise ValueError(f"open_frames: {path} must hold one array, or one named 'frames'; it holds {names}")
    key = "frames" if "frames" in names else names[0]
    return _medium(lambda: _open_member(path, key), f"{path} [{key}]")


@contextmanager
def _open_member(path: Path, key: str) -> Iterator[IO[bytes]]:
    with ZipFile(path) as archive, archive.open(f"{key}.npy") as stream:
        yield stream


def _medium(opener: _Opener, where: str) -> Medium:
    try:
        with opener() as stream:
            layout = _read_header(stream, where)
    except _DAMAGE as error:
        raise ValueError(f"open_frames: {where} cannot be read ({brief(error)})") from error
    return Medium(lambda numbers: _read(opener, layout, numbers), layout.frames)


def _read_header(stream: IO[bytes], where: str) -> _Layout:
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, fortran, dtype = read[np.lib.format.read_magic(stream)](stream)
    except Exception as error:  # its header is a Python expression, which can be wrong in every way
        raise ValueError(f"open_frames: {where} cannot be read as a numpy array ({brief(error)})") from error
    if fortran and math.prod(shape) > 0:
        raise ValueError(f"open_frames: {where} is in Fortran order: save numpy.ascontiguousarray(frames) instead")
    return _layout(shape, dtype, where)._replace(offset=stream.tell())


def _layout(shape: tuple[int, ...], dtype: np.dtype[Any], where: str) -> _Layout:
    check_dtype(dtype, where)
    first = len(shape) == 4 and shape[1] in (1, 3, 4) and shape[3] not in (1, 3, 4)
    last = len(shape) == 4 and shape[3] in (1, 3, 4) and shape[1] not in (1, 3, 4)
    if any(n < 1 for n in shape[1:]) or shape[0] < 0 or not (len(shape) == 3 or first or last):
        raise ValueError(f"open_frames: {where} must be {_SHAPES}, got {shape}")
    check_size(f"open_frames: {where}", *(shape[2:] if first else shape[1:3])[::-1])
    return _Layout(shape[0], shape[1:], dtype, first)


def _read(opener: _Opener, layout: _Layout, numbers: range) -> Iterator[Raw]:
    size = math.prod(layout.shape) * layout.dtype.itemsize
    with opener() as stream:
        for number in range(numbers.start, min(numbers.stop, layout.frames), numbers.step):
            data = np.empty(size, np.uint8)
            try:
                stream.seek(layout.offset + number * size)
                done = stream.readinto(data)
            except _DAMAGE as error:
                raise FrameError(number, f"the file is damaged ({brief(error)})") from error
            if done < size:
                raise FrameError(number, f"the file ends here, {layout.frames} frames were promised")
            array = data.view(layout.dtype).reshape(layout.shape)
            yield Raw(number, np.moveaxis(array, 0, -1) if layout.channels_first else array)
