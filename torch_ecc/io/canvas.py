"""A picture to draw on: a frame as 8-bit colours, with lines and labels placed to a fraction of a pixel.

Everything is given in frame pixels and sized to the picture, so that it reads the same at 250 x 250 and 2048 x 2048.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import repeat
from math import ceil, floor
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

Colour: TypeAlias = tuple[int, int, int]
"""Blue, green, red: OpenCV's order."""

WHITE: Colour = (245, 245, 245)
_DARK: Colour = (20, 20, 20)
_SMALLEST = 400  # px: smaller frames are enlarged
_UNSEEN = 0.125  # px, of a path: points nearer to the line between others
_SHIFT, _FAR = 4, 1 << 20  # lines are placed to 1/16 px, up to where OpenCV's integers end


class Box(NamedTuple):
    """A rectangle of the canvas, in its own pixels."""

    x: int
    y: int
    w: int
    h: int

    def overlap(self, other: Box) -> int:
        """The common area in px."""
        w = min(self.x + self.w, other.x + other.w) - max(self.x, other.x)
        h = min(self.y + self.h, other.y + other.h) - max(self.y, other.y)
        return max(w, 0) * max(h, 0)


class Stretch(NamedTuple):
    """The grey levels that become black and white."""

    low: float
    high: float

    @classmethod
    def of(cls, frame: Tensor) -> Stretch:
        """The whole range of 8 bits as it is; of anything else what 99.8 % of the pixels of ``frame`` lie in."""
        if frame.dtype.itemsize == 1:
            return cls(0.0, 255.0)
        low, high = np.nanpercentile(frame.cpu().numpy(), (0.1, 99.9))
        return cls(float(low), float(max(high, np.nextafter(low, np.inf))))

    def apply(self, frame: Tensor) -> NDArray[np.uint8]:
        """(H, W) or (C, H, W) -> (H, W, 3) in OpenCV's order."""
        pixels = frame.detach().cpu().numpy()
        if coloured := pixels.ndim == 3 and len(pixels) == 3:
            rows = np.ascontiguousarray(np.moveaxis(pixels, 0, -1))  # no copy where they were so stored
        else:
            rows = pixels.reshape(pixels.shape[-2:])
        rows = rows if rows.dtype == np.uint8 else self._in_8_bits(rows.reshape(len(rows), -1)).reshape(rows.shape)
        return np.asarray(cv2.cvtColor(rows, cv2.COLOR_RGB2BGR if coloured else cv2.COLOR_GRAY2BGR), np.uint8)

    def _in_8_bits(self, rows: NDArray[Any]) -> NDArray[Any]:
        scale, whole = 255.0 / (self.high - self.low), rows.dtype.kind in "iu"
        low: Any = self.low if whole else np.asarray(self.low).astype(rows.dtype)
        above = cv2.max(rows, low) if whole else np.fmax(rows, low)  # of NaN and a number the number
        return cv2.convertScaleAbs(above, alpha=scale, beta=-self.low * scale)


