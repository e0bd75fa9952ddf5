"""Where drawn frames go: a video, or a folder of PNG files. Both have ``.part`` in their name until they are closed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.output import part

_FPS = 25.0
_LOWEST, _HIGHEST, _WHOLE = 0.1, 1000.0, 60.0


class Sink(Protocol):
    """Takes BGR pictures of one size."""

    def write(self, picture: NDArray[np.uint8]) -> None: ...

    def close(self) -> Path:
        """Finish, give the result its final name, and return that."""


def open_sink(folder: Path, size: tuple[int, int], *, fps: float | None, as_frames: bool) -> Sink:
    """A video of ``size`` = (h, w) in ``folder``, or PNG frames if asked for or if no video can be written here."""
    folder.mkdir(parents=True, exist_ok=True)
    if not as_frames:
        video = _Video(folder, size, fps or _FPS)
        if video.opened:
            return video
    return _Frames(folder)


class _Video:
    def __init__(self, folder: Path, size: tuple[int, int], fps: float) -> None:
        # OpenCV takes the container from the extension, so .part goes before it.
        self._part, self._path = folder / "overlay.part.mp4", folder / "overlay.mp4"
        # MPEG-4 wants a time base under 65536 and even sides: fast videos get whole rates, odd sides one more pixel.
        pace = min(max(fps, _LOWEST), _HIGHEST)
        self._pad = (size[0] % 2, size[1] % 2)
        frame = (size[1] + self._pad[1], size[0] + self._pad[0])
        code = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._part), code, float(round(pace)) if pace > _WHOLE else pace, frame)

    @property
    def opened(self) -> bool:
        return self._writer.isOpened()

    def write(self, picture: NDArray[np.uint8]) -> None:
        bottom, right = self._pad
        if bottom or right:
            picture = np.pad(picture, ((0, bottom), (0, right), (0, 0)), mode="edge")
        self._writer.write(picture)

    def close(self) -> Path:
        self._writer.release()
        os.replace(self._part, self._path)
        return self._path


class _Frames:
    def __init__(self, folder: Path) -> None:
        self._part, self._path, self._count = part(folder, "overlay"), folder / "overlay", 0
        self._part.mkdir(exist_ok=True)
        self._clear(self._part)

    def write(self, picture: NDArray[np.uint8]) -> None:
        name = self._part / f"frame_{self._count:06d}.png"
        # Encoded in memory first: OpenCV's own file writing does not say why it failed.
        name.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
        self._count += 1

    def close(self) -> Path:
        """Frames of an earlier run are replaced; other files in that folder stay."""
        self._path.mkdir(exist_ok=True)
        self._clear(self._path)
        for name in self._part.iterdir():
            os.replace(name, self._path / name.name)
        self._part.rmdir()
        return self._path

    @staticmethod
    def _clear(folder: Path) -> None:
        for name in folder.glob("frame_*.png"):
            name.unlink()
