"""A record between its samples: a cubic spline at any times, undefined in gaps."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.records.motion import Motion

INSTANTS = 8  # of one exposure, over which the dense record is averaged
GAP = 3.0  # median periods without a sample that are not interpolated over
CLOSE = 0.25  # of the median period: samples nearer than that are one, for a spline through both would run wild
PASSES = 40  # of Jacobi for the spline: 1e-12


class Curve:
    """A record between its samples, whose times only must not decrease.

    ``exposure_s``: values are means over this time around the instant.
    """

    def __init__(self, motion: Motion, exposure_s: float = 0.0) -> None:
        self.period_s = motion.period_s
        self.time, self.pose = _merged(motion, CLOSE * self.period_s)
        self.slope = spline_slopes(self.time, self.pose)
        self.gap = GAP * self.period_s
        count = INSTANTS if exposure_s > 0 else 1
        self.instants = exposure_s * ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5)

    def __call__(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., 3) and whether they are defined (...) at times (...)."""
        t = time_s[..., None] + self.instants
        k = (torch.searchsorted(self.time, t, right=True) - 1).clamp(0, len(self.time) - 2)
        h = self.time[k + 1] - self.time[k]
        u = (t - self.time[k]) / h
        inside = (u >= 0) & (u <= 1) & (h <= self.gap)
        u, h = u[..., None], h[..., None]
        a, b, da, db = self.pose[k], self.pose[k + 1], h * self.slope[k], h * self.slope[k + 1]
        rise = b - a
        value = a + u * (da + u * (3 * rise - 2 * da - db + u * (da + db - 2 * rise)))
        return value.mean(-2), inside.all(-1)

    def speed(self, time_s: Tensor) -> Tensor:
        """Velocities (..., 3) per s at times (...), over one sample before and after.

        The spline's own slope is made of the samples whose noise is in the value, and would go along with it.
        """
        before, after = time_s - self.period_s, time_s + self.period_s
        (a, has_a), (b, has_b), (middle, _) = self(before), self(after), self(time_s)
        a, b = torch.where(has_a[..., None], a, middle), torch.where(has_b[..., None], b, middle)
        return (b - a) / (self.period_s * (has_a.double() + has_b.double()).clamp(min=1))[..., None]


def _merged(motion: Motion, apart_s: float) -> tuple[Tensor, Tensor]:
    """Times and poses with a pose, those less than ``apart_s`` after the first of a group by their mean."""
    time, pose = motion.time_s[motion.found], motion.pose[motion.found].nan_to_num()
    if bool((time.diff() >= apart_s).all()) and bool((time.diff() > 0).all()):
        return time.contiguous(), pose
    group, first = [-1], -float("inf")
    for t in time.tolist():
        fresh = t - first > apart_s
        first = t if fresh else first
        group.append(group[-1] + fresh)
    index = torch.tensor(group[1:])
    count = torch.bincount(index).double()
    mean = torch.zeros(len(count), 4, dtype=time.dtype).index_add(0, index, torch.cat((time[:, None], pose), 1))
    mean = mean / count[:, None]
    return mean[:, 0].contiguous(), mean[:, 1:]


def spline_slopes(time: Tensor, values: Tensor) -> Tensor:
    """Slopes (T, C) of the cubic spline through values (T, C) at uneven times (T,), whose second derivative is steady.

    The tridiagonal equations are diagonally dominant by 2, so that every pass of Jacobi halves the error.
    """
    h = time.diff()[:, None]
    rise = values.diff(dim=0) / h
    slope = torch.gradient(values, spacing=(time,), dim=0, edge_order=1)[0]
    before, after = h[:-1], h[1:]
    right = 3 * (after * rise[:-1] + before * rise[1:])
    for _ in range(PASSES):
        slope[1:-1] = (right - after * slope[:-2] - before * slope[2:]) / (2 * (before + after))
    return slope
