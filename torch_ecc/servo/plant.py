"""What a stage and its camera must offer to be servoed; a simulated one is ``sim.stage.workstation.Drive``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor

Values: TypeAlias = Tensor | Sequence[float]


class Limits(NamedTuple):
    """Of n axes: largest ``velocity`` (n,) and ``acceleration`` (n,), um and rad with s; ``travel`` (n, 2): the moves
    still possible to either side, (<= 0, >= 0), None where the stage does not tell."""

    velocity: Values
    acceleration: Values
    travel: Values | Sequence[Sequence[float]] | None = None


class Plant(Protocol):
    """A stage of n axes under a camera."""

    @property
    def period(self) -> float:
        """Seconds from frame to frame."""
        ...

    @property
    def limits(self) -> tuple[Values, ...]:
        """A ``Limits``, or a tuple with its values."""
        ...

    def frame(self) -> Tensor:
        """Wait for the next frame: (H, W), (C, H, W), uint8, uint16 or float."""
        ...

    def command(self, velocity: Tensor) -> None:
        """Go on with the velocities (n,), float64, um/s and rad/s, until the next call."""
        ...


def read_limits(plant: Plant) -> tuple[Tensor, Tensor, Tensor | None]:
    """The limits of a plant as float64 tensors (n,), (n,), (n, 2) or None. ValueError if they are not positive."""
    limits = Limits(*plant.limits)
    speed, acceleration = (torch.as_tensor(v, dtype=torch.float64) for v in limits[:2])
    for name, value in (("velocity", speed), ("acceleration", acceleration)):
        if value.dim() != 1 or value.shape != speed.shape or not bool((value > 0).all()):
            raise ValueError(f"plant: limits.{name} must be one number > 0 per axis, got {value.tolist()}")
    if not plant.period > 0:
        raise ValueError(f"plant: period must be > 0 s, got {plant.period}")
    if limits.travel is None:
        return speed, acceleration, None
    travel = torch.as_tensor(limits.travel, dtype=torch.float64)
    if travel.shape != (len(speed), 2):
        raise ValueError(f"plant: limits.travel must be ({len(speed)}, 2), got {tuple(travel.shape)}")
    return speed, acceleration, travel
