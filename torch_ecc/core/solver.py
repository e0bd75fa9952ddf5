"""The loop: batched inverse compositional Gauss-Newton for x, y and theta (paper, Algorithm 1, lines 7 to 10)."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_ecc.core.pose import Array, alike, library, retract, rotation
from torch_ecc.core.reference import Reference, reweigh
from torch_ecc.core.sampling import Sampler, host_looks, inside, make_sampler
from torch_ecc.core.settings import Settings

COARSE_TOLERANCE = 0.02  # px; the bilinear iterations only have to come near: their own bias is some 0.005 px
EDGE = 4  # px: a template nearer than this to the frame's border may cross it while iterating
SECANT_RANGE = 1.0  # px; steps beyond it are not stretched
LARGEST_STRETCH = 5.0
LONGEST_STEP = 0.2  # of the template's radius: a longer one left the range in which the linearisation means anything


class State(NamedTuple):
    """Of B templates: ``pose`` (B, 3), the last increment ``delta`` (B, 3) in px at the farthest pixel, its ``length``
    (B,) and the ``factor`` (B,) that it was stretched by, the predicted remaining ``error`` (B,) in px there,
    ``iterations`` (B,) and the last sampled ``patch`` (B, N), None before the first. On a CPU all but the patch are
    numpy arrays while they are iterated."""

    pose: Any
    delta: Any
    length: Any
    factor: Any
    error: Any
    iterations: Any
    patch: Any

    @staticmethod
    def start(reference: Reference, pose: Any) -> State:
        """Before the first iteration."""
        xp = library(pose)
        one, count = xp.ones_like(pose[:, 0]), xp.zeros_like(pose[:, 0], dtype=xp.int64)
        return State(pose, xp.zeros_like(pose), 0 * one, one, one * xp.inf, count, None)

    def convert(self, function: Callable[[Any], Any]) -> State:
        """The state in the other library, by ``Tensor.numpy`` or ``torch.from_numpy``."""
        return State._make([*map(function, self[:-1]), self.patch])

    def select(self, index: Tensor) -> State:
        """The state of some of the templates."""
        return self if len(index) == len(self.pose) else State(*(v[index] for v in self))

    def merge(self, index: Tensor, part: State) -> State:
        """This state with the templates at ``index`` replaced by ``part``."""
        if len(index) == len(self.pose):
            return part
        return State(*(v.index_copy(0, index, p) for v, p in zip(self, part, strict=True)))


def warps(reference: Reference, pose: Array) -> Array:
    """2x3 warps (B, 2, 3) that take ``reference.pixels`` to the frame: eq. (2) about the template's own centre."""
    turn = rotation(pose[:, 2])
    shift = pose[:, :2, None] - turn @ alike(reference.centre, pose)[:, :, None]
    warp: Array = library(pose).concatenate((turn, shift), -1)
    return warp


def gauss_newton(reference: Reference, sample: Sampler, state: State, tolerance: float) -> State:
    """One iteration. Elements whose predicted error is below ``tolerance`` already stay as they are."""
    xp, pose, busy = library(state.pose), state.pose, state.error > tolerance
    warp = warps(reference, pose)
    g = look(sample, warp, reference.pixels, state.patch, busy)  # I(W(p_k; x'))
    if sample.edge is not None:
        reference = reweigh(reference, torch.as_tensor(inside(warp, reference.pixels, sample.edge)))
    increment, reach = alike(reference.criterion.step(reference, g), pose), alike(reference.reach, pose)  # eq. (9)
    delta = increment * reach
    length = norm(delta)
    moving = (length < xp.inf) & busy  # NaN compares as not moving
    factor, rate = secant(state, delta, length)
    stretch = xp.minimum(factor, LONGEST_STEP * reach[:, 2] / length)
    moved = retract(pose, xp.where(moving[:, None], increment * stretch[:, None], 0.0))  # eq. (10)
    error = xp.where(moving, length * stretch * rate / (1 - rate), 0.0)
    length, stretch = xp.where(moving, length, state.length), xp.where(moving, stretch, state.factor)
    return State(moved, delta, length, stretch, error, state.iterations + moving, g)


def look(sample: Sampler, warp: Any, pixels: Tensor, patch: Tensor | None, busy: Any) -> Tensor:
    """The patches (B, N) at ``warp`` (B, 2, 3); where the host knows who is ``busy`` (B,), the others are as before."""
    if isinstance(busy, Tensor) or busy.all():
        return sample(warp, pixels)
    index, patch = busy.nonzero()[0], pixels.new_zeros(len(busy), pixels.shape[1]) if patch is None else patch
    return patch.index_copy(0, torch.from_numpy(index), sample.select(index)(warp[index], pixels))


