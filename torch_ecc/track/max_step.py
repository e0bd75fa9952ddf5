"""The largest step from one frame to the next, as people know it who know their stage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Reason, Status
from torch_ecc.core.pose import unwrap
from torch_ecc.track.lost import disproved


class MaxStep(NamedTuple):
    """At most ``length`` px and ``angle`` rad per frame; infinite where nobody knows."""

    length: float = math.inf
    angle: float = math.inf

    @staticmethod
    def of(step: Sequence[float] | None) -> MaxStep:
        """From (px, deg). ValueError for anything else."""
        if step is None:
            return MaxStep()
        numbers = list(step) if isinstance(step, Sequence) and not isinstance(step, str) else [step]
        if len(numbers) != 2 or not all(isinstance(n, int | float) and n > 0 for n in numbers):
            raise ValueError(f"max_step: expected (px, deg) per frame, both > 0, got {step!r}")
        return MaxStep(float(numbers[0]), math.radians(numbers[1]))

    @property
    def known(self) -> bool:
        return min(self) < math.inf

    def kept(self, estimate: Estimate, state: Mapping[str, Tensor]) -> Estimate:
        """The ``estimate`` in which those are lost that are farther from their last pose in the ``state`` of a tracker
        than that allows."""
        if not self.known:
            return estimate
        beyond = self.exceeded(estimate.pose, state["pose"], state["since"])
        return disproved(estimate, beyond & Status.good(estimate.status), Reason.TOO_FAR)

    def exceeded(self, pose: Tensor, last: Tensor, since: Tensor, slack: tuple[float, float] = (0.0, 0.0)) -> Tensor:
        """Which poses (..., 3) are farther from the ``last`` (..., 3) good ones than ``since`` (...) frames allow, and
        by more than the ``slack`` in px and rad."""
        moved = pose - last
        turned = unwrap(moved[..., 2], torch.zeros_like(moved[..., 2])).abs()
        length = torch.hypot(moved[..., 0], moved[..., 1])
        return (length > self.length * since + slack[0]) | (turned > self.angle * since + slack[1])

    def reach(self, since: Tensor, radius: Tensor) -> Tensor:
        """How far (...) the pixel at ``radius`` (...) px from the centre can have gone in ``since`` (...) frames."""
        return since * (self.length + radius * min(self.angle, math.pi))
