"""How a tracked template is drawn: outline, centre and x axis, recent path, and a label where there is room for it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.io.canvas import Box, Canvas, Colour
from torch_ecc.io.records import CONVERGED, DOUBTFUL
from torch_ecc.pose import transform

_COLOURS: dict[str, Colour] = {CONVERGED: (90, 225, 70), DOUBTFUL: (0, 165, 255)}
_LOST: Colour = (70, 70, 255)
_TRAIL: Colour = (255, 215, 90)
_Side: TypeAlias = Literal["above", "below", "right", "left", "inside", "tag"]
_SIDES: tuple[_Side, ...] = ("above", "below", "right", "left", "inside")


class Mark(NamedTuple):
    """A template in a frame: ``pose`` (3,), ``outlines`` (N, 2) from its centre, ``trail`` of (x, y), all in px."""

    number: int
    pose: Tensor
    score: float
    word: str
    outlines: list[Tensor]
    trail: Collection[NDArray[np.float64]]

    @property
    def lost(self) -> bool:
        """Whether the pose is an old one."""
        return self.word not in _COLOURS

    @property
    def colour(self) -> Colour:
        """Green for converged, orange for doubtful, red for lost."""
        return _COLOURS.get(self.word, _LOST)

    def on_frame(self, points: Tensor) -> NDArray[np.float64]:
        """Template points (N, 2) to frame points (N, 2)."""
        return transform(self.pose, points).numpy()

    def box(self, canvas: Canvas) -> Box:
        """What the outline takes of the canvas."""
        points = canvas.place(np.vstack([self.on_frame(line) for line in self.outlines]))
        (x, y), (right, bottom) = points.min(0).astype(int), points.max(0).astype(int)
        return Box(int(x), int(y), int(right - x), int(bottom - y))

    def text(self, side: _Side) -> str:
        """The words of the label: all of them, or only the number (and LOST) for a tag."""
        x, y, theta = self.pose.tolist()
        reason = "" if self.word == "LOST" else f" ({self.word.replace('_', ' ').lower()})"
        if side == "tag":
            return f"{self.number} LOST" if self.lost else str(self.number)
        if self.lost:
            return f"{self.number}   LOST{reason}\nlast at  x {x:.2f}   y {y:.2f}"
        return f"{self.number}   x {x:.2f}   y {y:.2f}\nθ {np.degrees(theta):.3f}°   score {self.score:.3f}"


def draw(canvas: Canvas, mark: Mark) -> None:
    """Everything but the label."""
    if len(mark.trail) > 1:
        canvas.line(np.stack(tuple(mark.trail)), _TRAIL)
    for line in mark.outlines:
        canvas.line(mark.on_frame(line), mark.colour, closed=True, width=1.5)
    reach = float(min(torch.vstack(mark.outlines).amax(0)))
    for axis in _cross(reach):
        canvas.line(mark.on_frame(axis), mark.colour)


def _cross(reach: float) -> tuple[Tensor, Tensor]:
    """The centre cross as a y line and an x line; the x line is drawn out to the right and ends in an arrow head."""
    arm, tip = 0.15 * reach, 0.5 * reach
    head = 0.08 * reach
    across = ((0.0, -arm), (0.0, arm))
    along = ((-arm, 0.0), (tip, 0.0), (tip - head, -head), (tip, 0.0), (tip - head, head))
    return torch.tensor(across, dtype=torch.float64), torch.tensor(along, dtype=torch.float64)


class Labels:
    """Where the labels go: beside their templates, on the sides that were free in the first frame.

    The sides stay, so that labels do not jump about; a template without a free side gets a small tag.
    """

    def __init__(self, canvas: Canvas, marks: Sequence[Mark], reserved: Box) -> None:
        boxes = [mark.box(canvas) for mark in marks]
        taken, self._sides = [reserved], []
        for index, mark in enumerate(marks):
            size = canvas.measure(mark.text("above"))
            others = boxes[:index] + boxes[index + 1 :]
            side, spot = _choose(canvas, boxes[index], size, (taken, others))
            self._sides.append(side)
            taken.append(spot)

    def draw(self, canvas: Canvas, marks: Sequence[Mark]) -> None:
        """The labels of the same templates in any frame."""
        for mark, side in zip(marks, self._sides, strict=True):
            text = mark.text(side)
            spot = _spot(side, mark.box(canvas), canvas.measure(text), canvas.gap)
            canvas.label(spot.x, spot.y, text, mark.colour)


def _choose(
    canvas: Canvas, box: Box, size: tuple[int, int], around: tuple[Sequence[Box], Sequence[Box]]
) -> tuple[_Side, Box]:
    """The side that hides least of the other templates, among those clear of the labels so far and of the edges."""
    labels, templates = around
    height, width = canvas.image.shape[:2]
    best: tuple[int, _Side, Box] | None = None
    for side in _SIDES:
        spot = _spot(side, box, size, canvas.gap)
        clear = spot.overlap(Box(0, 0, width, height)) == spot.w * spot.h and not any(map(spot.overlap, labels))
        fits = side != "inside" or (box.w > 2 * spot.w and box.h > 4 * spot.h)
        hidden = sum(map(spot.overlap, templates))
        if clear and fits and (best is None or hidden < best[0]):
            best = hidden, side, spot
    return best[1:] if best else ("tag", _spot("tag", box, (size[0] // 8, size[1] // 2), canvas.gap))


def _spot(side: _Side, box: Box, size: tuple[int, int], gap: int) -> Box:
    w, h = size
    corner = {
        "above": (box.x, box.y - h - gap),
        "below": (box.x, box.y + box.h + gap),
        "right": (box.x + box.w + gap, box.y),
        "left": (box.x - w - gap, box.y),
        "inside": (box.x + gap, box.y + gap),
        "tag": (box.x, box.y),
    }
    return Box(*corner[side], w, h)
