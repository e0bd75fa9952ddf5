"""The parasitic translation of a template away from the centre of rotation, against lever arm times angle (Fig. 9).

What the deviations are made of, and how they go together: the tracker's own error differs from step to step, that of
one set of sensors bends all steps alike.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.covariance import interpolation_error
from torch_ecc.core.pose import rotation, turn
from torch_ecc.paper.acquisition import tracker_of
from torch_ecc.paper.errors import rms
from torch_ecc.paper.steps import VIEW_UM, Staircase
from torch_ecc.records.motion import Motion, dwell_errors
from torch_ecc.sim import Sensors, SensorSettings, nonlinear_modes


class Deviations(NamedTuple):
    """x and y of every step but the first minus the law, ``nm`` (K, 2), and their ``covariance`` (2 K, 2 K) nm^2."""

    nm: Tensor
    covariance: Tensor

    @property
    def sigma(self) -> Tensor:
        """Standard deviations (K, 2) nm."""
        return self.covariance.diagonal().sqrt().reshape(-1, 2)

    @property
    def rms(self) -> float:
        """Of x and y together, nm."""
        return float(rms(self.nm.flatten()))

    @property
    def chi_square(self) -> float:
        """Per degree of freedom: 1 is expected; of 24, more than 2 comes by chance in 0.3 % of all cases."""
        flat = self.nm.flatten()
        return float(flat @ torch.linalg.solve(self.covariance, flat)) / len(flat)


def predicted(pose: Tensor) -> Tensor:
    """x and y (..., 2) um of the template from poses (..., 3) um, um, rad of the stage and the true lever arm."""
    arm = pose.new_tensor(VIEW_UM)
    moved: Tensor = pose[..., :2] + rotation(pose[..., 2]) @ arm - arm
    return moved


def deviations(found: Staircase) -> Deviations:
    """From lever arm times the sensors' angle."""
    cds = found.dwells["CDS"].mean
    return Deviations(_minus_law(found, cds), tracked(found) + sensed(cds[1:]))


def true_deviations(found: Staircase) -> Deviations:
    """From lever arm times the stage's true angle at the instants of the frames: those of the tracker and the lens."""
    time, motion = found.tracks["ECC"].time_s, found.acquired.motion
    stage = Motion(time, motion.at(time + found.acquired.offset_s))
    true = dwell_errors(stage, found.windows_s - found.alignment.offset_s).mean
    return Deviations(_minus_law(found, true), tracked(found))


def other_sensors(found: Staircase, sets: int) -> list[Deviations]:
    """The same track against the law by as many other sets of sensors, whose noise averages out within a dwell."""
    ideal = SensorSettings(noise_um=0.0, resolution_um=0.0)
    record = found.sensors.time_s
    true = dwell_errors(Motion(record, found.acquired.motion.at(record)), found.windows_s).mean
    distance, _ = Sensors(ideal, batch=sets, seed=1).read(true)
    covariance = tracked(found) + sensed(true[1:])
    return [Deviations(_minus_law(found, pose), covariance) for pose in ideal.mounting.pose(distance)]


def _minus_law(found: Staircase, stage: Tensor) -> Tensor:
    """Means of the track minus the law by mean poses ``stage`` (K, 3), both from the first step: (K - 1, 2) nm."""
    left: Tensor = 1e3 * (found.dwells["ECC"].mean[:, :2] - predicted(stage))
    return left[1:] - left[0]


def tracked(found: Staircase) -> Tensor:
    """Covariance (2 K, 2 K) nm^2 of the track's means of K steps after the first, minus that of the first.

    The scatter of the frames counts as white: the vibration, which has nothing below 1 Hz, averages better. What the
    sampler's aliasing makes of the place between the pixels is the same in all frames of a step and another one in each
    step; at the first the template lies on the pixels that it was cut from.
    """
    parts = scattered(found)[:, :, None] * torch.eye(2, dtype=torch.float64)
    own = parts[1:] + aliased(found)[1:]
    covariance: Tensor = torch.block_diag(*own) + parts[0].repeat(len(own), len(own))
    return covariance


def scattered(found: Staircase) -> Tensor:
    """Variances (K, 2) nm^2 of the track's means by the scatter of the frames."""
    return (1e3 * found.dwells["ECC"].standard_error[:, :2]) ** 2


def aliased(found: Staircase) -> Tensor:
    """Covariances (K, 2, 2) nm^2 of the track by aliasing in the sampler, as the tracker knows it from its template."""
    tracker = tracker_of(found.acquired.first)
    pose = found.calibration.to_pixels(found.dwells["ECC"].mean)
    shift = interpolation_error(tracker.references[0], turn(pose[:, 2]), tracker.settings.interpolation)
    if shift is None:
        return pose.new_zeros(len(pose), 2, 2)
    return 1e6 * found.calibration.covariance(shift @ shift.mT)[:, :2, :2]


def sensed(pose: Tensor) -> Tensor:
    """Covariance (2 K, 2 K) nm^2 of the law by the sensors' non-linearity at K mean poses (K, 3) um, um, rad.

    Their noise, 0.4 nm of a sample, is averaged.
    """
    arm = pose.new_tensor(VIEW_UM)
    through = (rotation(pose[:, 2] + pi / 2) @ arm)[:, :, None]  # of theta in the law
    slope = torch.cat((torch.eye(2, dtype=pose.dtype).expand(len(pose), 2, 2), through), 2)
    modes = 1e3 * (slope @ nonlinear_modes(SensorSettings(), pose)).flatten(0, 1)
    covariance: Tensor = modes @ modes.mT
    return covariance


def lever_arm(found: Staircase, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Lever arm (2,) um that the means of the steps tell by least squares, and its standard deviations (2,).

    ``covariance`` (2 K, 2 K) nm^2 of the steps from the law.
    """
    cds, ecc = found.dwells["CDS"].mean, found.dwells["ECC"].mean
    moved = ecc[:, :2] - cds[:, :2]
    turns = rotation(cds[:, 2])
    fit = torch.linalg.pinv((turns[1:] - turns[0]).flatten(0, 1))
    return fit @ (moved[1:] - moved[0]).flatten(), 1e-3 * (fit @ covariance @ fit.mT).diagonal().sqrt()
