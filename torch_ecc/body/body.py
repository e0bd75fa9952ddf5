"""Rigid bodies of a tracker's patches: one pose for each, exact to where its patches are far apart."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_ecc.body.fusion import Fusion, fuse
from torch_ecc.body.layout import Layout, Response
from torch_ecc.core.ambient import plain, threads_for, unrecorded
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import compose, inverse, rotation
from torch_ecc.core.reference import MARGIN
from torch_ecc.core.verdict import unknown
from torch_ecc.records.lens import Lens
from torch_ecc.track.shutter import Motion
from torch_ecc.track.tracker import Tracker

PASSES = 2  # until it is known when the row of a body's reference point is exposed
USED = 0.5  # of its weight: a patch with less is not counted among those that agree


class BodyEstimate(NamedTuple):
    """Poses of G bodies of R patches in one frame; of F frames every field has F in front.

    ``pose`` (G, 3) px, px, rad of each body's reference point, the middle of its patches in the first frame;
    ``displacement`` (G, 3) since then; ``covariance`` (G, 3, 3) of the pose, larger where patches disagree more than
    theirs explain, infinite where no patch was found (the last pose is kept); ``chi2`` (G,) of the patches that are
    used, and its degrees of ``freedom`` (G,); ``used`` (R,) bool, which patches were found and agree; ``weight`` (R,)
    by how much they count, in [0, 1]; ``residual`` (R, 3) px, px, rad of each patch from where its body says that it
    is, NaN where it was not found; ``status`` (G,) int8, CONVERGED or LOST.
    """

    pose: Tensor
    displacement: Tensor
    covariance: Tensor
    chi2: Tensor
    freedom: Tensor
    used: Tensor
    weight: Tensor
    residual: Tensor
    status: Tensor

    @property
    def sigma(self) -> Tensor:
        """Standard deviations of the pose: (G, 3) px, px, rad."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()

    @property
    def ok(self) -> Tensor:
        """Which bodies have a new pose: (G,) bool."""
        return Status.good(self.status)

    def at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (G, 3) and their covariances (G, 3, 3) of other points of the bodies: (G, 2) or (2,) px, where they
        were in the first frame."""
        arm = points.to(self.pose) - (self.pose - self.displacement)[..., :2]
        arm = (rotation(self.displacement[..., 2]) @ arm[..., None])[..., 0]
        shift = _lever(arm)
        pose = torch.cat((self.pose[..., :2] + arm, self.pose[..., 2:]), -1)
        return pose, shift @ _finite(self.covariance) @ shift.mT + _infinite(self.covariance)

    def relative(self, one: int, other: int) -> tuple[Tensor, Tensor]:
        """Where body ``one`` would be if the ``other`` had not moved, (3,), and its covariance (3, 3): the drift of a
        microscope over a still frame taken out."""
        pose, start = self.pose, self.pose - self.displacement
        back = compose(start, inverse(pose))[..., other, :]  # of the frame, to where the other was
        seen = compose(back, pose[..., one, :])
        turn = torch.zeros_like(self.covariance[..., other, :, :])
        turn[..., :2, :2], turn[..., 2, 2] = rotation(back[..., 2]), 1.0
        shift = turn @ _lever((pose[..., one, :] - pose[..., other, :])[..., :2])
        both = turn @ self.covariance[..., one, :, :] @ turn.mT
        return seen, both + shift @ self.covariance[..., other, :, :] @ shift.mT


def _lever(arm: Tensor) -> Tensor:
    """How the pose of a point an ``arm`` (..., 2) px away changes with that of a body: (..., 3, 3)."""
    shift = torch.eye(3, dtype=arm.dtype, device=arm.device).repeat(*arm.shape[:-1], 1, 1)
    shift[..., 0, 2], shift[..., 1, 2] = arm[..., 1], -arm[..., 0]
    return shift


def _finite(covariance: Tensor) -> Tensor:
    return torch.where(covariance.isfinite(), covariance, 0.0)


def _infinite(covariance: Tensor) -> Tensor:
    return torch.where(covariance.isfinite(), 0.0, covariance)


class Body(nn.Module):
    """Rigid bodies of the patches of a ``tracker``: called with its estimates, one frame after the other.

    ``groups``: the numbers of the patches of each body, by default all are one; a patch may be in no group, and in one
    at most. Patches should not overlap: the same pixels would count twice. ``lens``: poses are those without its
    distortion, and residuals those in the frame as it is. Patches that are not CONVERGED are left out, as are those
    that disagree with most others (``BodyEstimate.used``); where a body has lost a patch, it tells the tracker where to
    look for it in the next frame. Called with a whole Track, bodies of all its frames come at once, and the tracker is
    told nothing. Under a rolling shutter (``line_time``) a pose is of the instant at which the row of the body's
    reference point is exposed, to which patches on other rows are taken by their own motion. ValueError for what does
    not fit.
    """

    before: Tensor

    def __init__(
        self, tracker: Tracker, groups: Sequence[Sequence[int]] | None = None, lens: Lens | None = None
    ) -> None:
        super().__init__()
        if not isinstance(tracker, Tracker):
            raise ValueError(f"Body: tracker must be a Tracker, got {type(tracker).__name__}")
        if not isinstance(lens, Lens | None):
            raise ValueError(f"Body: lens must be a Lens, got {type(lens).__name__}")
        start = tracker.start
        groups = [range(len(start))] if groups is None else groups
        _check_groups(groups, len(start))
        _warn_of_overlap(groups, start, [n - 2 * MARGIN for n in tracker.template.shape[2:]])
        self.tracker, self.lens, self.layout = tracker, lens, layout_of(tracker, groups, lens)
        self.register_buffer("before", self.layout.start.clone())  # the last good poses, (G, 3)
        self.register_buffer("found", self.layout.start.new_ones(len(groups), dtype=torch.int8))  # in the last frame
        self.register_buffer("apart", start.new_zeros(len(start), dtype=torch.int64))  # frames in a row, of patches

    @plain
    @torch.no_grad()
    @unrecorded
    def forward(self, estimate: Estimate) -> BodyEstimate:
        """Bodies in a frame, (R, ...) -> (G, ...), or in the F frames of a track. ValueError for other patches."""
        if not isinstance(estimate, Estimate):
            raise ValueError(f"Body: estimate must be an Estimate or a Track, got {type(estimate).__name__}")
        layout = self._layout(estimate.pose.device)
        if estimate.pose.shape[-2:] != layout.place.shape:
            raise ValueError(f"Body: estimate must be of {len(layout.place)} patches, got {tuple(estimate.pose.shape)}")
        with threads_for(estimate.covariance.numel()):
            return self._forward(estimate, layout)

    def _forward(self, estimate: Estimate, layout: Layout) -> BodyEstimate:
        shutter, motion, good = self.tracker.shutter, None, estimate.status == Status.CONVERGED
        if estimate.pose.dim() == 3:
            motion = shutter.throughout(estimate) if shutter.line else None
            found = self._fused(estimate, motion, layout)
            return record(found, carried(found, layout.start), good, layout)
        if shutter.line:
            motion = Motion(*(v[None] for v in shutter.newest(self.tracker._buffers)))
        found = self._fused(Estimate(*(v[None] for v in estimate)), motion, layout)
        found = Fusion(*(v[0] for v in found))
        body = record(found, torch.where((found.freedom >= 0)[:, None], found.pose, self.before), good, layout)
        self._guide(estimate, body, layout)
        return body

    def _fused(self, estimate: Estimate, motion: Motion | None, layout: Layout) -> Fusion:
        """The bodies of F frames, (F, R, ...). With a ``motion`` (F, R, 3) the rows of patches are exposed one after
        the other: all are brought to the instant of the row of their body's reference point."""
        pose, covariance, good = estimate.pose, estimate.covariance, estimate.status == Status.CONVERGED
        found = fuse(pose, covariance, good, layout)
        if motion is None:
            return found
        for _ in range(PASSES):
            seen = found.pose[..., :2] if self.lens is None else self.lens.distort(found.pose[..., :2])
            later = self.tracker.shutter.line * (seen[..., layout.body, 1] - pose[..., 1])
            there, spread = motion.at(pose, covariance, later)
            found = fuse(there, spread, good, layout)
        return found

    def _layout(self, device: torch.device) -> Layout:
        if self.layout.place.device != device:
            self.layout = self.layout.to(device)
        return self.layout

    def _guide(self, estimate: Estimate, body: BodyEstimate, layout: Layout) -> None:
        """Tells the tracker where patches are that were not found, or that disagree: these ever more seldom."""
        state: Any = self._buffers
        if bool(body.used.all()):
            state["apart"].zero_()
        else:
            self._mend(estimate, body, layout, state)
        state["found"].copy_(body.ok)
        state["before"].copy_(body.pose)

    def _mend(self, estimate: Estimate, body: BodyEstimate, layout: Layout, state: Any) -> None:
        known = body.status[layout.body] == Status.CONVERGED
        mine = known & layout.taken
        lost = mine & (estimate.status != Status.CONVERGED)
        apart = state["apart"]
        apart.copy_(torch.where(mine & ~lost & ~body.used, apart + 1, 0))
        moved = lost | ((apart > 0) & ((apart & (apart - 1)) == 0))
        if bool(moved.any()):
            there, _ = layout.predict(body.pose[layout.body])
            before, _ = layout.predict(state["before"][layout.body])
            step = torch.where((known & (state["found"][layout.body] > 0))[:, None], there - before, 0.0)
            self.tracker.expect(there, step, moved)


