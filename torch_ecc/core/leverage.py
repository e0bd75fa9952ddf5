"""Whether blocks of high leverage say of a pose what the others say.

A dark edge before weak texture fixes a pose by itself: what the rest of a patch says is in the residuals, each block's
too small to be seen. So the pose is asked for once more with blocks that count by no more than the mean leverage
(bounded influence: Mallows, On some topics in robustness, 1975), one step from where it is:

    d = (sum c E)^-1 sum c K e,        E = K R^T over the pixels of a block,  c = min(1, mean / its mean diagonal)^2
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.blocks import Blocks, Parts
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.sampling import is_cpu

if TYPE_CHECKING:
    from torch_ecc.core.solution import Solution

AS_MUCH = 2.0  # times d: bounded, they still have their say
CERTAIN = 12.0  # of three squares of a standard normal: one in a hundred is as large


class Leverage(NamedTuple):
    """Of B templates: by how much their blocks count where none counts too much, ``bounded`` (B, blocks, 1); what takes
    the sum of their effects so counted to a ``step`` (B, 3, 3), and to numbers that are standard normal where residuals
    are white noise of unit variance, ``unit`` (B, 3, 3), 0 where that cannot be told."""

    bounded: Tensor
    step: Tensor
    unit: Tensor


def leverage_of(blocks: Blocks, parts: Parts, normal: Normal) -> Leverage:
    """Made of templates' ``blocks``, what these add to the ``normal`` equations, and those."""
    inverse, enough = normal.inverse[:, :3], blocks.enough
    own = torch.einsum("bip,bpjn->bijn", inverse, parts.normal[:, :, :3].to(inverse))
    each = own.diagonal(dim1=1, dim2=2).mean(2)
    mean = (each * enough).sum(1, keepdim=True) / enough.sum(1, keepdim=True).clamp(min=1)
    bounded = (mean / each.clamp(min=LEAST)).clamp(max=1).square()[:, None, None]
    step, regular = safe_inverse((own * bounded).sum(3))
    spread = (own * bounded.square()).sum(3) @ inverse[:, :, :3]
    root, failed = torch.linalg.cholesky_ex((spread + spread.mT) / 2)
    unit, solved = safe_inverse(root)
    known = regular & solved & (failed == 0)
    dtype = parts.normal.dtype
    unit = torch.where(known[:, None, None], unit, 0.0)
    return Leverage(bounded[:, 0, 0, :, None].to(dtype), step.to(dtype), unit.to(dtype))


def disagreement(leverage: Leverage, found: Solution) -> Tensor | None:
    """By what (B, 3) the poses that were ``found`` may be off if blocks of high leverage are wrong, in the template's
    axes and either way; 0 where they say the same but for noise. None if it is known that all do."""
    bounded, step, unit = leverage
    asked = torch.bmm(found.sums[:, 7:10], bounded)
    square = torch.linalg.vector_norm(torch.bmm(unit, asked), dim=(1, 2)).square()
    noise = found.total[:, 6] / found.total[:, 0].clamp(min=LEAST)
    if is_cpu(square.device) and all(s <= CERTAIN * v for s, v in zip(square.tolist(), noise.tolist(), strict=True)):
        return None
    off = AS_MUCH * torch.bmm(step, asked)[:, :, 0].to(noise) / found.gain[:, None]
    return torch.where((square > CERTAIN * noise)[:, None], off, 0.0)
