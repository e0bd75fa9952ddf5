"""Frames as pictures for a browser."""

from __future__ import annotations

import cv2
import torch
from torch import Tensor

from torch_ecc.io.canvas import Stretch
from torch_ecc.io.frames import Frame

LIVE_SIDE = 1024  # px: what is sent while it is tracked is no larger
QUALITY, LIVE_QUALITY = 92, 80  # of JPEG


def jpeg(frame: Frame, stretch: Stretch, side: int | None = None) -> bytes:
    """The picture of a frame, while it is tracked with sides of at most ``side`` px. ValueError if it is damaged."""
    picture = frame.picture()
    if side is not None and max(picture.shape[-2:]) > side:  # before colours are made of it
        picture = _smaller(picture, side / max(picture.shape[-2:]))
    quality = QUALITY if side is None else LIVE_QUALITY
    return bytes(cv2.imencode(".jpg", stretch.apply(picture), [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def _smaller(picture: Tensor, by: float) -> Tensor:
    """(H, W) or (C, H, W) at a lower resolution, each pixel the mean of those that it stands for."""
    if picture.dim() == 3:
        return torch.stack([_smaller(channel, by) for channel in picture])
    return torch.from_numpy(cv2.resize(picture.numpy(), None, fx=by, fy=by, interpolation=cv2.INTER_AREA))
