"""Frames of motion JPEG, through libjpeg-turbo: grey levels in two thirds of the time that whole pictures take FFmpeg.

Its luma is the exact transform's to rounding, that of FFmpeg a hundredth of a grey level too dark in the mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import av
import numpy as np
from av.video.reformatter import ColorRange
from simplejpeg import decode_jpeg, decode_jpeg_header

from torch_ecc.io.frames import Pixels

_ROUNDING = 2  # grey levels that decoders may differ by
_GREY = 4  # that red, green and blue may be apart where chroma is rounded by one
_LUMA = ("Gray", "YCbCr")
_LOOK = 25  # frames from one look for colours to the next: each takes as long as the grey levels do


@dataclass(slots=True, eq=False)
class Tint:
    """Whether a film has shown colours in the pictures that were ``asked`` for: of one that has not, few are looked at,
    so that colours that come later are shown with that delay."""

    asked: int = 0
    seen: bool = False

    def doubtful(self) -> bool:
        """Whether the next picture is to be looked at."""
        self.asked += 1
        return not self.seen and self.asked % _LOOK == 1


@dataclass(frozen=True, slots=True, eq=False)
class Jpeg:
    """A whole frame, whose grey levels (H, W) are there and whose colours are still in its ``packet``."""

    pixels: Pixels
    packet: Any
    coloured: bool
    tint: Tint
    is_corrupt: ClassVar = False
    key_frame: ClassVar = True

    @property
    def time(self) -> float | None:
        """By the container, in s."""
        pts, base = self.packet.pts, self.packet.time_base
        return None if pts is None or base is None else float(pts * base)

    def colours(self) -> Pixels:
        """(H, W, 3), or (H, W) where all are grey, as of most cameras that measure."""
        if self.tint.doubtful():
            h, w = self.pixels.shape
            small = decode_jpeg(self.packet, "RGB", min_height=-(-h // 8), min_width=-(-w // 8))
            self.tint.seen = bool(np.ptp(small, -1).max() > _GREY)
        if not self.tint.seen:
            return self.pixels
        picture: Pixels = decode_jpeg(self.packet, "RGB")
        return picture


def grey(packet: Any, width: int, height: int, tint: Tint) -> Jpeg | None:
    """The frame in a packet, None if it has another size or colours, or if anything in it is not as it should be."""
    try:
        found_height, found_width, colours, _ = decode_jpeg_header(packet)
        if (found_width, found_height) != (width, height) or colours not in _LUMA:
            return None
        return Jpeg(decode_jpeg(packet, "GRAY")[..., 0], packet, colours == "YCbCr", tint)
    except ValueError:
        return None


def is_plain(packet: Any, frame: av.VideoFrame) -> bool:
    """Is what FFmpeg has made of a packet, to rounding, what is found by ``grey``, and shown as it is?"""
    if frame.side_data.get("DISPLAYMATRIX") is not None or frame.color_range != ColorRange.JPEG:
        return False
    found, plane = grey(packet, frame.width, frame.height, Tint()), frame.planes[0]
    if found is None or plane.line_size < frame.width:
        return False
    luma: Pixels = np.ndarray((frame.height, frame.width), np.uint8, memoryview(plane), 0, (plane.line_size, 1))
    return int(np.abs(luma.astype(np.int16) - found.pixels).max()) <= _ROUNDING
