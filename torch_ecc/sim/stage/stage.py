"""A compliant 3-DOF piezo stage (Fig. 5, Table II): what it is told against where it goes.

Commands and poses are (x, y, theta) in um, um, rad with the algebra of ``torch_ecc.pose``, in stage axes. Three piezos
push the moving part along its tangents, 120 degrees apart at the radius ``lever_um``; the controller turns a command
into their strokes by that geometry. Each has hysteresis (``hysteresis.py``). What they do reaches the part through its
compliance: less than told, not equally in all directions, and with some cross-coupling, so that a circle comes out as
a smaller ellipse (Fig. 6). Creep and a second-order mode per axis follow (``plant.py``), then thermal drift and the
floor's vibration. A command is the straight line between its samples. Nothing is integrated in steps: the pose is
known in closed form at all times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import pi, radians
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.sim.camera import sensor
from torch_ecc.sim.stage.hysteresis import Hysteresis, Ramps
from torch_ecc.sim.stage.plant import Plant
from torch_ecc.sim.stage.vibration import Floor, Vibration

Row = tuple[float, float, float]

ACTUATORS_RAD = (pi / 2, pi / 2 + 2 * pi / 3, pi / 2 + 4 * pi / 3)  # directions in which the piezos push


@dataclass(frozen=True, kw_only=True)
class StageSettings:
    """A stage of the kind of Table II. ``compliance`` maps (x, y, lever theta) of the piezos to that of the part."""

    workspace_um: tuple[float, float] = (30.0, 30.0)
    workspace_urad: float = 1e6 * radians(0.24)
    lever_um: float = 8000.0
    hysteresis: Hysteresis = field(default_factory=Hysteresis)
    compliance: tuple[Row, Row, Row] = ((0.92, 0.012, 0.004), (-0.009, 0.87, 0.006), (0.003, -0.004, 0.94))
    natural_hz: Row = (180.0, 165.0, 240.0)  # x, y, theta
    damping: Row = (0.04, 0.04, 0.03)  # of critical
    creep: float = 0.012  # of the motion, per decade of time: 1 to 2 % of piezos (Physik Instrumente, Piezo Tutorial)
    creep_s: tuple[float, ...] = (0.1, 1.0, 10.0, 100.0)  # one element per decade
    rotation_center_um: tuple[float, float] = (60.0, -40.0)  # the point of the part that theta leaves where it is
    floor: Floor = field(default_factory=Floor)
    drift_um: float = 0.2  # rms over stages of the whole thermal drift in x and y
    drift_urad: float = 5.0
    drift_s: float = 600.0  # its time constant

    def __post_init__(self) -> None:
        lengths = (
            *self.workspace_um,
            self.workspace_urad,
            self.lever_um,
            *self.natural_hz,
            *self.creep_s,
            self.drift_s,
        )
        if not min(lengths) > 0:
            raise ValueError(f"StageSettings: workspace, lever, natural_hz and times must be > 0, got {lengths}")
        if not all(0 < ratio < 1 for ratio in self.damping):
            raise ValueError(f"StageSettings: damping must be in (0, 1), got {self.damping}")
        for name in ("creep", "drift_um", "drift_urad"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"StageSettings: {name} must be >= 0, got {getattr(self, name)}")
        if len(self.compliance) != 3 or any(len(row) != 3 for row in self.compliance):
            raise ValueError(f"StageSettings: compliance must be 3 x 3, got {self.compliance}")


class StageMotion(NamedTuple):
    """Where a stage was: ``pose`` (..., T, 3) um, um, rad at ``times_s`` (T,); ``at`` gives it at any other time."""

    times_s: Tensor
    pose: Tensor
    stage: Stage
    ramps: Ramps
    states: Tensor

    def at(self, times_s: Tensor) -> Tensor:
        """The pose at ``times_s`` (N,) in any order: (..., N, 3), exactly. ValueError outside the record."""
        end = float(self.times_s[-1])
        if times_s.dim() != 1 or not bool(((times_s >= 0) & (times_s <= end * (1 + 1e-12))).all()):
            raise ValueError(f"at: times_s must be (N,) between 0 and {end:g} s, got {_span(times_s)}")
        return self.stage.pose_at(self, times_s.to(self.times_s))


class Stage:
    """A stage, or a ``batch`` of B of them that drift and shake differently.

    Number i of a batch is the single stage of the same ``seed`` and ``first`` = i. Everything happens in float64 on
    the device of the command.
    """

    def __init__(
        self, settings: StageSettings | None = None, *, batch: int | None = None, seed: int = 0, first: int = 0
    ) -> None:
        self.settings = s = settings or StageSettings()
        if (batch is not None and batch < 1) or seed < 0 or first < 0:
            raise ValueError(f"Stage: batch must be >= 1, seed and first >= 0, got {batch}, {seed}, {first}")
        sources = [sensor.generator(seed, i) for i in range(first, first + (batch or 1))]
        drift = torch.stack([torch.randn(1, 3, generator=g, dtype=torch.float64) for g in sources])
        self.drift = drift * _column((s.drift_um, s.drift_um, 1e-6 * s.drift_urad))
        natural, damping = _column(s.natural_hz), _column(s.damping)
        self.vibration = Vibration.on(s.floor, natural, damping, sources=sources)
        if batch is None:
            self.drift, self.vibration = self.drift[0], self.vibration.only(0)
        gains = torch.full((len(s.creep_s),), s.creep, dtype=torch.float64)
        self.plant = Plant.of(natural, damping, creep=gains, creep_s=_column(s.creep_s))
        angles = _column(ACTUATORS_RAD)
        self.geometry = torch.stack(
            (angles.cos(), angles.sin(), torch.ones_like(angles)), 1
        )  # (x, y, lever theta) to strokes
        self.mix = _column(s.compliance) @ torch.linalg.inv(self.geometry)

    def run(self, command: Tensor, rate_hz: float) -> StageMotion:
        """Follow ``command`` (..., T, 3) um, um, rad, sampled at ``rate_hz``, from rest at its first row.

        Leading dimensions meet those of the batch. The moves, counted from 0, must fit into the workspace: where in
        its range a piezo is biased is up to the user. Raises ValueError for a command that does not, for shapes that do
        not fit, numbers that are not finite and a rate that is not positive.
        """
        self._check(command, rate_hz)
        s, command = self.settings, command.double()
        scale = command.new_tensor((1.0, 1.0, s.lever_um))
        ramps = s.hysteresis.drive((command * scale) @ self.geometry.to(command).mT, 1 / rate_hz)
        plant, mix = self.plant.to(command.device), self.mix.to(command)
        length = command.new_tensor(1 / rate_hz)
        start = plant.rest(ramps.value[..., 0, :] @ mix.mT)
        states = plant.march(start, ramps, mix, length)
        times = torch.arange(command.shape[-2], dtype=torch.float64, device=command.device) / rate_hz
        return StageMotion(times, self._pose(plant.output(states), times), self, ramps, states)

    def pose_at(self, motion: StageMotion, times_s: Tensor) -> Tensor:
        """The pose of a motion of this stage at ``times_s`` (N,) s: (..., N, 3)."""
        step = motion.times_s[1]
        index = (times_s / step).floor().long().clamp(0, len(motion.times_s) - 2)
        since = (times_s - index * step).clamp_min(0)
        plant = self.plant.to(times_s.device)
        states = motion.states[..., index, :]
        moved = plant.advance(states, motion.ramps.until(index, since, step), self.mix.to(times_s), since)
        return self._pose(plant.output(moved), times_s)

    def _pose(self, motion: Tensor, times_s: Tensor) -> Tensor:
        """Pose of the part from the motion (..., T, 3) um of its rotation centre and lever theta."""
        s = self.settings
        away = -torch.expm1(-times_s / s.drift_s)[:, None]
        whole = motion / motion.new_tensor((1.0, 1.0, s.lever_um))
        whole = whole + away * self.drift.to(times_s) + self.vibration.at(times_s)
        center = motion.new_tensor(s.rotation_center_um)
        shift = center - rotation(whole[..., 2]) @ center
        return torch.cat((whole[..., :2] + shift, whole[..., 2:]), -1)

    def _check(self, command: Tensor, rate_hz: float) -> None:
        s = self.settings
        if command.dim() < 2 or command.shape[-1] != 3 or command.shape[-2] < 2:
            raise ValueError(f"run: command must be (..., T, 3) with T >= 2, got {tuple(command.shape)}")
        if not rate_hz > 0:
            raise ValueError(f"run: rate_hz must be > 0, got {rate_hz}")
        if not bool(command.isfinite().all()):
            raise ValueError("run: command must be finite")
        batch, lead = self.drift.shape[:-2], command.shape[:-2]
        if batch and lead and lead[-1] not in (1, batch[0]):
            raise ValueError(
                f"run: command for {batch[0]} stages must be (T, 3) or ({batch[0]}, T, 3), got {(*command.shape,)}"
            )
        flat = command.double().reshape(-1, 3)
        moves = (flat.amax(0).clamp_min(0) - flat.amin(0).clamp_max(0)) * flat.new_tensor((1.0, 1.0, 1e6))
        for name, unit, move, limit in zip(
            ("x", "y", "theta"), ("um", "um", "urad"), moves.tolist(), (*s.workspace_um, s.workspace_urad), strict=True
        ):
            if move > limit * (1 + 1e-9):
                raise ValueError(
                    f"run: command must stay in the workspace, {limit:g} {unit} of {name}, got {move:g} {unit}"
                )


def _column(values: Sequence[float] | Sequence[Sequence[float]]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _span(times_s: Tensor) -> str:
    if times_s.dim() != 1 or len(times_s) == 0:
        return str(tuple(times_s.shape))
    return f"{float(times_s.min()):g} to {float(times_s.max()):g} s"
