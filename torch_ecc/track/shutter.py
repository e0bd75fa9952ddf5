"""Cameras that expose one row after the other: a template that moves is seen sheared and stretched, which is no turn.

A point of the target that is seen n rows below its centre is seen n line times later, and has moved on. To first order,

    x = t + R x' + s v (x - t)_y    =    t + (I + s v e_y^T / (1 - s v_y)) R x' ,

with v the centre's velocity in px per frame and s the line time in frames. The pose that is found is that of the
instant at which the row of the template's centre is exposed. The velocity is that of a polynomial through this pose and
the last ones, so that the frame is looked at again until it no longer changes. Of its degrees the one is taken with
which least is expected to be wrong: noise, which a higher one amplifies, and what the next degree would add, as it has
lately. That is how uncertain the velocity is, and how much more uncertain the pose by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from torch_ecc.core.estimate import Estimate, Origin, Status
from torch_ecc.core.pose import rotation, turn
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import is_cpu

NODES = 6  # earlier poses that a velocity may be of; one more tells how much is missing
OLDEST = 12.0  # frames: what is older tells nothing of how it moves now
PASSES = 4  # of one frame
LARGEST = 0.5  # of |s v|: a target that moves on by half of what is read out is not to be recognised

NEWEST = 0.3  # of the mean square of what a degree adds is this frame's
LEAST_NOISE = 2e-3  # px of a pose: what no noise model knows, as the sampler's own errors
FALLS = 0.5  # by so much its square falls, at least, from one degree to a next one that nobody knows
STRETCHES, BENDS = slice(0, 3), slice(3, 5)  # of blocks.STRAINS

State = Mapping[str, Tensor]


class Motion(NamedTuple):
    """Of R templates: ``velocity`` and ``acceleration`` (R, 3) px, px, rad per frame and per frame^2; how wrong both
    are expected to be, ``of_velocity`` and ``of_acceleration`` (R, 3), squared."""

    velocity: Tensor
    acceleration: Tensor
    of_velocity: Tensor
    of_acceleration: Tensor

    def at(self, pose: Tensor, covariance: Tensor, later: Tensor) -> tuple[Tensor, Tensor]:
        """Where what is at ``pose`` (..., 3) with a ``covariance`` (..., 3, 3) is so many frames ``later`` (...)."""
        t = later[..., None]
        more = self.of_velocity * t.square() + self.of_acceleration * t.square().square() / 4
        return pose + self.velocity * t + self.acceleration * t.square() / 2, covariance + torch.diag_embed(more)


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
        past = start[:, None].repeat(1, NODES + 1, 1)
        ages = torch.zeros_like(past[:, :, 0])
        ages[:, 0] = 1
        more = {"past_missing": torch.zeros_like(past), "past_noise": torch.zeros_like(start)}
        return {"past_poses": past, "past_ages": ages, **more}

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
        motion = self.motion(estimate.pose.detach(), state)
        return self.in_doubt(reference, self.straightened(reference, estimate, motion), motion)

    def in_doubt(self, reference: Reference, estimate: Estimate, motion: Motion) -> Estimate:
        """The ``estimate`` as uncertain as its ``motion`` makes it: an error of that feigns a turn, and strains that
        move the fit."""
        theta, inverse, radius = estimate.pose[:, 2], reference.normal.inverse[:, :3], reference.place.radius
        turned = rotation(theta)
        by = self.line * torch.einsum("bki,bj->bijk", turned, turned[:, 1])  # (R, 2, 2, 2): D by x and y of the error
        grows, stretches = by[:, 0, 0] + by[:, 1, 1], by[:, 0, 0] - by[:, 1, 1]
        leans, turns = by[:, 0, 1] + by[:, 1, 0], by[:, 0, 1] - by[:, 1, 0]
        strains = torch.stack((grows, stretches, leans), 1) * radius[:, None, None] / 2
        shift = inverse @ reference.parts.strain[:, :, STRETCHES].sum(3, dtype=theta.dtype) @ strains
        shift[:, 2] += turns / 2
        shift = turn(theta) @ shift
        more = shift @ torch.diag_embed(motion.of_velocity[:, :2]) @ shift.mT
        more[:, :2, :2] += torch.diag_embed(motion.of_acceleration[:, :2] * self.bent(radius)[:, None].square())
        return estimate._replace(covariance=estimate.covariance + more)

    def bent(self, radius: Tensor) -> Tensor:
        """By what a unit of acceleration shifts templates (R,): the mean over their rows, as of squares."""
        return (self.line * radius).square() / 12

    def straightened(self, reference: Reference, estimate: Estimate, motion: Motion) -> Estimate:
        """The ``estimate`` less what templates are shifted by because they are bent: their rows turn one after the
        other, and are ever faster. (In theta that is next to nothing, and stays.)"""
        theta, inverse, radius = estimate.pose[:, 2], reference.normal.inverse[:, :3], reference.place.radius
        bends = reference.parts.strain[:, :, BENDS].sum(3, dtype=theta.dtype)
        size = (
            torch.stack((theta.cos(), -theta.sin()), 1) * (self.line * motion.velocity[:, 2] * radius.square())[:, None]
        )
        shift = (turn(theta) @ inverse @ bends @ size[:, :, None])[:, :, 0] + motion.acceleration * self.bent(radius)[
            :, None
        ]
        shift = torch.where(Status.good(estimate.status)[:, None], pad(shift[:, :2], (0, 1)), 0.0)
        return estimate._replace(pose=estimate.pose - shift, displacement=estimate.displacement - shift)

    def distortion(self, pose: Tensor, state: State) -> Tensor | None:
        """``distorted``, None if all rows are exposed at once."""
        return None if self.line == 0 else self.distorted(pose, state)

    def distorted(self, pose: Tensor, state: State) -> Tensor:
        """D (R, 2, 2): templates at ``pose`` (R, 3) are seen at x = R (I + D) x' + t."""
        moved = self.line * self.motion(pose, state).velocity[:, :2]  # from one row to the next
        moved = moved * (LARGEST / moved.norm(dim=1, keepdim=True).clamp(min=LARGEST))
        turn = rotation(pose[:, 2])
        distortion: Tensor = turn.mT @ (moved / (1 - moved[:, 1:2]))[:, :, None] @ turn[:, 1:]
        return distortion.contiguous()

    def motion(self, pose: Tensor, state: State) -> Motion:
        """That of templates at ``pose`` (R, 3) after the earlier ones."""
        weights, faster, known = self.weights(pose, state)
        terms = weights @ torch.cat((pose[:, None], state["past_poses"]), 1)  # (R, NODES + 1, 3), of each degree
        missing = torch.maximum(terms.square(), lately(terms, state)) * known[:, :, None]
        missing[:, 1:] = torch.where(known[:, 1:, None], missing[:, 1:], FALLS * missing[:, :-1])
        noise = state["past_noise"].clamp(min=LEAST_NOISE**2)[:, None]
        of_velocity, of_acceleration = (
            (w.cumsum(1).square().sum(2)[:, :, None] * noise)[:, :-1] + more[:, 1:]  # with the first n degrees
            for w, more in ((weights, missing), (faster[:, :, None] * weights, missing * faster[:, :, None].square()))
        )
        likely = torch.where(known[:, :-1], of_velocity[:, :, :2].sum(2), torch.inf).argmin(1)
        taken = (likely[:, None] >= torch.arange(NODES, device=pose.device)) & known[:, :-1]
        terms, at = terms[:, :-1] * taken[:, :, None], likely[:, None, None].expand(-1, 1, 3)
        sums = terms.sum(1), (terms * faster[:, :-1, None]).sum(1)
        return Motion(*sums, *(square.gather(1, at)[:, 0] for square in (of_velocity, of_acceleration)))

    def weights(self, pose: Tensor, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """What each degree of the polynomial through ``pose`` (R, 3) and the earlier ones adds to the velocity at the
        pose, by the values of it and of each of them, (R, NODES + 1, NODES + 2); so many times as much to the
        acceleration, (R, NODES + 1); whether they are known, (R, NODES + 1): Newton's divided differences."""
        past, ages = state["past_poses"], state["past_ages"]
        known = (ages > 0) & (ages < OLDEST)
        ago = (ages + self.line * (pose[:, 1:2] - past[:, :, 1])).clamp(min=0.1)
        times = torch.cat((torch.zeros_like(ago[:, :1]), -ago), 1)
        values = torch.eye(NODES + 2, dtype=pose.dtype, device=pose.device).expand(len(pose), -1, -1)
        product, added = torch.ones_like(ago[:, :1]), []
        for order in range(1, NODES + 2):
            apart = torch.where(known[:, order - 1 :], times[:, :-order] - times[:, order:], 1.0)
            values = (values[:, :-1] - values[:, 1:]) / apart[:, :, None]
            added.append(torch.where(known[:, order - 1, None], values[:, 0] * product, 0.0))
            product = product * ago[:, order - 1, None]
        return torch.stack(added, 1), 2 * ((1 / ago).cumsum(1) - 1 / ago), known

    def newest(self, state: State) -> Motion:
        """That of the templates of a ``state`` in the newest frame, which it holds already."""
        past, ages = state["past_poses"], state["past_ages"]
        older = {"past_poses": past.roll(-1, 1), "past_ages": (ages.roll(-1, 1) - ages[:, :1]).clamp(min=0)}
        older["past_ages"][:, -1] = 0
        return self.motion(past[:, 0], {**state, **older})

    def throughout(self, track: Estimate) -> Motion:
        """That of R templates in each frame of a ``track`` (F, R, ...) by the frames before: (F, R, 3)."""
        good, count = Status.good(track.status) & (track.origin == Origin.TRACKED), len(track.pose)
        frame = torch.arange(count, device=track.pose.device)[:, None]
        before = frame - torch.arange(1, NODES + 2, device=frame.device)  # (F, NODES + 1)
        known = (before >= 0)[..., None] & good[before.clamp(min=0)]  # (F, NODES + 1, R)
        past = track.pose[before.clamp(min=0)].transpose(1, 2).flatten(0, 1)
        ages = (frame - before)[..., None] * known
        ages = ages.transpose(1, 2).flatten(0, 1).to(past)
        order = torch.where(ages > 0, ages, torch.inf).argsort(dim=1, stable=True)  # those that are known come first
        past, ages = past.gather(1, order[..., None].expand_as(past)), ages.gather(1, order)
        noise = torch.where(good[..., None], track.covariance.diagonal(0, 2, 3) / 2, 0.0).flatten(0, 1)
        state = {"past_poses": past, "past_ages": ages, "past_noise": noise, "past_missing": torch.zeros_like(past)}
        return Motion(*(v.unflatten(0, good.shape) for v in self.motion(track.pose.flatten(0, 1), state)))

    def remember(self, state: State, estimate: Estimate) -> None:
        """One frame on: what was tracked is the newest of the earlier poses, what a search has found the only one."""
        if self.line == 0:
            return
        weights, _, _ = self.weights(estimate.pose.detach(), state)
        missing = lately(weights @ torch.cat((estimate.pose.detach()[:, None], state["past_poses"]), 1), state)
        noise = estimate.covariance.detach().diagonal(0, 1, 2) / 2
        self.wait(state)
        past, ages = state["past_poses"], state["past_ages"]
        good, found = Status.good(estimate.status), estimate.origin != Origin.TRACKED
        newer = torch.cat((estimate.pose.detach()[:, None], past[:, :-1]), 1)
        younger = torch.cat((torch.ones_like(ages[:, :1]), torch.where(found[:, None], 0.0, ages[:, :-1])), 1)
        tracked = good & ~found
        state["past_missing"].copy_(torch.where(tracked[:, None, None], missing, state["past_missing"]))
        state["past_noise"].copy_(torch.where(tracked[:, None], noise, state["past_noise"]))
        past.copy_(torch.where(good[:, None, None], newer, past))
        ages.copy_(torch.where(good[:, None], younger, ages))

    def wait(self, state: State) -> None:
        """One frame on, of which nothing is known."""
        if self.line != 0:
            state["past_ages"].add_(state["past_ages"] > 0)


def lately(terms: Tensor, state: State) -> Tensor:
    """The mean square of what each degree adds, ``terms`` (R, NODES + 1, 3), over this frame and the last ones."""
    return torch.lerp(state["past_missing"], terms.square(), NEWEST)
