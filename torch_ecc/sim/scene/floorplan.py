"""The layout of an imagined integrated circuit: blocks of cells, buses, combs and bond pads between streets.

A block is a box (x0, y0, x1, y1) in px of the scene; what fills it comes as rectangles whose levels add up.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import atan2, hypot
from random import Random

from torch_ecc.sim.scene.layout import Rectangle

Box = tuple[float, float, float, float]

METAL, WELL, GATE, RIM = 64.0, -32.0, -28.0, -62.0  # grey levels over the substrate
RIM_WIDTH = 1.7  # px of the dark edge that a step in height shows
STREET = 12.0  # px between blocks
LARGEST, SMALLEST = 190.0, 60.0  # px of a block's side


def circuit(box: Box, seed: int) -> Iterator[Rectangle]:
    """A whole circuit in ``box``, the same for the same seed. The block over the origin is one of cells."""
    draw = Random(seed)
    for block in _split(box, draw):
        fill = draw.choices((cells, bus, comb, pad), (5, 3, 2, 1.5))[0]
        over_origin = block[0] <= 0 <= block[2] and block[1] <= 0 <= block[3]
        yield from (cells if over_origin else fill)(block, draw)


def cells(box: Box, draw: Random) -> Iterator[Rectangle]:
    """Rows of transistors: a well, a gate across it, contacts on both sides and a strap over some of them."""
    width, height = draw.uniform(24, 36), draw.uniform(26, 40)
    for x, y in _grid(box, width, height):
        yield from raised(x, y, width - 7, height - 8, WELL)
        if draw.random() < 0.12:
            continue
        yield Rectangle(x, y, 3.2, height - 3, GATE)
        reach = 0.26 * width
        for side in (-1, 1):
            for row in range(draw.choice((1, 2, 2, 3))):
                yield from raised(x + side * reach, y - 0.25 * height + 7.5 * row, 3.4, 3.4, 0.9 * METAL)
        if draw.random() < 0.45:
            yield from raised(x + draw.choice((-1, 1)) * reach, y + 0.22 * height, 4.4, 0.3 * height, METAL)
        if draw.random() < 0.3:
            yield from raised(x + 0.5 * width, y - 0.3 * height, 0.55 * width, 4.0, METAL)


def bus(box: Box, draw: Random) -> Iterator[Rectangle]:
    """Parallel traces along the longer side, all with one jog at 45 degrees, some cut short with a via at the end."""
    x0, y0, x1, y1 = box
    upright = y1 - y0 > x1 - x0
    length, across = (y1 - y0, x1 - x0) if upright else (x1 - x0, y1 - y0)
    pitch, jog = draw.uniform(9, 14), draw.choice((0.0, 0.0, 12.0, 18.0))
    middle = draw.uniform(0.35, 0.65) * length
    for k in range(int((across - jog) / pitch)):
        lane = (k + 0.5) * pitch
        start = draw.uniform(0.05, 0.3) * length if draw.random() < 0.25 else 0.0
        path = [(start, lane), (middle - jog / 2, lane), (middle + jog / 2, lane + jog), (length, lane + jog)]
        points = [(x0 + v, y0 + u) if upright else (x0 + u, y0 + v) for u, v in path]
        yield from trace(points, 0.42 * pitch)
        if start:
            yield from raised(*points[0], 0.62 * pitch, 0.62 * pitch, 0.35 * METAL)


def comb(box: Box, draw: Random) -> Iterator[Rectangle]:
    """Two interleaved combs of metal, the fingers of a capacitor."""
    x0, y0, x1, y1 = box
    pitch, spine = draw.uniform(10, 16), 9.0
    yield from raised((x0 + x1) / 2, y0 + spine / 2, x1 - x0, spine, METAL)
    yield from raised((x0 + x1) / 2, y1 - spine / 2, x1 - x0, spine, METAL)
    length = y1 - y0 - 2 * spine - 10
    for k in range(int((x1 - x0) / pitch)):
        x = x0 + (k + 0.5) * pitch
        y = y0 + spine + length / 2 if k % 2 else y1 - spine - length / 2
        yield Rectangle(x, y, 0.45 * pitch + 2 * RIM_WIDTH, length, RIM)
        yield Rectangle(x, y, 0.45 * pitch, length, METAL - RIM)


def pad(box: Box, draw: Random) -> Iterator[Rectangle]:
    """A bond pad: flat bright metal with a field of vias in one part of it."""
    x0, y0, x1, y1 = box
    yield from raised((x0 + x1) / 2, (y0 + y1) / 2, x1 - x0 - 6, y1 - y0 - 6, METAL)
    part = draw.uniform(0.3, 0.6)
    field = (x0 + 8, y0 + 8, x1 - 8, y0 + 8 + part * (y1 - y0 - 16))
    for x, y in _grid(field, 9.0, 9.0):
        yield Rectangle(x, y, 3.6, 3.6, 0.8 * RIM)


def raised(x: float, y: float, width: float, height: float, level: float) -> Iterator[Rectangle]:
    """A rectangle with the dark rim that a step in height shows under a microscope."""
    yield Rectangle(x, y, width + 2 * RIM_WIDTH, height + 2 * RIM_WIDTH, RIM)
    yield Rectangle(x, y, width, height, level - RIM)


def trace(points: list[tuple[float, float]], width: float) -> Iterator[Rectangle]:
    """A rimmed line of metal through ``points``."""
    for (xa, ya), (xb, yb) in pairwise(points):
        length = hypot(xb - xa, yb - ya)
        if length < 1:
            continue
        theta = atan2(ya - yb, xb - xa)  # y points down: a line going down has a negative angle
        x, y = (xa + xb) / 2, (ya + yb) / 2
        yield Rectangle(x, y, length, width + 2 * RIM_WIDTH, RIM, theta)
        yield Rectangle(x, y, length, width, METAL - RIM, theta)


def _split(box: Box, draw: Random) -> Iterator[Box]:
    """Cut a box in two, again and again, until the blocks are small; a street is left at every cut."""
    x0, y0, x1, y1 = box
    sides = (x1 - x0, y1 - y0)
    axis = int(sides[1] > sides[0])
    if sides[axis] < LARGEST or (max(sides) < 1.6 * LARGEST and min(sides) < SMALLEST):
        yield box
        return
    cut = box[axis] + draw.uniform(0.35, 0.65) * sides[axis]
    first, second = list(box), list(box)
    first[axis + 2], second[axis] = cut - STREET / 2, cut + STREET / 2
    for part in (first, second):
        yield from _split((part[0], part[1], part[2], part[3]), draw)


def _grid(box: Box, width: float, height: float) -> Iterator[tuple[float, float]]:
    """Centres of as many width x height cells as fit into a box, evenly spread."""
    x0, y0, x1, y1 = box
    columns, rows = int((x1 - x0) / width), int((y1 - y0) / height)
    for j in range(rows):
        for i in range(columns):
            yield x0 + (i + 0.5) * (x1 - x0) / columns, y0 + (j + 0.5) * (y1 - y0) / rows
