"""A rigid body of many patches on an analytic scene: frames, truth, the bound of all patches together, disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc import Body, BodyEstimate, Estimate, Lens, Status, Tracker
from torch_ecc.core.pose import compose, inverse, transform
from torch_ecc.paper.bound import jacobian, rounding
from torch_ecc.paper.scheme import Kept
from torch_ecc.sim import Camera, PlaneWaves

SCENE = PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0)
FEW = PlaneWaves.random(count=50, fmax=0.25, rms_gradient=7.0)  # waves, where each pixel's value is computed alone
OTHER = PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0, seed=3)
OFF = torch.tensor([0.3, -0.3, 0.003], dtype=torch.float64)  # of where patches are looked for
REDRAWN = 25  # draws of the noise on one pair of poses


@dataclass(frozen=True)
class Plan:
    """``across`` x ``across`` patches of ``size`` px over ``span`` px in the middle of a frame of ``side`` px."""

    side: int = 1024
    across: int = 4
    size: int = 61
    span: int = 700

    @property
    def places(self) -> Tensor:
        """Centres (R, 2) from the middle, whole px."""
        at = torch.linspace(-self.span / 2, self.span / 2, self.across, dtype=torch.float64).round()
        return torch.cartesian_prod(at, at).flip(1)

    @property
    def middle(self) -> Tensor:
        """Pose (3,) of the scene in the middle of the frame."""
        return torch.tensor([self.side // 2, self.side // 2, 0.0], dtype=torch.float64)

    def bound(self, noise: float, kept: Tensor | None = None) -> Tensor:
        """Bound (3,) px, px, rad of the pose of the ``kept`` patches' middle, all of them by default: the sum of what
        they tell, each with a gain and an offset of its own; template and frame redrawn."""
        places = self.places if kept is None else self.places[kept]
        told = torch.zeros(3, 3, dtype=torch.float64)
        for place in places:
            t, J = jacobian(SCENE, (self.size, self.size), torch.cat((place, place.new_zeros(1))))
            arm = place - self.places.mean(0)
            J = torch.stack((J[:, 0], J[:, 1], J[:, 2] + J[:, 0] * arm[1] - J[:, 1] * arm[0]), 1)
            span, _ = torch.linalg.qr(torch.stack((torch.ones_like(t), t), -1))
            J = J - span @ (span.mT @ J)
            told += J.mT @ J
        return (2 * (noise**2 + rounding(8)) * torch.linalg.inv(told)).diagonal().sqrt()


class Drawn(NamedTuple):
    """Errors (n, 3) px, px, rad, squared over their covariance (n,), chi-square per degree of freedom (n,), and which
    patches (n, R) were used."""

    error: Tensor
    nees: Tensor
    chi2: Tensor
    used: Tensor


def draw(plan: Plan, noise: float, count: int, wrong: str = "", apart: tuple[int, ...] = ()) -> Drawn:
    """Bodies in ``count`` redrawn pairs of frames, up to 5 px and 1.4 deg apart; the patches ``apart`` are ``wrong``:
    "covered", "jumped" (by 12 px) or "another body"."""
    g, found = torch.Generator().manual_seed(1), list[tuple[Tensor, ...]]()
    camera = Camera(size=(plan.side, plan.side), noise_sigma=noise)
    centers = plan.places + plan.middle[:2]
    for k in range(math.ceil(count / REDRAWN)):
        phase = torch.rand(3, 3, generator=g, dtype=torch.float64) - 0.5
        a = plan.middle + phase[0] * torch.tensor([1.0, 1.0, 0.0])
        b, c = (a + p * torch.tensor([10.0, 10.0, 0.05]) for p in phase[1:])
        first, second = (SCENE.render(p[None], camera.size) for p in (a, b))
        _disturb(second, wrong, transform(b, transform(inverse(a), centers))[list(apart)], plan.size, c)
        for n in range(min(REDRAWN, count - k * REDRAWN)):
            seeds = 2 * (k * REDRAWN + n)
            f, s = (camera.capture(Kept(v), a[None], seed=seeds + i)[0, 0] for i, v in enumerate((first, second)))
            tracker = Tracker(f, centers, plan.size, search=False)
            truth = compose(compose(b, inverse(a)).expand_as(tracker.start), tracker.start)
            tracker.expect(truth + OFF, 0 * truth, torch.ones(len(truth), dtype=torch.bool))
            body, estimate = Body(tracker), tracker(s)
            if wrong == "jumped":
                estimate = _jumped(estimate, apart)
            found.append(_judged(body(estimate), body, compose(b, inverse(a))))
    return Drawn(*(torch.stack(v) for v in zip(*found, strict=True)))


def _judged(found: BodyEstimate, body: Body, motion: Tensor) -> tuple[Tensor, ...]:
    error = found.pose[0] - compose(motion, body.layout.start[0])
    squares = error @ torch.linalg.solve(found.covariance[0], error) / 3
    return error, squares, found.chi2[0] / found.freedom[0], found.used


def _disturb(frame: Tensor, wrong: str, centers: Tensor, size: int, other: Tensor) -> None:
    """In a frame (1, 1, H, W), written in place: around ``centers`` (n, 2) another scene, or this one at ``other``."""
    if wrong not in ("covered", "another body"):
        return
    shown = (OTHER if wrong == "covered" else SCENE).render(other[None], tuple(frame.shape[-2:]))
    half = size // 2 + 12
    for x, y in centers.round().long().tolist():
        part = (..., slice(max(y - half, 0), y + half + 1), slice(max(x - half, 0), x + half + 1))
        frame[part] = shown[part]


def _jumped(estimate: Estimate, apart: tuple[int, ...]) -> Estimate:
    """As if a search had taken look-alikes 12 px away for them, and was sure."""
    pose, status = estimate.pose.clone(), estimate.status.clone()
    pose[list(apart), 0] += 12.0
    status[list(apart)] = int(Status.CONVERGED)
    return estimate._replace(pose=pose, status=status)


class Near(NamedTuple):
    """FEW as a ``lens`` shows it, drawn only near patches at ``places`` (R, 2) of the scene: exact, and quick."""

    lens: Lens
    places: Tensor
    reach: int

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """Frames (B, 1, h, w) at poses (B, 3)."""
        frames = torch.full((len(poses), 1, *size), FEW.mean)
        side = torch.arange(-self.reach, self.reach + 1, dtype=torch.float64)
        box = torch.cartesian_prod(side, side)
        for frame, pose in zip(frames[:, 0], poses.double(), strict=True):
            at = (self.lens.distort(transform(pose, self.places)).round()[:, None] + box).flatten(0, 1)
            at = at[((at >= 0) & (at < at.new_tensor((size[1], size[0])))).all(1)]
            looks = transform(inverse(pose), self.lens.undistort(at))
            frame[at[:, 1].long(), at[:, 0].long()] = FEW.value(looks).float()
        return frames
