"""overlay.mp4, or overlay/ of PNG frames: each template drawn where it was found."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.core.pose import warp
from torch_ecc.io.canvas import WHITE, Box, Canvas, Stretch
from torch_ecc.io.film import Film, FilmWriter, Picture
from torch_ecc.io.frames import Frame
from torch_ecc.io.marks import Labels, Mark, draw
from torch_ecc.io.records import Record, StatusNames, to_arrays, words
from torch_ecc.io.shapes import Shape, outlines

_TRAIL_FRAMES = 60


class OverlayWriter(FilmWriter):
    """Context manager: ``write`` each frame with its record, and find overlay.mp4 in ``out_dir``.

    ``shapes`` is what each of the R templates covers: its (h, w), or its mask (h, w). Green is converged, orange
    doubtful, red lost; the arrow is the template's x axis, the thin line its recent path. ``fps`` in Hz is the pace of
    the video (25 if None); ``um_matrix`` (2, 2), which takes a displacement in px to micrometres, adds that to the
    labels. If ``as_frames``, or if no H.264 can be written here, PNG frames come instead, in the folder overlay. Frames
    that are not 8-bit are stretched by the grey levels of the first one.

    Pictures are encoded and written on a thread of their own. The result has ``.part`` in its name until the run ends,
    by itself, by an exception or by Ctrl-C. Afterwards ``path`` is where it is, None if no frame came.
    """

    def __init__(
        self,
        out_dir: str | Path,
        *,
        shapes: Sequence[Shape],
        status_names: StatusNames,
        fps: float | None = None,
        um_matrix: Tensor | None = None,
        as_frames: bool = False,
    ) -> None:
        super().__init__(Film(out_dir, "overlay", fps, as_frames=as_frames))
        self._status_names, self._fps = dict(status_names), fps
        self._um = None if um_matrix is None else um_matrix.detach().cpu().numpy()
        self._outlines = [[line.numpy() for line in outlines(shape)] for shape in shapes]
        self._trails: list[deque[tuple[float, float]]] = [deque(maxlen=_TRAIL_FRAMES) for _ in shapes]
        self._frames = 0
        self._shape: torch.Size | None = None
        self._stretch: Stretch | None = None
        self._labels: Labels | None = None
        self._last: Picture | None = None

    def write(self, frame: Frame | Tensor, record: Record) -> None:
        """Have one frame drawn and appended: pixels (H, W) or (C, H, W) with C 1 or 3 in RGB order.

        ValueError if the frame is no picture or not of the size of the first one, or has not R templates.
        """
        if isinstance(frame, Tensor):
            frame = Frame(self._frames, frame, None if self._fps is None else self._frames / self._fps)
        self._shape = self._fitting(frame)
        arrays = to_arrays(record)
        marks = self._marks(arrays, words(arrays["status"], self._status_names))
        # Drawn here: two threads that hold Python's lock most of the time hinder each other. Encoding does not hold it.
        picture = self._drawn(frame, marks)
        self.film.add(lambda: picture)
        self._frames += 1

    def go_on(self, poses: NDArray[np.float64], found: NDArray[np.bool_]) -> None:
        """After the pictures of the first F frames of an unfinished run, with ``poses`` (F, R, 3) in px, px, rad of
        templates that were ``found`` (F, R) or not."""
        self.film.go_on(len(poses))
        for trail, pose, seen in zip(self._trails, poses.swapaxes(0, 1), found.T, strict=True):
            trail.extend(map(tuple, pose[seen][-_TRAIL_FRAMES:, :2].tolist()))
        self._frames = len(poses)

    def _fitting(self, frame: Frame) -> torch.Size | None:
        """The shape of all frames, as far as it is known. ValueError for one that is not like this."""
        if frame.pixels is None:
            return self._shape
        shape = frame.pixels.shape
        if len(shape) not in (2, 3) or (len(shape) == 3 and shape[0] not in (1, 3)):
            raise ValueError(f"write: frame must be (H, W), (1, H, W) or (3, H, W), got {tuple(shape)}")
        if self._shape is not None and shape != self._shape:
            raise ValueError(f"write: frame must be {tuple(self._shape)} as before, got {tuple(shape)}")
        return shape

    def _marks(self, arrays: Mapping[str, NDArray[Any]], status: list[str]) -> list[Mark]:
        if len(status) != len(self._outlines):
            raise ValueError(f"write: record must have {len(self._outlines)} templates as shapes, got {len(status)}")
        moved: Sequence[NDArray[np.float64] | None] = [None] * len(status)
        if self._um is not None:
            moved = list(arrays["displacement"][:, :2] @ self._um.T)
        warps = np.array([warp(*pose) for pose in arrays["pose"].tolist()])
        scores, lines = arrays["score"].tolist(), self._outlines
        values = zip(arrays["pose"], warps, scores, status, lines, self._trails, moved, strict=True)
        marks = []
        for number, (pose, place, score, word, outline, trail, um) in enumerate(values):
            mark = Mark(number, pose, place, score, word, outline, trail, um)
            if not mark.lost:
                trail.append((float(pose[0]), float(pose[1])))
            marks.append(mark)
        return marks

    def _drawn(self, frame: Frame, marks: list[Mark]) -> Picture:
        canvas = Canvas(self._picture(frame))
        clock = _clock(frame)
        w, h = canvas.measure(clock)
        footer = Box(0, canvas.image.shape[0] - h, w, h)
        self._labels = self._labels or Labels(footer)
        for mark in marks:
            draw(canvas, mark, len(marks))
        self._labels.draw(canvas, marks)
        canvas.label(canvas.clamp(footer), clock, WHITE)
        return canvas.image

    def _picture(self, frame: Frame) -> Picture:
        """(h, w, 3); of a frame that is damaged the last one, darker."""
        if frame.pixels is None:
            h, w = (480, 640) if self._shape is None else self._shape[-2:]
            return np.zeros((h, w, 3), np.uint8) if self._last is None else self._last // 3
        picture = frame.picture()
        self._stretch = self._stretch or Stretch.of(picture)
        self._last = self._stretch.apply(picture)
        return self._last


def _clock(frame: Frame) -> str:
    time = "" if frame.time_s is None else f"   {frame.time_s:.3f} s"
    damage = "" if frame.damage is None else f"\ndamaged: {frame.damage[:60]}"
    return f"frame {frame.number}{time}{damage}"
