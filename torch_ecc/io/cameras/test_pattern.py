"""A camera without a camera: a texture that goes round on a circle by whole pixels, on the beat."""

from __future__ import annotations

import math
import re
import time

import cv2
import numpy as np

from torch_ecc.io.cameras.newest import Newest
from torch_ecc.io.frames import Pixels

RADIUS = 16  # px
TURN_S = 2.0
BUFFERS = 4  # pictures that wait for their reader, as in a driver


def open_test(which: str) -> tuple[Newest, float]:
    """WIDTHxHEIGHT@HZ, by default 640x480@100: frame k shows the texture moved right and down by ``moved(k, hz)``."""
    told = re.fullmatch(r"(\d+)x(\d+)(?:@(\d+(?:\.\d+)?))?", which or "640x480@100")
    if not told:
        raise ValueError(f"open_frames: a test camera is WIDTHxHEIGHT@HZ, got {which!r}")
    width, height, hz = int(told[1]), int(told[2]), float(told[3] or 100)
    large = _texture(height + 2 * RADIUS, width + 2 * RADIUS)
    begun, count = time.perf_counter(), -1

    def read() -> tuple[Pixels, int]:
        nonlocal count
        count = max(count + 1, math.floor((time.perf_counter() - begun) * hz) - BUFFERS)
        time.sleep(max(begun + (count + 1) / hz - time.perf_counter(), 0.0))
        x, y = moved(count, hz)
        return large[RADIUS - y : RADIUS - y + height, RADIUS - x : RADIUS - x + width].copy(), count

    return Newest(read), hz


def moved(number: int, hz: float) -> tuple[int, int]:
    """Where the texture is in a frame, px from its middle."""
    angle = 2 * math.pi * number / (hz * TURN_S)
    return round(RADIUS * math.sin(angle)), round(RADIUS * math.cos(angle))


def _texture(height: int, width: int) -> Pixels:
    """Grey levels, uint8, of some pixels' grain."""
    noise = np.random.default_rng(0).standard_normal((height, width)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(np.clip(128 + 45 * soft / soft.std(), 0, 255), np.uint8)
