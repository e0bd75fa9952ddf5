"""The alignment of section V in three steps: detect both parts, servo the substrate, servo the probe to its landing.

1. Detect the poses of the probe and of the substrate in one frame.
2. Servo the substrate to the desired pose.
3. Servo the probe so that its tip is at its landing point, a point of the substrate, where that is now.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate
from torch_ecc.core.pose import transform
from torch_ecc.servo.control import Control
from torch_ecc.servo.detect import find
from torch_ecc.servo.jacobian import Jacobian
from torch_ecc.servo.loop import Observer, servo
from torch_ecc.servo.plant import Plant
from torch_ecc.servo.record import Ending, Result, Step
from torch_ecc.track.tracker import Tracker

Point: TypeAlias = tuple[float, float]
Detect: TypeAlias = Callable[[Tracker, Tensor], None]
"""Find the template of a tracker in a frame, wherever it is, and let the tracker go on from there."""


class Part(NamedTuple):
    """A part on its stage: the ``plant`` that moves it, the ``tracker`` of one template on it, taught on an earlier
    picture, and the image Jacobian; ``point`` (x', y') px of the template: the probe's tip, the substrate's landing."""

    plant: Plant
    tracker: Tracker
    jacobian: Jacobian
    point: Point


class Alignment(NamedTuple):
    """``detected`` poses (2, 3) of substrate and probe; the results of steps 2 and 3 (None if it did not come to it);
    ``miss`` (2,) px from the landing point to the tip in the last frame, as measured."""

    detected: Tensor
    substrate: Result
    probe: Result | None
    miss: Tensor

    @property
    def results(self) -> list[Result]:
        """Of the servo steps that were begun: the substrate's, the probe's."""
        return [result for result in (self.substrate, self.probe) if result is not None]

    @property
    def ending(self) -> Ending:
        """How the last of them ended."""
        return self.results[-1].ending

    @property
    def aligned(self) -> bool:
        """Did all steps reach their goal?"""
        return self.probe is not None and self.probe.aligned


def align_parts(
    substrate: Part,
    probe: Part,
    desired: Tensor | Sequence[float],
    *,
    detect: Detect | None = None,
    control: Control | None = None,
    observe: Observer | None = None,
) -> Alignment:
    """Bring the substrate to ``desired`` (3,) px, px, rad, and then the probe's tip over its landing point.

    Both parts are tracked all the time: ``observe(frame, estimate, step)`` gets both, the substrate first, and the step
    of the one that moves. ``detect``: step 1, by default ``find``. Raises ValueError as ``servo`` and ``find`` do.
    """
    frame = substrate.plant.frame()
    for part in (substrate, probe):
        (detect or find)(part.tracker, frame)
    both = _Both(substrate, probe, observe)
    detected = torch.cat(both.poses)
    first = servo(
        substrate.plant, substrate.tracker, desired, substrate.jacobian, control=control, observe=both.watch(0)
    )
    if not first.aligned:
        return Alignment(detected, first, None, both.miss)
    pose = both.poses[1][0]
    goal = torch.cat((pose[:2] - both.miss, pose[2:]))
    second = servo(probe.plant, probe.tracker, goal, probe.jacobian, control=control, observe=both.watch(1))
    return Alignment(detected, first, second, both.miss)


class _Both:
    """Both parts, tracked all the time whichever moves; ``poses``, (1, 3) of each, are those in the last frame."""

    def __init__(self, substrate: Part, probe: Part, observe: Observer | None) -> None:
        self.parts, self.observe = (substrate, probe), observe
        self.poses = [part.tracker.pose.cpu() for part in self.parts]

    def watch(self, moving: int) -> Observer:
        """What observes the servo run of part ``moving``: tracks the other one, and tells of both."""
        still = self.parts[1 - moving].tracker

        def watch(frame: Tensor, estimate: Estimate, step: Step) -> None:
            pair = [estimate, still(frame)] if moving == 0 else [still(frame), estimate]
            self.poses = [one.pose.cpu() for one in pair]
            if self.observe is not None:
                self.observe(frame, Estimate(*(torch.cat(v) for v in zip(*pair, strict=True))), step)

        return watch

    @property
    def miss(self) -> Tensor:
        """(2,) px from the landing point to the tip."""
        both = zip(self.parts, self.poses, strict=True)
        landing, tip = (transform(pose[0], pose.new_tensor([part.point]))[0] for part, pose in both)
        return tip - landing
