"""What of a patch is neither the template nor noise: a sheen, still background, another layer that moves by itself.

It may pull a pose as far as the fit can take it up, and what it has taken up no residual shows: sums over clusters of
pixels see a part of it. But how much of it is left tells how much there is, and such things are about as coarse as the
template's own texture. So it is taken for noise that is the same over patches as large as those over which the texture
correlates, of which the template has few.

It clings together along rows of blocks and along columns: what it adds to the pose does, or, where it pulls this way
and that, as blur does, the residuals themselves. The lines of a sensor do along one of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.clinging import Clinging
from torch_ecc.core.criteria import centred
from torch_ecc.core.normal import LEAST
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import Solution

LEAST_UNLIKE = 0.01  # of the template's power: as much noise of any kind, light and the sampler may leave
NEIGHBOURLY = 0.4  # correlation of the residuals of blocks with those beside them that noise never has
MUCH = 0.1  # of the template's power: then the residuals themselves are looked at
CLINGS = 1.5  # times as much as noise must residuals cling together: they are not noise, however much there is


def unlike(reference: Reference, found: Solution, score: Tensor, clings: Clinging) -> Tensor | None:
    """What it adds to the covariance (B, 3, 3) of poses, in the template's axes, of this ``score`` (B,) and with
    residuals that ``clings`` together. None if it is known that there is nothing like it."""
    scatter, ratio, _ = clings
    if scatter is None or ratio is None:
        return None
    if is_cpu(score.device) and none_at_all(score.tolist(), scatter[:, 0].tolist(), ratio[:, 1:].tolist()):
        return None
    coarse, much = ratio[:, 1:].amin(1).mean(1) > 1, (1 + MUCH) * score * score < 1
    if not is_cpu(score.device) or bool(much.any()):
        coarse |= (neighbourly(reference, found) > NEIGHBOURLY) & much
    normal, power = found.normal, found.gain.square()
    left = found.total[:, 6] / (power * normal.total).clamp(min=LEAST) - LEAST_UNLIKE * normal.contrast
    amount = left.clamp(min=0) * (1 - CLINGS / scatter.mean((1, 2))).clamp(min=0) * reference.patch
    amount = torch.where(coarse, amount, 0.0)
    block = normal.inverse[:, :3, :3]
    return amount[:, None, None] * (block @ normal.meat @ block.mT)


def neighbourly(reference: Reference, found: Solution) -> Tensor:
    """By how much (B,) the residuals of blocks are those of the next ones along rows and along columns, of both the
    lesser correlation."""
    weight, of_block = found.sums[:, 0], reference.blocks
    trust = weight if found.trust is None else weight * found.trust
    pairs = (found.sums[:, 1], weight), (of_block.t, of_block.weight)
    g, t = (centred(total / count.clamp(min=LEAST), trust)[0] for total, count in pairs)
    left = ((g - found.gain[:, None] * t) * (trust > 0)).unflatten(1, reference.grid.blocks)
    along = ((left[:, 1:] * left[:, :-1]).mean((1, 2)), (left[:, :, 1:] * left[:, :, :-1]).mean((1, 2)))
    least: Tensor = torch.minimum(*along) / left.square().mean((1, 2)).clamp(min=LEAST)
    return least


def none_at_all(score: list[float], scatter: list[list[float]], lines: list[list[list[float]]]) -> bool:
    """Whether next to nothing is left of all templates, or it is noise, or it is little and along one axis: seen at
    once, as in most frames."""
    return all(
        (1 + LEAST_UNLIKE) * s * s >= 1
        or sum(of_blocks) <= CLINGS * len(of_blocks)
        or ((1 + MUCH) * s * s >= 1 and sum(map(min, rows, columns)) <= len(rows))
        for s, of_blocks, (rows, columns) in zip(score, scatter, lines, strict=True)
    )