def layout_of(tracker: Tracker, groups: Sequence[Sequence[int]], lens: Lens | None) -> Layout:
    """Where a tracker's patches are, behind a lens if there is one. ValueError for patches beyond its range."""
    if lens is None:
        return Layout.of(tracker.start, groups)
    return Layout.behind(lens, tracker.start, groups, Response.of(tracker.references[0]))


def carried(found: Fusion, start: Tensor) -> Tensor:
    """Poses (F, G, 3) of bodies in the frames of a track, where nothing was found those of the frame before, and
    ``start`` (G, 3) before the first one."""
    ok = found.freedom >= 0
    number = torch.where(ok, torch.arange(len(ok), device=ok.device)[:, None], -1).cummax(0).values
    kept = found.pose.gather(0, number.clamp(min=0)[..., None].expand_as(found.pose))
    return torch.where((number >= 0)[..., None], kept, start)


def record(found: Fusion, pose: Tensor, good: Tensor, layout: Layout) -> BodyEstimate:
    """The record of what was ``found`` in a frame, or in F, with poses (..., G, 3) and ``good`` (..., R) patches."""
    ok = found.freedom >= 0
    covariance = torch.where(ok[..., None, None], found.covariance, unknown(found.covariance))
    residual = torch.where((good & layout.taken)[..., None], found.residual, torch.nan)
    status = torch.where(ok, int(Status.CONVERGED), int(Status.LOST)).to(torch.int8)
    used = found.weight >= USED
    moved = pose - layout.start
    return BodyEstimate(pose, moved, covariance, found.chi2, found.freedom, used, found.weight, residual, status)


