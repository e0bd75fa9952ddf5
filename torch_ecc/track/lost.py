"""Templates that are lost after all, and why."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Reason, Status
from torch_ecc.core.robust import FAMILIAR
from torch_ecc.core.verdict import unknown


def disproved(estimate: Estimate, lost: Tensor, reason: Reason) -> Estimate:
    """The ``estimate`` in which those (R,) that are ``lost`` are so for a ``reason``."""
    return estimate._replace(
        status=torch.where(lost, int(Status.LOST), estimate.status).to(torch.int8),
        reason=torch.where(lost, int(reason), estimate.reason).to(torch.int8),
        covariance=torch.where(lost[:, None, None], unknown(estimate.covariance), estimate.covariance),
    )


def told(estimate: Estimate, templates: list[int], reason: Reason) -> Estimate:
    """The ``estimate`` that tells of those ``templates`` that are lost that this ``reason`` is why."""
    if not templates:
        return estimate
    index = torch.tensor(templates, device=estimate.status.device)
    lost = estimate.status[index] == Status.LOST
    codes = torch.where(lost, int(reason), estimate.reason[index]).to(torch.int8)
    return estimate._replace(reason=estimate.reason.index_copy(0, index, codes))


def waiting(estimate: Estimate, templates: list[int], usual: Tensor) -> Estimate:
    """The ``estimate`` of a frame in which there is no time to search for those ``templates``: if they are lost that is
    why, and they are lost if they do not look as ``usual`` (R,) where they are."""
    unsought = torch.zeros_like(usual, dtype=torch.bool)
    unsought[templates] = True
    strange = unsought & (estimate.score < FAMILIAR * usual) & Status.good(estimate.status)
    return told(disproved(estimate, strange, Reason.WAITING), templates, Reason.WAITING)
