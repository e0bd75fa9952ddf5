"""Noise that is the same in all frames, a camera's fixed pattern: it holds a template where that was cut.

The template's gradients hold the pattern of the frame that they are from. Less than a pixel away it is still there, and
adds to what they find the pull of errors in variables,

    S^-1 (c v N) d exp(-d^2 / REACH),

of noise of variance v, of which the share c stays, at a displacement d; S and N as in ``covariance``. The share is what
is missing of the residuals next to where the template was cut. What is taken for noise may be fine texture, of which as
much is missing everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import turn
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import is_cpu

NEAR, FAR = 0.5, 3.0  # px: so near the pattern is the same, and so far it is another
LEAST = 0.35  # of the noise may be missing anyhow: between pixels of a frame, and where its estimate is coarse
REACH = 2.4  # px^2
TEXTURE = -1.0  # as a share: it is not noise


def pinned(estimate: Estimate, reference: Reference, state: Mapping[str, Tensor]) -> Estimate:
    """The ``estimate`` (R, ...) of a frame, whose covariance tells of that pull; the shares (R,) are kept in the
    ``state`` of a tracker."""
    noise, known, rms = reference.noise, state["fixed"], estimate.residual_rms.detach()
    on_cpu = is_cpu(rms.device)
    if on_cpu and nothing_missing(*(value.tolist() for value in (known, rms, noise.power, noise.frames))):
        return estimate
    pose, moved = estimate.pose.detach(), (estimate.pose - state["start"]).detach()
    distance2, missing = moved[:, :2].square().sum(1), 1 - rms.square() / (noise.power * (1 + noise.frames))
    seen, stays = Status.good(estimate.status), missing > LEAST
    share = torch.where(seen & (distance2 <= NEAR**2) & (known >= 0), torch.where(stays, missing, 0.0), known)
    known.copy_(torch.where(seen & (distance2 > FAR**2) & stays, TEXTURE, share))
    if on_cpu and not bool((known > 0).any()):
        return estimate
    axes, pull = turn(pose[:, 2]), known.clamp(min=0) * noise.of_frame * (-distance2 / REACH).exp()
    bread = reference.normal.bread, reference.normal.bread_bias
    turned = (axes.mT @ moved[:, :, None]) * pull[:, None, None]
    off = axes @ (torch.linalg.inv_ex(bread[0])[0] @ (bread[1] @ turned))
    more = (off @ off.mT).nan_to_num(0.0, 0.0, 0.0)
    return estimate._replace(covariance=estimate.covariance + more)


def nothing_missing(share: list[float], rms: list[float], power: list[float], frames: list[float]) -> bool:
    """Whether the host sees at once that templates have all the residuals that noise leaves, or it is no noise."""
    each = zip(share, rms, power, frames, strict=True)
    return all(s < 0 or (s == 0 and r * r >= (1 - LEAST) * p * (1 + n)) for s, r, p, n in each)
