"""A camera: frames of a scene under a light, with the disturbances of real ones; the truth is the given pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from torch_ecc.sim.camera import optics, sensor
from torch_ecc.sim.camera.light import Light
from torch_ecc.sim.camera.occluder import Occluder
from torch_ecc.sim.scene.scene import Rendered, Scene


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Settings of a camera. Grey levels are on the nominal 0..255 scale whatever ``bits`` is."""

    size: tuple[int, int] = (480, 640)  # (h, w) px
    lens: optics.Distortion | None = None  # shows things elsewhere; poses are those without it
    light: Light | None = None  # multiplies the scene; None is even light
    blur_sigma: float = 0.0  # px, Gaussian blur of the optics
    defocus_radius: float = 0.0  # px, radius of the disc that a point becomes out of focus
    exposure: float = 0.0  # open shutter as a part of the frame time, centred on the pose
    exposure_steps: int = 9  # instants averaged over the open shutter
    occluders: tuple[Occluder, ...] = ()  # things between the stage and the lens
    full_well: float | None = None  # electrons at grey level 255: shot noise; None has none
    gain: float = 1.0
    offset: float = 0.0  # grey levels
    drift: sensor.Drift | None = None  # of gain and offset over the frames
    noise_sigma: float = 0.0  # grey levels; see sensor.noise_sigma for a variance on [0, 1]
    bits: int | None = 8  # 8: uint8, 16: uint16, None: float32 without clipping

    def __post_init__(self) -> None:
        if len(self.size) != 2 or min(self.size) < 1:
            raise ValueError(f"Camera: size must be (h, w) of at least 1 px, got {self.size}")
        for name in ("blur_sigma", "defocus_radius", "exposure", "noise_sigma"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"Camera: {name} must be >= 0, got {getattr(self, name)}")
        if self.exposure > 1:
            raise ValueError(f"Camera: exposure must be at most 1 frame time, got {self.exposure}")
        if self.exposure_steps < 1:
            raise ValueError(f"Camera: exposure_steps must be at least 1, got {self.exposure_steps}")
        if self.full_well is not None and not self.full_well > 0:
            raise ValueError(f"Camera: full_well must be > 0 electrons, got {self.full_well}")
        if not self.gain > 0:
            raise ValueError(f"Camera: gain must be > 0, got {self.gain}")
        if self.bits not in (None, *sensor.DTYPES):
            raise ValueError(f"Camera: bits must be 8, 16 or None, got {self.bits}")

    def capture(
        self, scene: Rendered, poses: Tensor, *, velocities: Tensor | None = None, seed: int = 0, first: int = 0
    ) -> Tensor:
        """Frames (B, 1, h, w) at poses (B, 3), on their device: uint8, uint16 or float32 by ``bits``.

        ``velocities`` (B, 3) px, px, rad per frame time smear the exposure. The frames count from ``first``: light,
        drift, occluders and noise depend on the index of a frame and on ``seed``, not on how frames are batched.
        """
        if poses.dim() != 2 or poses.shape[1] != 3:
            raise ValueError(f"capture: poses must be (B, 3), got {tuple(poses.shape)}")
        if self.exposure > 0 and (velocities is None or velocities.shape != poses.shape):
            got = None if velocities is None else tuple(velocities.shape)
            raise ValueError(f"capture: an exposure needs velocities of shape {tuple(poses.shape)}, got {got}")
        indices = torch.arange(first, first + len(poses), device=poses.device)
        return self._sense(self._image(scene, poses, velocities, indices), indices, seed)

    def _image(self, scene: Rendered, poses: Tensor, velocities: Tensor | None, indices: Tensor) -> Tensor:
        """The noise-free image on the sensor: (B, 3) -> (B, 1, h, w) float32."""
        margin = optics.margin(self.blur_sigma, self.defocus_radius)
        padded = (self.size[0] + 2 * margin, self.size[1] + 2 * margin)
        shifted = poses + poses.new_tensor((margin, margin, 0.0))
        if self.exposure > 0 and velocities is not None:
            steps = (torch.arange(self.exposure_steps) + 0.5).tolist()
            times = [self.exposure * (step / self.exposure_steps - 0.5) for step in steps]
            frames = torch.zeros((len(poses), 1, *padded), device=poses.device)
            for t in times:
                frames += self._look(scene, shifted + t * velocities, padded, margin) / len(times)
        else:
            frames = self._look(scene, shifted, padded, margin)
        frames = optics.focus(frames, self.blur_sigma, self.defocus_radius)
        for occluder in self.occluders:
            frames = occluder.cover(frames, indices)
        return frames if self.light is None else frames * self.light.field(indices, self.size)

    def _look(self, scene: Rendered, poses: Tensor, size: tuple[int, int], margin: int) -> Tensor:
        """The scene through the lens, before any blur: (B, 3) -> (B, 1, h, w)."""
        if self.lens is None:
            return scene.render(poses, size)
        if not (hasattr(scene, "value")):
            raise ValueError(f"Camera: a lens needs a scene with exact values, got {type(scene).__name__}")
        return optics.distorted(cast("Scene", scene), self.lens, poses, size, margin)

    def _sense(self, frames: Tensor, indices: Tensor, seed: int) -> Tensor:
        """Gain, offset, noise and quantisation: (B, 1, h, w) float32 -> the camera's dtype."""
        sources = [sensor.generator(seed, int(i)) for i in indices.tolist()]
        if self.full_well is not None:
            frames = torch.stack([sensor.shot(f, self.full_well, g) for f, g in zip(frames, sources, strict=True)])
        frames = frames * self.gain + self.offset
        if self.drift is not None:
            frames = self.drift.apply(frames, indices)
        if self.noise_sigma > 0:
            frames = torch.stack([sensor.read(f, self.noise_sigma, g) for f, g in zip(frames, sources, strict=True)])
        return sensor.quantise(frames, self.bits)
