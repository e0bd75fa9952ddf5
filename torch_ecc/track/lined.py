"""Lines of a sensor with offsets of their own, the same in all frames, hold a template where that was cut.

They do along one axis, however far it has gone along the other, as a fixed pattern does (``pinned``): of offsets of
variance v by

    S^-1 v N d exp(-d^2 / REACH),

where N is what lines of unit variance add to the sums over the template's gradients. From one block of BLOCK lines to
the next they leave, a displacement of d px away, residuals whose means have second differences of mean square

    TOLD v min(d, d^2)

(OF_LINES and TOLD were measured with lines before scenes of four kinds, on which they do not depend: within a fifth
from 0.3 to 2 px). No more can be theirs than the template has of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, sin

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.normal import LEAST
from torch_ecc.core.pose import turn
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import Solution
from torch_ecc.track.pinned import FAR, REACH, uncertain

OF_LINES = 0.5  # N is so much of what white noise adds, over that noise's response to the instruments' blur
TOLD = 0.55  # of means of BLOCK lines
NEAREST, FARTHER, FARTHEST = 0.05, 1.2, 4.0  # px, times as far, px: where it is asked for, once each
NEVER = 1e9  # px
SURE, FREE = 3.0, 1.8  # standard deviations, of squares of neighbours that are not free of each other
FULL = 0.5  # of the fullest line's weight


def lined(estimate: Estimate, found: Solution, reference: Reference, state: Mapping[str, Tensor]) -> Estimate:
    """The ``estimate`` (R, ...) of what was ``found`` in a frame, whose covariance tells of the pull of lines. What is
    known of them, ``lines`` (R, 2, 2) in the ``state`` of a tracker, is their variance along x and y, and how far off
    it is to be asked for, again and again."""
    lines, moved = state["lines"], estimate.displacement.detach()[:, :2]
    on_cpu = is_cpu(moved.device)
    if on_cpu and nothing_due(lines.tolist(), moved.tolist(), estimate.pose[:, 2].tolist()):
        return estimate
    (power, due), reach = lines.unbind(2), moved.abs()
    farther = reach > due
    if not on_cpu or bool(farther.any()):
        reach = reach.clamp(max=FARTHEST)
        told = torch.stack([offsets(found, reference, axis) for axis in (0, 1)], 1)
        new = told / (TOLD * torch.minimum(reach, reach.square())).clamp(min=LEAST)
        farther = farther & Status.good(estimate.status)[:, None]
        power = torch.where(farther, torch.minimum(new, reference.blocks.lined.to(new)), power)
        again = FARTHER * reach + NEAREST
        again = torch.where(again < FARTHEST, again, NEVER)
        lines.copy_(torch.stack((power, torch.where(farther, again, due)), 2))
    along = torch.bmm(turn(estimate.pose.detach().select(1, 2)).mT[:, :2, :2], moved.unsqueeze(2)).squeeze(2)
    near = torch.where(along.abs() <= FAR, along * (-along.square() / REACH).exp(), 0.0) * power
    if on_cpu and not bool(near.any()):
        return estimate
    normal, pull = reference.normal, OF_LINES / reference.noise.response[:, :1] * near
    return uncertain(estimate, torch.bmm(normal.inverse[:, :3, :3], normal.bread_bias[:, :, :2] * pull.unsqueeze(1)))


def nothing_due(lines: list[list[list[float]]], moved: list[list[float]], theta: list[float]) -> bool:
    """Whether the host sees at once that there is nothing to ask for, and no lines that are known pull from so far."""
    for each, (x, y), turned in zip(lines, moved, theta, strict=True):
        (power_x, due_x), (power_y, due_y) = each
        if abs(x) > due_x or abs(y) > due_y:
            return False
        if power_x > 0 or power_y > 0:
            c, s = cos(turned), sin(turned)
            if (power_x > 0 and abs(c * x - s * y) <= FAR) or (power_y > 0 and abs(c * y + s * x) <= FAR):
                return False
    return True


def unknown_lines(start: Tensor) -> Tensor:
    """What is known at the ``start`` (R, 3) of lines (R, 2, 2): none, and where to ask for them."""
    return start.new_tensor((0.0, NEAREST)).expand(len(start), 2, 2).clone()


def offsets(found: Solution, reference: Reference, axis: int) -> Tensor:
    """The mean square (R,) of the second differences of means of lines of blocks along an ``axis``, x or y, that noise
    does not explain."""
    blocks, sums, gain = reference.blocks, found.sums, found.gain[:, None].to(found.sums)
    weight = sums[:, 0] if found.trust is None else sums[:, 0] * found.trust
    mean = sums[:, 1] / sums[:, 0].clamp(min=LEAST) - gain * blocks.t / blocks.weight.clamp(min=LEAST)
    count, total = torch.stack((weight, weight * mean)).unflatten(2, reference.grid.blocks).sum(2 + axis)
    full, line = count > FULL * count.amax(1, keepdim=True), total / count.clamp(min=LEAST)
    known = (full[:, 2:] & full[:, 1:-1] & full[:, :-2]).to(line)
    n, white = known.sum(1).clamp(min=1), found.total[:, 6] / found.total[:, 0].clamp(min=LEAST)
    each = 1 / count.clamp(min=LEAST)
    by_noise = ((each[:, 2:] + 4 * each[:, 1:-1] + each[:, :-2]) * known).sum(1) / n * white
    more = (line.diff(n=2, dim=1).square() * known).sum(1) / n - by_noise
    return torch.where(more > SURE * (2 * FREE / n).sqrt() * by_noise, more, 0.0)
