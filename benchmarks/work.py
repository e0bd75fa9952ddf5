"""What every tracker is given: frames, where the template is in the first one, the true poses, and the least error."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_ecc.core.pose import compose
from torch_ecc.paper.bound import cramer_rao, rounding
from torch_ecc.paper.scheme import SIZE, Harmonic
from torch_ecc.sim import Camera, GradientLight, Pads, PlaneWaves, Scene, Sequence, placed

STANDARD = Harmonic(20.0, 5.0, 40).closed()  # eq. (11): up to 3.1 px in x and in y, 4.4 px together, per frame
SMALL = Harmonic(5.0, 1.25, 40).closed()  # up to 1.1 px per frame


def data_folder(named: str | None) -> Path:
    """That of the real sequences: the one ``named``, or else the one that TORCH_ECC_DATA names."""
    folder = named or os.environ.get("TORCH_ECC_DATA")
    if folder is None or not (Path(folder) / "stills").is_dir():
        raise SystemExit(f"The folder of the real sequences is to be named, here or by TORCH_ECC_DATA, got {folder}")
    return Path(folder)


@dataclass(frozen=True, eq=False)
class Work:
    """``frames`` (F + 1, 1, H, W) uint8, the template ``size`` px around ``center`` (x, y) of the first one, its
    ``truth`` (F, 3) px, px, rad in the others, and the Cramer-Rao ``bound`` (3,) if the scene is known."""

    name: str
    title: str
    frames: Tensor
    center: tuple[float, float]
    size: int
    truth: Tensor
    bound: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Simulated:
    """A scene at poses ``path`` (F + 1, 3) before a camera, whose noise is drawn anew with every seed."""

    title: str
    scene: Scene
    path: Tensor = STANDARD
    camera: Camera = field(default_factory=Camera)

    def make(self, name: str, seed: int) -> Work:
        """The frames. The bound counts the noise twice: the template is as noisy."""
        sequence = Sequence(self.scene, self.path, self.camera, seed)
        center, frames = self.path[:1, :2], torch.cat(list(sequence.batches()))
        bound = cramer_rao(self.scene, (SIZE, SIZE), 2 * (self.camera.noise_sigma**2 + rounding(8)))
        x, y = center[0].tolist()
        return Work(name, self.title, frames, (x, y), SIZE, sequence.truth(center)[1:, 0], bound)


def waves() -> Scene:
    """Rich texture: 200 plane waves, amplitudes ~ 1/f up to 0.25 cycles per px, rms gradient 7 grey levels per px."""
    return PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0)


def fine(count: int = 200, fmax: float = 0.25, rms_gradient: float = 7.0) -> Scene:
    """Fine texture: equal amplitudes, frequencies spread evenly over the disc below ``fmax``."""
    generator = torch.Generator().manual_seed(0)
    u, angle, phase = math.tau * torch.rand(3, count, generator=generator, dtype=torch.float64)
    waves = math.tau * fmax * (u / math.tau).sqrt()[:, None] * torch.stack((angle.cos(), angle.sin()), 1)
    amplitude = rms_gradient / waves.square().sum().div(4).sqrt()
    return PlaneWaves(waves, amplitude.expand(count), phase)


def jumps(length: float = 4.4, frames: int = 40) -> Tensor:
    """Poses of a walk by ``length`` px in a random direction per frame, which no prediction helps with."""
    angle = math.tau * torch.rand(frames, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    walk = (length * torch.stack((angle.cos(), angle.sin(), 0 * angle), -1)).cumsum(0)
    return placed(torch.cat((0 * walk[:1], walk)), (320.0, 240.0))


WORKS: dict[str, Simulated] = {
    "clean": Simulated("waves, only rounded", waves()),
    "noise2": Simulated("waves, noise of 2", waves(), camera=Camera(noise_sigma=2.0)),
    "noise5": Simulated("waves, noise of 5", waves(), camera=Camera(noise_sigma=5.0)),
    "noise10": Simulated("waves, noise of 10", waves(), camera=Camera(noise_sigma=10.0)),
    "fine": Simulated("fine texture, small steps", fine(), SMALL),
    "hard": Simulated("fine texture, 4.4 px per frame", fine()),
    "jumps": Simulated("fine texture, 4.4 px any way", fine(), jumps()),
    "pads": Simulated("wafer-like pads", Pads.wafer()),
    "light": Simulated("waves, light falling off", waves(), camera=Camera(light=GradientLight(scale_px=640))),
}


def recorded(folder: Path, size: int | None = None) -> Work:
    """A sequence of ``data/`` with its known motion: pixel_shift, pyvale_rigid, rotation_full."""
    facts = json.loads((folder / "truth.json").read_text())
    images = [folder / "ref.png", *(folder / f["file"] for f in facts["frames"])]
    frames = torch.from_numpy(np.stack([cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in images]))[:, None]
    if facts["template_hint"]:
        x, y, w, h = facts["template_hint"]
        center, side = (x + (w - 1) / 2, y + (h - 1) / 2), min(w, h)
    else:
        center, side = ((frames.shape[-1] - 1) / 2, (frames.shape[-2] - 1) / 2), 201
    pivot = torch.tensor(facts["centre_px"] or center, dtype=torch.float64)
    moves = [(pivot[0] + f["tx"], pivot[1] + f["ty"], -math.radians(f["theta_deg"] or 0)) for f in facts["frames"]]
    offset = torch.tensor([*center, 0.0], dtype=torch.float64) - torch.tensor([*pivot.tolist(), 0.0])
    moved = torch.tensor(moves, dtype=torch.float64)
    return Work(
        folder.name, f"real: {folder.name}", frames, center, size or side, compose(moved, offset.expand_as(moved))
    )


RECORDED = ("pixel_shift", "pyvale_rigid", "rotation_full")
