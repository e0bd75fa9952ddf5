"""Watches a servo run: is the target seen, the camera alive, the stage following, the error falling?"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ecc.servo.control import Control
from torch_ecc.servo.record import Ending

MOVING = 0.05  # px per frame that a picture must be expected to change by before an unchanged one is suspicious
FOLLOWS = 0.2  # share of the commanded way that a part must go to count as following
JUDGED = 10.0  # tolerances: a commanded way that is shorter is not judged
NOISE = 3.0  # standard deviations of a measured pose that it may be beyond the tolerance in a single frame
GROWN, ROOM = 2.0, 20.0  # an error is diverging beyond GROWN times its least value so far, and ROOM px above it


class Watch:
    """Counts of one run. ``lost``: frames in a row without the target.

    Lengths are those of pose differences, with rad turned into px at ``radius``.
    """

    def __init__(self, control: Control, radius: float) -> None:
        self.control, self.radius = control, radius
        theta = math.radians(control.tolerance_deg)
        self.tolerance = torch.tensor((control.tolerance_px, control.tolerance_px, theta), dtype=torch.float64)
        self._last: Tensor | None = None
        self.lost = self._frozen = self._within = 0
        self._least = torch.inf
        self._errors: list[Tensor] = []
        self._ways: list[tuple[Tensor, Tensor]] = []  # expected and seen change of the last frames

    def repeated(self, frame: Tensor, expected: Tensor) -> bool:
        """Is this the frame before once more, to the last bit, though the part should have moved by ``expected`` (3,)?

        A camera's noise never repeats itself. Once suspected, a camera stays so until its picture changes.
        """
        same = self._last is not None and torch.equal(frame, self._last)
        moving = self.length(expected) > MOVING
        self._frozen = self._frozen + 1 if same and (moving or self._frozen > 0) else 0
        self._last = frame.clone()
        return self._frozen > 0

    def seen(self, good: bool) -> None:
        """Count the frames without the target."""
        self.lost = 0 if good else self.lost + 1
        if not good:
            self._ways.clear()
            self._least = torch.inf

    def went(self, expected: Tensor, change: Tensor) -> None:
        """Note how the pose should have changed since the last frame, (3,), and how it did."""
        self._ways = [*self._ways[-self.control.patience + 1 :], (expected, change)]

    def judge(self, error: Tensor, sigma: Tensor) -> Ending | None:
        """The end, if an ``error`` (3,) of standard deviation ``sigma`` (3,) and what came before say so."""
        self._errors = [*self._errors[1 - self.control.dwell :], error] if self.control.dwell > 1 else [error]
        near = bool((error.abs() <= self.tolerance + NOISE * sigma).all())
        self._within = self._within + 1 if near else 0
        middle = torch.stack(self._errors).mean(0).abs()
        if self._within >= self.control.dwell and bool((middle <= self.tolerance).all()):
            return Ending.ALIGNED
        length = self.length(error)
        self._least = min(self._least, length)
        if length > max(GROWN * self._least, self._least + ROOM):
            return Ending.DIVERGED
        return Ending.STALLED if self._stalled() else None

    def faults(self) -> Ending | None:
        """The end of the patience with a lost target or a frozen camera."""
        if self._frozen > self.control.patience:
            return Ending.FROZEN
        return Ending.LOST if self.lost > self.control.patience else None

    def length(self, difference: Tensor) -> float:
        """(3,) px, px, rad -> px."""
        return float((difference * difference.new_tensor((1.0, 1.0, self.radius))).norm())

    def _stalled(self) -> bool:
        """Regression of the seen on the expected changes: did the part go less than a fifth of the way it was sent?"""
        if len(self._ways) < self.control.patience:
            return False
        expected, change = (torch.stack(v) for v in zip(*self._ways, strict=True))
        weight = expected.new_tensor((1.0, 1.0, self.radius))
        expected, change = expected * weight, change * weight
        way = float(expected.norm(dim=1).sum())
        share = float((expected * change).sum() / expected.square().sum().clamp(min=1e-12))
        return way > JUDGED * self.control.tolerance_px and share < FOLLOWS
