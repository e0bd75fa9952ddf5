"""A second plant for the tests: a turntable under a camera, small and without any lag, that can be made to fail.

Its rotary axis stands still in the picture and carries the axes x and y, which therefore turn with the part: another
geometry than that of ``torch_ecc.sim.stage.workstation``, with another Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.servo import Limits
from torch_ecc.sim import Camera, PlaneWaves
from torch_ecc.track.tracker import Tracker

SCENE = PlaneWaves.random(40, fmax=0.12, rms_gradient=4.5, seed=5)
SIZE = (120, 160)
UM_PER_PX = 0.5
MIDDLE = torch.tensor((80.0, 60.0), dtype=torch.float64)


def jacobian(pose: Tensor) -> Tensor:
    """t = MIDDLE + R(theta) (x, y) / UM_PER_PX, so L = [R(theta) / UM_PER_PX, (d_y, -d_x)], d = t - MIDDLE."""
    d = pose[:2] - MIDDLE
    L = torch.zeros(3, 3, dtype=torch.float64)
    L[:2, :2], L[0, 2], L[1, 2], L[2, 2] = rotation(pose[2]) / UM_PER_PX, d[1], -d[0], 1.0
    return L


class Turntable:
    """``spoil(frame, number)`` may change what the camera gives; ``reach`` um is where x ends, without a word."""

    period = 1 / 25
    limits = Limits((60.0, 60.0, 1.0), (600.0, 600.0, 10.0))

    def __init__(
        self,
        position: tuple[float, float, float],
        *,
        spoil: Callable[[Tensor, int], Tensor] | None = None,
        reach: float = 1e9,
        noise: float = 1.0,
    ) -> None:
        self.position = torch.tensor(position, dtype=torch.float64)
        self.velocity, self.spoil, self.reach = torch.zeros(3, dtype=torch.float64), spoil, reach
        self.camera, self.frames, self.commands = Camera(size=SIZE, noise_sigma=noise), 0, list[Tensor]()

    @property
    def pose(self) -> Tensor:
        """The true pose now, (3,)."""
        turn = rotation(self.position[2])
        return torch.cat((MIDDLE + turn @ self.position[:2] / UM_PER_PX, self.position[2:]))

    def frame(self) -> Tensor:
        self.position = self.position + self.velocity * self.period
        self.position[0] = self.position[0].clamp(max=self.reach)
        frame = self.camera.capture(SCENE, self.pose[None], first=self.frames)[0, 0]
        self.frames += 1
        return frame if self.spoil is None else self.spoil(frame, self.frames - 1)

    def command(self, velocity: Tensor) -> None:
        self.velocity = velocity.clone()
        self.commands.append(self.velocity)

    def tracker(self) -> Tracker:
        """A tracker whose template is cut where the part is upright in the middle, and which starts where it is now."""
        home = torch.cat((MIDDLE, torch.zeros(1, dtype=torch.float64)))[None]
        tracker = Tracker(self.camera.capture(SCENE, home, seed=7)[0, 0], MIDDLE[None], 41)
        tracker.pose = self.pose[None]
        return tracker
