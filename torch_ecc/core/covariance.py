"""The covariance of poses: what the noise of template and frame, and aliasing in the sampler, make of them.

All of it is in the template's axes; ``pose.turn`` takes it to the frame's.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from torch_ecc.core.noise import Noise
from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.reference import Reference
from torch_ecc.core.solution import Solution

UNNOTICED = 2.0  # times what is expected of a block it may hold beside that and still be believed, see ``robust``


class Sandwich(NamedTuple):
    """What of the covariance of B templates is the same in every frame, (B, 3, 3) each. ``bread`` and ``next``: Z W G^T
    off the other columns with rows 1, 2, 0, and with rows 2, 0, 1, whose cross products are its cofactors; ``meat`` =
    Z W (Z W)^T off these, and ``placed``, what of it the template's place is uncertain by; what white noise of unit
    variance in the template adds to them, ``bread_bias``, ``next_bias`` and ``meat_bias``; ``place``, see ``Noise``,
    and ``alias``, what aliasing adds to that if it all adds up."""

    bread: Tensor
    next: Tensor
    meat: Tensor
    bread_bias: Tensor
    next_bias: Tensor
    meat_bias: Tensor
    placed: Tensor
    place: Tensor
    alias: Tensor


def sandwich(noise: Noise, normal: Normal, interpolation: str = "") -> Sandwich:
    """Of templates with this ``noise`` and these ``normal`` equations, looked at by a sampler."""
    alias, none = noise.alias.get(interpolation), torch.zeros_like(normal.meat)
    of_pixels, of_noise = (normal.bread, normal.meat), (normal.bread_bias, normal.meat_bias)
    sums = [m for bread, meat in (of_pixels, of_noise) for m in (bread.roll(-1, 1), bread.roll(-2, 1), meat)]
    placed = noise.place_share[:, None, None] * normal.meat
    sums += [placed, none if noise.place is None else noise.place, none if alias is None else alias @ alias.mT]
    return Sandwich(*sums)


def pose_covariance(
    known: Sandwich,
    white: Tensor,
    power: Tensor,
    bias: Tensor,
    scatter: Tensor | None = None,
    coherent: Tensor | None = None,
) -> Tensor:
    """Covariance (B, 3, 3) of poses when one frame's noise has a variance v and is seen with a gain whose square is the
    ``power`` (B,): v over that is the ``white`` (B,) noise.

    Sandwich of the instrumental-variable estimate, v S^-1 (P / gain^2 + P_t) S^-T with P = Z~ Z~^T. The template's
    noise, of variance ``bias`` (B,), is taken out of S, and out of P for its own part P_t: a derivative is
    antisymmetric, so that noise times its own derivative sums to nothing. ``scatter`` (B, 1, 3): how many times what
    white noise would do each row of K feels, see ``clinging``; ``coherent`` (B, 1, 1): see ``coherence``.
    """
    white, power, bias = (value.view(-1, 1, 1) for value in (white, power, bias))
    bread = torch.addcmul(known.bread, bias, known.bread_bias, value=-1)
    cofactors = torch.linalg.cross(bread, torch.addcmul(known.next, bias, known.next_bias, value=-1))
    determinant = torch.bmm(bread, cofactors.mT)[:, 1:2, 2:]  # the inverse is their transpose over it
    placed = torch.addcmul(known.placed, bias, known.meat_bias, value=-1)
    meat = torch.addcmul(known.meat, power, placed)  # all times gain^2
    root = (white if scatter is None else scatter * white).sqrt() / determinant
    half = cofactors * root
    rest = known.place if coherent is None else torch.addcmul(known.place, known.alias, coherent * coherent)
    return torch.baddbmm(rest, torch.bmm(half.mT, meat), half)


def hidden(reference: Reference, found: Solution, white: Tensor) -> Tensor | None:
    """What blocks that are believed next to others that are not may hide, as far as nobody notices: a covariance
    (B, 3, 3) of poses in frames with noise that counts as ``white`` (B,), variance over squared gain. None if it is
    known that all are believed.

    A cover ends where it likes, and the sampler carries its edge into blocks that it does not reach.
    """
    if found.trust is None:
        return None
    doubted = (found.trust < 1).to(found.trust).unflatten(1, reference.grid.blocks)
    near = max_pool2d(doubted[:, None], 3, 1, 1).flatten(1) * found.trust
    rows = found.normal.inverse[:, :3]
    meat = torch.einsum("bpqn,bn->bpq", reference.parts.normal, near.to(reference.parts.normal)).to(rows)
    spread = rows @ meat @ rows.mT
    return UNNOTICED / 2 * white.view(-1, 1, 1) * (spread + spread.mT)


def unevenness(instruments: Tensor, found: Solution, whole: bool) -> Tensor:
    """How many times as much is left (B,) where a template's gradients count as in all of it that is believed; its
    ``instruments`` (B, blocks, 1): by how much they do, over the mean. ``whole``: all of it is believed, and in sight.

    Where there is no light there is no noise, and no gradient either: all of it is where errors in variables count.
    """
    left = found.total[:, 6].clamp(min=LEAST)
    if whole:
        return torch.bmm(found.sums[:, 6:7], instruments).flatten() / left
    sums = found.sums[:, 0:7:6] if found.trust is None else found.sums[:, 0:7:6] * found.trust[:, None]
    pixels, there = (sums @ instruments)[:, :, 0].unbind(1)
    return there * found.total[:, 0] / (pixels * left).clamp(min=LEAST)


def coherence(axes: Tensor, sides: Tensor) -> Tensor:
    """How much of aliasing in the sampler adds up over templates of ``sides`` (2,) px at poses with ``axes``
    (B, 3, 3), see ``pose.turn``: (B, 1, 1).

    Where all pixels lie alike between the frame's (no rotation) their errors add up; over a turned template they
    cancel: the mean of exp(2 pi i k step) over n neighbours k is sin(pi n step) / (n sin(pi step)) but for its phase
    (Dirichlet).
    """
    step = axes[:, :1, :2]
    step = step - step.round()
    return torch.sinc(step * sides).div(torch.sinc(step)).prod(2, keepdim=True)


def interpolation_error(reference: Reference, axes: Tensor, interpolation: str) -> Tensor | None:
    """What aliasing shifts poses with ``axes`` (B, 3, 3) by: a square root (B, 3, 2) of its covariance; None where it
    does not count. The shift is ``Noise.alias`` times the sine of the phase, whose mean square is one half."""
    alias = reference.noise.alias.get(interpolation)
    return None if alias is None else alias * coherence(axes, reference.grid.sides)


def largest_variance(lever2: Tensor, covariance: Tensor) -> Tensor:
    """Variance (B,) of the place of a pixel with squared ``lever2`` (B, 3), px^2, under a ``covariance`` (B, 3, 3).

    Where the template is mostly noise, what is taken out for that may leave less than none of one component.
    """
    along: Tensor = torch.linalg.vector_norm(covariance.diagonal(dim1=1, dim2=2) * lever2, 1, 1)
    return along
