"""Cameras, through OpenCV: frames for as long as they are asked for, at the times at which they came."""

from __future__ import annotations

import time
from collections.abc import Iterator

import cv2
import numpy as np

from torch_ecc.io.frames import FrameError, Medium, Raw


def open_camera(index: int) -> Medium:
    """Frames of camera ``index``; iterating again goes on with what it sees then. Times count from the opening."""
    if index < 0:
        raise ValueError(f"open_frames: source as a camera index must be 0 or more, got {index}")
    capture = cv2.VideoCapture(index)
    if not capture.isOpened():
        raise ValueError(f"open_frames: camera {index} cannot be opened")
    fps = float(capture.get(cv2.CAP_PROP_FPS))
    opened = time.perf_counter()

    def read(numbers: range) -> Iterator[Raw]:
        for number in range(numbers.stop):
            found, frame = capture.read()
            if not found:
                raise FrameError(number, f"camera {index} delivers no frame any more")
            if number in numbers:
                yield Raw(
                    number,
                    frame if frame.ndim == 2 else np.ascontiguousarray(frame[..., ::-1]),
                    time.perf_counter() - opened,
                )

    return Medium(read, None, fps if fps > 0 else None)
