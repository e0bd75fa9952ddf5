"""Any XY stage and camera that Micro-Manager drives, as a plant."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any

import torch
from torch import Tensor

from torch_ecc.servo.plant import Values


@dataclass
class MicroManagerStage:
    """The current XY stage and camera of a Micro-Manager ``core`` (pymmcore or pymmcore-plus), looking and moving by
    turns: a velocity becomes a move of ``period`` s times as much, and a frame is taken once the stage has arrived.

    ``velocity`` um/s and ``acceleration`` um/s^2 are the most that may be asked for; ``travel`` ((low, high), (low,
    high)) um, of both axes, positions that must not be left. ValueError if the core has no such devices.
    """

    core: Any
    _: KW_ONLY
    period: float = 0.1
    velocity: float = 50.0
    acceleration: float = 1000.0
    travel: tuple[tuple[float, float], tuple[float, float]] | None = None

    def __post_init__(self) -> None:
        self.stage = str(self.core.getXYStageDevice())
        if not self.stage or not self.core.getCameraDevice():
            raise ValueError("MicroManagerStage: core must have an XY stage and a camera, chosen as its current ones")
        self._wanted = self._position()

    @property
    def limits(self) -> tuple[Values, ...]:
        """See ``Plant``."""
        most: list[Values] = [(value, value) for value in (self.velocity, self.acceleration)]
        if self.travel is not None:
            here = self._position()
            most.append(torch.tensor(self.travel, dtype=torch.float64) - here[:, None])
        return tuple(most)

    def frame(self) -> Tensor:
        """See ``Plant``: once the stage has arrived."""
        self.core.waitForDevice(self.stage)
        self.core.snapImage()
        return torch.from_numpy(self.core.getImage().copy())

    def command(self, velocity: Tensor) -> None:
        """See ``Plant``. What the stage rounds off does not add up: moves are counted from where it was to be."""
        step = velocity.detach().double().cpu() * self.period
        if bool(step.any()):
            self._wanted = self._wanted + step
            self.core.setXYPosition(self.stage, *self._wanted.tolist())

    def _position(self) -> Tensor:
        return torch.tensor(self.core.getXYPosition(self.stage), dtype=torch.float64)
