"""What every engine answers with: poses, and sums of its last look over blocks of pixels, for ``verdict`` to judge."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.criteria import centred
from torch_ecc.core.normal import Normal
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings

SUMS = 10  # rows of ``summed``
CLUSTERS = 9  # square sums of the last three of them, see ``clustered``
FLAT = 1e-12  # of a patch's power: what is left of it off its mean is rounding


class Trust(NamedTuple):
    """Of the templates at ``which`` (n,): by how much the pixels of their ``blocks`` (n, blocks) count, 0 to 1, None if
    all do. Where the host does not look that is all of them, in their order; what is answered of those that are not
    ``asked`` (n,) for, by default all, means nothing. ``judged``: whether anybody asks for more than poses, sums and
    totals; else the ``normal`` equations may be those of all pixels."""

    which: Tensor
    blocks: Tensor | None
    asked: Tensor | None = None
    judged: bool = True

    @staticmethod
    def whole(trust: Trust | None) -> bool:
        """Whether all pixels count."""
        return trust is None or trust.blocks is None


class Solution(NamedTuple):
    """What an engine answers with, of B templates: ``pose`` (B, 3); ``error`` (B,), the predicted remaining error in px
    at the farthest pixel; ``iterations`` (B,); of the last look the patch's ``gain`` (B,), ``sums`` (B, 10, blocks), in
    every block of pixels the rows of ``summed``, their ``total`` (B, 10 + 9) over the blocks, as they are trusted, with
    what the last three have in ``clustered``, and the ``normal`` equations of the pixels that count: in sight, and as
    their blocks are trusted. A gain or total not finite is 0. ``trust`` (B, blocks) in these, None if it is whole;
    ``odd`` (B,): which have blocks with more left than any noise leaves, None if it is known that none has;
    ``doubtful`` (B,): which must be solved again, None if all that must be are."""

    pose: Tensor
    error: Tensor
    iterations: Tensor
    gain: Tensor
    sums: Tensor
    total: Tensor
    normal: Normal
    trust: Tensor | None = None
    odd: Tensor | None = None
    doubtful: Tensor | None = None


Engine = Callable[[Reference, Tensor, Tensor, Settings, Trust | None], Solution]  # ``solver.solve``, ``native.solve``


def summed(
    reference: Reference, g: Tensor, seen: Tensor, trusted: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Gain, sums and total of patches g (B, N), see ``Solution``: over the pixels of each block, of the weights w times

        1, g0, g0^2, t0 g0, u g0, v g0, e^2, and of the first three rows of K times e,

    with g0 and t0 the patch and the template less their weighted means, (u, v) the pixel's place in ``Place.unit``, and
    e what the criterion's model leaves of g. Of a patch that is flat but for rounding g0 is 0. The ``reference`` weighs
    pixels by their blocks' trust; w is what is ``seen`` (B, N) without it, so that blocks that are not ``trusted`` have
    sums too. K is zero there.
    """
    w, (residual, gain) = reference.weight, reference.criterion.fit(reference, g)
    (g0, norm), (t0, _) = centred(g, w), centred(reference.signal[:, 3], w)
    power, mean, level = norm.square(), g[:, 0] - g0[:, 0], w.sum(-1)
    w = seen
    wg, (u, v) = w * g0, reference.uv.unbind(1)
    influence = (reference.K[:, :3] * residual[:, None]).unbind(1)
    rows = torch.stack((w, wg, wg * g0, wg * t0, wg * u, wg * v, w * residual * residual, *influence), 1)
    grid, dtype = reference.grid, reference.place.radius.dtype
    sums = rows.new_zeros(len(g), rows.shape[1], grid.blocks[0] * grid.blocks[1]).index_add_(2, grid.block, rows)
    rough = power > FLAT * (power + mean.square() * level)
    sums[:, 1:6] *= rough[:, None, None]
    counted = sums if trusted is None else torch.cat((sums[:, :7] * trusted[:, None], sums[:, 7:]), 1)
    total = torch.cat((counted.sum(-1, dtype=dtype), clustered(sums[:, 7:].to(dtype), grid.blocks)), 1)
    return gain.to(dtype).nan_to_num_(0.0, 0.0, 0.0), sums, total.nan_to_num_(0.0, 0.0, 0.0)


def clustered(effect: Tensor, grid: tuple[int, int]) -> Tensor:
    """Square sums (B, 9) of an ``effect`` (B, 3, blocks) over blocks, over rows and over columns of their ``grid``."""
    lines = effect.unflatten(2, grid)
    return torch.cat([each.square().sum(2) for each in (effect, lines.sum(3), lines.sum(2))], 1)


def counted_pixels(reference: Reference, visible: Tensor | None, trusted: Tensor | None) -> Tensor | None:
    """By how much the pixels (B, N) count: if they are ``visible`` (B, N), as their blocks are ``trusted``; None where
    all do."""
    if trusted is None:
        return visible
    share = trusted.to(reference.weight.dtype)[:, reference.grid.block]
    return share if visible is None else share * visible