def norm(vector: Any) -> Any:
    """Length (B,) of vectors (B, n)."""
    return (vector * vector).sum(-1) ** 0.5


def secant(state: State, delta: Any, length: Any) -> tuple[Any, Any]:
    """Stretch of an increment ``delta`` (B, 3) of the given ``length`` (B,), and the rate of convergence, (B,) each.

    Noise in the template shortens every step by one factor, so that steps shrink in a geometric series. Two of them
    tell its sum (the secant method on their common line). Only near the answer, where steps are such a series, and
    within one stage: another sampler or other pixels have another answer, to which the first step is no part of it. Of
    that step the earlier stage tells what it leaves: the share that its steps did not cover.
    """
    xp, last, first = library(delta), state.length, ~(state.error < inf)
    rate = xp.where(last > 0, length / last, 0.5)
    rate = xp.where(first & (state.factor > 1), 1 - 1 / state.factor, rate).clip(0.05, 0.95)
    along = (state.delta * delta).sum(-1) / (last * last)  # = 1 - (last stretch) * (share that a step covers)
    usable = (last < SECANT_RANGE) & (along < 0.9) & ~first
    return xp.where(usable, (state.factor / (1 - along)).clip(1.0, LARGEST_STRETCH), 1.0), rate


def iterate(reference: Reference, sample: Sampler, state: State, tolerance: float, budget: int) -> State:
    """Gauss-Newton until every predicted error is below ``tolerance`` or ``budget`` iterations are spent.

    An accelerator does them all, so that the host need not know: what has converged is masked.
    """
    state = state._replace(patch=None)
    for _ in range(budget):
        if host_looks(reference.K.device) and not (state.error > tolerance).any():
            break
        state = gauss_newton(reference, sample, state, tolerance)
    return state if state.patch is not None else state._replace(patch=torch.zeros_like(reference.K[:, 0]))


@np.errstate(all="ignore")
def refine(reference: Reference, image: Tensor, state: State, settings: Settings, *, border: bool) -> tuple[State, Any]:
    """From a start within the basin to the answer: bilinear and few pixels first, then all that is asked for.

    And which templates (B,) are settled: all with ``border``; without it no pixel may drop out of sight, and those
    that come near the border are left alone.
    """
    size, xp, sample = (image.shape[-2], image.shape[-1]), library(state.pose), None
    warp, todo = warps(reference, state.pose), stages(reference, settings)
    settled = xp.ones_like(state.pose[:, 0]) > 0 if border else inside(warp, reference.box, size, margin=EDGE).all(-1)
    for part, interpolation, tolerance, budget in todo:
        if border:
            state = stage(part, image, state, interpolation, tolerance, budget)
            continue
        if sample is None or interpolation != "bilinear":
            sample = make_sampler(interpolation, image, warp, reference.box)
        state = iterate(part, sample, state._replace(error=xp.where(settled, xp.inf, 0.0)), tolerance, budget)
        warp = warps(reference, state.pose)
        settled = settled & sample.covers(warp, reference.box, 0 if part is todo[-1][0] else EDGE)
    return state, settled


def stages(reference: Reference, settings: Settings) -> list[tuple[Reference, str, float, int]]:
    """What to do one after the other: the pixels, the sampler, the tolerance in px and the iterations at most."""
    thin, budget = reference.thin, settings.max_iterations
    if budget == 1 or (settings.interpolation == "bilinear" and thin is reference):
        return [(reference, settings.interpolation, settings.tolerance, budget)]
    coarse = max(budget * 2 // 3, 1)
    return [
        (thin, "bilinear", max(settings.tolerance, COARSE_TOLERANCE), coarse),
        (reference, settings.interpolation, settings.tolerance, budget - coarse),
    ]


@np.errstate(all="ignore")
def stage(
    reference: Reference, image: Tensor, state: State, interpolation: str, tolerance: float, budget: int
) -> State:
    """``iterate`` with one sampler; templates that reach beyond the frame are weighed anew at every iteration."""
    state = state._replace(error=torch.full_like(state.error, torch.inf), patch=torch.zeros_like(reference.K[:, 0]))
    warp, size = warps(reference, state.pose), (image.shape[-2], image.shape[-1])
    sample = make_sampler(interpolation, image, warp, reference.box)
    whole = inside(warp, reference.box, size, margin=EDGE).all(-1)
    for index, edge in ((whole, None), (~whole, size)):
        some = index.nonzero()[:, 0]
        if len(some):
            begin = state.select(some).convert(Tensor.numpy if host_looks(some.device) else Tensor.clone)
            part = sample._replace(edge=edge).select(some)
            found = iterate(reference.select(some), part, begin, tolerance, budget)
            state = state.merge(some, found.convert(torch.as_tensor))
    return state
