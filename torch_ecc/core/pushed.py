"""Does a frame hold a pose? A template that is pushed off it must come back.

In a direction that has no texture a template's own noise is all that answers, and sigma, made of its gradients, knows
nothing of it. What noise adds to them can be told if it is white. Of noise that was blurred, as by a colour filter, a
JPEG or a denoiser, nothing in one image tells that it is none of the scene's; but another frame does not have it, and
there the template stays where it was pushed to.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.normal import LEAST, Normal
from torch_ecc.core.pose import retract, turn
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Engine, Solution, Trust

PUSH = 0.5  # px, of the farthest pixel
LEAST_ANSWER = 0.1  # where no direction answers more, nothing holds the pose
MOST_LEFT = 0.7  # of a push: more is noise's


@torch.no_grad()
def left_of_push(engine: Engine, reference: Reference, image: Tensor, settings: Settings, found: Solution) -> Tensor:
    """The share (B,) of a push that one iteration of the ``engine`` leaves of templates that were ``found``, in the
    direction in which their texture is most like noise: of texture next to none, of noise all of it. Of a blurred
    picture it leaves something in every direction: what counts is how much more in that one than in any."""
    image, found = image.detach(), found._replace(pose=found.pose.detach())
    least, most = by_information(found.normal)
    weak, strong = (answer(engine, reference, image, settings, found, way) for way in (least, most))
    return 1 - weak / strong.clamp(LEAST_ANSWER, 1.0)


def answer(
    engine: Engine, reference: Reference, image: Tensor, settings: Settings, found: Solution, direction: Tensor
) -> Tensor:
    """The share (B,) of a push in a ``direction`` (B, 3) that is taken back."""
    axes = turn(found.pose[:, 2])
    push = direction * (PUSH / torch.linalg.vector_norm(direction * reference.place.lever, dim=1, keepdim=True))
    starts = (retract(found.pose, away) for away in (push, -push))
    before, after = (engine(reference, image, start, settings.once, trusted(found)).pose for start in starts)
    apart = (axes.mT @ (after - before)[:, :, None])[:, :, 0]
    power = found.normal.bread_bias.diagonal(dim1=1, dim2=2)
    share: Tensor = (apart * power * push).sum(1) / (2 * (push * power * push).sum(1)).clamp(min=LEAST)
    return 1 - share


def by_information(normal: Normal) -> tuple[Tensor, Tensor]:
    """The increments (B, 3), of some length, about which there is least and most information for what noise would
    leave."""
    unit = normal.bread_bias.diagonal(dim1=1, dim2=2).clamp(min=LEAST).rsqrt()
    information = normal.bread * unit[:, :, None] * unit[:, None]
    directions: Tensor = torch.linalg.eigh(information.nan_to_num(0.0, 0.0, 0.0))[1]
    return directions[:, :, 0] * unit, directions[:, :, 2] * unit


def trusted(found: Solution) -> Trust | None:
    """As it was solved with."""
    if found.trust is None:
        return None
    return Trust(torch.arange(len(found.trust), device=found.trust.device), found.trust)
