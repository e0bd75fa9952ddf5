"""The servo loop: frame, pose, velocity, until the part is where it should be, or something is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TypeAlias

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import transform, unwrap
from torch_ecc.servo.control import Control, Controller
from torch_ecc.servo.detect import find
from torch_ecc.servo.jacobian import Jacobian, planned_move, pseudo_inverse
from torch_ecc.servo.plant import Plant, read_limits
from torch_ecc.servo.record import Ending, Log, Result, Step
from torch_ecc.servo.watch import Watch
from torch_ecc.track.tracker import Tracker

Observer: TypeAlias = Callable[[Tensor, Estimate, Step], None]
SEARCH_EVERY = 5  # frames without the target from one search to the next
UNREACHABLE = 20.0  # tolerances: a component that no axis moves must not be further off than that


def servo(
    plant: Plant,
    tracker: Tracker,
    desired: Tensor | Sequence[float],
    jacobian: Jacobian,
    *,
    control: Control | None = None,
    observe: Observer | None = None,
) -> Result:
    """Drive the first template of ``tracker`` to the pose ``desired`` (3,) px, px, rad, by eqs. (12) and (13).

    ``jacobian``: the image Jacobian, ``StageJacobian`` for instance, right in sign and roughly in size. theta takes
    the shorter way round. ``observe(frame, estimate, step)`` is called after each command. Whatever happens, an error
    in here included, the last command is velocity zero (it alone may exceed the acceleration).

    What goes wrong on the way: a lost target or a repeated frame brakes the stage; it goes on when the target is seen
    again, and ends after ``control.patience`` frames. A stage that does not follow and an error that grows end it, too.
    Ctrl-C returns what was done, as INTERRUPTED.

    Raises ValueError before anything moves if the desired pose is outside the view or beyond what the axes and their
    travel reach, or if L is singular.
    """
    run = _Run.checked(plant, tracker, desired, jacobian, control or Control())
    steps: list[Step] = []
    ending: Ending | None = None
    try:
        while ending is None:
            frame = plant.frame()
            estimate = tracker(frame)
            step, ending = run.step(frame, estimate)
            plant.command(step.velocity)
            steps.append(step)
            run.search(frame)
            if observe is not None:
                observe(frame, estimate, step)
    except KeyboardInterrupt:
        ending = Ending.INTERRUPTED
    finally:
        plant.command(torch.zeros_like(run.controller.velocity))
    return Result(ending, Log.of(steps, len(run.controller.velocity)))


class _Run:
    """One run: the controller, its watch and the last good pose."""

    def __init__(self, tracker: Tracker, goal: Tensor, controller: Controller, travel: Tensor | None) -> None:
        self.tracker, self.goal, self.controller, self.travel = tracker, goal, controller, travel
        self.watch = Watch(controller.control, float(tracker.references[0].place.radius[0]))
        self.pose, self.frames, self._fresh, self._started = goal, 0, False, False

    @classmethod
    def checked(
        cls, plant: Plant, tracker: Tracker, desired: Tensor | Sequence[float], jacobian: Jacobian, control: Control
    ) -> _Run:
        """ValueError for what is known to be wrong before the first frame."""
        goal = _as_pose(desired)
        speed, acceleration, travel = read_limits(plant)
        _check_view(tracker, goal)
        return cls(tracker, goal, Controller(jacobian, control, (speed, acceleration), plant.period), travel)

    def step(self, frame: Tensor, estimate: Estimate) -> tuple[Step, Ending | None]:
        """What follows from a frame, and whether this is the end."""
        before, good = self.pose, bool(Status.good(estimate.status[0]))
        pose = self.pose = estimate.pose[0].detach().double().cpu()
        self.watch.seen(good)
        if good and not self._started:
            self._begin(pose)
        repeated = self.watch.repeated(frame, self.controller.shown(pose))
        fresh, self._fresh = self._fresh, good and not repeated
        if self._fresh and fresh:
            self.watch.went(self.controller.shown(before), pose - before)
            self.controller.observe(pose, before, self.watch.radius)
        error = pose - self.goal
        sigma = estimate.sigma[0].double().cpu()
        ending = self.watch.judge(self._reachable(error), sigma) if self._fresh else self.watch.faults()
        stop = ending is not None or not self._fresh
        velocity = self.controller.hold() if stop else self.controller.steer(pose, self.goal)
        time, self.frames = self.frames * self.controller.period, self.frames + 1
        if ending is None and self.frames == self.controller.control.max_frames:
            ending = Ending.TIME_OUT
        return Step(time, pose, error, velocity, float(estimate.score[0]), int(estimate.status[0])), ending

    def search(self, frame: Tensor) -> None:
        """Where the target is lost and the stage stands: look for it in the whole frame, now and again."""
        due = self.watch.lost % SEARCH_EVERY == SEARCH_EVERY - 1
        if due and self.controller.control.search and not bool(self.controller.velocity.any()):
            with suppress(ValueError):  # not there, or twice: then it stays lost
                find(self.tracker, frame)

    def _begin(self, pose: Tensor) -> None:
        """The first pose: choose the turn of theta, and refuse what cannot be reached."""
        self.goal = torch.cat((self.goal[:2], unwrap(self.goal[2:], pose[2:])))
        error = pose - self.goal
        rest, allowed = error - self._reachable(error), UNREACHABLE * self.watch.tolerance
        for name, left, most in zip(("x", "y", "theta"), rest.tolist(), allowed.tolist(), strict=True):
            if abs(left) > most:
                unit = "rad" if name == "theta" else "px"
                raise ValueError(f"servo: desired pose is unreachable, no axis takes away {left:+.4g} {unit} of {name}")
        if self.travel is not None:
            move = planned_move(self.controller.jacobian, pose, self.goal)
            for k, (way, (low, high)) in enumerate(zip(move.tolist(), self.travel.tolist(), strict=True)):
                if not low <= way <= high:
                    raise ValueError(
                        f"servo: desired pose is unreachable, axis {k} would have to move by {way:.4g} "
                        f"and can move from {low:.4g} to {high:+.4g} from here"
                    )
        self._started = True

    def _reachable(self, error: Tensor) -> Tensor:
        """The part of an error (3,) that the axes can take away: L L^+ e."""
        L = self.controller.jacobian(self.goal)
        return L @ pseudo_inverse(L) @ error


def _as_pose(desired: Tensor | Sequence[float]) -> Tensor:
    pose = torch.as_tensor(desired, dtype=torch.float64).detach().cpu()
    if pose.shape != (3,) or not bool(pose.isfinite().all()):
        raise ValueError(f"servo: desired must be three finite numbers (px, px, rad), got {pose.tolist()}")
    return pose


def _check_view(tracker: Tracker, goal: Tensor) -> None:
    """ValueError if the first template would leave the frame at ``goal`` (3,)."""
    reference, (height, width) = tracker.references[0], tracker.frame_shape[-2:]
    corners = reference.grid.box[:2].mT.double().cpu() - reference.place.centre[0].double().cpu()
    x, y = transform(goal, corners).unbind(1)
    if float(x.min()) < 0 or float(y.min()) < 0 or float(x.max()) > width - 1 or float(y.max()) > height - 1:
        spans = " and ".join(f"{n} = {float(v.min()):.1f} to {float(v.max()):.1f}" for n, v in (("x", x), ("y", y)))
        raise ValueError(
            f"servo: desired pose is outside the view, the template would take {spans} px of {width}x{height} px"
        )
