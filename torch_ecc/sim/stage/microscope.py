"""A zoom microscope with a camera over a stage (Fig. 5, Table II): from the stage's um to the image's px and back.

``um_per_px`` and ``axis_angle`` are those of ``Calibration``: a displacement d in px is R(axis_angle) um_per_px d in um
along the axes of the stage. The lens stands on the same floor as the stage, on a column of its own: its vibration is in
the images and not in sensors that sit at the stage.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import asin, tan
from typing import Any

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.sensor import generator
from torch_ecc.sim.camera.sequence import Sequence
from torch_ecc.sim.scene.scene import Scene
from torch_ecc.sim.stage.stage import StageMotion
from torch_ecc.sim.stage.vibration import Floor, Vibration

STREAM = 2  # of random numbers, apart from the stage's and the sensors' own
BLUR = 0.21  # sigma of the Gaussian next to an Airy disc, in wavelengths over NA


@dataclass(frozen=True, kw_only=True)
class Microscope:
    """Table II: 10x objective, zoom 0.7 to 3.55, 2048 x 2048 px of 5.5 um at 100 Hz; the rest are its usual values."""

    zoom: float = 3.55
    objective: float = 10.0
    aperture: float = 0.28  # numerical, of a Mitutoyo M Plan Apo 10x
    wavelength_um: float = 0.55
    pixel_um: float = 5.5  # of the sensor
    sensor_px: tuple[int, int] = (2048, 2048)  # (h, w)
    region_px: tuple[int, int] = (480, 640)  # (h, w) that is read out, from the middle of the sensor
    frame_rate_hz: float = 100.0
    exposure_s: float = 0.002
    defocus_um: float = 0.0  # of the surface from the focal plane
    axis_angle: float = 0.004  # rad, from the camera's axes to the stage's
    view_um: tuple[float, float] = (0.0, 0.0)  # the point of the moving part whose image is in the middle at pose 0
    floor: Floor = field(default_factory=Floor)
    column_hz: float = 45.0  # natural frequency of the lens on its column
    column_damping: float = 0.05

    def __post_init__(self) -> None:
        if not 0.7 <= self.zoom <= 3.55:
            raise ValueError(f"Microscope: zoom must be between 0.7 and 3.55, got {self.zoom}")
        for name in ("objective", "wavelength_um", "pixel_um", "frame_rate_hz", "column_hz"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Microscope: {name} must be > 0, got {getattr(self, name)}")
        for name in ("aperture", "column_damping"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"Microscope: {name} must be in (0, 1), got {getattr(self, name)}")
        if not 0 <= self.exposure_s * self.frame_rate_hz <= 1:
            longest = 1 / self.frame_rate_hz
            raise ValueError(f"Microscope: exposure_s must be between 0 and {longest:g} s, got {self.exposure_s}")
        for side, whole in zip(self.region_px, self.sensor_px, strict=True):
            if not 1 <= side <= whole:
                raise ValueError(f"Microscope: region_px must fit {self.sensor_px}, got {self.region_px}")

    @property
    def um_per_px(self) -> float:
        """Of the surface."""
        return self.pixel_um / (self.objective * self.zoom)

    @property
    def field_um(self) -> tuple[float, float]:
        """Height and width of what the region shows."""
        return self.region_px[0] * self.um_per_px, self.region_px[1] * self.um_per_px

    def camera(self, **settings: Any) -> Camera:
        """The camera behind the lens: region, diffraction, defocus and exposure. All others are ``settings``."""
        spread = abs(self.defocus_um) * tan(asin(self.aperture))
        optics = {
            "size": self.region_px,
            "blur_sigma": BLUR * self.wavelength_um / self.aperture / self.um_per_px,
            "defocus_radius": spread / self.um_per_px,
            "exposure": self.exposure_s * self.frame_rate_hz,
            "exposure_steps": 3,  # enough for smears of a px or two
        }
        return Camera(**{**optics, **settings})

    def poses_px(self, poses: Tensor) -> Tensor:
        """Where the point ``view_um`` of the part is in the image: (..., 3) um, um, rad -> (..., 3) px, px, rad."""
        if poses.dim() < 1 or poses.shape[-1] != 3:
            raise ValueError(f"poses_px: poses must be (..., 3), got {tuple(poses.shape)}")
        view = poses.new_tensor(self.view_um)
        shift = poses[..., :2] + rotation(poses[..., 2]) @ view - view
        turn = rotation(poses.new_tensor(self.axis_angle))
        middle = poses.new_tensor((self.region_px[1] // 2, self.region_px[0] // 2))
        return torch.cat((shift @ turn / self.um_per_px + middle, poses[..., 2:]), -1)

    def times(self, motion: StageMotion, *, start_s: float = 0.0) -> Tensor:
        """Middles of the exposures of all frames (F,) s that fit into the motion from ``start_s`` on, on its clock."""
        first = start_s + self.exposure_s / 2
        last = float(motion.times_s[-1]) - self.exposure_s / 2
        if not (start_s >= 0 and first <= last):
            raise ValueError(f"times: start_s must leave room for a frame in {last:g} s, got {start_s}")
        count = int((last - first) * self.frame_rate_hz + 1e-9) + 1
        return first + torch.arange(count, dtype=torch.float64, device=motion.times_s.device) / self.frame_rate_hz

    def film(
        self, scene: Scene, motion: StageMotion, *, start_s: float = 0.0, camera: Camera | None = None, seed: int = 0
    ) -> Sequence:
        """The frames of a ``scene`` on a single stage, the first exposure opening at ``start_s`` of the motion's clock.

        The exposure is smeared along the secant of the motion while it is open. The poses of the sequence are those at
        the middles of the exposures, at ``times(motion, start_s=start_s)``. ValueError for a batch of stages and for a
        camera of another size.
        """
        if motion.pose.dim() != 2:
            raise ValueError(f"film: the motion must be of one stage, (T, 3), got {tuple(motion.pose.shape)}")
        if camera is not None and camera.size != self.region_px:
            raise ValueError(f"film: the camera must have the size {self.region_px} of the region, got {camera.size}")
        times = self.times(motion, start_s=start_s)
        column = self._column(seed)

        def look(at: Tensor) -> Tensor:
            return self.poses_px(motion.at(at) - column.at(at))

        velocities = None
        if self.exposure_s > 0:
            half = self.exposure_s / 2
            velocities = (look(times + half) - look(times - half)) / (self.exposure_s * self.frame_rate_hz)
        return Sequence(scene, look(times), camera or self.camera(), seed, velocities)

    def _column(self, seed: int) -> Vibration:
        """Motion of the lens; turning of it is left out."""
        natural = torch.tensor((self.column_hz,) * 3, dtype=torch.float64)
        damping = torch.full((3,), self.column_damping, dtype=torch.float64)
        shake = Vibration.on(self.floor, natural, damping, sources=[generator(seed, 0, STREAM)]).only(0)
        return Vibration(shake.frequency_hz, shake.amplitudes * shake.amplitudes.new_tensor((1.0, 1.0, 0.0)))
