"""Two records of one motion, untriggered and at two rates: all that stands between them, estimated at once.

The clocks have an unknown offset, each record its own zero, and the image a small angle to the stage. The paper's
comparison (``comparison.nearest_errors``) leaves all of that in its errors; here what is left is the measurement's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.records.motion import Motion, check_motion

INSTANTS = 8  # of one exposure, over which the dense record is averaged
GAP = 3.0  # median periods without a sample that are not interpolated over
POINTS, LAGS = 1000, 8000  # frames and offsets tried in the first search for the offset, at most
PASSES = 40  # of Jacobi for the spline: 1e-12
CHUNK = 64_000  # interpolated poses at once
NAMES = ("offset_s", "axis_angle_rad", "x0_um", "y0_um", "theta0_rad", "scale", "lever_x_um", "lever_y_um")
FLOOR = (1e-6, 1e-6, 1e-9)  # um, um, rad: below this a record is exact


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """What stands between the records, besides the time offset and the three zeros.

    ``angle``: between the axes of image and stage; where theta alone moves, a lever arm does the same. ``scale``: a
    factor of the track's x and y. ``lever``: the template lies away from the point whose x and y the sensors give.
    ``exposure_s``: the camera averages the motion over it. ``max_offset_s``: how far the clocks may be apart.
    """

    angle: bool = True
    scale: bool = False
    lever: bool = False
    exposure_s: float = 0.0
    max_offset_s: float = 2.0

    def __post_init__(self) -> None:
        for name in ("exposure_s", "max_offset_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: expected a time >= 0 in s, got {value}")

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters in their order."""
        return tuple(name for name, free in zip(NAMES, self.free, strict=True) if free)

    @property
    def free(self) -> tuple[bool, ...]:
        """Which of all parameters are estimated."""
        return (True, self.angle, True, True, True, self.scale, self.lever, self.lever)


class Alignment(NamedTuple):
    """What ``align_records`` found.

    ``offset_s``: a frame at time t was taken at t + offset_s on the sensors' clock. ``axis_angle``: rad, to be added to
    ``Calibration.axis_angle``. ``zero`` (3,) um, um, rad added to the track; ``scale`` of the track's x and y;
    ``lever`` (2,) um, from the sensors' point to the template. ``names`` and ``covariance`` (P, P) of the parameters
    that were estimated, in the units of their names; infinite on the diagonal where the motion does not tell.
    ``errors`` (T, 3) um, um, rad: track minus sensors, NaN where a frame is lost or has no sensor sample around it.
    ``converged``: did the steps end?
    """

    offset_s: float
    axis_angle: float
    zero: Tensor
    scale: float
    lever: Tensor
    names: tuple[str, ...]
    covariance: Tensor
    errors: Tensor
    converged: bool

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each parameter."""
        return dict(zip(self.names, self.covariance.diagonal().sqrt().tolist(), strict=True))

    @property
    def valid(self) -> Tensor:
        """Which frames have an error: (T,) bool."""
        return self.errors.isfinite().all(1)

    @property
    def rms(self) -> Tensor:
        """Root mean square errors (3,) um, um, rad."""
        return self.errors[self.valid].square().mean(0).sqrt()


def align_records(track: Motion, sensors: Motion, unknowns: Unknowns | None = None) -> Alignment:
    """Time offset, axis angle, zeros (and scale, lever arm) by least squares on both whole records.

    The sensors' record s is interpolated by a cubic spline and averaged over the exposure. Then

        error(t) = scale R(axis_angle) m(t) + zero - s(t + offset) - (R(s_theta) - 1) lever

    is made least by Gauss-Newton, each of x, y and theta weighted by its own scatter. The covariance takes errors of
    different frames as independent. On a pure circle, offset and axis angle do the same: only what is not on the circle
    tells them apart. ValueError for records that do not overlap (see ``Unknowns.max_offset_s``) or do not fit the
    description at the top.
    """
    track, sensors = check_motion("track", track), check_motion("sensors", sensors)
    model = _Model(track, Curve(sensors, (unknowns or Unknowns()).exposure_s), unknowns or Unknowns())
    p = torch.zeros(8, dtype=torch.float64)
    p[0], p[5] = model.search(), 1.0
    weight, converged = 1 / noise(track), False
    for _ in range(50):
        residual, jacobian, _ = model(p)
        step, _ = _solve(residual, jacobian, weight)
        p[model.free] -= step
        used, weight = weight, 1 / residual.square().mean(0).sqrt().maximum(p.new_tensor(FLOOR))
        settled = ((used / weight - 1).abs() <= 1e-6).all()  # under new weights the next step is no longer small
        converged = bool(settled and (step.abs() <= 1e-9 * (1 + p[model.free].abs())).all())
        if converged:
            break
    residual, jacobian, valid = model(p)
    _, covariance = _solve(residual, jacobian, weight)
    errors = torch.full_like(track.pose, math.nan)
    errors[valid] = residual
    return Alignment(float(p[0]), float(p[1]), p[2:5], float(p[5]), p[6:], model.names, covariance, errors, converged)


class Curve:
    """A record between its samples: a cubic spline, undefined in its gaps.

    ``exposure_s``: values are means over this time around the instant.
    """

    def __init__(self, motion: Motion, exposure_s: float = 0.0) -> None:
        good = motion.pose.isfinite().all(1)
        self.time, self.pose = motion.time_s[good].contiguous(), motion.pose[good]
        self.slope = spline_slopes(self.time, self.pose)
        self.period_s = motion.period_s
        self.gap = GAP * self.period_s
        count = INSTANTS if exposure_s > 0 else 1
        self.instants = exposure_s * ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5)

    def __call__(self, time_s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Poses (..., 3), velocities (..., 3) per s and whether they are defined (...) at times (...)."""
        t = time_s[..., None] + self.instants
        k = (torch.searchsorted(self.time, t, right=True) - 1).clamp(0, len(self.time) - 2)
        h = self.time[k + 1] - self.time[k]
        u = (t - self.time[k]) / h
        inside = (u >= 0) & (u <= 1) & (h <= self.gap)
        u, h = u[..., None], h[..., None]
        a, b, da, db = self.pose[k], self.pose[k + 1], h * self.slope[k], h * self.slope[k + 1]
        rise = b - a
        value = a + u * (da + u * (3 * rise - 2 * da - db + u * (da + db - 2 * rise)))
        speed = (da + u * (2 * (3 * rise - 2 * da - db) + 3 * u * (da + db - 2 * rise))) / h
        return value.mean(-2), speed.mean(-2), inside.all(-1)


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


