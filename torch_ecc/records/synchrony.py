"""Two records of one motion, untriggered and at two rates: all that stands between them, estimated at once.

The clocks have an unknown offset, each record its own zero, and the image a small angle to the stage; its axes may
count the other way. The paper's comparison (``motion.nearest_errors``) leaves all of that in its errors; here what is
left is the measurement's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.records.lags import Sense, Signs, Start, starts
from torch_ecc.records.least_squares import FLOOR, least_squares, ordinary
from torch_ecc.records.motion import Motion, check_motion
from torch_ecc.records.spline import Curve

NAMES = ("offset_s", "axis_angle_rad", "x0_um", "y0_um", "theta0_rad", "scale", "lever_x_um", "lever_y_um", "rate_ppm")
ZEROS = slice(2, 5)  # among them
PPM = 1e-6
QUARTER = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)  # of a turn, as rotation(pi / 2)
NEAR_S = 2.0  # clocks that were set by hand or by network differ by less
APART = "align: the records do not overlap, see max_offset_s and the units of time"
SURE = 10.0  # nats by which one fit must be better than another that is preferred


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """What stands between the records, besides the time offset and the three zeros.

    ``angle``: between the axes of image and stage; where theta alone moves, a lever arm does the same. ``scale``: a
    factor of the track's x and y. ``lever``: the template lies away from the point whose x and y the sensors give.
    ``rate``: one clock is faster. ``exposure_s``: the camera averages the motion over it. ``max_offset_s``: how far the
    clocks may be apart; None for any time at which the records overlap. ``signs`` of the track's x, y and theta against
    the sensors'; None for whichever fit.
    """

    angle: bool = True
    scale: bool = False
    lever: bool = False
    rate: bool = False
    exposure_s: float = 0.0
    max_offset_s: float | None = None
    signs: Signs | None = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("exposure_s", "max_offset_s"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: expected a time >= 0 in s, got {value}")
        if self.signs is not None and (len(self.signs) != 3 or any(abs(sign) != 1 for sign in self.signs)):
            raise ValueError(f"signs: expected 1 or -1 for each of x, y and theta, got {self.signs}")

    def free(self, components: Tensor) -> list[int]:
        """Which of all parameters two records with these ``components`` (3,) fix."""
        x, y, theta = components.tolist()
        plane = self.angle and x and y
        lever = self.lever and theta and (x or y)
        rest = (self.scale and (x or y), lever, lever, self.rate)
        return [k for k, free in enumerate((True, plane, x, y, theta, *rest)) if free]

    def senses(self, components: Tensor, weight: Tensor) -> list[Sense]:
        """Every sense of the axes to be tried, as they are first. A turn takes x the other way where y is."""
        x, y, theta = components.tolist()
        angle, lever = self.angle and x and y, self.lever and theta
        if angle:  # a turn takes one for the other
            weight = torch.cat((weight[:2].square().mean().sqrt().expand(2), weight[2:]))
        if self.signs is not None:
            return [Sense(self.signs, angle, lever, weight)]
        both = (1.0, -1.0)
        kinds = product(both if x and not angle else both[:1], both if y else both[:1], both if theta else both[:1])
        return [Sense(signs, angle, lever, weight) for signs in sorted(kinds, reverse=True)]


class Alignment(NamedTuple):
    """What ``align_records`` found.

    ``offset_s``: a frame at time t was taken at t + offset_s on the sensors' clock, with ``rate`` estimated a frame in
    the middle of the track. ``signs`` (3,) by which x, y and theta of the track are to be multiplied first.
    ``axis_angle``: rad, to be added to ``Calibration.axis_angle``. ``zero`` (3,) um, um, rad added to the track;
    ``scale`` of the track's x and y; ``lever`` (2,) um, from the sensors' point to the template; ``rate_ppm``: how much
    more time goes by on the sensors' clock. ``names`` and ``covariance`` (P, P) of the parameters that were estimated,
    in the units of their names; infinite on the diagonal where the motion does not tell. ``errors`` (T, 3) um, um, rad:
    track minus sensors, NaN where a frame is lost or has no sensor sample around it, and for what a record has not.
    ``converged``: did the steps end? ``rival_s``: another offset at which the records fit as well, if there is one.
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
    signs: Tensor
    rate_ppm: float = 0.0
    rival_s: float | None = None

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each parameter."""
        return dict(zip(self.names, self.covariance.diagonal().sqrt().tolist(), strict=True))

    @property
    def valid(self) -> Tensor:
        """Which frames have an error: (T,) bool."""
        return self.errors.isfinite().any(1)

    @property
    def rms(self) -> Tensor:
        """Root mean square errors (3,) um, um, rad."""
        return self.errors[self.valid].square().mean(0).sqrt()

    def moved(self, pose: Tensor) -> Tensor:
        """The track's poses (T, 3) along the sensors' axes, from their zero."""
        m = pose * self.signs
        plane = self.scale * m[:, :2] @ rotation(pose.new_tensor(self.axis_angle)).mT
        return torch.cat((plane, m[:, 2:]), 1) + self.zero

    def at(self, time_s: Tensor) -> Tensor:
        """Times of the track on the sensors' clock."""
        return time_s + self.offset_s + PPM * self.rate_ppm * (time_s - _middle(time_s))


