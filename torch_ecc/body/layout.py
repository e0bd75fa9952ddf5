"""Where the patches of rigid bodies are, and where they are expected when the bodies have moved.

A body moves as its reference point and its angle do, pose (3,) px, px, rad with the conventions of ``core.pose``; a
patch has a place in its body that never changes: W(patch) = W(body) o W(place).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import tau
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import compose, inverse


class Layout(NamedTuple):
    """R patches of G bodies: the ``place`` (R, 3) of each in its body, which ``body`` (R,) it is a part of, 0 for none;
    whether it is (G, R) as 0 and 1, ``member``; where the bodies ``start`` (G, 3) and how far patches are from there,
    ``reach`` (G,) px, rms."""

    place: Tensor
    body: Tensor
    member: Tensor
    start: Tensor
    reach: Tensor

    @staticmethod
    def of(start: Tensor, groups: Sequence[Sequence[int]]) -> Layout:
        """Of patches that start at (R, 3), the middle of a group's patches being its body's reference point."""
        member = start.new_zeros(len(groups), len(start))
        for g, group in enumerate(groups):
            member[g, list(group)] = 1.0
        count = member.sum(1, keepdim=True)
        origin = torch.cat((member @ start[:, :2] / count, start[[group[0] for group in groups], 2:]), 1)
        body = member.argmax(0)
        place = compose(inverse(origin)[body], start)
        reach = (member @ place[:, :2].square().sum(1, keepdim=True) / count)[:, 0].sqrt()
        return Layout(place, body, member, origin, reach.clamp(min=1.0))

    def select(self, index: Tensor) -> Layout:
        """A single body of the patches at ``index`` (n,), which are its own."""
        g = int(self.body[index[0]])
        member = self.member.new_ones(1, len(index))
        return Layout(self.place[index], self.body[index] * 0, member, self.start[g : g + 1], self.reach[g : g + 1])

    def predict(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Where patches (..., R, 3) are if their bodies are at ``pose`` (..., R, 3), and how that changes with x, y and
        theta times ``reach``: (..., R, 3, 3)."""
        there = compose(pose, self.place.expand_as(pose))
        arm = (there - pose)[..., :2] / self.reach[self.body][:, None]
        slope = torch.stack((arm[..., 1], -arm[..., 0], 1 / self.reach[self.body].expand(arm.shape[:-1])), -1)
        one = torch.eye(3, 2, dtype=pose.dtype, device=pose.device).expand(*pose.shape, 2)
        return there, torch.cat((one, slope[..., None]), -1)

    def bodies(self, patch: Tensor) -> Tensor:
        """Where each patch (..., R, 3) by itself says that its body is: (..., R, 3)."""
        return compose(patch, inverse(self.place).expand_as(patch))

    def gather(self, values: Tensor) -> Tensor:
        """The sum over each body's patches of ``values`` (..., R, n): (..., G, n)."""
        return self.member @ values


def wrapped(difference: Tensor) -> Tensor:
    """Differences of poses (..., 3) less whole turns."""
    x, y, theta = difference.unbind(-1)
    return torch.stack((x, y, theta - tau * torch.round(theta / tau)), -1)
