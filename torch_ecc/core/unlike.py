"""What of a patch is neither the template nor noise: a sheen, still background, another layer that moves by itself.

It may pull a pose as far as the fit can take it up, and what it has taken up no residual shows: sums over clusters of
pixels see a part of it. But how much of it is left tells how much there is, and such things are about as coarse as the
template's own texture. So it is taken for noise that is the same over patches as large as those over which the texture
correlates, of which the template has few.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.clinging import Clinging
from torch_ecc.core.normal import LEAST
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import Solution

LEAST_UNLIKE = 0.01  # of the template's power: as much noise of any kind, light and the sampler may leave
CLINGS = 1.5  # times as much as noise must residuals cling together: they are not noise, however much there is


def unlike(reference: Reference, found: Solution, score: Tensor, clings: Clinging) -> Tensor | None:
    """What it adds to the covariance (B, 3, 3) of poses, in the template's axes, of this ``score`` (B,) and with
    residuals that ``clings`` together. None if it is known that there is nothing like it.

    It clings together along rows of blocks and along columns. The lines of a sensor do along one of them.
    """
    scatter, ratio, _ = clings
    if scatter is None or ratio is None:
        return None
    if is_cpu(score.device) and none_at_all(score.tolist(), scatter[:, 0].tolist(), ratio[:, 1:].tolist()):
        return None
    normal, power = found.normal, found.gain.square()
    left = found.total[:, 6] / (power * normal.total).clamp(min=LEAST) - LEAST_UNLIKE * normal.contrast
    amount = left.clamp(min=0) * (1 - CLINGS / scatter.mean((1, 2))).clamp(min=0) * reference.patch
    amount = torch.where(ratio[:, 1:].amin(1).mean(1) > 1, amount, 0.0)
    block = normal.inverse[:, :3, :3]
    return amount[:, None, None] * (block @ normal.meat @ block.mT)


def none_at_all(score: list[float], scatter: list[list[float]], lines: list[list[list[float]]]) -> bool:
    """Whether next to nothing is left of all templates, or it is noise, or it is along one axis: seen at once, as in
    most frames."""
    return all(
        (1 + LEAST_UNLIKE) * s * s >= 1
        or sum(of_blocks) <= CLINGS * len(of_blocks)
        or sum(map(min, rows, columns)) <= len(rows)
        for s, of_blocks, (rows, columns) in zip(score, scatter, lines, strict=True)
    )
