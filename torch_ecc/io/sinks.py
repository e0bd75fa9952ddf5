"""Where drawn pictures go: an H.264 video that browsers play, or a folder of PNG files.

Both have ``.part`` in their name until they are whole. What a killed run has left of either can be gone on with: a
video is a bare stream until its end, which every picture is appended to, and gets its container then.
"""

from __future__ import annotations

import os
from contextlib import suppress
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.output import append, create, part, publish, reopen

_FPS = 25.0
_LOWEST, _HIGHEST = 0.1, 1000.0  # what players know
_CODEC, _STREAM = "libx264", "h264"
# Fast rather than small: the encoder must not take longer than the tracker, and a constant quantiser spares it a look
# at each picture beforehand. A key picture every 50, to jump to.
_OPTIONS = {"preset": "ultrafast", "qp": "34", "tune": "zerolatency", "g": "50"}


class Sink(Protocol):
    """Takes BGR pictures of one size."""

    def write(self, picture: NDArray[np.uint8]) -> None: ...

    def close(self, *, keep: bool) -> Path:
        """Finish, give the result its final name, and return that; ``keep`` what a later run can go on with."""

    def leave(self) -> None:
        """Close what is open, and leave it as it is."""


def open_sink(folder: Path, name: str, fps: float | None, kept: int, *, as_frames: bool) -> Sink:
    """The video ``name``.mp4, or PNG frames in the folder ``name`` if asked for or if no video can be written here,
    after the ``kept`` pictures that are there."""
    folder.mkdir(parents=True, exist_ok=True)
    if as_frames or _CODEC not in av.codecs_available:
        return _Frames(folder, name, kept)
    return _Video(folder, name, fps or _FPS, kept)


def left(folder: Path, name: str) -> int:
    """How many pictures of ``name`` a run has left that can be gone on with."""
    pictures, stream = part(folder, name), part(folder, f"{name}.{_STREAM}")
    if pictures.is_dir() and not pictures.is_symlink():
        return len(list(pictures.glob("frame_*.png")))
    return max(len(_sizes(stream)) - 1, 0) if stream.is_file() and not stream.is_symlink() else 0


def _sizes(stream: Path) -> list[int]:
    """Bytes of each picture of a bare stream, of which the last may be cut off."""
    with suppress(av.FFmpegError), av.open(str(stream.absolute()), format=_STREAM) as video:
        return [packet.size for packet in video.demux(video=0) if packet.size]
    return []


class _Video:
    def __init__(self, folder: Path, name: str, fps: float, kept: int) -> None:
        self._folder, self._name, self._count = folder, name, kept
        self._pace = Fraction(min(max(fps, _LOWEST), _HIGHEST)).limit_denominator(1 << 16)
        stream = part(folder, f"{name}.{_STREAM}")
        self._file = reopen(stream, sum(islice(_sizes(stream), kept))) if kept else create(stream)
        self._encoder: Any = None

    def write(self, picture: NDArray[np.uint8]) -> None:
        bottom, right = picture.shape[0] % 2, picture.shape[1] % 2
        if bottom or right:  # its chroma has half as many rows and columns
            picture = np.pad(picture, ((0, bottom), (0, right), (0, 0)), mode="edge")
        self._encoder = self._encoder or self._begin(*picture.shape[:2])
        rows = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), np.uint8)
        # Without a copy PyAV 18 takes planes of any other height for those of one that is a multiple of four.
        made = av.VideoFrame.from_ndarray if picture.shape[0] % 4 else av.VideoFrame.from_numpy_buffer
        planes = made(rows, format="yuv420p")
        planes.pts, self._count = self._count, self._count + 1
        self._append(self._encoder.encode(planes))

    def _begin(self, height: int, width: int) -> Any:
        encoder: Any = av.CodecContext.create(_CODEC, "w")
        encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
        encoder.framerate, encoder.time_base = self._pace, 1 / self._pace
        encoder.colorspace, encoder.color_range = 5, 1  # BT.601, 16 to 235: what OpenCV makes
        encoder.thread_count, encoder.options = 1, _OPTIONS
        return encoder

    def _append(self, packets: list[Any]) -> None:
        for packet in packets:
            append(self._file, bytes(packet))

    def close(self, *, keep: bool) -> Path:
        with self._file:
            self._append(self._encoder.encode() if self._encoder else [])
        film, stream = f"{self._name}.mp4", part(self._folder, f"{self._name}.{_STREAM}")
        try:
            self._contain(stream, part(self._folder, film))
        except OSError:
            part(self._folder, film).unlink(missing_ok=True)
            raise
        publish(self._folder, film)
        if not keep:
            stream.unlink()
        return self._folder / film

    def leave(self) -> None:
        self._file.close()

    def _contain(self, stream: Path, film: Path) -> None:
        """The same pictures in a container, whose index comes first, so that it plays while it loads."""
        create(film).close()
        with (
            av.open(str(stream.absolute()), format=_STREAM) as source,
            av.open(str(film.absolute()), "w", format="mp4", options={"movflags": "+faststart"}) as target,
        ):
            video = target.add_stream_from_template(source.streams.video[0])
            video.time_base = 1 / self._pace
            for number, packet in enumerate(each for each in source.demux(video=0) if each.size):
                packet.stream, packet.time_base, packet.duration = video, 1 / self._pace, 1
                packet.pts = packet.dts = number
                target.mux(packet)


class _Frames:
    def __init__(self, folder: Path, name: str, kept: int) -> None:
        self._part, self._path, self._count = part(folder, name), folder / name, kept
        if self._part.is_symlink():
            self._part.unlink()
        self._part.mkdir(exist_ok=True)
        for file in sorted(self._part.glob("frame_*.png"))[kept:]:
            file.unlink()

    def write(self, picture: NDArray[np.uint8]) -> None:
        # Encoded in memory first: OpenCV's own file writing does not say why it failed.
        with create(self._part / f"frame_{self._count:06d}.png") as file:
            append(file, cv2.imencode(".png", picture)[1].tobytes())
        self._count += 1

    def close(self, *, keep: bool) -> Path:
        """Frames of an earlier run are replaced; other files in that folder stay."""
        if keep:
            return self._part
        self._path.mkdir(exist_ok=True)
        for file in self._path.glob("frame_*.png"):
            file.unlink()
        for file in self._part.iterdir():
            os.replace(file, self._path / file.name)
        self._part.rmdir()
        return self._path

    def leave(self) -> None:
        """Nothing is open."""
