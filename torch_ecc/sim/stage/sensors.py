"""Capacitive displacement sensors (CDS): what three of them read at the poses of a stage, and how well.

Geometry is in ``mounting.py``. A reading is the distance plus the sensor's non-linearity and noise, clipped to its
range and rounded to its resolution.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.sim.camera.sensor import generator
from torch_ecc.sim.stage import mounting as geometry
from torch_ecc.sim.stage.mounting import FREE, Mounting
from torch_ecc.sim.stage.stage import StageMotion

STREAM = 1  # of random numbers, apart from the stage's own


@dataclass(frozen=True, kw_only=True)
class SensorSettings:
    """Table II: range 0 to 200 um, resolution 0.2 nm, read at 1024 Hz."""

    mounting: Mounting = field(default_factory=Mounting)
    range_um: tuple[float, float] = (0.0, 200.0)
    resolution_um: float = 2e-4
    noise_um: float = 4e-4  # rms of a sample
    nonlinearity: float = 2e-4  # of the range, the largest deviation
    rate_hz: float = 1024.0

    def __post_init__(self) -> None:
        if not self.range_um[0] < self.range_um[1]:
            raise ValueError(f"SensorSettings: range_um must be (low, high), got {self.range_um}")
        if not self.rate_hz > 0:
            raise ValueError(f"SensorSettings: rate_hz must be > 0, got {self.rate_hz}")
        for name in ("resolution_um", "noise_um", "nonlinearity"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"SensorSettings: {name} must be >= 0, got {getattr(self, name)}")

    @property
    def span_um(self) -> float:
        """Length of the range."""
        return self.range_um[1] - self.range_um[0]


class SensorRecord(NamedTuple):
    """Distances (..., T, 3) um at ``times_s`` (T,); ``saturated`` (..., T, 3): out of range and clipped there."""

    times_s: Tensor
    distance_um: Tensor
    saturated: Tensor


class Sensors:
    """Three sensors, or a ``batch`` of B such sets; number i of a batch is the single set of ``first`` = i."""

    def __init__(
        self, settings: SensorSettings | None = None, *, batch: int | None = None, seed: int = 0, first: int = 0
    ) -> None:
        self.settings = settings or SensorSettings()
        if (batch is not None and batch < 1) or seed < 0 or first < 0:
            raise ValueError(f"Sensors: batch must be >= 1, seed and first >= 0, got {batch}, {seed}, {first}")
        self.batch, self.keys = batch, [(seed, first + i, STREAM) for i in range(batch or 1)]

    def record(self, motion: StageMotion, *, start_s: float = 0.0) -> SensorRecord:
        """Readings all along a motion at the sensors' own rate, the first at ``start_s``; the clock is the motion's."""
        end = float(motion.times_s[-1])
        if not 0 <= start_s <= end:
            raise ValueError(f"record: start_s must be between 0 and {end:g} s, got {start_s}")
        count = int((end - start_s) * self.settings.rate_hz + 1e-9) + 1
        times = start_s + torch.arange(count, dtype=torch.float64, device=motion.times_s.device) / self.settings.rate_hz
        times = times.clamp_max(end)
        return SensorRecord(times, *self.read(motion.at(times)))

    def read(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Distances in um and where they were clipped, for poses (..., T, 3) um, um, rad: two (..., T, 3).

        The same call gives the same noise.
        """
        if poses.dim() < 2 or poses.shape[-1] != 3:
            raise ValueError(f"read: poses must be (..., T, 3), got {tuple(poses.shape)}")
        if self.batch and poses.dim() > 2 and poses.shape[-3] not in (1, self.batch):
            raise ValueError(
                f"read: poses for {self.batch} sets must be ({self.batch}, T, 3), got {tuple(poses.shape)}"
            )
        s = self.settings
        exact = s.mounting.distance(poses)
        sources = [generator(*key) for key in self.keys]
        kinds = torch.stack([2 * pi * torch.rand(1, 3, generator=g, dtype=torch.float64) for g in sources])
        noise = torch.stack([torch.randn(poses.shape[-2], 3, generator=g, dtype=torch.float64) for g in sources])
        if self.batch is None:
            kinds, noise = kinds[0], noise[0]
        second, third = bends(s, exact)
        bend = kinds.cos().to(exact) * second + kinds.sin().to(exact) * third
        value = exact + bend + s.noise_um * noise.to(exact)
        low, high = s.range_um
        saturated = (value < low) | (value > high)
        value = value.clamp(low, high)
        if s.resolution_um > 0:
            value = (value / s.resolution_um).round() * s.resolution_um
        return value, saturated


