"""Cameras that expose one row after the other: a template that moves is seen sheared and stretched, which is no turn.

A point of the target that is seen n rows below its centre is seen n line times later, and has moved on. To first order,

    x = t + R x' + s v (x - t)_y    =    t + (I + s v e_y^T / (1 - s v_y)) R x' ,

with v the centre's velocity in px per frame and s the line time in frames. The pose that is found is that of the
instant at which the row of the template's centre is exposed. The velocity is that of a polynomial through this pose and
the last ones, so that the frame is looked at again until it no longer changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Self

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Origin, Status
from torch_ecc.core.pose import rotation, turn
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import is_cpu

NODES = 4  # earlier poses that a velocity is of: at 0.7 rad per frame, it is right to 4 %
OLDEST = 12.0  # frames: what is older tells nothing of how it moves now
PASSES = 4  # of one frame
LARGEST = 0.5  # of |s v|: a target that moves on by half of what is read out is not to be recognised

BENDS = [3, 4]  # of blocks.STRAINS

State = Mapping[str, Tensor]


class Shutter(NamedTuple):
    """``line``: frames from one row to the next, 0 for all rows at once."""

    line: float

    @classmethod
    def of(cls, line_time: float | None, fps: float | None) -> Self:
        """Of a camera's times. ValueError for such that none has."""
        if line_time is None:
            return cls(0.0)
        if isinstance(line_time, bool) or not isinstance(line_time, int | float) or not math.isfinite(line_time):
            raise ValueError(f"line_time: expected seconds from one row to the next, got {line_time!r}")
        if fps is None or isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < math.inf:
            raise ValueError(f"fps: expected a rate > 0 in frames per second with line_time, got {fps!r}")
        return cls(line_time * fps)

    def check(self, rows: int) -> None:
        """ValueError for more ``rows`` than a frame's time is enough for."""
        if abs(self.line) * rows > 1.001:
            most = f"the {rows} rows of a frame to be read out before the next one is"
            raise ValueError(f"line_time: expected {most}, got {abs(self.line) * rows:.3g} times the time of a frame")

    def beginning(self, start: Tensor) -> dict[str, Tensor]:
        """What a tracker's state holds of earlier poses: how many frames ago they were, newest first, 0 for none."""
        if self.line == 0:
            return {}
        past = start[:, None].repeat(1, NODES, 1)
        ages = torch.zeros_like(past[:, :, 0])
        ages[:, 0] = 1
        return {"past_poses": past, "past_ages": ages}

    def solve(
        self,
        solve: Callable[[Reference, Tensor], Estimate],
        reference: Reference,
        start: Tensor,
        state: State,
        tolerance: float,
    ) -> Estimate:
        """What ``solve`` finds of a frame from ``start`` (R, 3) on when it knows how the templates are distorted."""
        if self.line == 0:
            return solve(reference, start)
        distortion = self.distorted(start, state)
        for _ in range(PASSES):
            estimate = solve(reference.distorted(distortion), start)
            good = Status.good(estimate.status)
            start = torch.where(good[:, None], estimate.pose.detach(), start)
            last, distortion = distortion, self.distorted(start, state)
            change = (distortion - last).flatten(1).norm(dim=1) * reference.place.radius
            if is_cpu(start.device) and not bool((good & (change > tolerance)).any()):
                break
        turned, age = start[:, 2] - state["past_poses"][:, 0, 2], state["past_ages"][:, 0]
        return self.straightened(reference, estimate, torch.where(age > 0, turned / age.clamp(min=1), 0.0))

    def straightened(self, reference: Reference, estimate: Estimate, turning: Tensor) -> Estimate:
        """The ``estimate`` less what templates that are ``turning`` (R,) rad per frame are shifted by because they are
        bent: their rows turn one after the other. (In theta that is next to nothing, and stays.)"""
        theta, inverse, radius = estimate.pose[:, 2], reference.normal.inverse[:, :3], reference.place.radius
        bends = reference.parts.strain[:, :, BENDS].sum(3, dtype=theta.dtype)
        size = torch.stack((theta.cos(), -theta.sin()), 1) * (self.line * turning * radius.square())[:, None]
        shift = (turn(theta) @ inverse @ bends @ size[:, :, None])[:, :, 0] * theta.new_tensor((1.0, 1.0, 0.0))
        shift = torch.where(Status.good(estimate.status)[:, None], shift, 0.0)
        return estimate._replace(pose=estimate.pose - shift, displacement=estimate.displacement - shift)

    def distortion(self, pose: Tensor, state: State) -> Tensor | None:
        """``distorted``, None if all rows are exposed at once."""
        return None if self.line == 0 else self.distorted(pose, state)

    def distorted(self, pose: Tensor, state: State) -> Tensor:
        """D (R, 2, 2): templates at ``pose`` (R, 3) are seen at x = R (I + D) x' + t."""
        moved = self.line * self.velocity(pose, state)[:, :2]  # from one row to the next
        moved = moved * (LARGEST / moved.norm(dim=1, keepdim=True).clamp(min=LARGEST))
        turn = rotation(pose[:, 2])
        distortion: Tensor = turn.mT @ (moved / (1 - moved[:, 1:2]))[:, :, None] @ turn[:, 1:]
        return distortion.contiguous()

    def velocity(self, pose: Tensor, state: State) -> Tensor:
        """Of templates at ``pose`` (R, 3), px, px, rad per frame: that of the polynomial through it and the earlier
        ones (Newton's divided differences)."""
        past, ages = state["past_poses"], state["past_ages"]
        known = (ages > 0) & (ages < OLDEST)
        ago = (ages + self.line * (pose[:, 1:2] - past[:, :, 1])).clamp(min=0.1)
        times = torch.cat((torch.zeros_like(ago[:, :1]), -ago), 1)
        values = torch.cat((pose[:, None], past), 1)
        velocity, product = torch.zeros_like(pose), torch.ones_like(ago[:, :1])
        for order in range(1, NODES + 1):
            apart = times[:, :-order] - times[:, order:]
            values = (values[:, :-1] - values[:, 1:]) / apart[:, :, None]
            velocity = velocity + torch.where(known[:, order - 1, None], values[:, 0] * product, 0.0)
            product = product * ago[:, order - 1, None]
        return velocity

    def remember(self, state: State, estimate: Estimate) -> None:
        """One frame on: what was tracked is the newest of the earlier poses, what a search has found the only one."""
        if self.line == 0:
            return
        self.wait(state)
        past, ages = state["past_poses"], state["past_ages"]
        good, found = Status.good(estimate.status), estimate.origin != Origin.TRACKED
        newer = torch.cat((estimate.pose.detach()[:, None], past[:, :-1]), 1)
        younger = torch.cat((torch.ones_like(ages[:, :1]), torch.where(found[:, None], 0.0, ages[:, :-1])), 1)
        past.copy_(torch.where(good[:, None, None], newer, past))
        ages.copy_(torch.where(good[:, None], younger, ages))

    def wait(self, state: State) -> None:
        """One frame on, of which nothing is known."""
        if self.line != 0:
            state["past_ages"].add_(state["past_ages"] > 0)
