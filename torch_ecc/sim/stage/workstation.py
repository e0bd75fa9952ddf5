"""The workstation of Fig. 12: a substrate and a probe, each on a stage of its own, under one microscope.

The substrate's stage has the axes x, y, z, theta, the probe's x, y, z. A stage carries its part like this: the axes x
and y move a point of the picture, the axis of rotation, by

    dc = diag(1 / f) R(-a) (dx, dy)     px, with f = ``um_per_px`` and a = ``axis_angle_deg``,

and the part turns about that point, which lies at ``axis`` in the part's own coordinates. z moves a part in and out of
focus. Time passes when a frame is taken: every frame is one ``period`` later, and shows what was ``delay`` frames ago.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import radians
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import compose, inverse, rotation
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.scene.probe import Probe
from torch_ecc.sim.scene.scene import Scene
from torch_ecc.sim.stage.axes import Axis, MultiAxisStage

Part = Literal["substrate", "probe"]
ROTARY = Axis(low=-6.5, high=6.5, speed=1.0, acceleration=10.0, step=1e-6)
IN_PLANE = {"substrate": (0, 1, 3), "probe": (0, 1)}  # the axes that the picture shows: x, y (, theta)
Z = 2


@dataclass(frozen=True, kw_only=True)
class Mount:
    """How a stage carries its part. With all axes at 0 the part's origin is at ``home`` px, turned by ``home_deg``."""

    home: tuple[float, float]
    home_deg: float = 0.0
    um_per_px: float = 0.275
    axis_angle_deg: float = 0.0  # from the camera's axes to the stage's, as in torch_ecc.Calibration
    axis: tuple[float, float] = (0.0, 0.0)  # px in the part's coordinates: the point that it turns about
    x: Axis = field(default_factory=Axis)
    y: Axis = field(default_factory=Axis)
    z: Axis = field(default_factory=Axis)
    theta: Axis = ROTARY  # of the substrate only

    def __post_init__(self) -> None:
        if not self.um_per_px > 0:
            raise ValueError(f"Mount: um_per_px must be > 0, got {self.um_per_px}")

    def pose(self, position: Tensor) -> Tensor:
        """Stage (x, y, theta) um, um, rad -> the part's pose in the frame; (3,) -> (3,)."""
        turn = rotation(torch.tensor(-radians(self.axis_angle_deg), dtype=torch.float64))
        moved = torch.cat((turn @ position[:2] / self.um_per_px, position[2:]))
        return compose(self._start() + moved, -self._lever())

    def position(self, pose: Tensor) -> Tensor:
        """The inverse of ``pose``: (3,) px, px, rad -> (3,) um, um, rad."""
        moved = compose(pose, self._lever()) - self._start()
        turn = rotation(torch.tensor(radians(self.axis_angle_deg), dtype=torch.float64))
        return torch.cat((turn @ moved[:2] * self.um_per_px, moved[2:]))

    def _lever(self) -> Tensor:
        return torch.tensor((*self.axis, 0.0), dtype=torch.float64)

    def _start(self) -> Tensor:
        """The axis of rotation in the frame, and theta, with all axes at 0."""
        return compose(torch.tensor((*self.home, radians(self.home_deg)), dtype=torch.float64), self._lever())


class Instant(NamedTuple):
    """Poses (3,) of both parts and how far the probe is out of focus, um."""

    substrate: Tensor
    probe: Tensor
    dz: float


@dataclass(frozen=True, kw_only=True)
class Microscope:
    """``period`` s from frame to frame; a frame is ``delay`` frames old when it comes; ``focus`` um is the z in focus;
    ``seed`` is that of all noise."""

    camera: Camera = field(default_factory=Camera)
    period: float = 1 / 30
    delay: int = 0
    focus: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.period > 0:
            raise ValueError(f"Microscope: period must be > 0 s, got {self.period}")
        if self.camera.exposure > 0:
            raise ValueError(f"Microscope: the camera's exposure must be 0, got {self.camera.exposure}")
        if self.delay < 0:
            raise ValueError(f"Microscope: delay must be >= 0 frames, got {self.delay}")