class Canvas:
    """``image`` is (h, w, 3) uint8; ``scale`` sizes lines and letters, 1 for 480 px; ``gap`` is the usual distance.

    ``step`` is the length in frame px of what is 1 px long at a scale of 1.
    """

    def __init__(self, picture: NDArray[np.uint8]) -> None:
        shortest = min(picture.shape[:2])
        self._zoom = ceil(_SMALLEST / shortest)
        zoomed = picture.repeat(self._zoom, 0).repeat(self._zoom, 1) if self._zoom > 1 else picture
        self.image = np.ascontiguousarray(zoomed)
        self.scale = max(1.0, shortest * self._zoom / 480)
        self.gap = round(3 * self.scale)
        self.step = self.scale / self._zoom
        self._size: int = round(12.5 * self.scale)  # of letters

    def place(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Frame pixels to canvas pixels, (..., 2): both count from the middle of their first pixel."""
        placed: NDArray[np.float64] = points if self._zoom == 1 else (points + 0.5) * self._zoom - 0.5
        return placed

    def path(self, points: NDArray[np.float64], colour: Colour) -> None:
        """A line through many (N, 2) frame points, by no more of them than one sees."""
        few = cv2.approxPolyDP(points.astype(np.float32), _UNSEEN / self._zoom, False)
        self.lines([few[:, 0].astype(np.float64)], colour)

    def lines(
        self, points: Sequence[NDArray[np.float64]], colour: Colour, *, closed: bool = False, width: float = 1.0
    ) -> None:
        """Lines through (N, 2) frame points each, with a dark rim that keeps them visible on any texture."""
        fixed = [self._fixed(each) for each in points]
        thickness = max(1, round(width * self.scale))
        rim = thickness + 2 * max(1, round(0.6 * self.scale))
        for shade, size in ((_DARK, rim), (colour, thickness)):
            cv2.polylines(self.image, fixed, closed, shade, size, cv2.LINE_AA, _SHIFT)

    def _fixed(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """(N, 1, 2) in OpenCV's fractions of a pixel."""
        return np.round(self.place(points) * (1 << _SHIFT)).clip(-_FAR, _FAR).astype(np.int32)[:, None]

    def measure(self, text: str) -> tuple[int, int]:
        """Width and height in canvas px of the label that ``text`` makes."""
        lines = text.split("\n")
        width = max(sum(map(_width, repeat(self._size), line)) for line in lines)
        return width + 4 * self.gap, len(lines) * (_height(self._size) + self.gap) + self.gap

    def clamp(self, box: Box) -> Box:
        """The box moved to where all of it is on the canvas, as far as that is large enough."""
        height, width = self.image.shape[:2]
        return box._replace(x=max(0, min(box.x, width - box.w)), y=max(0, min(box.y, height - box.h)))

    def label(self, spot: Box, text: str, colour: Colour) -> None:
        """``text`` on dark ground with an edge of ``colour``, at a ``spot`` of the canvas as large as ``measure``."""
        ground = self.image[spot.y : spot.y + spot.h, spot.x : spot.x + spot.w]
        cv2.rectangle(self.image, spot, _DARK, cv2.FILLED)
        cv2.rectangle(self.image, spot._replace(w=self.gap), colour, cv2.FILLED)
        for number, line in enumerate(text.split("\n")):
            ink = np.concatenate([_glyph(self._size, letter, colour) for letter in line or " "], 1)
            top = self.gap + number * (_height(self._size) + self.gap)
            under = ground[top : top + ink.shape[0], 3 * self.gap : 3 * self.gap + ink.shape[1]]
            under[:] = ink[: under.shape[0], : under.shape[1]]


@cache
def _load_font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib and knows theta and the degree sign."""
    import matplotlib as mpl  # slow to import

    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


@cache
def _glyph(size: int, letter: str, colour: Colour) -> NDArray[np.uint8]:
    """A letter in half of a ``colour`` on dark ground, (h, w, 3): drawn once, since labels change in every frame."""
    font = _load_font(size)
    mask = Image.new("L", (_width(size, letter), _height(size)))
    ImageDraw.Draw(mask).text((0, -_top(size)), letter, 255, font)
    ink = np.asarray(mask, np.float32)[..., None] / 255
    dark, tint = np.array(_DARK), (np.array(WHITE) + np.array(colour)) / 2
    return np.asarray((dark + ink * (tint - dark)).round(), np.uint8)


@cache
def _width(size: int, letter: str) -> int:
    return max(round(_load_font(size).getlength(letter)), 1)


@cache
def _height(size: int) -> int:
    return ceil(_load_font(size).getbbox(_TALLEST)[3]) - _top(size)


@cache
def _top(size: int) -> int:
    return floor(_load_font(size).getbbox(_TALLEST)[1])


_TALLEST = "Δθy("