def _warn_of_overlap(groups: Sequence[Sequence[int]], start: Tensor, size: Sequence[int]) -> None:
    for g, group in enumerate(groups):
        at = start[list(group), :2]
        apart = (at[:, None] - at).abs() >= at.new_tensor((size[1], size[0]))
        shared = (~apart.any(2)).sum() - len(group)
        if int(shared) > 0:
            words = "share pixels, whose noise then counts twice: sigma tells too little"
            warnings.warn(f"Body: {int(shared) // 2} pairs of patches of group {g} {words}", stacklevel=3)


def _check_groups(groups: Sequence[Sequence[int]], count: int) -> None:
    """ValueError for groups of no patch, of patches that there are not, or that share one."""
    seen: dict[int, int] = {}
    if not hasattr(groups, "__len__") or not all(hasattr(group, "__len__") for group in groups):
        raise ValueError(f"Body: groups must be one list of patch numbers per body, got {groups!r}")
    if len(groups) == 0:
        raise ValueError("Body: groups must be one list of patch numbers per body, got none")
    for g, group in enumerate(groups):
        if len(group) == 0:
            raise ValueError(f"Body: group {g} must hold at least one patch, got none")
        for r in group:
            if not isinstance(r, int) or not 0 <= r < count:
                raise ValueError(f"Body: group {g} must hold numbers of patches from 0 to {count - 1}, got {r!r}")
            if r in seen:
                raise ValueError(f"Body: patch {r} must be in one group, got it in {seen[r]} and {g}")
            seen[r] = g
