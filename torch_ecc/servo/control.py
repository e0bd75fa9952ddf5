"""The control law, eqs. (12) and (13), in discrete time, within the limits of the stage."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_ecc.servo.jacobian import LARGEST_CONDITION, Jacobian, condition, learn, pseudo_inverse

LEAST_MOVE = 0.3  # px at the template's radius: shorter moves drown in noise and teach nothing


@dataclass(frozen=True, kw_only=True)
class Control:
    """Settings of a run.

    ``gain``: lambda in 1/s; ``tolerance_px`` of x and y and ``tolerance_deg`` of theta: the mean error of ``dwell``
    frames in a row must keep them, and each of these frames within three standard deviations of its pose; ``delay``:
    frames from the exposure of a frame to the command made from it, as far as known; ``learn``: weight in [0, 1] of
    Broyden's update of L, 0 for none; ``patience``: frames for which a lost target, a frozen camera or a stage that
    does not follow is waited for; ``search``: look for a lost target in the whole frame (``find``) once the stage
    stands; ``max_frames``: end of the run.
    """

    gain: float = 2.0
    tolerance_px: float = 0.05
    tolerance_deg: float = 0.01
    dwell: int = 10
    delay: int = 0
    learn: float = 0.0
    patience: int = 30
    search: bool = True
    max_frames: int = 1500

    def __post_init__(self) -> None:
        for name in ("gain", "tolerance_px", "tolerance_deg"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"Control: {name} must be a finite number > 0, got {value}")
        for name, least in (("dwell", 1), ("delay", 0), ("patience", 1), ("max_frames", 1)):
            if not getattr(self, name) >= least:
                raise ValueError(f"Control: {name} must be at least {least}, got {getattr(self, name)}")
        if not 0 <= self.learn <= 1:
            raise ValueError(f"Control: learn must lie in [0, 1], got {self.learn}")


class Controller:
    """Poses in, velocities out. State: the last velocity, the moves on their way to the picture, what was learnt of L.

    ``speed`` and ``acceleration`` (n,) are kept in every command; ``radius`` px turns rad into px at the template.

    Discrete time. A velocity v_k acts from one frame to the next, T = ``period``, so that e_(k+1) = e_k + T L v_k. With
    v = -g L^+ e and g = (1 - exp(-lambda T)) / T the error is exactly exp(-lambda k T) e_0 at the frames, at any frame
    rate; lambda T -> 0 gives eq. (13). A lag of the stage adds to that: its time constant tau makes the rate about
    lambda (1 + lambda tau).

    Delay. A frame that is d frames old does not show the last d moves yet; they are added to the measured pose (a Smith
    predictor), which leaves the decay as it is. A delay that nobody told the controller is harmless while
    lambda T < d^d / (d+1)^(d+1) (0.25, 0.15, 0.11 for d = 1, 2, 3: no overshoot), and is unstable from about
    g T = 2 sin(pi / (4 d + 2)) on (1, 0.62, 0.45).

    Limits. All velocities are scaled by one factor, so that the path in the picture stays straight, to keep each axis
    below its ``speed`` and below ``acceleration`` / g, from where e^(-lambda t) brakes within the acceleration.
    Changes of velocity are scaled in the same way.
    """

    def __init__(self, jacobian: Jacobian, control: Control, limits: tuple[Tensor, Tensor], period: float) -> None:
        speed, acceleration = limits
        self.control, self.period, self._nominal = control, period, jacobian
        self.gain = (1 - math.exp(-control.gain * period)) / period
        self.speed, self.most = torch.minimum(speed, acceleration / self.gain), acceleration * period
        self.velocity = torch.zeros_like(speed)
        self._correction = speed.new_zeros(3, len(speed))
        self._commands: deque[Tensor] = deque([self.velocity] * (control.delay + 1), control.delay + 1)

    def jacobian(self, pose: Tensor) -> Tensor:
        """L (3, n) at a pose, with what was learnt."""
        return self._nominal(pose) + self._correction

    def present(self, pose: Tensor) -> Tensor:
        """The pose (3,) now: the measured one and the moves since it was exposed."""
        for velocity in list(self._commands)[1:]:
            pose = pose + self.jacobian(pose) @ velocity * self.period
        return pose

    def shown(self, pose: Tensor) -> Tensor:
        """What the frame that shows ``pose`` should have changed by since the frame before it, (3,)."""
        return self.jacobian(pose) @ self._commands[0] * self.period

    def steer(self, pose: Tensor, desired: Tensor) -> Tensor:
        """The velocity (n,) for a measured pose (3,), eq. (13)."""
        now = self.present(pose)
        wanted = -self.gain * pseudo_inverse(self.jacobian(now)) @ (now - desired)
        return self._limited(wanted)

    def hold(self) -> Tensor:
        """The velocity (n,) on the way to standing still, within the acceleration."""
        return self._limited(torch.zeros_like(self.velocity))

    def observe(self, pose: Tensor, before: Tensor, radius: float) -> None:
        """Learn from the poses (3,) of two frames in a row (Broyden), if the move between them was long enough."""
        move, L = self._commands[0] * self.period, self.jacobian(before)
        length = (L @ move * L.new_tensor((1.0, 1.0, radius))).norm()
        if self.control.learn == 0 or float(length) < LEAST_MOVE:
            return
        better = learn(L, move, pose - before, self.control.learn)
        if condition(better) < LARGEST_CONDITION:
            self._correction = better - self._nominal(before)

    def _limited(self, wanted: Tensor) -> Tensor:
        wanted = wanted / float((wanted.abs() / self.speed).amax().clamp(min=1.0))
        change = wanted - self.velocity
        self.velocity = self.velocity + change / float((change.abs() / self.most).amax().clamp(min=1.0))
        self._commands.append(self.velocity)
        return self.velocity
