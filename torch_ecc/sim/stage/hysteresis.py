"""Hysteresis of piezo actuators: the Prandtl-Ishlinskii model with rate-dependent thresholds.

After Al Janaideh and Krejci, "Inverse rate-dependent Prandtl-Ishlinskii model for feedforward compensation of
hysteresis in a piezomicropositioning actuator", IEEE/ASME Trans. Mechatronics 18 (2013) 1498::

    H[u](t) = w_0 u(t) + sum_i w_i F_i[u](t),    r_i(t) = alpha i + beta |du/dt|,    w_i ~ exp(-r_i / rho)

F_i is the play of half width r_i: it stays until u pushes it, F(t) = max(u - r, min(u + r, F(t-))). Between samples u
and r run straight, so that a play rests first and then follows a straight line: it is known exactly at all times. The
default sizes are no actuator's own; they are chosen for what makers state of open-loop piezos, loops that open by 2 %
of small moves and 10-15 % of large ones (Physik Instrumente, Piezo Tutorial).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


class Ramps(NamedTuple):
    """Signals of A actuators in S steps: each starts from ``value`` (..., S, A) um; of its N parts every one rests
    and then, in the last ``duration`` (..., S, A, N) s of the step, runs with ``slope`` (..., S, A, N) um per s."""

    value: Tensor
    slope: Tensor
    duration: Tensor

    def until(self, index: Tensor, since: Tensor, step_s: Tensor) -> Ramps:
        """The first ``since`` (M,) s of the steps ``index`` (M,) as M steps of their own; all steps last ``step_s``."""
        slope, duration = self.slope[..., index, :, :], self.duration[..., index, :, :]
        left = (duration - (step_s - since)[:, None, None]).clamp_min(0)
        return Ramps(self.value[..., index, :], slope, left)


@dataclass(frozen=True)
class Hysteresis:
    """Settings of the model; the weights sum to 1, so that an actuator never moves further than told."""

    share: float = 0.4  # of the stroke that goes through the plays, w_1 + w_2 + ...; 0 has no hysteresis
    spacing_um: float = 1.25  # alpha
    lag_s: float = 2e-4  # beta: 0 is rate-independent
    decay_um: float = 12.0  # rho
    plays: int = 10

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise ValueError(f"Hysteresis: share must be in [0, 1), got {self.share}")
        if self.plays < 1:
            raise ValueError(f"Hysteresis: plays must be at least 1, got {self.plays}")
        for name in ("spacing_um", "decay_um"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Hysteresis: {name} must be > 0, got {getattr(self, name)}")
        if not self.lag_s >= 0:
            raise ValueError(f"Hysteresis: lag_s must be >= 0, got {self.lag_s}")

    def thresholds(self, speed: Tensor) -> Tensor:
        """r_i in um at speeds |du/dt| in um per s: (...) -> (..., N)."""
        rest = self.spacing_um * torch.arange(1, self.plays + 1, dtype=speed.dtype, device=speed.device)
        return rest + self.lag_s * speed[..., None]

    def weights(self, like: Tensor) -> Tensor:
        """(1 + N,) of the dtype and device of ``like``: w_0 and the weights of the plays."""
        rest = self.thresholds(like.new_zeros(()))
        falling = (-rest / self.decay_um).exp()
        return torch.cat((rest.new_tensor((1 - self.share,)), self.share * falling / falling.sum()))

    def drive(self, stroke: Tensor, step_s: float) -> Ramps:
        """What A actuators do that are told ``stroke`` (..., S + 1, A) um, samples ``step_s`` s apart.

        The plays start in the middle. The speed that widens a play at a sample is that of the step before it.
        """
        moves = stroke.diff(dim=-2)
        speed = torch.cat((torch.zeros_like(stroke[..., :1, :]), moves.abs() / step_s), -2)
        reach = self.thresholds(speed)
        low, high = stroke[..., None] - reach, stroke[..., None] + reach
        plays = play(low, high)
        turns = plays.diff(dim=-3)
        # Going up a play follows its lower edge, going down its upper one; it rests until the edge has come.
        edge = torch.where(turns > 0, low.diff(dim=-3), high.diff(dim=-3))
        moving = (turns / edge).nan_to_num(0.0).clamp(0, 1)  # part of the step; 0 / 0 where nothing moves
        weights = self.weights(stroke)
        start = torch.cat((stroke[..., None], plays), -1)[..., :-1, :, :]
        slope = torch.cat((moves[..., None], edge), -1) / step_s
        duration = torch.cat((torch.ones_like(moves)[..., None], moving), -1) * step_s
        return Ramps(start @ weights, slope * weights, duration)


def play(low: Tensor, high: Tensor) -> Tensor:
    """F_k = max(low_k, min(high_k, F_k-1)) from F = 0: (..., T, A, N), same shape; low <= high, along dimension -3.

    Clipping to an interval after clipping to another is again clipping to an interval: all prefixes are composed in
    log2 T passes over the whole tensor.
    """
    low, high = low.clone(), high.clone()
    shift = 1
    while shift < low.shape[-3]:
        later, earlier = slice(shift, None), slice(None, -shift)
        bounds = low[..., later, :, :].clone(), high[..., later, :, :].clone()
        ends = [edge[..., earlier, :, :].clamp(*bounds) for edge in (low, high)]
        low[..., later, :, :], high[..., later, :, :] = ends
        shift *= 2
    return torch.zeros_like(low).clamp(low, high)
