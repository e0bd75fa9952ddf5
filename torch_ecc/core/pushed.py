"""Does a frame hold a pose? A template that is pushed off it must come back.

In a direction that has no texture a template's own noise is all that answers, and sigma, made of its gradients, knows
nothing of it. What noise adds to them can be told if it is white. Of noise that was blurred, as by a colour filter, a
JPEG or a denoiser, nothing in one image tells that it is none of the scene's; but another frame does not have it, and
there the template stays where it was pushed to. A template that has come back clearly in so many frames has texture:
it is not asked again while all of it counts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.pose import retract, turn
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Engine, Solution, Trust

PUSH = 0.5  # px, of the farthest pixel
LEAST_ANSWER = 0.1  # where no direction answers more, nothing holds the pose
MOST_LEFT = 0.7  # of a push: more is noise's
CLEARLY = 0.5  # of that: less is texture's, if it is so in
ENOUGH = 8  # frames in a row
DOUBLINGS = 6  # of a power: what is a tenth less is then a thousandth


class Push(NamedTuple):
    """How B templates are pushed in an ``image``: by the ``engine`` that it gives for them. ``answered`` (B,): in how
    many frames in a row they came back clearly, None if nobody counts."""

    engine: Callable[[], Engine]
    reference: Reference
    image: Tensor
    settings: Settings
    answered: Tensor | None = None

    def unanswered(self, share: Tensor) -> Tensor:
        """The ``share`` (B,) of the information that may be noise's of templates all of whose pixels count: 0 of those
        that have answered."""
        return share if self.answered is None else torch.where(self.answered < ENOUGH, share, 0.0)

    def __call__(self, found: Solution, asked: Tensor) -> Tensor:
        """What is left, over what may be, of those that are ``asked`` (B,) bool, 0 of the others."""
        share = self.left(found, asked) / MOST_LEFT
        if self.answered is not None:
            count = torch.where(share < CLEARLY, self.answered + 1, 0)
            self.answered.copy_(torch.where(asked, count, self.answered))
        return torch.where(asked, share, 0.0)

    def left(self, found: Solution, asked: Tensor) -> Tensor:
        """``left_of_push`` (B,) of those that are ``asked`` (B,); of copies of one template only they are solved."""
        one, reference, image = self.reference.one, self.reference, self.image
        if one is None or not is_cpu(asked.device):
            return left_of_push(self.engine(), reference, image, self.settings, found, trusted(found, asked))
        some = asked.nonzero()[:, 0]
        reference, image = one.copies(len(some)), image if len(image) == 1 else image[some]
        of_some = each(lambda value: value[some], found)
        share = left_of_push(self.engine(), reference, image, self.settings, of_some, trusted(of_some, asked[some]))
        return share.new_zeros(len(asked)).index_copy(0, some, share)


@torch.no_grad()
def left_of_push(
    engine: Engine, reference: Reference, image: Tensor, settings: Settings, found: Solution, trust: Trust | None = None
) -> Tensor:
    """The share (B,) of a push that one iteration of the ``engine`` leaves of templates that were ``found`` and are
    solved with a ``trust``, in the direction in which their texture is most like noise: of texture next to none, of
    noise all of it. Of a blurred picture it leaves something in every direction: what counts is how much more in that
    one than in any."""
    image, found = image.detach(), found._replace(pose=found.pose.detach())
    least, most = by_information(found.normal)

    def again(start: Tensor) -> Solution:
        return engine(reference, image, start, settings.once, trust)

    weak = answer(again, reference, found, least)
    if is_cpu(weak.device) and min(weak.tolist()) > 1 - CLEARLY * MOST_LEFT:  # clearly, if most is left of no push
        return 1 - weak
    return 1 - weak / answer(again, reference, found, most).clamp(LEAST_ANSWER, 1.0)


def answer(solve: Callable[[Tensor], Solution], reference: Reference, found: Solution, direction: Tensor) -> Tensor:
    """The share (B,) of a push in a ``direction`` (B, 3) that is taken back by those who ``solve`` from a start on."""
    axes = turn(found.pose[:, 2])
    push = direction * (PUSH / torch.linalg.vector_norm(direction * reference.place.lever, dim=1, keepdim=True))
    starts = (retract(found.pose, away) for away in (push, -push))
    before, after = (solve(start).pose for start in starts)
    apart = (axes.mT @ (after - before)[:, :, None])[:, :, 0]
    power = found.normal.bread_bias.diagonal(dim1=1, dim2=2)
    share: Tensor = (apart * power * push).sum(1) / (2 * (push * power * push).sum(1)).clamp(min=LEAST)
    return 1 - share


def by_information(normal: Normal) -> tuple[Tensor, Tensor]:
    """The increments (B, 3), of some length, about which there is least and most information for what noise would
    leave."""
    unit = normal.bread_bias.diagonal(dim1=1, dim2=2).clamp(min=LEAST).rsqrt()
    information = normal.bread * unit[:, :, None] * unit[:, None]
    information = information.nan_to_num(0.0, 0.0, 0.0)
    return weakest(information) * unit, strongest(information) * unit


def weakest(matrix: Tensor) -> Tensor:
    """The eigenvector (B, 3), of some length, of a symmetric ``matrix`` (B, 3, 3) >= 0 with its least eigenvalue: that
    of its cofactors with the largest."""
    scaled = matrix / trace(matrix)
    return strongest(torch.linalg.cross(scaled.roll(-1, 1), scaled.roll(-2, 1)))


def strongest(matrix: Tensor) -> Tensor:
    """That with the largest one: nothing else is left of the powers. (LAPACK's has the host look at it.)"""
    power = matrix + LEAST * torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    for _ in range(DOUBLINGS):
        power = power / trace(power)
        power = power @ power
    largest = power.diagonal(dim1=1, dim2=2).argmax(1)
    vector: Tensor = power.gather(2, largest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    return vector


def trace(matrix: Tensor) -> Tensor:
    """(B, 1, 1) of (B, 3, 3)."""
    return matrix.diagonal(dim1=1, dim2=2).sum(1).clamp(min=LEAST)[:, None, None]


def trusted(found: Solution, asked: Tensor) -> Trust | None:
    """As it was solved with, in those that are ``asked`` (B,)."""
    if found.trust is None and is_cpu(asked.device):
        return None
    return Trust(torch.arange(len(asked), device=asked.device), found.trust, asked, judged=False)
