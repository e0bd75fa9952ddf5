"""Arrays of a track, some frames at a time: of what is drawn of a long one, little is in memory at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from typing import IO, Any, TypeAlias, cast
from zipfile import ZipFile

import numpy as np
from numpy.lib.format import read_array_header_1_0, read_array_header_2_0, read_magic
from numpy.lib.npyio import NpzFile
from numpy.typing import ArrayLike, NDArray

Arrays: TypeAlias = Mapping[str, ArrayLike] | NpzFile
"""By name: an open .npz file, or any others."""


def shape_of(arrays: Arrays, name: str) -> tuple[int, ...]:
    """Of one of them, which is not read for that."""
    if not isinstance(arrays, NpzFile):
        return np.shape(arrays[name])
    with _member(arrays, name) as file:
        return _header(file)[0]


def blocks(arrays: Arrays, names: list[str], frames: int) -> Iterator[dict[str, NDArray[Any]]]:
    """So many frames of each at a time."""
    with ExitStack() as stack:
        parts = [_parts(arrays, name, frames, stack) for name in names]
        for some in zip(*parts, strict=True):
            yield dict(zip(names, some, strict=True))


def _parts(arrays: Arrays, name: str, frames: int, stack: ExitStack) -> Iterator[NDArray[Any]]:
    if isinstance(arrays, NpzFile):
        file = stack.enter_context(_member(arrays, name))
        shape, by_columns, kind = _header(file)
        if not by_columns:
            return _read(file, shape, kind, frames)
    values = np.asarray(arrays[name])
    return (values[first : first + frames] for first in range(0, len(values), frames))


def _read(file: IO[bytes], shape: tuple[int, ...], kind: np.dtype[Any], frames: int) -> Iterator[NDArray[Any]]:
    for first in range(0, shape[0], frames):
        part = (min(frames, shape[0] - first), *shape[1:])
        yield np.frombuffer(file.read(int(np.prod(part)) * kind.itemsize), kind).reshape(part)


def _member(archive: NpzFile, name: str) -> IO[bytes]:
    return cast("ZipFile", archive.zip).open(f"{name}.npy")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether columns come first, and kind of an .npy file, whose numbers follow."""
    read = read_array_header_1_0 if read_magic(file) == (1, 0) else read_array_header_2_0
    return read(file)