def align_records(track: Motion, sensors: Motion, unknowns: Unknowns | None = None) -> Alignment:
    """Time offset, axis angle, zeros (and signs, scale, lever arm, rate) by least squares on both whole records.

    The sensors' record s is interpolated by a cubic spline and averaged over the exposure. Then

        error(t) = scale R(axis_angle) signs m(t) + zero - s(t + offset) - (R(s_theta) - 1) lever

    is made least from every offset and sense of the axes that explains much, the best one chosen, and there once more
    with the errors of successive frames taken for what they are, not independent (see ``least_squares``). On a pure
    circle, offset and axis angle do the same: only what is not on the circle tells them apart. Of components that a
    record does not have, nothing is asked. ValueError for records that do not overlap (see ``Unknowns.max_offset_s``)
    or do not fit the description at the top.
    """
    unknowns = unknowns or Unknowns()
    track, sensors = check_motion("track", track), check_motion("sensors", sensors)
    first, shift = float(track.time_s[0]), _shift(track, sensors, unknowns)
    near = Motion(track.time_s - first, track.pose), Motion(sensors.time_s - shift - first, sensors.pose)
    model, near_s = _Model(*near, unknowns), 0.0 if shift else NEAR_S  # of clocks that are apart nothing is known
    chosen, rival = _choose(_fits(model, near_s), track.period_s, near_s)
    both = torch.ones_like(track.found)

    def common(q: Tensor) -> tuple[Tensor, Tensor]:
        residual, jacobian, valid = model(q, chosen.signs)
        both.logical_and_(valid)  # a frame that has once lain in a gap stays out, or it might come and go for ever
        return residual[both[valid]], jacobian[both[valid]]

    p, covariance, converged = least_squares(common, chosen.p, model.free, ZEROS)
    residual, _, valid = model(p, chosen.signs)
    errors = torch.full_like(track.pose, math.nan)
    errors[valid] = torch.where(model.components, residual, math.nan)
    angle, signs = _upright(float(p[1]), p.new_tensor(chosen.signs), unknowns)
    other = None if rival is None else float(rival.p[0]) + shift
    found = (float(p[0]) + shift, angle, p[ZEROS], float(p[5]), p[6:8], model.names, covariance, errors, converged)
    return Alignment(*found, signs, float(p[8]), other)


def noise(motion: Motion) -> Tensor:
    """Standard deviation (3,) of white noise on a smooth motion, from the median size of its second differences."""
    second = motion.pose.diff(n=2, dim=0)[:, motion.components]
    second = second[second.isfinite().all(1)]
    size = motion.pose.new_zeros(3)
    if len(second):
        size[motion.components] = second.abs().median(0).values
    # The median of |N(0, 1)| is 0.6745; a second difference has the variance 1 + 4 + 1.
    return (size / (0.6745 * math.sqrt(6))).maximum(size.new_tensor(FLOOR))


