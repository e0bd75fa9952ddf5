"""A sequence from a configuration, as ``torch-ecc simulate CONFIG.toml`` reads it; see ``configs/simulate.toml``.

Everything is checked before anything is rendered. The names of settings are those of the constructors they fill.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import hypot, radians
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_ecc.config import as_table, choose, fill, refuse_unknown
from torch_ecc.records.lens import Lens
from torch_ecc.sim.camera import motion
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.dataset import read_poses
from torch_ecc.sim.camera.light import GradientLight, LampDrift, Light, Lights, SpotLight, VignetteLight
from torch_ecc.sim.camera.sensor import noise_sigma
from torch_ecc.sim.camera.sequence import Sequence, check_inside
from torch_ecc.sim.camera.still import image_light, image_scene
from torch_ecc.sim.scene.micrograph import micrograph
from torch_ecc.sim.scene.scene import Pads, PlaneWaves, Scene, Speckle

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


@dataclass(frozen=True)
class Placement:
    """Where the motion happens: about ``center`` (x, y) px, the middle of the frame unless given.

    ``lead_in`` frames go from rest at the centre to the first pose; 0 starts in the first pose.
    """

    center: tuple[float, float] | None = None
    lead_in: int = 20


@dataclass(frozen=True, eq=False)
class Simulation:
    """A checked configuration: the sequence, the template to track in it and the configuration itself."""

    sequence: Sequence
    template: Template
    truth: Tensor  # (F, 1, 3) px, px, rad: the poses of the template, as without a lens
    metadata: dict[str, Any]


def from_config(values: Mapping[str, Any], *, folder: Path | str = ".") -> Simulation:
    """A simulation from nested tables; relative paths start at ``folder``, that of the configuration file.

    ValueError for unknown keys, scenes, lights or motions (with the known ones), values out of range, a missing still,
    and a template that leaves the frame at any pose; no frame is rendered.
    """
    refuse_unknown(values, ("seed", "scene", "motion", "light", "camera", "template"), "simulate")
    folder = Path(folder)
    camera = read_camera(values.get("camera", {}), read_light(values.get("light", []), folder), folder)
    poses = _motion(_table(values, "motion", "harmonic"), camera.size, folder)
    template = _template(values.get("template", {}), folder)
    scene = choose(SCENES, _table(values, "scene", "micrograph"), "[scene]", folder=folder)
    sequence = Sequence(scene, poses, camera, _seed(values.get("seed", 0)))
    lens = camera.lens if isinstance(camera.lens, Lens) else None
    origin = poses[0, :2] if lens is None else lens.distort(poses[0, :2])
    center = origin.round() if template.center is None else poses.new_tensor(template.center)
    truth = sequence.truth((center if lens is None else lens.undistort(center))[None])
    check_inside(truth if lens is None else lens.distort_pose(truth), template.size, camera.size)
    x, y = center.tolist()
    metadata = {"config": dict(values), "template": {"size": list(template.size), "center": [x, y]}}
    return Simulation(sequence, Template(template.size, (x, y)), truth, metadata)


def _table(values: Mapping[str, Any], key: str, kind: str) -> Any:
    """A table of the configuration, of the default ``kind`` if it names none."""
    table = values.get(key, {})
    return {"kind": kind, **table} if isinstance(table, Mapping) else table


def _template(values: Any, folder: Path) -> Template:
    """The template; a single number as ``size`` is the side of a square."""
    if isinstance(values, Mapping) and isinstance(values.get("size"), int):
        values = {**values, "size": [values["size"]] * 2}
    return fill(Template, values, "[template]", folder=folder)


def _seed(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"simulate: seed must be an integer >= 0, got {value!r}")
    return value


def read_light(values: Any, folder: Path) -> Light | None:
    """One [light] table, or several [[light]] that multiply."""
    tables = [values] if isinstance(values, Mapping) else values
    if not isinstance(tables, list):
        raise ValueError(f"[light] must be a table or an array of tables, got {values!r}")
    lights = tuple(choose(LIGHTS, table, "[light]", folder=folder) for table in tables)
    return (lights[0] if len(lights) == 1 else Lights(lights)) if lights else None


def read_camera(values: Any, light: Light | None, folder: Path) -> Camera:
    """The camera; ``noise_variance`` may stand for ``noise_sigma``, and bits = "float" for None, which TOML has not."""
    settings = dict(as_table(values, "[camera]"))
    if "noise_variance" in settings:
        if "noise_sigma" in settings:
            raise ValueError("[camera]: give noise_sigma or noise_variance, got both")
        variance = settings.pop("noise_variance")
        if not isinstance(variance, int | float) or isinstance(variance, bool):
            raise ValueError(f"[camera]: noise_variance must be a number, got {variance!r}")
        settings["noise_sigma"] = noise_sigma(variance)
    if settings.get("bits") == "float":
        settings["bits"] = None
    lens = settings.pop("lens", None)
    camera = fill(Camera, settings, "[camera]", folder=folder, light=light, lens=None)
    return camera if lens is None else replace(camera, lens=read_lens(lens, camera.size))


def read_lens(values: Any, size: tuple[int, int]) -> Lens:
    """The lens before a frame of ``size`` (h, w), about its middle and in units of half its diagonal unless told."""
    middle = [(size[1] - 1) / 2, (size[0] - 1) / 2]
    given = {"center": middle, "focal": hypot(*middle)} | dict(as_table(values, "[camera.lens]"))
    lens = fill(Lens, given, "[camera.lens]")
    corners = [[x, y] for x in (0, size[1] - 1) for y in (0, size[0] - 1)]
    lens.check(torch.tensor(corners, dtype=torch.float64), "[camera.lens]")
    return lens


def _motion(values: Any, size: tuple[int, int], folder: Path) -> Tensor:
    """The poses in the frame; a key that ends in ``_deg`` gives its angle (the last number of a row) in degrees."""
    own = {key: value for key, value in as_table(values, "[motion]").items() if key in ("center", "lead_in")}
    settings = {k.removesuffix("_deg"): _radians(k, v) for k, v in values.items() if k not in own}
    placement = fill(Placement, own, "[motion]", folder=folder)
    poses = motion.from_rest(choose(MOTIONS, settings, "[motion]", folder=folder), placement.lead_in)
    return motion.placed(poses, placement.center or (size[1] // 2, size[0] // 2))


def _radians(key: str, value: Any) -> Any:
    if not key.endswith("_deg"):
        return value
    row = list(value) if isinstance(value, list | tuple) else [value]
    if not row or not isinstance(row[-1], int | float):
        raise ValueError(f"[motion]: {key} must be numbers, got {value!r}")
    turned = [*row[:-1], radians(row[-1])]
    return turned if isinstance(value, list | tuple) else turned[0]
