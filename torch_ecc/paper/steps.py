"""Figs. 8 to 11: steps of theta of 0.04 deg up to 0.24 deg and back under uneven light, by ECC, SSD and CDS.

Simulated once for all four figures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.paper.acquisition import COMMAND_HZ, Acquisition, Bench, microscope, simulated_once, zeroed
from torch_ecc.paper.result import Advance, Table, cells, counter
from torch_ecc.records.calibration import Calibration
from torch_ecc.records.motion import Dwells, Motion, dwell_errors
from torch_ecc.records.synchrony import Alignment, Unknowns, align_records
from torch_ecc.sim import GradientLight, LampDrift, Lights, Microscope

STEP_DEG, HIGHEST = 0.04, 6
LEVELS = torch.tensor((*range(HIGHEST + 1), *range(HIGHEST - 1, -1, -1)), dtype=torch.float64)  # in steps
LEVELS_DEG = STEP_DEG * LEVELS  # what is commanded
ZOOM = 0.7  # "the focal length of the zoom lens is set to the minimum"
VIEW_UM = (1500.0, -1000.0)  # the template, from the origin of the stage's moving part
LAMP = 0.2  # of its light that the lamp gains in the first half of the staircase, and loses in the second
GAIN = 0.8  # of the camera, so that nothing is clipped at that
SETTLE_S = 0.15  # after which a dwell is counted
METHODS = {"ECC": {}, "ECC, gain": {"illumination": "gain"}, "SSD": {"criterion": "ssd"}}


def step_table(title: str, columns: Mapping[str, Tensor], first: int = 0) -> Table:
    """Angles (K,) in deg by name beside those commanded at steps ``first``, ``first`` + 1, ..."""
    values = zip(LEVELS_DEG[first:].tolist(), *(column.tolist() for column in columns.values()), strict=True)
    rows = [(f"{k}", f"{level:.2f}", *cells(row, ".5f")) for k, (level, *row) in enumerate(values, first)]
    return Table(title, ("step", "commanded", *columns), rows)


class Staircase(NamedTuple):
    """Records zeroed at rest, and their dwells: ``tracks`` and ``dwells`` by method, "CDS" among the dwells.

    ``alignment`` is that of ECC with the sensors, with the lever arm from the sensors' point to the template;
    ``windows_s`` (K, 2) where each dwell counts on the sensors' clock; ``calibration`` from the image to the stage.
    """

    acquired: Acquisition
    tracks: dict[str, Motion]
    sensors: Motion
    dwells: dict[str, Dwells]
    alignment: Alignment
    windows_s: Tensor
    calibration: Calibration

    def mean_deg(self, method: str) -> Tensor:
        """Mean theta (K,) in deg of each step."""
        theta: Tensor = self.dwells[method].mean[:, 2].rad2deg()
        return theta


def command(dwell_s: float) -> Tensor:
    """Thirteen dwells of theta at (0, 0): (T, 3) um, um, rad at 1 kHz."""
    theta = math.radians(STEP_DEG) * LEVELS
    turn = theta.repeat_interleave(round(dwell_s * COMMAND_HZ))
    return torch.stack((0 * turn, 0 * turn, turn), -1)


@simulated_once
def staircase(quick: bool, advance: Advance) -> Staircase:
    """Dwells of 3 s; simulated at the first call only. ``quick``: dwells of 0.3 s, and a smaller part of the sensor."""
    return climbed(lambda view, light: Bench(view, light, GAIN, METHODS), 0.3 if quick else 3.0, quick, advance)


def climbed(bench: Callable[[Microscope, Lights], Bench], dwell_s: float, quick: bool, advance: Advance) -> Staircase:
    """What a ``bench`` records of the staircase under a lamp that drifts, in dwells of ``dwell_s``."""
    view, path = microscope(quick, zoom=ZOOM, view_um=VIEW_UM), command(dwell_s)
    frames = Bench(view).frames(path)
    light = Lights((GradientLight(), LampDrift(LAMP, period=2.2 * frames)))
    return compared(bench(view, light).acquire(path, counter(frames, advance)), view, dwell_s)


def compared(acquired: Acquisition, view: Microscope, dwell_s: float) -> Staircase:
    """The dwells of ``dwell_s`` of all records of a staircase that a microscope has seen, on one clock."""
    angle, rest = view.axis_angle, dwell_s / 4  # the angle is known from the circles
    turn, calibration = Calibration(1.0, angle), Calibration(view.um_per_px, angle)
    sensors = zeroed(acquired.sensors, rest)
    tracks = {name: zeroed(Motion(m.time_s, turn.to_physical(m.pose)), rest) for name, m in acquired.tracks.items()}
    unknowns = Unknowns(angle=False, lever=True, max_offset_s=0.5)
    alignment = align_records(tracks["ECC"], sensors, unknowns)
    starts = dwell_s * torch.arange(len(LEVELS), dtype=torch.float64)
    windows = torch.stack((starts + SETTLE_S, starts + dwell_s - 0.01), 1)
    dwells = {name: dwell_errors(m, windows - alignment.offset_s) for name, m in tracks.items()}
    dwells["CDS"] = dwell_errors(sensors, windows)
    return Staircase(acquired, tracks, sensors, dwells, alignment, windows, calibration)
