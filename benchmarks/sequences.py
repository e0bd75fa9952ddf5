"""Errors of a Tracker along a sequence of an analytic scene, and of every method under uneven light."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

from torch_ecc.core.estimate import Status
from torch_ecc.paper.errors import by_unit, errors, largest, rms
from torch_ecc.paper.scheme import SIZE, Harmonic
from torch_ecc.sim import Camera, Scene, Sequence
from torch_ecc.sim.camera.light import Light
from torch_ecc.track.tracker import Tracker


class Run(NamedTuple):
    """Pose errors (F, 3) px, px, deg of a tracked sequence, and the status (F,)."""

    error: Tensor
    status: Tensor

    @property
    def largest(self) -> tuple[float, float]:
        """Largest error in x or y, px, and in theta, deg, of the frames that were not lost."""
        return by_unit(largest(self.error[Status.good(self.status)]))

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square error of the worse of x and y, px, and of theta, deg, of the frames that were not lost."""
        return by_unit(rms(self.error[Status.good(self.status)]))

    @property
    def lost(self) -> int:
        """Frames without a new pose."""
        return int((~Status.good(self.status)).sum())


def track_path(sequence: Sequence, options: Mapping[str, Any] | None = None) -> Run:
    """Errors of a Tracker with ``options`` whose template is cut at the scene's origin in frame 0, from frame 1 on."""
    center = sequence.poses[:1, :2]
    frames = iter(sequence)
    tracker = Tracker(next(frames), center, SIZE, **(options or {}))
    track = tracker.track_sequence(frames)
    return Run(errors(track.pose[:, 0], sequence.truth(center)[1:, 0]), track.status[:, 0])


LIGHT_METHODS = {
    "ssd": {"criterion": "ssd"},
    "ecc_paper": {"criterion": "ecc_paper"},
    "ecc, gain": {"illumination": "gain"},
    "ecc, linear": {"illumination": "linear"},
    "ecc, quadratic": {"illumination": "quadratic"},
}


def under_light(scene: Scene, light: Light | None, motion: Harmonic) -> dict[str, Run]:
    """Each method's errors under ``light`` (none: even light), noise-free and unquantised."""
    camera = Camera(light=light, bits=None)
    sequence = Sequence(scene, motion.closed(camera.size), camera)
    return {name: track_path(sequence, options) for name, options in LIGHT_METHODS.items()}
