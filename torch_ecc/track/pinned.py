"""What is the same in all frames holds a template where that was cut: a camera's fixed pattern, and its marks.

The template's gradients hold the pattern of the frame that they are from. Less than a pixel away it is still there, and
adds to what they find the pull of errors in variables,

    S^-1 (c v N) d exp(-d^2 / REACH),

of noise of variance v, of which the share c stays, at a displacement d; S and N as in ``covariance``. The share is what
is missing of the residuals next to where the template was cut. What is taken for noise may be fine texture, of which as
much is missing everywhere.

A mark of more contrast than the rest stays, and so does the pose, long before too much is left of any block. Then the
rest says something else: see ``core.leverage``.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.leverage import disagreement
from torch_ecc.core.pose import turn
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import Solution
from torch_ecc.track.watch import ELSEWHERE, HEEDED

NEAR, FAR = 0.5, 3.0  # px: so near the pattern is the same, and so far it is another
LEAST_SHARE = 0.35  # of the noise may be missing anyhow: between pixels of a frame, and where its estimate is coarse
REACH = 2.4  # px^2
TEXTURE = -1.0  # as a share: it is not noise


def held(estimate: Estimate, found: Solution, reference: Reference, state: Mapping[str, Tensor]) -> Estimate:
    """The ``estimate`` (R, ...) of what was ``found`` in a frame, whose covariance tells of both."""
    if is_cpu(estimate.status.device) and min(estimate.status.tolist()) > Status.MAX_ITERATIONS:
        return estimate  # nothing was
    estimate, moved = pinned(estimate, reference, state), estimate.displacement.detach()
    if is_cpu(moved.device) and all(x * x + y * y > ELSEWHERE**2 for x, y, _ in moved.tolist()):
        return estimate
    off = disagreement(reference.leverage, found)
    if off is None:
        return estimate
    near = (moved[:, :2].square().sum(1) <= ELSEWHERE**2) & (state["heed"] != HEEDED) & Status.good(estimate.status)
    return uncertain(estimate, torch.where(near[:, None, None], off[:, :, None], 0.0))


def pinned(estimate: Estimate, reference: Reference, state: Mapping[str, Tensor]) -> Estimate:
    """The ``estimate`` (R, ...) of a frame, whose covariance tells of the pattern's pull; the shares (R,) are kept in
    the ``state`` of a tracker."""
    noise, known, rms = reference.noise, state["fixed"], estimate.residual_rms.detach()
    on_cpu = is_cpu(rms.device)
    if on_cpu and nothing_missing(*(value.tolist() for value in (known, rms, noise.power, noise.frames))):
        return estimate
    moved, missing = estimate.displacement.detach(), 1 - rms.square() / noise.of_both
    distance2, seen, stays = moved[:, :2].square().sum(1), Status.good(estimate.status), missing > LEAST_SHARE
    share = torch.where(seen & (distance2 <= NEAR**2) & (known >= 0), torch.where(stays, missing, 0.0), known)
    known.copy_(torch.where(seen & (distance2 > FAR**2) & stays, TEXTURE, share))
    if on_cpu and not bool((known > 0).any()):
        return estimate
    pull = known.clamp(min=0) * noise.of_frame * (-distance2 / REACH).exp()
    turned = turn(estimate.pose.detach()[:, 2]).mT @ moved[:, :, None]
    solved = reference.normal.inverse[:, :3, :3] @ (reference.normal.bread_bias @ turned)  # the first is that of S
    return uncertain(estimate, solved * pull[:, None, None])


def uncertain(estimate: Estimate, off: Tensor) -> Estimate:
    """The ``estimate`` (R, ...) whose poses may be off, in the template's axes, by each of k columns (R, 3, k) too."""
    there = torch.bmm(turn(estimate.pose.detach().select(1, 2)), off)
    return estimate._replace(covariance=estimate.covariance + torch.bmm(there, there.mT).nan_to_num_(0.0, 0.0, 0.0))


def nothing_missing(share: list[float], rms: list[float], power: list[float], frames: list[float]) -> bool:
    """Whether the host sees at once that templates have all the residuals that noise leaves, or it is no noise."""
    each = zip(share, rms, power, frames, strict=True)
    return all(s < 0 or (s == 0 and r * r >= (1 - LEAST_SHARE) * p * (1 + n)) for s, r, p, n in each)
