"""overlay.mp4, or overlay/ of PNG frames: each template drawn where it was found."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.io.canvas import WHITE, Box, Canvas, Stretch
from torch_ecc.io.marks import Labels, Mark, draw
from torch_ecc.io.output import check_folder
from torch_ecc.io.records import Record, StatusNames, to_arrays, words
from torch_ecc.io.shapes import Shape, outlines
from torch_ecc.io.sinks import Sink, open_sink

_TRAIL_FRAMES = 60


class _Run(NamedTuple):
    """What the first frame settles for all."""

    shape: torch.Size
    stretch: Stretch
    labels: Labels
    sink: Sink


class OverlayWriter:
    """Context manager: ``write`` each frame with its record, and find overlay.mp4 in ``out_dir``.

    ``shapes`` is what each of the R templates covers: its (h, w), or its mask (h, w). Green is converged, orange
    doubtful, red lost; the arrow is the template's x axis, the thin line its recent path. ``fps`` in Hz is the pace of
    the video (25 if None). If ``as_frames``, or if this machine's OpenCV cannot write a video, PNG frames come instead,
    in the folder overlay. Frames that are not 8-bit are stretched by the grey levels of the first one.

    The result has ``.part`` in its name until the run ends, by itself, by an exception or by Ctrl-C. Afterwards
    ``path`` is where it is, None if no frame came.
    """

    def __init__(
        self,
        out_dir: str | Path,
        *,
        shapes: Sequence[Shape],
        status_names: StatusNames,
        fps: float | None = None,
        as_frames: bool = False,
    ) -> None:
        self.out_dir = check_folder(out_dir, "OverlayWriter")
        self.path: Path | None = None
        self._status_names, self._fps, self._as_frames = dict(status_names), fps, as_frames
        self._outlines = [outlines(shape) for shape in shapes]
        self._trails: list[deque[NDArray[np.float64]]] = [deque(maxlen=_TRAIL_FRAMES) for _ in shapes]
        self._frames = 0
        self._run: _Run | None = None

    def write(self, frame: Tensor, record: Record) -> None:
        """Draw one frame, (H, W) or (C, H, W) with C 1 or 3 in RGB order, and append it.

        ValueError if the frame is no picture or not of the size of the first one, or has not R templates.
        """
        if frame.dim() not in (2, 3) or (frame.dim() == 3 and frame.shape[0] not in (1, 3)):
            raise ValueError(f"write: frame must be (H, W), (1, H, W) or (3, H, W), got {tuple(frame.shape)}")
        stretch = self._run.stretch if self._run else Stretch.of(frame)
        marks = self._marks(record)
        canvas = Canvas(stretch.apply(frame))
        run = self._run = self._run or self._begin(frame, stretch, canvas)
        if frame.shape != run.shape:
            raise ValueError(f"write: frame must be {tuple(run.shape)} as before, got {tuple(frame.shape)}")
        for mark in marks:
            draw(canvas, mark)
        run.labels.draw(canvas, marks)
        canvas.label(self._footer(canvas), self._clock(), WHITE)
        run.sink.write(canvas.image)
        self._frames += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        run, self._run = self._run, None
        if run is not None:
            self.path = run.sink.close()

    def _begin(self, frame: Tensor, stretch: Stretch, canvas: Canvas) -> _Run:
        height, width = canvas.image.shape[:2]
        sink = open_sink(self.out_dir, (height, width), fps=self._fps, as_frames=self._as_frames)
        return _Run(frame.shape, stretch, Labels(self._footer(canvas)), sink)

    def _marks(self, record: Record) -> list[Mark]:
        arrays = to_arrays(record)
        status = words(arrays["status"], self._status_names)
        if len(status) != len(self._outlines):
            raise ValueError(f"write: record must have {len(self._outlines)} templates as shapes, got {len(status)}")
        values = zip(arrays["pose"], arrays["score"], status, self._outlines, self._trails, strict=True)
        marks = [Mark(number, torch.from_numpy(pose), *rest) for number, (pose, *rest) in enumerate(values)]
        for mark, trail in zip(marks, self._trails, strict=True):
            if not mark.lost:
                trail.append(mark.pose[:2].numpy())
        return marks

    def _clock(self) -> str:
        return f"frame {self._frames}" + (f"   {self._frames / self._fps:.3f} s" if self._fps else "")

    def _footer(self, canvas: Canvas) -> Box:
        w, h = canvas.measure(self._clock())
        return Box(0, canvas.image.shape[0] - h, w, h)
