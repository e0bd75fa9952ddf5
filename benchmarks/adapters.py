"""One small protocol for all trackers, and what they need to follow a template from frame to frame.

A tracker is a function ``start(first, center, size)`` that is shown the first frame and the template in it and returns
a function ``follow(frame)`` with the pose (x, y, theta) in px, px, rad of torch_ecc's convention, or None where it
gives up. Frames are uint8 tensors (1, H, W).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc import Status, Tracker

Pose = tuple[float, float, float]
Follow = Callable[[Tensor], Pose | None]
Start = Callable[[Tensor, tuple[float, float], int], Follow]
Image = NDArray[Any]
Align = Callable[[Image, Image, Image], Image]


class Peer(NamedTuple):
    """A tracker, whose it is, and on how many frames of a sequence it is run: slow ones on the first few."""

    start: Start
    family: str
    frames: int = 1000


def ours(**options: Any) -> Start:
    """torch_ecc's Tracker with ``options``."""

    def start(first: Tensor, center: tuple[float, float], size: int) -> Follow:
        tracker = Tracker(first, [center], size, **options)

        def follow(frame: Tensor) -> Pose | None:
            estimate = tracker(frame)
            return tuple(estimate.pose[0].tolist()) if bool(Status.good(estimate.status)) else None

        return follow

    return start


def aligned(make: Callable[[], Align], *, reach: int | None, surround: int = 0, blur: bool = False) -> Start:
    """A tracker from a function that aligns two images: ``align(template, image, warp)`` returns the 2x3 warp (OpenCV's
    convention, template pixel -> image pixel) refined from the given one, or raises.

    It is given the square around the last pose that is ``reach`` px wider than the template on every side (None: the
    whole frame). ``surround``: px of surroundings that the template is cut with. ``blur``: both are blurred first, in
    float32, 5 x 5.
    """

    def start(first: Tensor, center: tuple[float, float], size: int) -> Follow:
        side, align = size + 2 * surround, make()
        smooth = _smooth if blur else np.ascontiguousarray
        middle, (x, y) = np.array([(side - 1) / 2] * 2 + [1.0]), center
        template = np.ascontiguousarray(_square(smooth(first[0].numpy()), x, y, side)[0])
        warp = np.array([[1.0, 0.0, x - middle[0]], [0.0, 1.0, y - middle[1]]])  # template pixel -> frame pixel

        def follow(frame: Tensor) -> Pose | None:
            nonlocal warp
            image, corner = frame[0].numpy(), np.zeros((2, 3))
            if reach is not None:
                image, corner = _square(image, *(warp @ middle).tolist(), size + 2 * reach)
            try:
                warp = align(template, smooth(image), warp - corner) + corner
            except (cv2.error, RuntimeError):
                return None
            x, y = (warp @ middle).tolist()
            return x, y, math.atan2(warp[0, 1] - warp[1, 0], warp[0, 0] + warp[1, 1])

        return follow

    return start


def _smooth(image: Image) -> Image:
    return cv2.GaussianBlur(image.astype(np.float32), (5, 5), 0)


def _square(image: Image, x: float, y: float, side: int) -> tuple[Image, Image]:
    """The square around (x, y), moved into the image where it would leave it, and a 2x3 matrix of its corner."""
    h, w = image.shape
    left = max(min(round(x - (side - 1) / 2), w - side), 0)
    top = max(min(round(y - (side - 1) / 2), h - side), 0)
    return image[top : top + side, left : left + side], np.array([[0, 0, left], [0, 0, top]], dtype=np.float64)
