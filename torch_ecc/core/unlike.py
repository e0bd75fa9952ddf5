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
FEW = 4  # blocks along a side, which the fit makes unlike each other
MORE = 2.0  # times as much as noise leaves is something else
CLINGS = 1.5  # times as much as noise must residuals cling together: they are not noise, however much there is


def unlike(reference: Reference, found: Solution, score: Tensor, clings: Clinging) -> Tensor | None:
    """What it adds to the covariance (B, 3, 3) of poses, in the template's axes, of this ``score`` (B,) and with
    residuals that ``clings`` together. None if it is known that there is nothing like it."""
    scatter, ratio, _ = clings
    normal, power = found.normal, found.gain.square()
    least = LEAST_UNLIKE * normal.contrast
    if scatter is None or ratio is None:  # too few blocks to tell: what is more than noise leaves is none
        if is_cpu(score.device) and all((1 + LEAST_UNLIKE) * s * s >= 1 for s in score.tolist()):
            return None
        share, least = torch.ones_like(score), torch.maximum(least, MORE * reference.noise.of_both)
    else:
        if is_cpu(score.device) and none_at_all(score.tolist(), scatter[:, 0].tolist(), ratio[:, 1:].tolist()):
            return None
        coarse, much = ratio[:, 1:].amin(1).mean(1) > 1, (1 + MUCH) * score * score < 1
        if not is_cpu(score.device) or bool(much.any()):
            coarse |= (neighbourly(reference, found) > NEIGHBOURLY) & much
        share = torch.where(coarse, (1 - CLINGS / scatter.mean((1, 2))).clamp(min=0), 0.0)
    left = found.total[:, 6] / (power * normal.total).clamp(min=LEAST)
    block = normal.inverse[:, :3, :3]
    return ((left - least).clamp(min=0) * share * reference.patch)[:, None, None] * (block @ normal.meat @ block.mT)


def neighbourly(reference: Reference, found: Solution) -> Tensor:
    """By how much (B,) the residuals of blocks are those of the next ones along rows and along columns, of both the
    lesser correlation; along the longer side alone where blocks are few along the other."""
    weight, of_block = found.sums[:, 0], reference.blocks
    trust = weight if found.trust is None else weight * found.trust
    pairs = (found.sums[:, 1], weight), (of_block.t, of_block.weight)
    g, t = (centred(total / count.clamp(min=LEAST), trust)[0] for total, count in pairs)
    left = ((g - found.gain[:, None] * t) * (trust > 0)).unflatten(1, reference.grid.blocks)
    sides = [(axis, n) for axis, n in enumerate(left.shape) if axis > 0 and n >= min(FEW, max(left.shape[1:]))]
    along = [(left.narrow(k, 1, n - 1) * left.narrow(k, 0, n - 1)).mean((1, 2)) for k, n in sides]
    least: Tensor = torch.stack(along).amin(0) / left.square().mean((1, 2)).clamp(min=LEAST)
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
