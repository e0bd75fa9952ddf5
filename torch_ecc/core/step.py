"""The step (Algorithm 1, line 9): how far to go along an increment, and what error is expected to remain."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import retract

SECANT_RANGE = 1.0  # px; steps beyond it are not accelerated
LARGEST_SCALE = 5.0  # of an accelerated step
LONGEST_STEP = 0.2  # of the template's radius: a longer one left the range in which the linearisation means anything


class State(NamedTuple):
    """Of B templates: ``pose`` (B, 3), the last increment ``delta`` (B, 3) in px at the farthest pixel, its ``length``
    (B,), the ``scale`` (B,) of the step taken, the predicted remaining ``error`` (B,) in px there, ``iterations``."""

    pose: Tensor
    delta: Tensor
    length: Tensor
    scale: Tensor
    error: Tensor
    iterations: Tensor

    @staticmethod
    def start(pose: Tensor) -> State:
        """Before the first iteration."""
        none = torch.zeros_like(pose[:, 0])
        return State(pose, torch.zeros_like(pose), none, none + 1, none + inf, none.long())


def advance(state: State, increment: Tensor, lever: Tensor, busy: Tensor) -> State:
    """The state after an ``increment`` (B, 3) of those ``busy`` (B,); one that is not finite ends the iterations."""
    delta = increment * lever
    length = torch.linalg.vector_norm(delta, dim=1)
    moving = (length < inf) & busy  # NaN compares as not moving
    scale, rate = secant(state, delta, length)
    scale = torch.minimum(scale, LONGEST_STEP * lever[:, 2] / length)
    pose = retract(state.pose, torch.where(moving[:, None], increment * scale[:, None], 0.0))  # eq. (10)
    error = torch.where(moving, length * scale * rate / (1 - rate), torch.where(busy, 0.0, state.error))
    delta = torch.where(moving[:, None], delta, state.delta)
    length, scale = torch.where(moving, length, state.length), torch.where(moving, scale, state.scale)
    return State(pose, delta, length, scale, error, state.iterations + moving)


def secant(state: State, delta: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Aitken (secant) acceleration: the scale of an increment ``delta`` (B, 3) of the given ``length`` (B,), and the
    rate of convergence, (B,) each.

    Noise in the template shortens every step by one factor 1 - q, so that steps shrink in a geometric series of ratio
    q, and two of them tell its sum, step / (1 - q) (the secant method on their common line). Only near the answer,
    where steps are such a series, and within one stage: another sampler or other pixels have another answer, to which
    the first step is no part of it. Its rate comes from the stage before: the share that its steps left uncovered.
    """
    last, first = state.length, ~(state.error < inf)
    rate = torch.where(last > 0, length / last, 0.5)
    rate = torch.where(first & (state.scale > 1), 1 - 1 / state.scale, rate).clamp(0.05, 0.95)
    along = (state.delta * delta).sum(-1) / (last * last)  # = 1 - (last scale) * (share that a step covers)
    usable = (last < SECANT_RANGE) & (along < 0.9) & ~first
    return torch.where(usable, (state.scale / (1 - along)).clamp(1.0, LARGEST_SCALE), 1.0), rate
