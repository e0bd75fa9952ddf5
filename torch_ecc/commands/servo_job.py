"""The alignment of section V on the simulated workstation, from a configuration to poses, logs and true errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.commands.jobs import Align
from torch_ecc.config import fill, refuse_unknown
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.pose import transform
from torch_ecc.records.calibration import Calibration
from torch_ecc.servo.alignment import Alignment, Part, align_parts
from torch_ecc.servo.control import Control
from torch_ecc.servo.jacobian import StageJacobian
from torch_ecc.servo.record import Step
from torch_ecc.sim.stage.workstation import Workstation
from torch_ecc.sim.workcell import TABLES, Workcell, read_workcell
from torch_ecc.track.tracker import Tracker

NOISE = {"noise": 0.05}  # um/s, rms error of a velocity
COVERED = 0.98  # opacity from which a pixel belongs to the probe's template
Observer = Callable[[Tensor, Estimate, Step], None]


def setting(scale: float = 1.0, **changes: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of configs/servo.toml, with lengths in the picture times ``scale``, and ``changes`` of tables."""

    def px(*values: float) -> list[float]:
        return [scale * value for value in values]

    axis, axes = px(120, -60), {"x": NOISE, "y": NOISE}
    values: dict[str, Any] = {
        "align": {"desired": [*px(250, 240), 0.0], "landing": px(110, 30), "size": 2 * round(60 * scale) + 1},
        "control": {"gain": 2.0},
        "belief": {"um_per_px": 0.275 / scale, "axis_angle_deg": 0.0, "axis": axis},
        "start": {"substrate": [*px(215, 270), 35.0], "probe": px(555, 130), "height": 5.0},
        "substrate": {"home": px(250, 240), "um_per_px": 0.275 / scale, "axis": axis, **axes},
        "probe": {"home": px(540, 130), "um_per_px": 0.275 / scale, **axes},
        "look": {"scale": scale},
        "microscope": {},
        "scene": {"kind": "micrograph"},
        "light": [{"kind": "gradient", "x": 0.25, "y": 0.15}],
        "camera": {"size": [round(480 * scale), round(640 * scale)], "noise_sigma": 2.0},
    }
    return {
        name: values.get(name, {}) | dict(changes.get(name, {})) if name != "light" else values[name]
        for name in (*values, *(set(changes) - set(values)))
    }


@dataclass(frozen=True)
class Belief:
    """What the controller takes the stages to be like: scale, angle of the axes, the substrate's axis of rotation."""

    um_per_px: float
    axis_angle_deg: float = 0.0
    axis: tuple[float, float] = (0.0, 0.0)

    def jacobian(self, *, rotary: bool) -> StageJacobian:
        """The image Jacobian that follows."""
        calibration = Calibration(self.um_per_px, math.radians(self.axis_angle_deg))
        return StageJacobian(calibration, self.axis, rotary)


@dataclass(frozen=True, eq=False)
class ServoJob:
    """A checked configuration."""

    align: Align
    control: Control
    belief: Belief
    cell: Workcell

    @classmethod
    def read(cls, values: Mapping[str, Any], *, folder: Path | str = ".") -> ServoJob:
        """From nested tables. ValueError for whatever does not fit; nothing is rendered."""
        refuse_unknown(values, ("align", "control", "belief", *TABLES), "servo")
        for key in ("align", "belief", "start"):
            if key not in values:
                raise ValueError(f"servo: missing table [{key}]")
        align, belief = fill(Align, values["align"], "[align]"), fill(Belief, values["belief"], "[belief]")
        control = fill(Control, values.get("control", {}), "[control]")
        return cls(align, control, belief, read_workcell(values, folder=folder))


class Run(NamedTuple):
    """A finished alignment, and by the simulator's own account: the substrate's ``error`` (3,) px, px, rad, and the
    ``miss`` (2,) px from the landing point to the tip. ``frames`` (h, w) are those at the end of each step."""

    alignment: Alignment
    error: Tensor
    miss: Tensor
    frames: list[Tensor]

    @property
    def off(self) -> tuple[float, float, float]:
        """By how much: the substrate in px and in deg, the tip in px."""
        return float(self.error[:2].norm()), math.degrees(abs(float(self.error[2]))), float(self.miss.norm())


class Alignee(NamedTuple):
    """The workstation of a job with both parts ready to be aligned."""

    station: Workstation
    substrate: Part
    probe: Part
    shapes: list[tuple[int, int] | Tensor]


def prepare_parts(job: ServoJob) -> Alignee:
    """Build the workstation and cut both templates from its lesson."""
    station, lesson, size = job.cell.build(), job.cell.lesson(), job.align.size
    homes = [torch.tensor([job.cell.mounts[part].home], dtype=torch.float64) for part in ("substrate", "probe")]
    mask = probe_mask(station, homes[1][0], (lesson.shape[0], lesson.shape[1]), size)
    trackers = Tracker(lesson, homes[0], size), Tracker(lesson, homes[1], size, mask=mask)
    beliefs = job.belief.jacobian(rotary=True), job.belief.jacobian(rotary=False)
    points = job.align.landing, station.probe.tip
    plants = station.plant("substrate"), station.plant("probe")
    substrate, probe = map(Part, plants, trackers, beliefs, points)
    return Alignee(station, substrate, probe, [(size, size), mask])


def run_alignment(job: ServoJob, alignee: Alignee, observe: Observer | None = None) -> Run:
    """All three steps."""
    x, y, deg = job.align.desired
    desired = torch.tensor((x, y, math.radians(deg)), dtype=torch.float64)
    station, frames, last = alignee.station, list[Tensor](), [torch.empty(0)]
    mover: list[int] = []

    def watch(frame: Tensor, estimate: Estimate, step: Step) -> None:
        axes = len(step.velocity)
        if mover[-1:] != [axes]:  # the first frame of a step is what the step before it left
            mover.append(axes)
            frames.append(frame)
        last[0] = frame
        if observe is not None:
            observe(frame, estimate, step)

    alignment = align_parts(alignee.substrate, alignee.probe, desired, control=job.control, observe=watch)
    substrate, probe = station.truth("substrate"), station.truth("probe")
    points = [torch.tensor([part.point], dtype=torch.float64) for part in alignee[1:3]]
    miss = transform(probe, points[1])[0] - transform(substrate, points[0])[0]
    return Run(alignment, substrate - desired, miss, [*frames, last[0]])


def probe_mask(station: Workstation, home: Tensor, frame: tuple[int, int], size: int) -> Tensor:
    """Where the probe covers its template, (size, size) bool: what a user would draw as a polygon."""
    pose = torch.cat((home, home.new_zeros(1)))[None]
    opaque = station.probe.cover.render(pose, frame)[0, 0] > COVERED
    left, top = (home - (size - 1) / 2).round().long().tolist()
    return opaque[top : top + size, left : left + size]
