"""Layouts: where the rectangles of an imagined wafer lie. Deterministic in the seed."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import NamedTuple

EXTENT = 1500.0  # px, side of the square that a layout covers


class Rectangle(NamedTuple):
    """Centre (px, scene), full width and height (px), grey levels added inside, angle (rad, as in a pose)."""

    x: float
    y: float
    width: float
    height: float
    level: float
    theta: float = 0.0


def wafer(pitch: float, contrast: float, seed: int) -> Iterator[Rectangle]:
    """Pads on a grid, each with at most one line towards its right or lower neighbour."""
    if not pitch > 0:
        raise ValueError(f"Pads.wafer: pitch must be > 0, got {pitch}")
    draw = random.Random(seed)
    count = int(EXTENT / pitch)
    # An odd shift of the grid puts a pad's corner, not its flat middle, at the origin.
    for i in range(-count // 2, count // 2 + 1):
        for j in range(-count // 2, count // 2 + 1):
            x, y = (i + 0.3) * pitch, (j + 0.35) * pitch
            width, height = (pitch * draw.uniform(0.35, 0.6) for _ in range(2))
            yield Rectangle(x, y, width, height, contrast)
            line = draw.choice(("right", "down", "none"))
            if line == "right":
                length = 0.4 * pitch
                yield Rectangle(x + (width + length) / 2, y, length, 0.05 * pitch, contrast)
            elif line == "down":
                length = 0.4 * pitch
                yield Rectangle(x, y + (height + length) / 2, 0.05 * pitch, length, contrast)
