"""The trackers that are compared, each at its best settings, behind one small protocol.

A tracker is a function ``start(first, center, size)`` that is shown the first frame and the template in it and returns
a function ``follow(frame)`` with the pose (x, y, theta) in px, px, rad of torch_ecc's convention, or None where it
gives up. Frames are uint8 tensors (1, H, W). Every peer starts from the previous pose, as torch_ecc does with
``prediction="hold"``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_ecc import Status, Tracker
from torch_ecc.pose import from_opencv, to_opencv

Pose = tuple[float, float, float]
Follow = Callable[[Tensor], Pose | None]
Start = Callable[[Tensor, tuple[float, float], int], Follow]
REACH = 80  # px: half the side of the square that is cut around the last pose of a 121 px template


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


def opencv(align: Callable[..., np.ndarray], blur: bool, reach: int | None) -> Start:
    """OpenCV's ECC: ``align(template, image, warp)`` returns the refined 2x3 warp or raises.

    ``blur``: template and image are blurred 5 x 5 here, before cutting, in float32. ``reach``: align with a square of
    this half side around the last pose (grown with the template), instead of the whole frame.
    """

    def start(first: Tensor, center: tuple[float, float], size: int) -> Follow:
        pose = torch.tensor([*center, 0.0], dtype=torch.float64)
        x, y = (round(c - (size - 1) / 2) for c in center)
        whole = _blurred(first[0].numpy()) if blur else first[0].numpy()
        template = np.ascontiguousarray(whole[y : y + size, x : x + size])

        def follow(frame: Tensor) -> Pose | None:
            nonlocal pose
            image, (left, top) = frame[0].numpy(), (0, 0)
            if reach is not None:
                image, (left, top) = _around(image, pose, reach + (size - 121 + 1) // 2)
            warp = to_opencv(pose, (size, size)).numpy() - np.array([[0, 0, left], [0, 0, top]])
            try:
                warp = align(template, _blurred(image) if blur else image, warp.astype(np.float32))
            except cv2.error:
                return None
            warp = warp.astype(np.float64) + np.array([[0, 0, left], [0, 0, top]])
            pose = from_opencv(torch.from_numpy(warp), (size, size))
            return tuple(pose.tolist())

        return follow

    return start


def ecc(criteria: tuple[int, int, float], gauss: int) -> Callable[..., np.ndarray]:
    """cv2.findTransformECC; ``gauss``: side of its own blur."""
    return lambda t, image, warp: cv2.findTransformECC(t, image, warp, cv2.MOTION_EUCLIDEAN, criteria, None, gauss)[1]


def ecc_multiscale(t: np.ndarray, image: np.ndarray, warp: np.ndarray) -> np.ndarray:
    """cv2.findTransformECCMultiScale (OpenCV 5) at its own settings but for the motion."""
    parameters = cv2.ECCParameters()
    parameters.motionType = cv2.MOTION_EUCLIDEAN
    return cv2.findTransformECCMultiScale(t, image, warp, parameters)[1]


def _blurred(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image.astype(np.float32), (5, 5), 0)


def _around(image: np.ndarray, pose: Tensor, reach: int) -> tuple[np.ndarray, tuple[int, int]]:
    """The square of half side ``reach`` around ``pose``, less what lies outside the image, and its corner (x, y)."""
    x, y = (round(v) for v in pose[:2].tolist())
    left, top = max(x - reach, 0), max(y - reach, 0)
    return np.ascontiguousarray(image[top : y + reach + 1, left : x + reach + 1]), (left, top)


def opencv_peers() -> dict[str, Peer]:
    """Shipped settings on the whole frame; the fastest fair setting (blurred once here, cut out, loose eps)."""
    count_or_eps = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
    shipped, loose = (count_or_eps, 50, 1e-3), (count_or_eps, 50, 1e-4)
    peers = {
        "OpenCV ECC, shipped": Peer(opencv(ecc(shipped, 5), blur=False, reach=None), "OpenCV"),
        "OpenCV ECC, fastest fair": Peer(opencv(ecc(loose, 1), blur=True, reach=REACH), "OpenCV"),
    }
    if hasattr(cv2, "findTransformECCMultiScale"):
        peers["OpenCV ECC, multi-scale"] = Peer(opencv(ecc_multiscale, blur=False, reach=REACH), "OpenCV")
    return peers
