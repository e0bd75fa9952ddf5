"""Where the patches of rigid bodies are, and where they are expected when the bodies have moved.

A body moves as its reference point and its angle do, pose (3,) px, px, rad with the conventions of ``core.pose``; a
patch has a place in its body that never changes: W(patch) = W(body) o W(place).

Behind a lens the body is where it would be without, and patches are where the lens shows them. There it also deforms
them, more or less than in the first frame: what a rigid fit makes of that is its response to a displacement field, a
constant matrix of the template (as the columns of K say), times the field at nine points of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import tau
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import compose, inverse, rotation, transform
from torch_ecc.core.reference import Reference
from torch_ecc.records.lens import Lens


class View(NamedTuple):
    """What a ``lens`` makes of R patches: nine points of each in its body, ``there`` (R, 9, 2), and from its centre in
    its own axes as they were seen in the first frame, ``offset`` (R, 9, 2); by how much the pose of a rigid fit changes
    with what displaces them, ``response`` (R, 3, 18); their ``angle`` (R,) in the body as it was seen there."""

    lens: Lens
    there: Tensor
    offset: Tensor
    response: Tensor
    angle: Tensor

    def predict(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., R, 3) in which patches of bodies at ``pose`` (..., R, 3) are found, and how their places change
        with those without the lens, (..., R, 2, 2)."""
        straight, angle = transform(pose, self.there), pose[..., 2] + self.angle
        seen = self.lens.distort(straight)
        middle, back = seen[..., MIDDLE, :], rotation(angle)
        field = (seen - middle[..., None, :]) @ back - self.offset
        rigid = torch.cat((middle, angle[..., None]), -1)
        response = (self.response @ field.flatten(-2)[..., None])[..., 0]
        slope = self.lens.slope(straight[..., MIDDLE, :])
        return compose(rigid, response), slope