class _Model:
    """Errors of the track against the sensors, and their derivatives by the parameters."""

    def __init__(self, track: Motion, sensors: Motion, unknowns: Unknowns) -> None:
        self.track, self.unknowns, self.curve = track, unknowns, Curve(sensors, unknowns.exposure_s)
        self.components = track.components & sensors.components
        if not bool(self.components.any()):
            raise ValueError("align: expected at least one of x, y and theta in both records")
        self.free = unknowns.free(self.components)
        self.names = tuple(NAMES[k] for k in self.free)
        self.ago = track.time_s - _middle(track.time_s)

    def starts(self, near_s: float) -> list[Start]:
        """Where to begin, without what explains next to nothing beside the best; ``near_s``: see ``lags.starts``."""
        weight = torch.where(self.components, 1 / noise(self.track), 0.0)
        reach = math.inf if self.unknowns.max_offset_s is None else self.unknowns.max_offset_s
        found = starts(self.track, self.curve, self.unknowns.senses(self.components, weight), reach, near_s)
        if not found:
            raise ValueError(APART)
        least = 0.5 * max(start.explained for start in found)
        return [start for start in found if start.explained >= least]

    def spread(self, p: Tensor, valid: Tensor) -> Tensor:
        """What there would be to explain in these frames: (3,) um, um, rad."""
        m, s = self.track.pose[valid].nan_to_num(), self.curve(self.track.time_s[valid] + p[0])[0]
        square = (m.var(0) + s.var(0)) * self.components
        if bool(self.components[:2].all()):
            square[:2] = square[:2].mean()
        return square.sqrt()

    def __call__(self, p: Tensor, signs: Signs) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals (V, 3), Jacobian (V, 3, P) and the frames (T,) that have both records."""
        time = self.track.time_s + p[0] + PPM * p[8] * self.ago
        s, inside = self.curve(time)
        valid = self.track.found & inside
        if int(valid.sum()) < max(4, len(self.free)):
            raise ValueError(APART)
        s, speed = s[valid], self.curve.speed(time[valid])
        m = self.track.pose[valid].nan_to_num() * p.new_tensor(signs)
        sense = math.prod(signs)  # in which the stage turns while its theta grows
        lever, whirl = rotation(sense * s[:, 2]), sense * rotation(sense * s[:, 2] + math.pi / 2)
        lever = lever - torch.eye(2, dtype=lever.dtype)
        residual = m + p[ZEROS] - s
        seen = s[:, :2] + lever @ p[6:8] - p[2:4]  # by the sensors: the track's own noise would pose as knowledge
        residual[:, :2] = p[5] * m[:, :2] @ rotation(p[1]).mT - seen
        jacobian = m.new_zeros(len(m), 3, len(NAMES))
        jacobian[:, :, 0] = -speed
        jacobian[:, :2, 0] -= (whirl @ p[6:8]) * speed[:, 2:]
        jacobian[:, :, 8] = PPM * self.ago[valid, None] * jacobian[:, :, 0]
        jacobian[:, :2, 1] = seen @ QUARTER.mT
        jacobian[:, :, ZEROS] = torch.eye(3, dtype=m.dtype)
        jacobian[:, :2, 5] = seen / p[5]
        jacobian[:, :2, 6:8] = -lever
        share = self.components.double()
        return residual * share, jacobian[:, :, self.free] * share[:, None], valid


class _Fit(NamedTuple):
    """The best parameters ``p`` around one start, with ``left`` (3,) rms errors of ``frames`` frames, ``explained``
    nats, and the share of them that counts if the errors of successive frames are not independent."""

    p: Tensor
    signs: Signs
    left: Tensor
    frames: int
    explained: float
    independent: float


def _fits(model: _Model, near_s: float) -> list[_Fit]:
    """The fit from every start. ValueError if the records overlap at none."""
    found = [fit for start in model.starts(near_s) if (fit := _fit(model, start)) is not None]
    if not found:
        raise ValueError(APART)
    return found


def _fit(model: _Model, start: Start) -> _Fit | None:
    """The fit around a start with frames taken as independent; None if it leads to where the records do not overlap."""
    p = torch.zeros(len(NAMES), dtype=torch.float64)
    p[0], p[1], p[5] = start.offset_s, start.angle, 1.0
    try:
        p[ZEROS] -= model(p, start.signs)[0].mean(0)
        p, residual = ordinary(lambda q: model(q, start.signs)[:2], p, model.free)
    except ValueError:
        return None
    left = residual.std(0).maximum(residual.new_tensor(FLOOR))
    ratio = (model.spread(p, model(p, start.signs)[2]) / left).clamp(min=1.0)
    before, after = residual[:-1], residual[1:]
    alike = (before * after).sum(0) / residual.square().sum(0).clamp(min=1e-300)
    independent = float(((1 - alike.square()) / (1 + alike.square()))[model.components].mean())
    return _Fit(p, start.signs, left, len(residual), len(residual) * float(ratio.log().sum()), independent)


def _choose(fits: list[_Fit], period_s: float, near_s: float) -> tuple[_Fit, _Fit | None]:
    """The fit to believe, and another one as good at another offset if there is one.

    Of those that are not clearly worse than the best, that with the axes as they are goes before others, and that with
    nearly the same clocks.
    """
    best = max(fits, key=lambda fit: fit.explained)

    def as_good(fit: _Fit) -> bool:
        count = best.independent * min(fit.frames, best.frames)
        much = fit.frames >= 0.5 * best.frames and fit.explained >= 0.5 * best.explained
        return much and count * float((fit.left / best.left).log().sum()) < SURE

    liked = [fit for fit in fits if as_good(fit)]
    chosen = max(liked, key=lambda fit: (sum(fit.signs), abs(float(fit.p[0])) <= near_s, fit.explained))
    others = [fit for fit in liked if abs(float(fit.p[0] - chosen.p[0])) > 2 * period_s]
    return chosen, max(others, key=lambda fit: fit.explained, default=None)


def _shift(track: Motion, sensors: Motion, unknowns: Unknowns) -> float:
    """What to take off the sensors' clock first, in s: clocks that are years apart do not meet by themselves."""
    t, s = track.time_s, sensors.time_s
    apart = bool(s[0] > t[-1] + NEAR_S) or bool(t[0] > s[-1] + NEAR_S)
    return float(s[0] - t[0]) if apart and unknowns.max_offset_s is None else 0.0


def _upright(angle: float, signs: Tensor, unknowns: Unknowns) -> tuple[float, Tensor]:
    """The least angle: y the other way and half a turn is x the other way."""
    if unknowns.signs is None and unknowns.angle and signs[1] < 0 and math.cos(angle) < 0:
        return math.remainder(angle - math.pi, math.tau), signs * signs.new_tensor((-1.0, -1.0, 1.0))
    return math.remainder(angle, math.tau), signs


def _middle(time_s: Tensor) -> float:
    return 0.5 * float(time_s[0] + time_s[-1])
