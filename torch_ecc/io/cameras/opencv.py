"""Cameras that OpenCV knows, by their index."""

from __future__ import annotations

import cv2
import numpy as np

from torch_ecc.io.cameras.newest import Newest
from torch_ecc.io.frames import Pixels


def open_opencv(which: str) -> tuple[Newest, float | None]:
    """Camera of this index and its rate in Hz, if it tells. ValueError if there is none."""
    if not (which.isascii() and which.isdecimal()):
        raise ValueError(f"open_frames: source as a camera index must be 0 or more, got {which or 'none'}")
    capture = cv2.VideoCapture(int(which))
    if not capture.isOpened():
        raise ValueError(f"open_frames: camera {int(which)} cannot be opened")
    fps = float(capture.get(cv2.CAP_PROP_FPS))

    def read() -> tuple[Pixels, None] | None:
        found, frame = capture.read()
        if not found:
            return None
        return (frame if frame.ndim == 2 else np.ascontiguousarray(frame[..., ::-1])), None

    return Newest(read, capture.release), fps if fps > 0 else None
