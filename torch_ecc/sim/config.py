"""A sequence from a configuration, as ``torch-ecc simulate CONFIG.toml`` reads it; ``configs/simulate.toml`` has it all.

Everything is checked before anything is rendered. The names of settings are those of the constructors they fill.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Any

from torch import Tensor

from torch_ecc.sim import motion
from torch_ecc.sim.camera import Camera
from torch_ecc.sim.dataset import read_poses
from torch_ecc.sim.light import GradientLight, LampDrift, Light, Lights, SpotLight, VignetteLight
from torch_ecc.sim.micrograph import micrograph
from torch_ecc.sim.scene import Pads, PlaneWaves, Scene, Speckle
from torch_ecc.sim.sensor import noise_sigma
from torch_ecc.sim.sequence import Sequence, check_inside
from torch_ecc.sim.settings import choose, fill
from torch_ecc.sim.still import image_light, image_scene

SCENES: dict[str, Callable[..., Scene]] = {
    "micrograph": micrograph,
    "waves": PlaneWaves.random,
    "wafer": Pads.wafer,
    "speckle": Speckle.random,
    "image": image_scene,
}
LIGHTS: dict[str, Callable[..., Light]] = {
    "gradient": GradientLight,
    "spot": SpotLight,
    "vignette": VignetteLight,
    "drift": LampDrift,
    "image": image_light,
}
MOTIONS: dict[str, Callable[..., Tensor]] = {
    "harmonic": motion.harmonic,
    "circle": motion.circle,
    "ramp": motion.ramp,
    "steps": motion.steps,
    "random_walk": motion.random_walk,
    "table": motion.table,
    "file": read_poses,
}


@dataclass(frozen=True)
class Template:
    """The patch to track: ``size`` (h, w) px, marked upright at ``center`` (x, y) px of frame 0.

    Without a ``center`` it is marked at the pixel next to the scene's origin.
    """

    size: tuple[int, int] = (121, 121)
    center: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if min(self.size) < 1:
            raise ValueError(f"Template: size must be (h, w) of at least 1 px, got {self.size}")


@dataclass(frozen=True, eq=False)
class Simulation:
    """A checked configuration: the sequence, the template to track in it and the configuration itself."""

    sequence: Sequence
    template: Template
    truth: Tensor  # (F, 1, 3) px, px, rad: the poses of the template
    metadata: dict[str, Any]


@dataclass(frozen=True)
class _Config:
    """The tables of a configuration file."""

    scene: dict[str, Any]
    motion: dict[str, Any]
    light: list[dict[str, Any]]
    camera: dict[str, Any]
    template: dict[str, Any]
    seed: int


def from_config(values: Mapping[str, Any], *, folder: Path | str = ".") -> Simulation:
    """A simulation from nested tables; relative paths start at ``folder``, that of the configuration file.

    ValueError for unknown keys, scenes, lights or motions (with the known ones), values out of range, a missing still,
    and a template that leaves the frame at any pose; no frame is rendered.
    """
    known = ("seed", "scene", "motion", "light", "camera", "template")
    for key in values:
        if key not in known:
            raise ValueError(f"simulate: unknown key {key!r}, known are {', '.join(known)}")
    folder = Path(folder)
    camera = _camera(values.get("camera", {}), _light(values.get("light", []), folder), folder)
    poses = _motion(values.get("motion", {}), camera.size, folder)
    template = fill(Template, values.get("template", {}), "[template]", folder=folder)
    scene = choose(SCENES, {"kind": "micrograph", **values.get("scene", {})}, "[scene]", folder=folder)
    sequence = Sequence(scene, poses, camera, _seed(values.get("seed", 0)))
    center = poses[:1, :2].round() if template.center is None else poses.new_tensor([template.center])
    truth = sequence.truth(center)
    check_inside(truth, template.size, camera.size)
    marked = Template(template.size, (float(center[0, 0]), float(center[0, 1])))
    metadata = {"config": dict(values), "template": {"size": list(marked.size), "center": list(center[0].tolist())}}
    return Simulation(sequence, marked, truth, metadata)
