"""A stage of several axes that takes velocities: lag, end stops, finite steps and noise, integrated exactly.

Each axis follows its commanded velocity c through a linear lag of time constant T, of first order, T u' = c - u, or of
second order, T^2 u'' + 2 damping T u' + u = c. The command is constant from one call to the next, so one matrix
exponential per axis takes the state (position, velocity u, u', c) from call to call without any error of integration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor


@dataclass(frozen=True)
class Axis:
    """One axis. Linear axes count in um and s, rotary ones in rad and s.

    ``low`` and ``high``: its end stops; ``speed`` and ``acceleration``: what may be asked of it (a faster command is
    cut to ``speed``); ``step``: the position is a whole number of them (0: any); ``lag``: the time constant in s (0:
    none); ``damping``: None for a lag of first order; ``noise``: rms error of the velocity while it is asked to move.
    """

    low: float = -150.0
    high: float = 150.0
    speed: float = 80.0
    acceleration: float = 500.0
    step: float = 0.001
    lag: float = 0.005
    damping: float | None = None
    noise: float = 0.0

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"Axis: low must be below high, got {self.low} and {self.high}")
        for name in ("speed", "acceleration"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Axis: {name} must be > 0, got {getattr(self, name)}")
        for name in ("step", "lag", "noise"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"Axis: {name} must be >= 0, got {getattr(self, name)}")
        if self.damping is not None and not self.damping > 0:
            raise ValueError(f"Axis: damping must be > 0 or None, got {self.damping}")


class MultiAxisStage:
    """The state of n ``axes`` that start at rest at ``position`` (n,); ``seed`` is that of their noise."""

    def __init__(self, axes: Sequence[Axis], position: Sequence[float] | Tensor, *, seed: int = 0) -> None:
        start = torch.as_tensor(position, dtype=torch.float64)
        if start.shape != (len(axes),):
            raise ValueError(
                f"MultiAxisStage: position must have one value per axis ({len(axes)}), got {tuple(start.shape)}"
            )
        for k, (axis, value) in enumerate(zip(axes, start.tolist(), strict=True)):
            if not axis.low <= value <= axis.high:
                raise ValueError(
                    f"MultiAxisStage: axis {k} reaches from {axis.low:g} to {axis.high:g}, got position {value:g}"
                )
        self.axes = tuple(axes)
        self._state = torch.zeros(len(axes), 4, dtype=torch.float64)
        self._state[:, 0] = start
        self._source = torch.Generator().manual_seed(seed)

    @property
    def position(self) -> Tensor:
        """Where the axes are, in whole steps: (n,) um or rad."""
        step, q = self._column("step"), self._state[:, 0]
        return torch.where(step > 0, torch.round(q / step) * step, q)

    @property
    def velocity(self) -> Tensor:
        """How fast they are: (n,) um/s or rad/s."""
        return self._state[:, 1].clone()

    @property
    def limits(self) -> tuple[Tensor, Tensor, Tensor]:
        """Speed (n,), acceleration (n,) and the moves still possible to either side (n, 2)."""
        ends = torch.stack((self._column("low"), self._column("high")), 1)
        return self._column("speed"), self._column("acceleration"), ends - self.position[:, None]

    def advance(self, velocity: Tensor, seconds: float) -> None:
        """Move for ``seconds`` under a constant command (n,), um/s or rad/s."""
        speed = self._column("speed")
        noise = self._column("noise") * torch.randn(len(self.axes), generator=self._source, dtype=torch.float64)
        command = velocity.to(speed).clamp(-speed, speed)
        self._state[:, 3] = torch.where(command != 0, command + noise, command)
        self._state = (_transition(self.axes, seconds) @ self._state[:, :, None])[:, :, 0]
        low, high = self._column("low"), self._column("high")
        hit = (self._state[:, 0] < low) | (self._state[:, 0] > high)
        self._state[:, 0] = torch.minimum(torch.maximum(self._state[:, 0], low), high)
        self._state[hit, 1:] = 0.0

    def _column(self, name: str) -> Tensor:
        return torch.tensor([getattr(axis, name) for axis in self.axes], dtype=torch.float64)


@lru_cache(maxsize=64)
def _transition(axes: tuple[Axis, ...], seconds: float) -> Tensor:
    """What ``seconds`` do to (position, velocity, its derivative, command) of each axis: (n, 4, 4)."""
    rates = torch.zeros(len(axes), 4, 4, dtype=torch.float64)
    for rate, axis in zip(rates, axes, strict=True):
        if axis.lag == 0:
            rate[0, 3] = 1.0
            continue
        w = 1 / axis.lag
        rate[0, 1] = 1.0
        if axis.damping is None:
            rate[1, 1], rate[1, 3] = -w, w
        else:
            rate[1, 2] = 1.0
            rate[2, 1], rate[2, 2], rate[2, 3] = -w * w, -2 * axis.damping * w, w * w
    moved: Tensor = torch.linalg.matrix_exp(rates * seconds)
    for matrix, axis in zip(moved, axes, strict=True):
        if axis.lag == 0:
            matrix[1] = matrix.new_tensor((0.0, 0.0, 0.0, 1.0))
    return moved
