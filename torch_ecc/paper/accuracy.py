"""Accuracy on analytic scenes: scatter against the Cramer-Rao bound, honesty of the covariance, uneven light."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.align import align
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import compose, inverse
from torch_ecc.core.reference import MARGIN, prepare
from torch_ecc.paper.bound import cramer_rao, oracle, rounding
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.light import Light
from torch_ecc.sim.camera.motion import harmonic, placed
from torch_ecc.sim.camera.sequence import Sequence
from torch_ecc.sim.scene.scene import Scene
from torch_ecc.track.tracker import Tracker

SIZE = 121  # px, the paper's template
BATCH = 50  # pairs that are aligned at once
ROOM = 40  # px that a frame is larger than the template and its surroundings, on each side
FRAME = SIZE + 2 * MARGIN + 2 * ROOM
MIDDLE = torch.tensor([FRAME // 2, FRAME // 2, 0], dtype=torch.float64)


@dataclass(frozen=True)
class Draws:
    """Random pairs of template and frame, both drawn anew each time.

    ``noise`` in grey levels, ``count`` pairs, displacements up to 10 px in x and y and, with ``turn``, any angle;
    ``bits`` of the camera, None for no rounding.
    """

    noise: float = 0.0
    count: int = 250
    turn: bool = True
    illumination: str = "linear"
    interpolation: str = "bspline3"
    bits: int | None = 8
    seed: int = 0


class Pairs(NamedTuple):
    """Poses (n, 3) of the scene in the ``first`` and the ``second`` frame of each pair, the frames (n, 1, H, W), and
    the ``truth`` (n, 3): where the template, the middle of the first frame, is in the second."""

    first: Tensor
    second: Tensor
    template: Tensor
    image: Tensor
    truth: Tensor


def pairs(scene: Scene, draws: Draws) -> Iterator[Pairs]:
    """The pairs of ``draws``, some at a time: templates at random sub-pixel places, frames at random poses."""
    generator = torch.Generator().manual_seed(draws.seed)
    phase, shift = torch.rand(2, draws.count, 3, generator=generator, dtype=torch.float64) - 0.5
    first = MIDDLE + phase * torch.tensor([1.0, 1.0, 0.0])
    second = first + shift * torch.tensor([20.0, 20.0, math.tau if draws.turn else 0.0])
    camera = Camera(size=(FRAME, FRAME), noise_sigma=draws.noise, bits=draws.bits)
    for k in range(0, draws.count, BATCH):
        a, b = first[k : k + BATCH], second[k : k + BATCH]
        template = camera.capture(scene, a, seed=2 * draws.seed, first=k)
        image = camera.capture(scene, b, seed=2 * draws.seed + 1, first=k)
        yield Pairs(a, b, template, image, moved(a, b))


def moved(first: Tensor, second: Tensor) -> Tensor:
    """Where the middle of a frame with the scene at ``first`` (n, 3) is in one with the scene at ``second``: (n, 3)."""
    return compose(second, compose(inverse(first), MIDDLE.expand_as(first)))


class Scatter(NamedTuple):
    """Pose errors (draws, 3) px, px, rad, their normalised squares over 3 (draws,), the bound (3,), iterations and
    status (draws,)."""

    error: Tensor
    nees: Tensor
    bound: Tensor
    iterations: Tensor
    status: Tensor

    @property
    def ratio(self) -> Tensor:
        """Root mean square error over the Cramer-Rao bound, (3,)."""
        return self.error.square().mean(0).sqrt() / self.bound


def scatter(scene: Scene, draws: Draws) -> Scatter:
    """Align all pairs of ``draws``."""
    return by_sampler(scene, draws, (draws.interpolation,))[draws.interpolation]


def by_sampler(scene: Scene, draws: Draws, samplers: tuple[str, ...]) -> dict[str, Scatter]:
    """``scatter`` of the same pairs with each of the ``samplers``."""
    cut = slice(ROOM, -ROOM)
    mask = torch.zeros(FRAME - 2 * ROOM, FRAME - 2 * ROOM, dtype=torch.bool)
    mask[MARGIN:-MARGIN, MARGIN:-MARGIN] = True  # what lies around the template gives its border true gradients
    found: dict[str, list[Estimate]] = {name: [] for name in samplers}
    truth = []
    for pair in pairs(scene, draws):
        near = pair.truth + torch.tensor([0.3, -0.3, math.radians(0.17)])
        reference = prepare(pair.template[:, :, cut, cut], illumination=draws.illumination, mask=mask)
        for name, estimates in found.items():
            estimates.append(align(reference, pair.image, near, interpolation=name))
        truth.append(pair.truth)
    bound = cramer_rao(scene, (SIZE, SIZE), 2 * (draws.noise**2 + rounding(draws.bits)))
    return {name: _summary(estimates, torch.cat(truth), bound) for name, estimates in found.items()}


def _summary(estimates: list[Estimate], truth: Tensor, bound: Tensor) -> Scatter:
    found = Estimate(*(torch.cat(v) for v in zip(*estimates, strict=True)))
    error = found.pose - truth
    nees = (error[:, None] @ torch.linalg.solve(found.covariance, error[:, :, None])).flatten() / 3
    return Scatter(error, nees, bound, found.iterations, found.status)


def least(scene: Scene, draws: Draws) -> Tensor:
    """Pose errors (draws, 3) px, px, rad on the pairs of ``draws`` of one who knows the scene: all that rounding and
    noise leave to least squares. The scene is fitted to either frame, and one pose taken relative to the other."""
    errors = []
    for pair in pairs(scene, draws):
        first, second = (
            torch.stack([oracle(scene, f[0], p, (SIZE, SIZE)) for f, p in zip(frames, poses, strict=True)])
            for frames, poses in ((pair.template, pair.first), (pair.image, pair.second))
        )
        errors.append(moved(first, second) - pair.truth)
    return torch.cat(errors)


@dataclass(frozen=True)
class Harmonic:
    """One cycle of eq. (11): ``amplitude_px`` in x and y and ``amplitude_deg``, ``frames`` of them."""

    amplitude_px: float = 20.0
    amplitude_deg: float = 5.0
    frames: int = 40

    def path(self, camera: Camera) -> Tensor:
        """Poses (frames + 1, 3) of the scene about the middle of the frame; the first one is the template's."""
        h, w = camera.size
        turn = math.radians(self.amplitude_deg)
        cycle = harmonic((self.amplitude_px, self.amplitude_px, turn), self.frames)
        return placed(torch.cat((cycle[-1:], cycle)), (w / 2, h / 2))


class Run(NamedTuple):
    """Pose errors (F, 3) px, px, rad of a tracked sequence, and the status (F,)."""

    error: Tensor
    status: Tensor

    @property
    def largest(self) -> tuple[float, float]:
        """Largest error in x or y, px, and in theta, deg, of the frames that were not lost."""
        x, y, theta = self.error[Status.good(self.status)].abs().amax(0).tolist()
        return max(x, y), math.degrees(theta)

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square error of the worse of x and y, px, and of theta, deg, of the frames that were not lost."""
        x, y, theta = self.error[Status.good(self.status)].square().mean(0).sqrt().tolist()
        return max(x, y), math.degrees(theta)

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
    return Run(track.pose[:, 0] - sequence.truth(center)[1:, 0], track.status[:, 0])


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
    sequence = Sequence(scene, motion.path(camera), camera)
    return {name: track_path(sequence, options) for name, options in LIGHT_METHODS.items()}
