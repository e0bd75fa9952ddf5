"""Figs. 6 and 7: circles of 8 and 12 um, by camera and capacitive sensors. Simulated once for both figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_ecc.paper.acquisition import COMMAND_HZ, Acquisition, Bench, ease, microscope, simulated_once, zeroed
from torch_ecc.paper.errors import valid
from torch_ecc.paper.result import Advance, counter
from torch_ecc.records.calibration import Calibration
from torch_ecc.records.curves import Circle, Ellipse, fit_circle, fit_ellipse, fit_line
from torch_ecc.records.motion import Motion, nearest_errors
from torch_ecc.records.spline import Curve
from torch_ecc.records.synchrony import Alignment, align_records

RADII = (8.0, 12.0)  # um, commanded
ZOOM = 2.0  # 0.275 um per px
REST_S = 0.05  # of the whole, at which both records are zeroed
ON_RIM = 0.9  # of the largest distance from rest: the circular portion
ON_LINE = (0.02, 0.95)  # the straight portion


class Round(NamedTuple):
    """One circle: both records zeroed at rest, and what the analyses make of them.

    ``dynamic`` and the residuals of ``joint`` (., 3) um, um, rad are errors by the paper's method, of the circular
    portion ``portion`` (.,) of the frames, and by the joint estimate. ``line_angle`` in rad is that of image against
    stage by straight lines. ``parts`` (3,) um, um, rad are the rms "known" that is left with clocks and angle known
    exactly, and what the vibration of the "lens", the "tracker" and the sensors, "CDS", have in it.
    """

    radius: float
    axis_angle: float
    acquired: Acquisition
    track: Motion
    sensors: Motion
    portion: Tensor
    dynamic: Tensor
    joint: Alignment
    line_angle: float
    circle: Circle
    ellipse: Ellipse
    parts: dict[str, Tensor]


@simulated_once
def rounds(quick: bool, advance: Advance) -> list[Round]:
    """Both circles; simulated at the first call only. ``quick``: in 3 s, and a smaller part of the sensor."""
    bench = Bench(microscope(quick, zoom=ZOOM))
    commands = {radius: command(radius, 3.0 if quick else 10.0) for radius in RADII}
    tick = counter(sum(map(bench.frames, commands.values())), advance)
    return [one_round(*each, replace(bench, seed=k), tick) for k, each in enumerate(commands.items())]


def command(radius: float, length_s: float) -> Tensor:
    """Rest, the line to (radius, 0), one round, the line back, rest: (T, 3) um, um, rad at 1 kHz, eased everywhere."""
    u = torch.arange(0, length_s * COMMAND_HZ + 0.5, dtype=torch.float64) / (length_s * COMMAND_HZ)
    out = radius * (ease((u - 0.1) / 0.15) - ease((u - 0.8) / 0.15))
    phase = math.tau * ease((u - 0.25) / 0.55)
    return torch.stack((out * phase.cos(), out * phase.sin(), 0 * u), -1)


def one_round(radius: float, path: Tensor, bench: Bench, tick: Callable[[], None]) -> Round:
    """Simulate, track and analyse one circle."""
    acquired = bench.acquire(path, tick)
    rest = REST_S * len(path) / COMMAND_HZ
    track, sensors = zeroed(acquired.tracks["ECC"], rest), zeroed(acquired.sensors, rest)
    visual, sensed = portions(track)[1], portions(sensors)[1]
    cut = [Motion(m.time_s[rows], m.pose[rows]) for m, rows in ((track, visual), (sensors, sensed))]
    points = cut[1].pose[:, :2]
    turn = Calibration(1.0, bench.microscope.axis_angle)
    turned, image = (turn.to_physical(m.pose) for m in (acquired.tracks["ECC"], acquired.truth))
    at = acquired.truth.time_s + acquired.offset_s
    differences = {
        "known": turned - Curve(acquired.sensors)(at)[0],
        "lens": image - acquired.motion.at(at),
        "tracker": turned - image,
        "CDS": acquired.sensors.pose - acquired.motion.at(acquired.sensors.time_s),
    }
    return Round(
        radius,
        bench.microscope.axis_angle,
        acquired,
        track,
        sensors,
        visual,
        nearest_errors(*cut),
        align_records(track, sensors),
        line_angle(track, sensors),
        fit_circle(points),
        fit_ellipse(points),
        {name: valid(difference).std(0) for name, difference in differences.items()},
    )


def portions(motion: Motion) -> tuple[Tensor, Tensor, Tensor]:
    """The straight way out, the circular portion and the way back, (T,) each, as the record itself shows them.

    The circle is what lies between the first and the last sample near the rim.
    """
    distance = motion.pose[:, :2].norm(dim=1).nan_to_num()
    on_rim, low, high = (share * distance.max() for share in (ON_RIM, *ON_LINE))
    rim, index = (distance > on_rim).nonzero()[:, 0], torch.arange(len(distance))
    line = (distance > low) & (distance < high)
    return line & (index < rim[0]), (index >= rim[0]) & (index <= rim[-1]), line & (index > rim[-1])


def line_angle(track: Motion, sensors: Motion) -> float:
    """Angle in rad from the image's axes to the stage's by straight lines, mean of the ways out and back."""
    image, stage = ([fit_line(m.pose[way, :2]).angle for way in portions(m)[::2]] for m in (track, sensors))
    return sum(math.remainder(a - b, math.tau) for a, b in zip(image, stage, strict=True)) / 2


def common_angle(found: list[Round]) -> float:
    """``line_angle`` of all circles together, weighted by what lines of such length tell: their length squared."""
    return float(np.average([r.line_angle for r in found], weights=[r.radius**2 for r in found]))