def noise(motion: Motion) -> Tensor:
    """Standard deviation (3,) of white noise on a smooth motion, from the median size of its second differences."""
    second = motion.pose.diff(n=2, dim=0)
    second = second[second.isfinite().all(1)]
    size = second.abs().median(0).values if len(second) else torch.zeros(3, dtype=torch.float64)
    # The median of |N(0, 1)| is 0.6745; a second difference has the variance 1 + 4 + 1.
    return (size / (0.6745 * math.sqrt(6))).maximum(size.new_tensor(FLOOR))


class _Model:
    """Errors of the track against the sensors, and their derivatives by (offset, angle, zeros, scale, lever)."""

    def __init__(self, track: Motion, curve: Curve, unknowns: Unknowns) -> None:
        self.track, self.curve, self.unknowns, self.names = track, curve, unknowns, unknowns.names
        self.good = track.pose.isfinite().all(1)
        self.free = [k for k, free in enumerate(unknowns.free) if free]

    def __call__(self, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals (V, 3), Jacobian (V, 3, P) and the frames (T,) that have both records."""
        s, speed, inside = self.curve(self.track.time_s + p[0])
        valid = self.good & inside
        if int(valid.sum()) < len(self.free):
            raise ValueError("align: the records do not overlap, see max_offset_s and the units of time")
        m, s, speed = self.track.pose[valid], s[valid], speed[valid]
        turned, across = m[:, :2] @ rotation(p[1]).mT, m[:, :2] @ rotation(p[1] + math.pi / 2).mT
        lever, whirl = rotation(s[:, 2]), rotation(s[:, 2] + math.pi / 2)
        lever = lever - torch.eye(2, dtype=lever.dtype)
        residual = m + p[2:5] - s
        residual[:, :2] = p[5] * turned + p[2:4] - s[:, :2] - lever @ p[6:]
        jacobian = m.new_zeros(len(m), 3, 8)
        jacobian[:, :, 0] = -speed
        jacobian[:, :2, 0] -= (whirl @ p[6:]) * speed[:, 2:]
        jacobian[:, :2, 1] = p[5] * across
        jacobian[:, :, 2:5] = torch.eye(3, dtype=m.dtype)
        jacobian[:, :2, 5] = turned
        jacobian[:, :2, 6:] = -lever
        return residual, jacobian[:, :, self.free], valid

    def search(self) -> float:
        """The offset at which the records are most alike at any angle between them.

        On a grid of a quarter of a frame first, then to a sample of the sensors: ringing has minima of its own.
        """
        reach, good = self.unknowns.max_offset_s, self.good
        time, m = self.track.time_s[good], self.track.pose[good]
        every = -(-len(time) // POINTS)
        best = self._best(time[::every], m[::every], _grid(reach, self.track.period_s / 4))
        near = min(2 * self.track.period_s, reach)
        return self._best(time, m, best + _grid(near, self.curve.period_s))

    def _best(self, time: Tensor, m: Tensor, lags: Tensor) -> float:
        """The offset among ``lags`` (J,) of least unlikeness where at least half as many frames count as anywhere."""
        weight, chunk = 1 / noise(self.track), max(1, CHUNK // len(time))
        found = [self._unlikeness(time, m, some, weight) for some in lags.split(chunk)]
        cost, frames = (torch.cat(part) for part in zip(*found, strict=True))
        if int(frames.max()) < 4:
            raise ValueError("align: the records do not overlap, see max_offset_s and the units of time")
        return float(lags[torch.where(frames >= 0.5 * frames.max(), cost, math.inf).argmin()])

    def _unlikeness(self, time: Tensor, m: Tensor, lags: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted mean square differences (J,) at offsets (J,), least over zeros and angle, and frames counted."""
        s, _, inside = self.curve(time + lags[:, None])
        share = inside.double() / inside.sum(1, keepdim=True).clamp(min=1)
        s = s - (share[..., None] * s).sum(1, keepdim=True)
        m = m - (share[..., None] * m).sum(1, keepdim=True)
        if self.unknowns.lever:  # whatever goes along with theta may be the lever's
            z, w = (_without(v[..., :2], s[..., 2:], share[..., None]) for v in (m, s))
        else:
            z, w = m[..., :2], s[..., :2]
        z, w = (torch.complex(v[..., 0], v[..., 1]) for v in (z, w))
        product = (share * z * w.conj()).sum(1)
        alike = 2 * (product.abs() if self.unknowns.angle else product.real)
        plane = (share * (z.abs().square() + w.abs().square())).sum(1) - alike
        turn = (share * (m[..., 2] - s[..., 2]).square()).sum(1)
        return plane * weight[:2].square().mean() + turn * weight[2].square(), inside.sum(1)


def _grid(reach: float, step: float) -> Tensor:
    """Offsets from -reach to reach about ``step`` apart, at most ``LAGS``; one at 0 for no reach."""
    count = min(2 * math.ceil(reach / step) + 1, LAGS)
    return torch.linspace(-reach, reach, count, dtype=torch.float64) if reach > 0 else torch.zeros(1).double()


def _without(values: Tensor, along: Tensor, share: Tensor) -> Tensor:
    """Centred ``values`` (J, T, 2) without their part along (J, T, 1), frames weighted by ``share`` (J, T, 1)."""
    part = (share * along * values).sum(1, keepdim=True) / (share * along.square()).sum(1, keepdim=True).clamp(
        min=1e-30
    )
    return values - part * along


def _solve(residual: Tensor, jacobian: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss-Newton step (P,) and covariance (P, P) of residuals (V, 3) weighted by (3,).

    Directions that the residuals do not fix are left alone, and what has a part in them gets an infinite variance.
    """
    r, J = (residual * weight).flatten(), (jacobian * weight[:, None]).flatten(0, 1)
    size = torch.linalg.vector_norm(J, dim=0)
    J = J / size.clamp(min=1e-300)
    values, vectors = torch.linalg.eigh(J.mT @ J)
    seen = values > 1e-12
    inverse = (vectors * torch.where(seen, 1 / values.clamp(min=1e-300), 0.0)) @ vectors.mT
    blind = ((vectors.square() * ~seen).sum(1) > 1e-6) | (size == 0)
    factor = size.clamp(min=1e-300)
    step = (inverse @ (J.mT @ r)) / factor
    covariance = inverse / torch.outer(factor, factor) * (r @ r / max(len(r) - len(size), 1))
    covariance[blind, blind] = math.inf
    return torch.where(size > 0, step, 0.0), covariance
