"""One small protocol for all trackers, and what they need to follow a template from frame to frame.

A tracker is a function ``start(first, center, size)`` that is shown the first frame and the template in it and returns
a function ``follow(frame)`` with the pose (x, y, theta) in px, px, rad of torch_ecc's convention, or None where it
gives up. Frames are uint8 tensors (1, H, W).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc import Status, Tracker
from torch_ecc.pose import from_opencv, to_opencv

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
        pose = torch.tensor([*center, 0.0], dtype=torch.float64)
        side, align = size + 2 * surround, make()
        smooth = _smooth if blur else np.ascontiguousarray
        template = np.ascontiguousarray(_square(smooth(first[0].numpy()), pose, side)[0])

        def follow(frame: Tensor) -> Pose | None:
            nonlocal pose
            image, corner = frame[0].numpy(), np.zeros((2, 3))
            if reach is not None:
                image, corner = _square(image, pose, size + 2 * reach)
            warp = to_opencv(pose, (side, side)).numpy() - corner
            try:
                warp = align(template, smooth(image), warp) + corner
            except (cv2.error, RuntimeError):
                return None
            pose = from_opencv(torch.from_numpy(warp), (side, side))
            return tuple(pose.tolist())

        return follow

    return start


def _smooth(image: Image) -> Image:
    return cv2.GaussianBlur(image.astype(np.float32), (5, 5), 0)


def _square(image: Image, pose: Tensor, side: int) -> tuple[Image, Image]:
    """The square around ``pose``, moved into the image where it would leave it, and a 2x3 matrix of its corner."""
    x, y = (round(v - (side - 1) / 2) for v in pose[:2].tolist())
    h, w = image.shape
    x, y = max(min(x, w - side), 0), max(min(y, h - side), 0)
    return image[y : y + side, x : x + side], np.array([[0, 0, x], [0, 0, y]], dtype=np.float64)
