"""Laws of torch's ambient state: autocast, default dtype and device, and inference mode change no pose."""

from __future__ import annotations

import importlib
import math
import pkgutil
import random
import timeit
from contextlib import contextmanager

import pytest
import torch

import torch_ecc as te
from torch_ecc import servo
from torch_ecc.core.ambient import plain
from torch_ecc.sim.scene.scene import PlaneWaves

CENTER, SIZE = [(48.0, 44.0)], 27


def render(*poses: tuple[float, float, float]) -> torch.Tensor:
    path = torch.tensor(poses, dtype=torch.float64, device="cpu")
    return PlaneWaves.random(seed=5).render(path, (88, 96))[:, 0].round().clamp(0, 255).to(torch.uint8)


# It moves a little, jumps to where it is searched for nearby, and then to where it is only found in the whole frame.
FRAMES = render((48, 44, 0), (49.3, 43.2, 0.02), (60.0, 50.0, 0.1), (30.5, 35.2, -1.2), (31.0, 35.4, -1.22))
FLOATS = FRAMES[:3].float()
COLOUR = FRAMES[:, None].expand(-1, 3, -1, -1).contiguous()
POSE = torch.tensor([[48.6, 44.2, 0.01]], dtype=torch.float64, device="cpu")
MOVES = torch.tensor([[1.0, 2, 0.1], [4, -3, 0.2], [-2, 5, 0.3], [0, 1, 0]], dtype=torch.float64, device="cpu")
STAGE = torch.tensor([[0.3, -1.1], [1.2, 0.9], [-0.5, -2.6], [0, 0]], dtype=torch.float64, device="cpu")


@contextmanager
def default_dtype(dtype: torch.dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def default_device(device: str):
    torch.set_default_device(device)
    try:
        yield
    finally:
        torch.set_default_device(None)


STATES = {
    "bfloat16 autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "float16 autocast": lambda: torch.autocast("cpu", dtype=torch.float16),
    "float64 default": lambda: default_dtype(torch.float64),
    "float16 default": lambda: default_dtype(torch.float16),
    "meta default": lambda: default_device("meta"),
    "inference": torch.inference_mode,
}


def tracker(**options):
    return lambda: te.Tracker(options.pop("frame", FRAMES[0]), CENTER, SIZE, **options)


def follow(tracker: te.Tracker) -> list[torch.Tensor]:
    """Every frame, there and back; all that is told of them and all that is kept."""
    track = tracker.track_sequence(FRAMES[[1, 2, 3, 4, 0]])
    return [*track, track.sigma, *tracker.state_dict(keep_vars=True).values()]


def found(tracker: te.Tracker) -> list[torch.Tensor]:
    servo.find(tracker, FRAMES[3])
    return [*tracker(FRAMES[4]), tracker.pose, tracker.velocity]


def poses(_: None) -> list[torch.Tensor]:
    p, q = MOVES[:2], MOVES[2:]
    back = te.pose.from_opencv(te.pose.to_opencv(p, (5, 7)), (5, 7)), te.pose.from_se2(te.pose.to_se2(p))
    two = [function(p, q) for function in (te.pose.compose, te.pose.retract, te.pose.ahead)]
    turned = te.pose.transform(p, STAGE[None]), te.pose.unwrap(p[:, 2], q[:, 2])
    return [*back, *two, *turned, te.pose.inverse(p), te.pose.from_matrix(te.pose.matrix(p))]


def calibration(dtype: torch.dtype):
    def use(made: te.CalibrationFit) -> list[torch.Tensor]:
        move, square = MOVES.to(dtype), torch.diag_embed(MOVES.to(dtype).abs() + 1)
        physical = made.calibration.to_physical(move)
        return [made.sigma, physical, made.calibration.to_pixels(physical), made.calibration.covariance(square)]

    return use


def located(locator: te.Locator) -> list[torch.Tensor]:
    result = locator(FRAMES[3])
    return [*result.estimate, result.score, *result.runner_up, result.runner_up_score, result.ambiguous]


def by_name(reference: te.Reference) -> list[torch.Tensor]:
    result = te.locate(reference, COLOUR[3])
    return [*result.estimate, result.score, result.ambiguous]


def aligned(backend: str):
    return lambda reference: list(te.align(reference, FRAMES[1], POSE - POSE.round(), backend=backend))


def patch(mask: bool = False) -> te.Reference:
    y, x = torch.meshgrid(*(torch.arange(27.0, dtype=torch.float32, device="cpu"),) * 2, indexing="ij")
    return te.prepare(FRAMES[0, 31:58, 35:62], mask=(x - 13) ** 2 + (y - 13) ** 2 < 150 if mask else None)


def nothing() -> None:
    return None


def align_all(reference: te.Reference, backend: str) -> list[torch.Tensor]:
    return [v for name in ("bilinear", "bspline5") for v in te.align(reference, FRAMES[1], POSE, interpolation=name, backend=backend)]


# How an object is made, and what is asked of it.
CALLS = {
    "native": (tracker(backend="native"), follow),
    "torch": (tracker(backend="torch"), follow),
    "levels": (tracker(backend="torch", levels=2, criterion="ssd"), follow),
    "floats": (lambda: te.Tracker(FLOATS[0].clone(), CENTER, SIZE, backend="native"), lambda t: list(t(FLOATS[1].clone()))),
    "colour": (lambda: te.Tracker(COLOUR[0], CENTER, SIZE, backend="torch"), lambda t: list(t(COLOUR[1]))),
    "find": (lambda: te.Tracker.find(FRAMES[0, 30:60, 30:62], FRAMES[1], backend="torch")[0], follow),
    "servo": (tracker(), found),
    "align native": (patch, lambda reference: align_all(reference, "native")),
    "align torch": (lambda: patch(mask=True), lambda reference: align_all(reference, "torch")),
    "locate": (patch, by_name),
    "locator": (lambda: te.Locator(patch(), (88, 96)), located),
    "texture": (nothing, lambda _: [te.texture(COLOUR[0], CENTER, SIZE)]),
    "poses": (nothing, poses),
    "calibration": (lambda: te.calibrate(MOVES, STAGE), calibration(torch.float64)),
    "calibration of floats": (lambda: te.calibrate(MOVES.float(), STAGE.float()), calibration(torch.float32)),
}