class Layout(NamedTuple):
    """R patches of G bodies: the ``place`` (R, 3) of each in its body, which ``body`` (R,) it is a part of, 0 for none;
    whether it is (G, R) as 0 and 1, ``member``; where the bodies ``start`` (G, 3) and how far patches are from there,
    ``reach`` (G,) px, rms; by what x, y and theta of bodies are counted, ``units`` (G, 3); how places turn with cos and
    sin of their body's angle, and the slope of that in these units, ``turning`` (R, 6, 3); the ``view`` if there is a
    lens before them."""

    place: Tensor
    body: Tensor
    member: Tensor
    start: Tensor
    reach: Tensor
    units: Tensor
    turning: Tensor
    view: View | None = None

    @property
    def taken(self) -> Tensor:
        """Which patches are part of a body: (R,) bool."""
        return self.member.any(0)

    @staticmethod
    def of(start: Tensor, groups: Sequence[Sequence[int]]) -> Layout:
        """Of patches that start at (R, 3), the middle of a group's patches being its body's reference point."""
        return Layout._of(start, groups, start[[group[0] for group in groups], 2:])

    @staticmethod
    def _of(start: Tensor, groups: Sequence[Sequence[int]], angle: Tensor) -> Layout:
        """With the bodies' ``angle`` (G, 1) at the start."""
        member = start.new_zeros(len(groups), len(start))
        for g, group in enumerate(groups):
            member[g, list(group)] = 1.0
        count = member.sum(1, keepdim=True)
        origin = torch.cat((member @ start[:, :2] / count, angle), 1)
        body = member.argmax(0)
        place = compose(inverse(origin)[body], start)
        reach = (member @ place[:, :2].square().sum(1, keepdim=True) / count)[:, 0].sqrt().clamp(min=1.0)
        units = torch.stack((torch.ones_like(reach), torch.ones_like(reach), reach), 1)
        return Layout(place, body, member, origin, reach, units, _turning(place, reach[body]))

    @staticmethod
    def behind(lens: Lens, start: Tensor, groups: Sequence[Sequence[int]], response: Response) -> Layout:
        """The same of patches seen by a ``lens`` at ``start`` (R, 3), whose fits have a ``response``. ValueError beyond
        the lens's range."""
        first = start[[group[0] for group in groups], 2:]
        plain = Layout._of(lens.undistort_pose(start), groups, first)
        points = response.points.to(start)
        there = transform(inverse(plain.start)[plain.body], lens.undistort(transform(start, points)))
        angle = start[:, 2] - first[plain.body, 0]
        return plain._replace(view=View(lens, there, points, response.matrix.to(start), angle))

    def to(self, device: torch.device) -> Layout:
        """All of it on a ``device``."""
        view = self.view and View(self.view.lens, *(v.to(device) for v in self.view[1:]))
        place, body, member, start, reach, units, turning = (v.to(device) for v in self[:7])
        return Layout(place, body, member, start, reach, units, turning, view)

    def select(self, index: Tensor) -> Layout:
        """A single body of the patches at ``index`` (n,), which are its own."""
        g, view = int(self.body[index[0]]), self.view and View(self.view.lens, *(v[index] for v in self.view[1:]))
        start, reach, units = (value[g : g + 1] for value in (self.start, self.reach, self.units))
        member = self.member.new_ones(1, len(index))
        return Layout(self.place[index], self.body[index] * 0, member, start, reach, units, self.turning[index], view)

    def predict(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Where patches (..., R, 3) are if their bodies are at ``pose`` (..., R, 3), and how that changes with x, y and
        theta times ``reach``: (..., R, 3, 3)."""
        turned = self._turned(pose[..., 2])
        there, one = pose + turned[..., :3, 0], torch.eye(3, 2, dtype=pose.dtype, device=pose.device)
        slope = torch.cat((one.expand(*pose.shape, 2), turned[..., 3:, :]), -1)
        if self.view is None:
            return there, slope
        seen, lens = self.view.predict(pose)
        return seen, torch.cat((lens @ slope[..., :2, :], slope[..., 2:, :]), -2)

    def bodies(self, patch: Tensor) -> Tensor:
        """Where each patch (..., R, 3) by itself says that its body is: (..., R, 3)."""
        patch = patch if self.view is None else self.view.lens.straight_pose(patch)
        return patch - self._turned(patch[..., 2] - self.place[:, 2])[..., :3, 0]

    def _turned(self, theta: Tensor) -> Tensor:
        """The places of patches in bodies turned by ``theta`` (..., R), and their slopes: (..., R, 6, 1)."""
        return self.turning @ torch.stack((theta.cos(), theta.sin(), torch.ones_like(theta)), -1)[..., None]

    def gather(self, values: Tensor) -> Tensor:
        """The sum over each body's patches of ``values`` (..., R, n): (..., G, n)."""
        return self.member @ values


class Response(NamedTuple):
    """By how much the pose that a rigid fit finds for R templates changes, in their axes, with what displaces nine of
    their ``points`` (R, 9, 2), x and y of one after the other: ``matrix`` (R, 3, 18). Between the points the
    displacement is a polynomial of second order in x and in y."""

    points: Tensor
    matrix: Tensor

    @staticmethod
    def of(reference: Reference) -> Response:
        """Of prepared templates, from their own texture: rows of K times the field along the slopes."""
        half = (reference.grid.box[:2, 2] - reference.grid.box[:2, 0]) / 2
        middle = (reference.grid.box[:2, 2] + reference.grid.box[:2, 0]) / 2
        basis = _biquadratic((reference.grid.pixels[:2] - middle[:, None]) / half[:, None])
        points = _nine().to(half) * half + middle - reference.place.centre[:, None]
        slopes = reference.signal[:, :2].transpose(1, 2)  # (R, N, 2)
        columns = basis.T[None, :, :, None] * slopes[:, :, None]  # (R, N, 9, 2)
        return Response(points, reference.K[:, :3] @ columns.flatten(2))

    @staticmethod
    def even(count: int, size: tuple[int, int]) -> Response:
        """Of ``count`` templates (h, w) with the same texture everywhere and in all directions."""
        h, w = size
        points = _nine().double() * torch.tensor(((w - 1) / 2, (h - 1) / 2)).double()
        y, x = (
            v.flatten() for v in torch.meshgrid(*(torch.linspace(-1, 1, n).double() for n in (h, w)), indexing="ij")
        )
        basis = _biquadratic(torch.stack((x, y)))  # (9, N)
        x, y, one, none = x * (w - 1) / 2, y * (h - 1) / 2, torch.ones_like(x), torch.zeros_like(x)
        moved = torch.stack((torch.stack((one, none, y)), torch.stack((none, one, -x))))  # (2, 3, N) by x, y, theta
        normal = torch.einsum("kin,kjn->ij", moved, moved)
        pulled = torch.einsum("kin,pn->ipk", moved, basis)
        return Response(points.expand(count, 9, 2), torch.linalg.solve(normal, pulled.flatten(1)).expand(count, 3, 18))


def _turning(place: Tensor, reach: Tensor) -> Tensor:
    """Of places (R, 3), with the ``reach`` (R,) of their bodies: what makes (cos, sin, 1) of a body's angle the place
    turned by it and the slope of that over reach, (R, 6, 3)."""
    (x, y, theta), none, far = place.unbind(1), torch.zeros_like(reach), 1 / reach
    rows = (x, y, none), (y, -x, none), (none, none, theta), (y * far, -x * far, none), (-x * far, -y * far, none)
    return torch.stack([torch.stack(row, 1) for row in (*rows, (none, none, far))], 1)


MIDDLE = 4  # of nine points


def _nine() -> Tensor:
    """Nine points (9, 2) of the square [-1, 1]^2, row by row."""
    side = torch.tensor([-1.0, 0.0, 1.0])
    return torch.cartesian_prod(side, side).flip(1)


def _biquadratic(points: Tensor) -> Tensor:
    """The nine polynomials (9, N) that are one at one of nine points and zero at the others, at ``points`` (2, N)."""
    x, y = (torch.stack((v * (v - 1) / 2, 1 - v * v, v * (v + 1) / 2)) for v in points)
    return (y[:, None] * x).flatten(0, 1)


def wrapped(difference: Tensor) -> Tensor:
    """Differences of poses (..., 3) less whole turns."""
    theta = difference[..., 2:]
    return torch.cat((difference[..., :2], theta - tau * torch.round(theta / tau)), -1)
