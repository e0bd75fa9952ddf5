"""Pictures that are made and written on a thread of their own, beside the tracking."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.beside import Behind
from torch_ecc.io.output import check_folder
from torch_ecc.io.sinks import Sink, left, open_sink

Picture = NDArray[np.uint8]


class Film:
    """``add`` pictures, and find ``name``.mp4 (or the folder ``name``, if ``as_frames``) in ``folder``, at ``fps`` in
    Hz, 25 if None. Nothing is created before the first one. ``resumable``: keep what a later run can go on with, if
    this one ends before its time."""

    def __init__(self, folder: str | Path, name: str, fps: float | None = None, *, as_frames: bool = False) -> None:
        self.folder, self.name = check_folder(folder, "OverlayWriter"), name
        self._fps, self._as_frames, self._kept = fps, as_frames, 0
        self.resumable = False
        self._behind = Behind()
        self._sink: Sink | None = None

    @property
    def left(self) -> int:
        """How many pictures an unfinished run has left."""
        return left(self.folder, self.name)

    def go_on(self, kept: int) -> None:
        """Behind so many of those pictures, which stay."""
        self._kept = kept

    def add(self, make: Callable[[], Picture]) -> None:
        """Have a picture (h, w, 3) in OpenCV's order made and written, later. OSError if one before failed to be."""
        self._behind.do(lambda: self._write(make()))

    def _write(self, picture: Picture) -> None:
        if self._sink is None:
            self._sink = open_sink(self.folder, self.name, self._fps, self._kept, as_frames=self._as_frames)
        self._sink.write(picture)

    def close(self, *, whole: bool) -> Path | None:
        """All that was added is written: where it is, None if there is nothing."""
        try:
            self._behind.finish()
        except BaseException:
            if self._sink is not None:
                self._sink.leave()
            raise
        if self._sink is None and self._kept:
            self._sink = open_sink(self.folder, self.name, self._fps, self._kept, as_frames=self._as_frames)
        return self._sink.close(keep=self.resumable and not whole) if self._sink else None


class FilmWriter:
    """Context manager of what makes a ``film``. Afterwards ``path`` is where it is, None if no frame came."""

    def __init__(self, film: Film) -> None:
        self.film = film
        self.path: Path | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.path = self.film.close(whole=error is None)