def bends(settings: SensorSettings, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Two shapes of non-linearity in um at distances (...) um, Legendre's second and third.

    A sensor has cos(psi) of the one and sin(psi) of the other with a psi of its own; what offset and gain would take
    out is left out.
    """
    x = 2 * (distance - settings.range_um[0]) / settings.span_um - 1
    size = settings.nonlinearity * settings.span_um / 2**0.5
    return size * (1.5 * x**2 - 0.5), size * (2.5 * x**3 - 1.5 * x)


class ErrorBudget(NamedTuple):
    """Standard deviations (..., 3) um, um, rad of x, y and theta by their causes."""

    resolution: Tensor
    noise: Tensor
    nonlinearity: Tensor
    mounting: Tensor
    total: Tensor


def error_budget(settings: SensorSettings, poses: Tensor, *, mounting_covariance: Tensor | None = None) -> ErrorBudget:
    """How well the sensors tell the displacement from the zero pose to ``poses`` (N, 3) um, um, rad.

    Resolution and noise count once (the zero is averaged), resolution as q / sqrt(12) of a uniform error.
    Non-linearity counts as the rms over sensors of a kind, mounting by its covariance (8, 8) as
    ``calibrate_mounting`` gives it. First-order propagation with the exact inverse's own derivatives.
    """
    if poses.dim() != 2 or poses.shape[1] != 3:
        raise ValueError(f"error_budget: poses must be (N, 3), got {tuple(poses.shape)}")
    if mounting_covariance is not None and mounting_covariance.shape != (len(FREE), len(FREE)):
        raise ValueError(f"error_budget: mounting_covariance must be (8, 8), got {tuple(mounting_covariance.shape)}")
    poses = poses.double()
    numbers = settings.mounting.numbers().to(poses.device)
    exact, zero, to_pose = _linear(numbers, poses)

    def spread(variance: Tensor) -> Tensor:
        """Of the pose from independent variances (N, 3) of the distances."""
        squares: Tensor = to_pose.square() @ variance[..., None]
        return squares[..., 0].sqrt()

    even = torch.ones_like(exact)
    parts = [
        spread(settings.resolution_um**2 / 12 * even),
        spread(settings.noise_um**2 * even),
        nonlinear_modes(settings, poses).square().sum(-1).sqrt(),
        torch.zeros_like(exact),
    ]
    if mounting_covariance is not None:
        parts[3] = _mounting_sigma(numbers, exact, zero, mounting_covariance.to(exact))
    total = torch.stack(parts).square().sum(0).sqrt()
    return ErrorBudget(parts[0], parts[1], parts[2], parts[3], total)


def nonlinear_modes(settings: SensorSettings, poses: Tensor) -> Tensor:
    """What the non-linearity makes of the displacements to ``poses`` (N, 3) um, um, rad: (N, 3, 6).

    Six independent causes, two shapes of each sensor, each with the rms over sensors of a kind. A set of sensors bends
    all its poses alike: modes[i] @ modes[j].mT is the covariance (3, 3) of its errors at poses i and j.
    """
    exact, zero, to_pose = _linear(settings.mounting.numbers().to(poses.device), poses.double())
    moved = zip(bends(settings, exact), bends(settings, zero), strict=True)
    return torch.cat([to_pose * ((a - b) / 2**0.5)[:, None] for a, b in moved], -1)


def _linear(numbers: Tensor, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distances (N, 3) at poses (N, 3) and (1, 3) at the zero pose, and derivatives (N, 3, 3) of pose by distance."""
    exact, zero = geometry.distance(numbers, poses), geometry.distance(numbers, torch.zeros_like(poses[:1]))
    return exact, zero, torch.func.vmap(torch.func.jacfwd(lambda d: geometry.pose(numbers, d)))(exact)


def _mounting_sigma(numbers: Tensor, exact: Tensor, zero: Tensor, covariance: Tensor) -> Tensor:
    """Standard deviations (N, 3) of displacements that a mounting known with this covariance (8, 8) makes."""
    free = torch.tensor(FREE, device=exact.device)

    def displacement(some: Tensor) -> Tensor:
        m = numbers.index_copy(0, free, some)
        return geometry.pose(m, exact) - geometry.pose(m, zero)

    jacobian = torch.func.jacfwd(displacement)(numbers[free])
    spread: Tensor = jacobian @ covariance @ jacobian.mT
    return spread.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
