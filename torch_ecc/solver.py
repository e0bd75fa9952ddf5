"""The loop: batched inverse compositional Gauss-Newton for x, y and theta (paper, Algorithm 1, lines 7 to 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.pose import retract, rotation
from torch_ecc.reference import Reference, reweigh
from torch_ecc.sampling import Sampler, inside, make_sampler

COARSE_TOLERANCE = 0.02  # px; the bilinear iterations only have to come near: their own bias is some 0.005 px
EDGE = 4  # px: a template nearer than this to the frame's border may cross it while iterating
SECANT_RANGE = 1.0  # px; steps beyond it are not stretched
LARGEST_STRETCH = 5.0
LONGEST_STEP = 0.2  # of the template's radius: a longer one left the range in which the linearisation means anything


@dataclass(frozen=True)
class Settings:
    """How to iterate and when to believe the result.

    ``tolerance``: remaining error in px at the template's farthest pixel. A template is lost below ``min_score`` and
    out of view when less than ``min_visible`` of its weight lies in the frame. ``backend``: "auto" is the native path
    on a CPU where it is there or can be compiled, "native" says so if it cannot, "torch" never is.
    """

    interpolation: str = "bspline3"
    max_iterations: int = 15
    tolerance: float = 1e-3
    min_score: float = 0.5
    min_visible: float = 0.25
    backend: str = "auto"

    def __post_init__(self) -> None:
        for name, known in (
            ("interpolation", ["bilinear", "bspline3", "bspline5"]),
            ("backend", ["auto", "torch", "native"]),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: expected one of {known}, got {getattr(self, name)!r}")
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(f"max_iterations: expected a whole number of at least 1, got {self.max_iterations}")
        if not self.tolerance > 0:
            raise ValueError(f"tolerance: expected a length in px > 0, got {self.tolerance}")
        for name, value in (("min_score", self.min_score), ("min_visible", self.min_visible)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name}: expected a number from 0 to 1, got {value}")


class State(NamedTuple):
    """Of B templates: ``pose`` (B, 3), the last increment ``delta`` (B, 3) in px at the farthest pixel and the
    ``factor`` (B,) that it was stretched by, the predicted remaining ``error`` (B,) in px there, ``iterations`` (B,)
    and the last sampled ``patch`` (B, N)."""

    pose: Tensor
    delta: Tensor
    factor: Tensor
    error: Tensor
    iterations: Tensor
    patch: Tensor

    @staticmethod
    def start(reference: Reference, pose: Tensor) -> State:
        """Before the first iteration."""
        one, count = torch.ones_like(pose[:, 0]), torch.zeros_like(pose[:, 0], dtype=torch.int64)
        return State(pose, torch.zeros_like(pose), one, one * torch.inf, count, torch.zeros_like(reference.K[:, 0]))

    def select(self, index: Tensor) -> State:
        """The state of some of the templates."""
        return self if len(index) == len(self.pose) else State(*(v[index] for v in self))

    def merge(self, index: Tensor, part: State) -> State:
        """This state with the templates at ``index`` replaced by ``part``."""
        if len(index) == len(self.pose):
            return part
        return State(*(v.index_copy(0, index, p) for v, p in zip(self, part, strict=True)))


def warps(reference: Reference, pose: Tensor) -> Tensor:
    """2x3 warps (B, 2, 3) that take ``reference.pixels`` to the frame: eq. (2) about the template's own centre."""
    turn = rotation(pose[:, 2])
    shift = pose[:, :2, None] - turn @ reference.centre[:, :, None].to(turn.dtype)
    return torch.cat((turn, shift), -1)