class Workstation:
    """Both stages and the microscope; ``start`` are the poses (3,) of the parts in the first frame, ``height`` um the
    probe's z. ValueError if a stage does not reach its start."""

    def __init__(
        self,
        scenes: tuple[Scene, Probe],
        mounts: Mapping[Part, Mount],
        microscope: Microscope,
        *,
        start: Mapping[Part, Sequence[float] | Tensor] | None = None,
        height: float = 0.0,
    ) -> None:
        self.scene, self.probe = scenes
        self.mounts, self.microscope = dict(mounts), microscope
        begin = start or {}
        self.stages = {p: _stage(p, mount, begin.get(p), height, microscope.seed) for p, mount in mounts.items()}
        self._commands = {part: torch.zeros(len(s.axes), dtype=torch.float64) for part, s in self.stages.items()}
        self._recent = deque([self._now()], microscope.delay + 1)
        self.frames = 0

    def truth(self, part: Part) -> Tensor:
        """The exact pose of a part now: (3,) px, px, rad."""
        position = self.stages[part].position
        theta = position[3:] if len(position) > 3 else position.new_zeros(1)
        return self.mounts[part].pose(torch.cat((position[:2], theta)))

    def command(self, part: Part, velocity: Tensor) -> None:
        """Set the velocities of all axes of a stage, (4,) or (3,): um/s, um/s, um/s (, rad/s)."""
        self._commands[part] = velocity.double().clone()

    def frame(self) -> Tensor:
        """Let one period pass under the last commands, and give the frame (h, w)."""
        for part, stage in self.stages.items():
            stage.advance(self._commands[part], self.microscope.period)
        self._recent.append(self._now())
        substrate, probe, dz = self._recent[0]
        scene = self.probe.over(self.scene, compose(inverse(substrate), probe), dz)
        shot = self.microscope.camera.capture(scene, substrate[None], seed=self.microscope.seed, first=self.frames)
        self.frames += 1
        return shot[0, 0]

    def plant(self, part: Part) -> Drive:
        """One part as a controller sees it: its in-plane axes and the common camera."""
        return Drive(self, part)

    def _now(self) -> Instant:
        dz = float(self.stages["probe"].position[Z]) - self.microscope.focus
        return Instant(self.truth("substrate"), self.truth("probe"), dz)


class Drive:
    """The axes of one stage that the picture shows, x, y (, theta), with the camera: a plant for visual servoing."""

    def __init__(self, workstation: Workstation, part: Part) -> None:
        self.workstation, self.part, self.period = workstation, part, workstation.microscope.period

    @property
    def limits(self) -> tuple[Tensor, Tensor, Tensor]:
        """Speed (n,), acceleration (n,) and the moves still possible to either side (n, 2)."""
        speed, acceleration, travel = (v[list(IN_PLANE[self.part])] for v in self.stage.limits)
        return speed, acceleration, travel

    @property
    def stage(self) -> MultiAxisStage:
        """The stage itself."""
        return self.workstation.stages[self.part]

    def frame(self) -> Tensor:
        """The next frame (h, w)."""
        return self.workstation.frame()

    def command(self, velocity: Tensor) -> None:
        """Set the velocities (n,) of these axes; the others stand still."""
        whole = torch.zeros(len(self.stage.axes), dtype=torch.float64)
        whole[list(IN_PLANE[self.part])] = velocity.double()
        self.workstation.command(self.part, whole)


def _stage(
    part: Part, mount: Mount, start: Sequence[float] | Tensor | None, height: float, seed: int
) -> MultiAxisStage:
    """The stage of a part, at rest where the part is at the pose ``start`` (its home if None)."""
    x, y, theta = (torch.zeros(3) if start is None else mount.position(torch.as_tensor(start).double())).tolist()
    if part == "substrate":
        return MultiAxisStage((mount.x, mount.y, mount.z, mount.theta), (x, y, 0.0, theta), seed=seed)
    if abs(theta) > 1e-9:
        raise ValueError(f"Workstation: the probe cannot turn, got a start at {theta:g} rad from its home")
    return MultiAxisStage((mount.x, mount.y, mount.z), (x, y, height), seed=seed + 1)
