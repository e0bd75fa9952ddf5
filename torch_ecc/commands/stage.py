"""``torch-ecc servo`` on somebody's own stage: what a patch shows is brought to a place in the picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_ecc.commands.servo import LogWriter
from torch_ecc.commands.track import STATUS_NAMES
from torch_ecc.config import fill, refuse_unknown
from torch_ecc.core.estimate import Estimate
from torch_ecc.io import OverlayWriter
from torch_ecc.io.cameras.micromanager import open_core
from torch_ecc.io.output import check_folder, part, publish
from torch_ecc.io.summary import write_json
from torch_ecc.records.calibration import Calibration
from torch_ecc.servo import Control, MicroManagerStage, Result, StageJacobian, Step, servo
from torch_ecc.track.tracker import Tracker

TABLES = ("micromanager", "align", "belief", "control")


@dataclass(frozen=True)
class Target:
    """The patch of ``size`` px at ``center`` in the first picture, px, is to be at ``desired``, px."""

    center: tuple[float, float]
    desired: tuple[float, float]
    size: int = 121
    out: str = "torch-ecc-servo"
    overlay: bool = True


@dataclass(frozen=True)
class Belief:
    """What the controller takes the stage to be like: its scale (negative against the picture's axis) and angle."""

    um_per_px: float | tuple[float, float]
    axis_angle_deg: float = 0.0


def run_stage(values: Mapping[str, Any], progress: Callable[[Step], None] = lambda step: None) -> tuple[Result, Path]:
    """Close the loop that nested tables of settings tell, and write log.csv, overlay.mp4 and summary.json.

    Ctrl-C stops the stage and keeps what was done. ValueError, before anything moves, for what does not fit.
    """
    refuse_unknown(values, TABLES, "servo")
    for key in ("align", "belief"):
        if key not in values:
            raise ValueError(f"servo: missing table [{key}]")
    target, belief = fill(Target, values["align"], "[align]"), fill(Belief, values["belief"], "[belief]")
    control, folder = fill(Control, values.get("control", {}), "[control]"), check_folder(target.out, "servo")
    settings = dict(values["micromanager"])
    core = open_core(settings.pop("config", "demo"))
    plant: MicroManagerStage = fill(MicroManagerStage, settings, "[micromanager]", core=core)
    tracker = Tracker(plant.frame(), [target.center], target.size)
    jacobian = StageJacobian(Calibration(belief.um_per_px, math.radians(belief.axis_angle_deg)), rotary=False)
    with ExitStack() as files:
        log = files.enter_context(LogWriter(folder))
        shapes, fps = [(target.size, target.size)], 1 / plant.period
        film = OverlayWriter(folder, shapes=shapes, status_names=STATUS_NAMES, fps=fps) if target.overlay else None
        if film is not None:
            files.enter_context(film)

        def observe(frame: Tensor, estimate: Estimate, step: Step) -> None:
            log.write("stage", step)
            if film is not None:
                film.write(frame, estimate)
            progress(step)

        desired = torch.tensor((*target.desired, 0.0), dtype=torch.float64)
        result = servo(plant, tracker, desired, jacobian, control=control, observe=observe)
    write_json(part(folder, "summary.json"), _summary(values, result))
    publish(folder, "summary.json")
    return result, folder


def _summary(values: Mapping[str, Any], result: Result) -> dict[str, Any]:
    x, y, theta = result.log.error[-1].tolist()
    error = {"x_px": x, "y_px": y, "theta_deg": math.degrees(theta)}
    frames = len(result.log.time)
    return {
        "aligned": result.aligned,
        "ending": result.ending.name,
        "frames": frames,
        "error": error,
        "settings": values,
    }
