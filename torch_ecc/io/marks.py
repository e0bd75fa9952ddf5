"""How a tracked template is drawn: outline, centre and x axis, recent path, and a label where there is room for it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.canvas import Box, Canvas, Colour
from torch_ecc.io.records import CONVERGED, DOUBTFUL

_COLOURS: dict[str, Colour] = {CONVERGED: (90, 225, 70), DOUBTFUL: (0, 165, 255)}
_LOST: Colour = (70, 70, 255)
_TRAIL: Colour = (255, 215, 90)
_CROWD = 30  # templates: of more, those that are right are outlines alone,
_ROOM = 8.0  # unless they are so many times as large as their number
_Side: TypeAlias = Literal["above", "below", "right", "left", "tag"]
_Spot: TypeAlias = tuple[_Side, Box]


class Mark(NamedTuple):
    """A template in a frame: ``pose`` (3,) px, px, rad, as a ``warp`` (2, 3) too, ``outlines`` (N, 2) from its centre
    and ``trail`` of (x, y) in px; where the scale is known, what it has ``moved`` (2,) in micrometres."""

    number: int
    pose: NDArray[np.float64]
    warp: NDArray[np.float64]
    score: float
    word: str
    outlines: list[NDArray[np.float64]]
    trail: Collection[tuple[float, float]]
    moved: NDArray[np.float64] | None = None

    @property
    def lost(self) -> bool:
        """Whether the pose is an old one."""
        return self.word not in _COLOURS

    @property
    def colour(self) -> Colour:
        """Green for converged, orange for doubtful, red for lost."""
        return _COLOURS.get(self.word, _LOST)

    def on_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Template points (N, 2) to frame points (N, 2)."""
        placed: NDArray[np.float64] = points @ self.warp[:, :2].T + self.warp[:, 2]
        return placed

    def box(self, canvas: Canvas) -> Box:
        """What the outline takes of the canvas."""
        points = canvas.place(np.vstack([self.on_frame(line) for line in self.outlines]))
        (x, y), (right, bottom) = points.min(0).astype(int), points.max(0).astype(int)
        return Box(int(x), int(y), int(right - x), int(bottom - y))

    def plain(self, canvas: Canvas, count: int) -> bool:
        """Whether one of so many templates is to be an outline alone: where nothing is wrong, in a crowd."""
        if count <= _CROWD or self.word != CONVERGED:
            return False
        box, (w, h) = self.box(canvas), canvas.measure(str(self.number))
        return box.w * box.h < _ROOM * w * h

    def text(self, side: _Side) -> str:
        """The words of the label: all of them, or only the number (and LOST) for a tag."""
        x, y, theta = self.pose.tolist()
        reason = "" if self.word == "LOST" else f" ({self.word.replace('_', ' ').lower()})"
        if side == "tag":
            return f"{self.number} LOST" if self.lost else str(self.number)
        if self.lost:
            return f"{self.number}   LOST{reason}\nlast at  x {x:.2f}   y {y:.2f}"
        um = "" if self.moved is None else "\nΔx {:+.3f} µm   Δy {:+.3f} µm".format(*self.moved)
        return f"{self.number}   x {x:.2f}   y {y:.2f}{um}\nθ {np.degrees(theta):.3f}°   score {self.score:.3f}"


def draw(canvas: Canvas, mark: Mark, count: int) -> None:
    """Everything but the label, of one of so many templates."""
    if mark.plain(canvas, count):
        canvas.lines([mark.on_frame(line) for line in mark.outlines], mark.colour, closed=True)
        return
    if len(mark.trail) > 1:
        canvas.path(np.array(tuple(mark.trail)), _TRAIL)
    canvas.lines([mark.on_frame(line) for line in mark.outlines], mark.colour, closed=True, width=1.5)
    reach = float(np.vstack(mark.outlines).max(0).min())
    canvas.lines([mark.on_frame(axis) for axis in _cross(max(0.12 * reach, 4 * canvas.step))], mark.colour)


def _cross(arm: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The centre cross as a y line and an x line; the x line is drawn out to the right and ends in an arrow head."""
    tip, back, half = 4 * arm, 3.2 * arm, 0.6 * arm
    across = ((0.0, -arm), (0.0, arm))
    along = ((-arm, 0.0), (tip, 0.0), (back, -half), (tip, 0.0), (back, half))
    return np.array(across), np.array(along)


class Labels:
    """Where the labels go: beside their templates, clear of each other and of a ``reserved`` part of the canvas.

    A label stays on its side while there is room, so that it does not jump about. A template without a free side gets a
    small tag; where that is so for most of them at first, all do, and in a crowd only those do that are not right.
    """

    def __init__(self, reserved: Box) -> None:
        self._reserved = reserved
        self._sides: list[_Side] = []

    def draw(self, canvas: Canvas, marks: Sequence[Mark]) -> None:
        """The labels of the same templates as in the frames before."""
        boxes = [mark.box(canvas) for mark in marks]
        spots = self._place(canvas, marks, boxes)
        if not self._sides and 2 * spots.count(None) > len(marks):
            spots = [None] * len(marks)
        self._sides = ["tag" if spot is None else spot[0] for spot in spots]
        for mark, box, spot in zip(marks, boxes, spots, strict=True):
            if mark.plain(canvas, len(marks)):
                continue
            if spot is not None:
                canvas.label(spot[1], mark.text(spot[0]), mark.colour)
                continue
            text = mark.text("tag")
            w, h = canvas.measure(text)
            canvas.label(canvas.clamp(Box(box.x, box.y - h, w, h)), text, mark.colour)

    def _place(self, canvas: Canvas, marks: Sequence[Mark], boxes: Sequence[Box]) -> list[_Spot | None]:
        """The side and place of each label; None for a tag."""
        labels, found = [self._reserved], list[_Spot | None]()
        sides: list[_Side] = self._sides or ["above"] * len(marks)
        for mark, box, before in zip(marks, boxes, sides, strict=True):
            if before == "tag":
                found.append(None)
                continue
            spots = _spots(canvas, box, canvas.measure(mark.text("above")))
            side = _choose(spots, before, labels, boxes)
            found.append(None if side == "tag" else (side, spots[side]))
            if side != "tag":
                labels.append(spots[side])
        return found


def _choose(spots: Mapping[_Side, Box], before: _Side, labels: Sequence[Box], templates: Sequence[Box]) -> _Side:
    """The side, clear of other labels, that hides least of the templates; changing sides must be worth it."""
    costs: dict[_Side, float] = {"tag": 0.35}
    for side, spot in spots.items():
        if not any(map(spot.overlap, labels)):
            hidden = max(spot.overlap(box) / max(box.w * box.h, 1) for box in templates)
            costs[side] = 10 * hidden + (0.1 if side != before else 0.0)
    return min(costs, key=lambda side: costs[side])


def _spots(canvas: Canvas, box: Box, size: tuple[int, int]) -> dict[_Side, Box]:
    """Where a label of a template in ``box`` may go, moved to be on the canvas."""
    w, h = size
    gap = canvas.gap
    corners: dict[_Side, tuple[int, int]] = {
        "above": (box.x, box.y - h - gap),
        "below": (box.x, box.y + box.h + gap),
        "right": (box.x + box.w + gap, box.y),
        "left": (box.x - w - gap, box.y),
    }
    return {side: canvas.clamp(Box(*corner, w, h)) for side, corner in corners.items()}
