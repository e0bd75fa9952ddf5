"""Alignments from many random starts, and servo runs of the substrate alone, with their true errors and limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.commands.servo_job import Run, ServoJob, prepare_parts, run_alignment, setting
from torch_ecc.paper.errors import in_degrees
from torch_ecc.paper.result import cells
from torch_ecc.servo.detect import find
from torch_ecc.servo.loop import servo
from torch_ecc.servo.record import Ending, Log, Result
from torch_ecc.sim.stage.axes import MultiAxisStage


class Trial(NamedTuple):
    """One alignment: how it ended, true errors of the substrate px, deg and of the tip px, frames, and the largest
    velocity and acceleration as parts of their limits."""

    ending: Ending
    substrate_px: float
    substrate_deg: float
    tip_px: float
    frames: int
    speed: float
    acceleration: float


class Single(NamedTuple):
    """A servo run of the substrate: ``result``, true ``error`` (3,) px, px, rad at its end, parts of the limits."""

    result: Result
    error: Tensor
    speed: float
    acceleration: float


def random_start(number: int, scale: float = 1.0) -> dict[str, Any]:
    """The table [start] with both parts anywhere in the view, apart from each other, theta up to 90 deg off."""
    g = torch.Generator().manual_seed(number)
    x, y, turn, px, py = torch.rand(5, generator=g, dtype=torch.float64).tolist()
    substrate = [scale * (100 + 260 * x), scale * (100 + 280 * y), 180 * turn - 90]
    return {"substrate": substrate, "probe": [scale * (520 + 50 * px), scale * (80 + 320 * py)]}


def trial(values: Mapping[str, Any]) -> Trial:
    """The alignment that a configuration describes."""
    job = ServoJob.read(values)
    alignee = prepare_parts(job)
    run: Run = run_alignment(job, alignee)
    logs, stages = [result.log for result in run.alignment.results], alignee.station.stages.values()
    used = [shares(log, stage, job.cell.microscope.period) for log, stage in zip(logs, stages, strict=False)]
    return Trial(run.alignment.ending, *run.off, sum(len(log.time) for log in logs), *map(max, zip(*used, strict=True)))


def error_cells(error: Tensor) -> list[str]:
    """An error (3,) px, px, rad as a table shows it."""
    x, y, theta = in_degrees(error).tolist()
    return [*cells((x, y), ".3f"), *cells((theta,), ".4f")]


def shares(log: Log, stage: MultiAxisStage, period: float) -> tuple[float, float]:
    """Largest commanded velocity and acceleration of a log as parts of the stage's limits."""
    speed, acceleration, _ = (v[[0, 1, 3] if log.velocity.shape[1] == 3 else [0, 1]] for v in stage.limits)
    change = torch.diff(log.velocity, dim=0, prepend=torch.zeros_like(log.velocity[:1])) / period
    return float((log.velocity.abs() / speed).max()), float((change.abs() / acceleration).max())


def single(scale: float = 1.0, **changes: Mapping[str, Any]) -> Single:
    """Servo the substrate alone (step 2, the "visual servoing step 1" of Fig. 13), with ``changes`` of the setting."""
    job = ServoJob.read(setting(scale, **changes))
    alignee = prepare_parts(job)
    plant, tracker, jacobian, _ = alignee.substrate
    x, y, deg = job.align.desired
    desired = torch.tensor((x, y, math.radians(deg)), dtype=torch.float64)
    find(tracker, plant.frame())
    result = servo(plant, tracker, desired, jacobian, control=job.control)
    used = shares(result.log, alignee.station.stages["substrate"], plant.period)
    return Single(result, alignee.station.truth("substrate") - desired, *used)
