"""The script that an OpenCV user writes to follow patches: read, grey, crop, blur, findTransformECC, CSV.

``python plain_opencv.py INPUT OUT.csv SIZE X Y [X Y ...]``: what ``command.py`` times beside ``torch-ecc track``.
"""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

REACH = 16  # px around the template that are searched
STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
Image = NDArray[Any]


def read(path: str) -> Iterator[Image]:
    """The frames in grey."""
    if path.endswith(".tif"):
        for page in range(cv2.imcount(path, cv2.IMREAD_UNCHANGED)):
            if page % 100 == 0:
                pages = cv2.imreadmulti(path, page, 100, flags=cv2.IMREAD_UNCHANGED)[1]
            yield pages[page % 100]
        return
    video = cv2.VideoCapture(path)
    while True:
        there, frame = video.read()
        if not there:
            return
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)


def cut(frame: Image, x: float, y: float, side: int) -> tuple[Image, int, int]:
    """A blurred square around (x, y) and where it begins."""
    left = min(max(round(x) - side // 2, 0), frame.shape[1] - side)
    top = min(max(round(y) - side // 2, 0), frame.shape[0] - side)
    patch = frame[top : top + side, left : left + side].astype(np.float32)
    return cv2.GaussianBlur(patch, (5, 5), 0), left, top


def main(path: str, out: str, size: int, centers: list[tuple[float, float]]) -> None:
    """Follow the squares of ``size`` px around the ``centers`` and write a row for each in every frame."""
    half, templates, poses = size // 2, [], [(x, y, 0.0) for x, y in centers]
    with open(out, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("frame", "template", "x", "y", "theta", "score"))
        for number, frame in enumerate(read(path)):
            templates = templates or [cut(frame, x, y, size)[0] for x, y in centers]
            for k, template in enumerate(templates):
                x, y, theta = poses[k]
                view, left, top = cut(frame, x, y, size + 2 * REACH)
                c, s = math.cos(theta), math.sin(theta)
                place = x - left - c * half - s * half, y - top + s * half - c * half
                warp = np.array([[c, s, place[0]], [-s, c, place[1]]], np.float32)
                score, warp = cv2.findTransformECC(template, view, warp, cv2.MOTION_EUCLIDEAN, STOP, None, 1)
                x, y = (warp @ (half, half, 1) + (left, top)).tolist()
                poses[k] = x, y, math.atan2(warp[0, 1], warp[0, 0])
                rows.writerow((number, k, *poses[k], score))


if __name__ == "__main__":
    path, out, size, *numbers = sys.argv[1:]
    main(path, out, int(size), list(zip(map(float, numbers[::2]), map(float, numbers[1::2]), strict=True)))
