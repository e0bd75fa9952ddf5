"""A workstation from the tables of a configuration; see ``configs/servo.toml``. Checked before anything is rendered."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Any

from torch import Tensor

from torch_ecc.config import choose, fill
from torch_ecc.sim.camera.motion import Pose
from torch_ecc.sim.config import SCENES, read_camera, read_light
from torch_ecc.sim.scene.probe import Probe
from torch_ecc.sim.scene.scene import Scene
from torch_ecc.sim.stage.workstation import Microscope, Mount, Part, Workstation

TABLES = ("scene", "camera", "light", "microscope", "substrate", "probe", "look", "start")


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where the parts are at first: ``substrate`` px, px, deg; ``probe`` px, px; its ``height`` um."""

    substrate: Pose
    probe: tuple[float, float]
    height: float = 0.0


@dataclass(frozen=True, eq=False)
class Workcell:
    """All parts of a workstation that is not yet built."""

    scenes: tuple[Scene, Probe]
    mounts: Mapping[Part, Mount]
    microscope: Microscope
    start: Start

    def build(self) -> Workstation:
        """The workstation at its start. ValueError if a stage does not reach it."""
        x, y, deg = self.start.substrate
        start: dict[Part, Pose] = {"substrate": (x, y, radians(deg)), "probe": (*self.start.probe, 0.0)}
        return Workstation(self.scenes, self.mounts, self.microscope, start=start, height=self.start.height)

    def lesson(self) -> Tensor:
        """A frame (h, w) with both parts at home, from which their templates are cut."""
        # Another seed: the noise of the lesson is not that of the first frame.
        other = dataclasses.replace(self.microscope, seed=self.microscope.seed + 1, delay=0)
        return Workstation(self.scenes, self.mounts, other, height=self.start.height).frame()


def read_workcell(values: Mapping[str, Any], *, folder: Path | str = ".") -> Workcell:
    """The workcell of nested tables; relative paths start at ``folder``.

    ValueError for unknown keys, values out of range and a start that a stage does not reach.
    """
    folder = Path(folder)
    tables = {name: values.get(name, {}) for name in TABLES}
    camera = read_camera(tables["camera"], read_light(values.get("light", []), folder), folder)
    scene = choose(SCENES, {"kind": "micrograph", **tables["scene"]}, "[scene]", folder=folder)
    cell = Workcell(
        (scene, fill(Probe.infinity, tables["look"], "[look]", folder=folder)),
        {part: fill(Mount, tables[part], f"[{part}]", folder=folder) for part in ("substrate", "probe")},
        fill(Microscope, tables["microscope"], "[microscope]", folder=folder, camera=camera),
        fill(Start, tables["start"], "[start]", folder=folder),
    )
    cell.build()
    return cell
