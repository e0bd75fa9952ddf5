"""Frames as pictures for a browser."""

from __future__ import annotations

import cv2
import torch
from torch import Tensor

from torch_ecc.io.canvas import Stretch
from torch_ecc.io.frames import Frame

LIVE_SIDE = 1024  # px: what is sent while it is tracked is no larger
QUALITY = {False: 92, True: 80}  # of JPEG, by whether it is live


def jpeg(frame: Frame, stretch: Stretch, *, live: bool = False) -> bytes:
    """The picture of a frame. ValueError if it is damaged."""
    picture = frame.picture()
    if live and max(picture.shape[-2:]) > LIVE_SIDE:  # before colours are made of it
        picture = _smaller(picture, LIVE_SIDE / max(picture.shape[-2:]))
    return bytes(cv2.imencode(".jpg", stretch.apply(picture), [cv2.IMWRITE_JPEG_QUALITY, QUALITY[live]])[1])


def _smaller(picture: Tensor, by: float) -> Tensor:
    """(H, W) or (C, H, W) at a lower resolution."""
    if picture.dim() == 3:
        return torch.stack([_smaller(channel, by) for channel in picture])
    return torch.from_numpy(cv2.resize(picture.numpy(), None, fx=by, fy=by, interpolation=cv2.INTER_LINEAR))
