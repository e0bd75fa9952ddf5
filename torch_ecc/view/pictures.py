"""Frames as pictures for a browser."""

from __future__ import annotations

import cv2
import numpy as np

from torch_ecc.io.canvas import Stretch
from torch_ecc.io.frames import Frame

LIVE_SIDE = 1280  # px: what is sent while it is tracked is no larger
QUALITY = {False: 92, True: 80}  # of JPEG, by whether it is live


def jpeg(frame: Frame, stretch: Stretch, *, live: bool = False) -> bytes:
    """The picture of a frame. ValueError if it is damaged."""
    picture = stretch.apply(frame.picture())
    side = max(picture.shape[:2])
    if live and side > LIVE_SIDE:
        picture = np.asarray(
            cv2.resize(picture, None, fx=LIVE_SIDE / side, fy=LIVE_SIDE / side, interpolation=cv2.INTER_AREA)
        )
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY[live]])[1])
