"""The experimental system of Fig. 5 and Table II, simulated: a stage, its capacitive sensors, and a microscope's camera
whose rendered frames are tracked. Both records come with clocks of their own, as untriggered instruments give them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Status, Track
from torch_ecc.paper.errors import valid
from torch_ecc.paper.result import Advance, Table, cells
from torch_ecc.paper.scheme import SIZE
from torch_ecc.records.calibration import Calibration
from torch_ecc.records.motion import Motion
from torch_ecc.sim import Floor, Microscope, Sensors, Sequence, Stage, StageMotion, StageSettings, micrograph
from torch_ecc.sim.camera.light import Light
from torch_ecc.sim.scene.scene import Scene
from torch_ecc.sim.scene.window import Window
from torch_ecc.track.tracker import Tracker

AROUND = 16  # px drawn around it: all that a tracker reads
COMMAND_HZ = 1000.0
QUIET = Floor(speed_um_s=0.78)  # VC-G: an isolated table (Amick et al., SPIE 5933, 2005)
NOISE = 2.0  # of the camera, grey levels
CAMERA_START_S = 0.2137  # of the stage's clock; the sensors start with the stage
T = TypeVar("T")


class Acquisition(NamedTuple):
    """Both records as ``Motion`` in um, um, rad: one per tracker, NaN where it was lost, and the sensors'.

    Each counts from its own zero; ``zeroed`` brings them to zero at rest. ``truth`` is what the template's image really
    did, through the same calibration, ``motion`` what the stage really did, on the sensors' clock, and ``offset_s`` the
    truth of the clocks. ``seconds`` each part took; ``first`` (H, W) is the first frame.
    """

    tracks: dict[str, Motion]
    sensors: Motion
    truth: Motion
    motion: StageMotion
    offset_s: float
    seconds: dict[str, float]
    first: Tensor


@dataclass(frozen=True)
class Bench:
    """Settings: microscope, light, ``gain`` of the camera, and the trackers by name."""

    microscope: Microscope
    light: Light | None = None
    gain: float = 1.0
    methods: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: {"ECC": {}})
    seed: int = 0

    def frames(self, command: Tensor) -> int:
        """How many ``acquire`` will take along ``command`` (T, 3), to within one."""
        return int((len(command) / COMMAND_HZ - CAMERA_START_S) * self.microscope.frame_rate_hz)

    def acquire(self, command: Tensor, tick: Callable[[], None]) -> Acquisition:
        """Run the stage along ``command`` (T, 3) um, um, rad at 1 kHz, film it at 100 Hz, read the sensors at 1024 Hz.

        The trackers' scale is known, the angle between image and stage is not. ``tick`` is called at every frame.
        """
        seconds: dict[str, float] = {}
        with _timed(seconds, "stage"):
            motion = Stage(StageSettings(floor=QUIET), seed=self.seed).run(command, COMMAND_HZ)
        with _timed(seconds, "sensors"):
            sensors = Sensors(seed=self.seed)
            record = sensors.record(motion)
            pose = sensors.settings.mounting.pose(record.distance_um)
            read = Motion(record.times_s, torch.where(record.saturated.any(-1, keepdim=True), torch.nan, pose))
        film, scale = self._film(motion), Calibration(self.microscope.um_per_px)
        tracks, first = self._track(film, seconds, tick)
        times = torch.arange(len(film), dtype=torch.float64) / self.microscope.frame_rate_hz
        moved = film.truth(torch.tensor([_middle(film.camera.size)]))[:, 0]
        truth = Motion(times, scale.to_physical(moved - moved[0]))
        offset = float(self.microscope.times(motion, start_s=CAMERA_START_S)[0] - record.times_s[0])
        motions = {}
        for name, track in tracks.items():
            pose = scale.to_physical(track.displacement[:, 0])
            motions[name] = Motion(times, torch.where(Status.good(track.status), pose, torch.nan))
        return Acquisition(motions, read, truth, motion, offset, seconds, first)

    def _film(self, motion: StageMotion) -> Sequence:
        """The lens' point-spread and the pixel's own width blur the analytic scene exactly, instead of its pixels."""
        spread = (self.microscope.camera().blur_sigma ** 2 + 1 / 12) ** 0.5
        settings = {"light": self.light, "gain": self.gain, "noise_sigma": NOISE}
        camera = self.microscope.camera(blur_sigma=0.0, **settings)
        scene = self.shown(micrograph(sigma=spread))
        return self.microscope.film(scene, motion, start_s=CAMERA_START_S, camera=camera, seed=self.seed)

    def shown(self, scene: Scene) -> Scene:
        """As much of the ``scene`` as the trackers read."""
        return Window(scene, (SIZE + 2 * AROUND,) * 2)

    def trackers(self, first: Tensor) -> dict[str, Callable[[Tensor], Estimate]]:
        """What follows the template of the ``first`` frame (H, W), by name: a frame -> Estimate (1, ...)."""
        return {name: tracker_of(first, **options) for name, options in self.methods.items()}

    def _track(
        self, film: Sequence, seconds: dict[str, float], tick: Callable[[], None]
    ) -> tuple[dict[str, Track], Tensor]:
        """Every method on the same frames, and the first frame (H, W)."""
        first = film.batch(0, 1)[0, 0]
        trackers = self.trackers(first)
        found: dict[str, list[Estimate]] = {name: [] for name in trackers}
        for k in range(len(film)):
            with _timed(seconds, "frames"):
                frame = film.batch(k, k + 1)[0, 0]
            for name, tracker in trackers.items():
                with _timed(seconds, f"tracking, {name}"):
                    found[name].append(tracker(frame))
            tick()
        return {name: Track.stack(estimates) for name, estimates in found.items()}, first


def simulated_once(simulate: Callable[[bool, Advance], T]) -> Callable[[bool, Advance], T]:
    """``simulate(quick, advance)`` at the first call only; later ones get what that one returned."""
    kept: dict[bool, T] = {}

    @wraps(simulate)
    def recall(quick: bool, advance: Advance) -> T:
        if quick not in kept:
            kept[quick] = simulate(quick, advance)
        return kept[quick]

    return recall


def microscope(quick: bool, **options: Any) -> Microscope:
    """A stiff column on that table, and a strobe (2 ms of light would smear 0.05 um at most).

    ``quick``: it reads a smaller part of its sensor.
    """
    region = (240, 320) if quick else (480, 640)
    return Microscope(region_px=region, floor=QUIET, column_hz=90.0, exposure_s=0.0, **options)


def times(acquired: Mapping[str, Acquisition]) -> Table:
    """Seconds of each part of every simulation, and of all."""
    first = next(iter(acquired.values()))
    rows = [(name, *cells((*a.seconds.values(), sum(a.seconds.values())), ".1f")) for name, a in acquired.items()]
    frames, samples, (h, w) = len(first.truth.time_s), len(first.sensors.time_s), first.first.shape
    title = f"Time in s: {frames} frames of {w}x{h} px and {samples} samples of three sensors"
    return Table(title + (", each" if len(rows) > 1 else ""), ("", *first.seconds, "all"), rows)


def tracker_of(first: Tensor, **options: Any) -> Tracker:
    """The tracker of the template in the middle of the first frame (H, W)."""
    return Tracker(first, [_middle((first.shape[-2], first.shape[-1]))], SIZE, **options)


def zeroed(motion: Motion, rest_s: float) -> Motion:
    """The record from the mean of its first ``rest_s`` s, in which the stage rests."""
    rest = motion.pose[motion.time_s < motion.time_s[0] + rest_s]
    return Motion(motion.time_s, motion.pose - valid(rest).mean(0))


def ease(u: Tensor) -> Tensor:
    """0 to 1 for u from 0 to 1, starting and ending without speed and acceleration; any shape."""
    u = u.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _middle(size: tuple[int, int]) -> tuple[float, float]:
    return float(size[1] // 2), float(size[0] // 2)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the time that its block takes to ``seconds[name]``."""
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
