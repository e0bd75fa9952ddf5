"""Video files and cameras, through OpenCV: (H, W, 3) uint8 RGB frames."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2

from torch_ecc.io.frames import FrameError, Medium, Pixels, counted

VIDEOS = frozenset(
    ".avi .gif .m4v .mjpeg .mjpg .mkv .mov .mp4 .mpeg .mpg .mts .ogv .ts .webm .wmv .y4m".split()  # noqa: SIM905
)
_SLACK_FRAMES, _SLACK = 3, 0.02


def open_video(path: Path) -> Medium:
    """The frames of a video file; ``length`` and ``fps`` as its container declares them."""
    capture = cv2.VideoCapture(str(path))
    opened, count, fps = capture.isOpened(), int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), _fps(capture)
    capture.release()
    if not opened:
        raise ValueError(f"open_frames: {path} cannot be opened as a video (damaged, or a codec OpenCV does not have)")
    return Medium(
        counted(lambda: _read_video(path, max(count, 0), fps), fps), count if count > 0 else None, fps, exact=False
    )


def open_camera(index: int) -> Medium:
    """Frames of camera ``index`` for as long as they are asked for; iterating again goes on with what it sees then."""
    if index < 0:
        raise ValueError(f"open_frames: source as a camera index must be 0 or more, got {index}")
    capture = cv2.VideoCapture(index)
    if not capture.isOpened():
        raise ValueError(f"open_frames: camera {index} cannot be opened")
    return Medium(counted(lambda: _read_camera(capture, index)), None, _fps(capture))


def _fps(capture: cv2.VideoCapture) -> float | None:
    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if fps > 0 else None


def _read_video(path: Path, declared: int, fps: float | None) -> Iterator[Pixels]:
    capture, index, seconds = cv2.VideoCapture(str(path)), 0, 0.0
    try:
        while True:
            read, frame = capture.read()
            if not read:
                break
            index, seconds = index + 1, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
    finally:
        capture.release()
    # Counted in time and with some slack: what containers declare is exact for some and an estimate for others.
    missing = declared - 1 - seconds * fps if fps and seconds > 0 else declared - index
    if index and missing > max(_SLACK_FRAMES, _SLACK * declared):
        raise FrameError(index, f"{path.name} ends here, but declares {declared} frames: it is cut off or damaged")


def _read_camera(capture: cv2.VideoCapture, index: int) -> Iterator[Pixels]:
    for count in range(sys.maxsize):
        read, frame = capture.read()
        if not read:
            raise FrameError(count, f"camera {index} delivers no frame any more")
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
