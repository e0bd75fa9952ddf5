"""Two records of one motion at two rates: the paper's comparison of a track with capacitive sensors (section IV-B).

A record is a ``Motion``: times that do not go back, poses in um, um, rad along the stage's axes. A component that is
never finite is one that the record does not have; rows in which another one is not are lost samples: they keep their
place in every result, as NaN. ``synchrony`` estimates what stands between two records instead.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Motion(NamedTuple):
    """``time_s`` (T,) and ``pose`` (T, 3) um, um, rad."""

    time_s: Tensor
    pose: Tensor

    def part(self, start_s: float, end_s: float) -> Motion:
        """The samples with start <= time <= end."""
        inside = (self.time_s >= start_s) & (self.time_s <= end_s)
        return Motion(self.time_s[inside], self.pose[inside])

    @property
    def period_s(self) -> float:
        """Median time between samples."""
        gaps = self.time_s.diff()
        return float(gaps[gaps > 0].median())

    @property
    def components(self) -> Tensor:
        """Which of x, y and theta the record has at all: (3,) bool."""
        return self.pose.isfinite().any(0)

    @property
    def found(self) -> Tensor:
        """Which samples have every component that the record has: (T,) bool."""
        return self.pose[:, self.components].isfinite().all(1) & self.components.any()


def check_motion(name: str, motion: Motion) -> Motion:
    """The record in float64. ValueError for wrong shapes, bad or unsorted times, under 4 poses."""
    time, pose = motion.time_s.double(), motion.pose.double()
    if time.dim() != 1 or pose.shape != (len(time), 3):
        raise ValueError(f"{name}: expected times (T,) and poses (T, 3), got {tuple(time.shape)}, {tuple(pose.shape)}")
    if not bool(time.isfinite().all()):
        raise ValueError(f"{name}: times must be finite, sample {int((~time.isfinite()).nonzero()[0])} is not")
    back = (time.diff() < 0).nonzero()
    if len(back):
        k = int(back[0]) + 1
        raise ValueError(f"{name}: times must increase, sample {k} at {time[k]:.6f} s follows {time[k - 1]:.6f} s")
    good = int(Motion(time, pose).found.sum())
    if good < 4:
        raise ValueError(f"{name}: expected at least 4 samples with a finite pose, got {good} of {len(time)}")
    if int((time.diff() > 0).sum()) < 3:
        raise ValueError(f"{name}: expected at least 4 different times, got {time.unique().tolist()}")
    return Motion(time, pose)


def nearest_errors(track: Motion, sensors: Motion) -> Tensor:
    """The paper's dynamic tracking errors, (T, 3) um, um, rad: track minus the nearest sensor sample of each group.

    Both records hold the same portion of the motion. The sensors' samples are divided equally into one group per visual
    point, and of each group the one nearest to that point in x and y is taken. With frames missing, a sample belongs to
    the frame nearest in time. NaN where the track has no pose or the group no sample.
    """
    track, sensors = check_motion("track", track), check_motion("sensors", sensors)
    frame = track.time_s - track.time_s[0] + track.period_s / 2
    sample = sensors.time_s - sensors.time_s[0] + sensors.period_s / 2
    frame = frame * (sample[-1] + sensors.period_s / 2) / (frame[-1] + track.period_s / 2)
    group = torch.bucketize(sample, (frame[1:] + frame[:-1]) / 2, right=True)
    common = sensors.components & track.components
    distance = (sensors.pose - track.pose[group])[:, :2].square()[:, common[:2]].sum(1)
    distance = torch.where(sensors.found & track.found[group], distance, math.inf)
    least = torch.full_like(frame, math.inf).scatter_reduce(0, group, distance, "amin")
    chosen = ((distance == least[group]) & distance.isfinite()).nonzero()[:, 0]
    errors = torch.full_like(track.pose, math.nan)
    errors[group[chosen]] = track.pose[group[chosen]] - sensors.pose[chosen]
    return errors


class Dwells(NamedTuple):
    """Steps of a staircase: ``mean`` (K, 3) and its standard error, ``samples`` (K,) in each; per sample of the record,
    ``errors`` (T, 3) from the mean of its step and ``step`` (T,); NaN and -1 outside every dwell and where lost."""

    mean: Tensor
    standard_error: Tensor
    samples: Tensor
    errors: Tensor
    step: Tensor


def dwell_errors(motion: Motion, windows_s: Tensor) -> Dwells:
    """Averages over each dwell and the deviations from them, the paper's mean errors: windows (K, 2) start, end in s.

    The difference of two records' ``mean`` is the paper's absolute error. NaN for a dwell without samples.
    """
    motion = check_motion("dwell_errors", motion)
    if windows_s.dim() != 2 or windows_s.shape[1] != 2 or not bool((windows_s[:, 1] > windows_s[:, 0]).all()):
        raise ValueError(f"dwell_errors: windows_s must be (K, 2) with start < end, got {tuple(windows_s.shape)}")
    time = motion.time_s[:, None]
    inside = (time >= windows_s[:, 0]) & (time < windows_s[:, 1]) & motion.found[:, None]
    share = inside.double().mT
    pose = motion.pose.nan_to_num()
    count = share.sum(1)
    mean = share @ pose / count[:, None]
    owner = torch.where(inside.any(1), inside.double().argmax(1), -1)
    errors = torch.where(owner[:, None] >= 0, pose - mean[owner], math.nan)
    variance = share @ errors.nan_to_num().square() / (count[:, None] - 1).clamp(min=1)
    return Dwells(mean, (variance / count[:, None]).sqrt(), count.long(), errors, owner)