def gauss_newton(reference: Reference, sample: Sampler, state: State, tolerance: float) -> State:
    """One iteration. Elements whose predicted error is below ``tolerance`` already stay as they are."""
    pose = state.pose
    warp = warps(reference, pose)
    g = sample(warp, reference.pixels)  # I(W(p_k; x'))
    seen = reference if sample.edge is None else reweigh(reference, inside(warp, reference.pixels, sample.edge))
    increment = seen.criterion.step(seen, g).to(pose.dtype)  # eq. (9), or a better one
    delta = increment * reference.lever
    length = torch.linalg.vector_norm(delta, dim=-1)
    moving = length.isfinite() & (state.error > tolerance)
    factor, rate = secant(state, delta, length)
    stretch = torch.minimum(factor, LONGEST_STEP * reference.radius / length.clamp(min=1e-12))
    moved = retract(pose, increment * stretch[:, None])  # eq. (10)
    return State(
        torch.where(moving[:, None], moved, pose),
        torch.where(moving[:, None], delta, state.delta),
        torch.where(moving, stretch, state.factor),
        torch.where(moving, length * stretch * rate / (1 - rate), 0.0),
        state.iterations + moving,
        g,
    )


def secant(state: State, delta: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Stretch of an increment ``delta`` (B, 3) of the given ``length`` (B,), and the rate of convergence, (B,) each.

    Noise in the template shortens every step by one factor, so that steps shrink in a geometric series. Two of them
    tell its sum (the secant method on their common line). Only near the answer, where steps are such a series, and
    within one stage: another sampler or other pixels have another answer, to which the first step is no part of it.
    """
    last = torch.linalg.vector_norm(state.delta, dim=-1)
    rate = torch.where(last > 0, length / last, 0.5).clamp(0.05, 0.95)
    along = (state.delta * delta).sum(-1) / (last * last)  # = 1 - (last stretch) * (share that a step covers)
    usable = (last < SECANT_RANGE) & (along < 0.9) & state.error.isfinite()
    return torch.where(usable, (state.factor / (1 - along)).clamp(1.0, LARGEST_STRETCH), 1.0), rate


def iterate(reference: Reference, sample: Sampler, state: State, tolerance: float, budget: int) -> State:
    """Gauss-Newton until every predicted error is below ``tolerance`` or ``budget`` iterations are spent."""
    result, index = state, torch.arange(len(state.pose), device=state.pose.device)
    period = check_period(index.device)
    for k in range(1, budget + 1):
        state = gauss_newton(reference, sample, state, tolerance)
        if k < budget and k % period == 0:
            busy = (state.error > tolerance).nonzero()[:, 0]
            if len(busy) == 0:
                break
            if len(busy) < len(index):  # converged elements stop costing
                result = result.merge(index, state)
                index, state = index[busy], state.select(busy)
                reference, sample = reference.select(busy), sample.select(busy)
    return result.merge(index, state)


def check_period(device: torch.device) -> int:
    """Iterations between two looks at what has converged: each look stops an accelerator, and costs a CPU nothing."""
    return 1 if device.type == "cpu" else 4


def refine(reference: Reference, image: Tensor, state: State, settings: Settings) -> State:
    """From a start within the basin to the answer: bilinear and few pixels first, then all that is asked for."""
    budget, thin, patch = settings.max_iterations, reference.thin, state.patch
    if budget > 1 and (settings.interpolation != "bilinear" or thin is not reference):
        coarse = max(budget * 2 // 3, 1)
        state = state._replace(patch=patch[:, : thin.K.shape[-1]])
        state = stage(thin, image, state, "bilinear", max(settings.tolerance, COARSE_TOLERANCE), coarse)
        state = state._replace(patch=patch)
        budget -= coarse
    return stage(reference, image, state, settings.interpolation, settings.tolerance, budget)


def stage(
    reference: Reference, image: Tensor, state: State, interpolation: str, tolerance: float, budget: int
) -> State:
    """``iterate`` with one sampler; templates that reach beyond the frame are weighed anew at every iteration."""
    state = state._replace(error=torch.full_like(state.error, float("inf")))
    warp, size = warps(reference, state.pose), (image.shape[-2], image.shape[-1])
    sample = make_sampler(interpolation, image, warp, reference.box)
    whole = inside(warp, reference.box, size, margin=EDGE).all(-1)
    for index, edge in ((whole, None), (~whole, size)):
        some = index.nonzero()[:, 0]
        if len(some):
            part = sample._replace(edge=edge).select(some)
            state = state.merge(some, iterate(reference.select(some), part, state.select(some), tolerance, budget))
    return state
