"""Which patches move together: rigid motions over all frames, not over the last one.

The motion of the frame that a patch says by itself explains, or does not, where another patch is in every frame. The
motion that explains most is refitted to what it explains, which is a body; then the next one is sought among the rest.
In the end all bodies compete for all patches. What stands still needs no hypothesis, and is a body beside the others.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.body.fusion import fuse
from torch_ecc.body.layout import Layout, wrapped
from torch_ecc.core.ambient import plain, threads_for
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import compose, inverse, transform

MOST = 30  # frames, evenly spread, that are compared
FEWEST_FRAMES = 3  # in which a patch was found
FEWEST = 2  # patches of a body
SLACK = (0.05, 0.004)  # px, rad: errors of real patches that their covariances do not know, as of light and edges,
RELATIVE = 0.03  # and share of the way that patches have gone: lenses, and heights, show some of them larger
EXPLAINED = 8.0  # mean of squared distances, two components of which would be chance
FARTHEST = 60.0  # squared distances count so much at most: a frame that went wrong is no other body
UNKNOWN = 12.0  # what a patch counts that nothing explains so far
ROUNDS = 6
HYPOTHESES, AT_ONCE = 160, 16  # patches whose own motion is tried for a body
REFITTED = 12  # of these motions at most


class Groups(NamedTuple):
    """``groups``: the numbers of the patches of each body, the largest one first, and what stands ``still`` last if
    there is anything: a list each, as ``Body`` takes them; ``misfit`` (R,): the mean squared distance of each patch
    from its body's motion, infinite for those of none."""

    groups: list[list[int]]
    still: bool
    misfit: Tensor


class _Seen(NamedTuple):
    """R patches in F frames: poses (F, R, 3), covariances with slack, variances of a place and of an angle (F, R);
    where they were found (F, R); their start (R, 3)."""

    pose: Tensor
    covariance: Tensor
    place: Tensor
    angle: Tensor
    good: Tensor
    start: Tensor


class _Motion(NamedTuple):
    """Motions of the frame, (F, H, 3), with the variances of their place and angle (F, H) at a point (F, H, 2), known
    in some frames (F, H)."""

    pose: Tensor
    place: Tensor
    angle: Tensor
    at: Tensor
    known: Tensor


@plain
@torch.no_grad()
def rigid_groups(track: Estimate, bodies: int) -> Groups:
    """The patches of a Track (F, R, ...) grouped into so many ``bodies`` that move, or fewer if there are no more, and
    one more that stands still if there is anything. Patches that go with none, as across an edge, are in no group.

    ValueError for what is no track, and if no two patches move together.
    """
    if track.pose.dim() != 3:
        raise ValueError(f"rigid_groups: track must be (F, R, ...), got {tuple(track.pose.shape)}")
    if not isinstance(bodies, int) or isinstance(bodies, bool) or bodies < 1:
        raise ValueError(f"rigid_groups: bodies must be a whole number of at least 1, got {bodies!r}")
    with threads_for(1):  # thousands of operations, none of which is long
        found = _grouped(_sampled(track), bodies)
    if not found.groups:
        raise ValueError("rigid_groups: no two patches move together")
    return found


def _grouped(seen: _Seen, bodies: int) -> Groups:
    """Of all that is ``seen``: body after body, then all at once."""
    usable, standing, found = seen.good.sum(0) >= FEWEST_FRAMES, _still(seen), list[Tensor]()
    known = _misfit(seen, standing)[0][0].clamp(max=FARTHEST)  # by what there is so far
    still = int(((known < EXPLAINED) & usable).sum()) >= FEWEST
    known = known if still else torch.full_like(known, FARTHEST)
    while len(found) < bodies:
        members = _next(seen, usable & (known >= EXPLAINED), known)
        if members is None:
            break
        found.append(members)
        known = torch.minimum(known, torch.where(members, 0.0, FARTHEST))
    return _competing(seen, found, standing if still else None)


def _sampled(track: Estimate) -> _Seen:
    some = torch.linspace(0, len(track.pose) - 1, min(MOST, len(track.pose))).round().long().to(track.pose.device)
    pose, covariance, status = track.pose[some], track.covariance[some], track.status[some]
    good = (status == Status.CONVERGED) & covariance.isfinite().flatten(2).all(2)
    start = (track.pose - track.displacement).nanmedian(0).values  # the same in all frames in which it is told
    pose = torch.where(good[..., None], pose, start)
    covariance = torch.where(good[..., None, None], covariance, 0.0)
    moved = RELATIVE * (pose - start)
    way = torch.linalg.vector_norm(moved[..., :2], dim=-1)
    slack = torch.stack((way, way, moved[..., 2]), -1).square() + pose.new_tensor((*SLACK[:1], *SLACK)).square()
    covariance = covariance + torch.diag_embed(slack)
    place = covariance[..., 0, 0] + covariance[..., 1, 1]
    return _Seen(pose, covariance, place / 2, covariance[..., 2, 2], good, start)


def _still(seen: _Seen) -> _Motion:
    none = torch.zeros_like(seen.place[:, :1])
    pose = torch.zeros_like(seen.pose[:, :1])
    return _Motion(pose, none, none, pose[..., :2], torch.ones_like(seen.good[:, :1]))


def _of_patches(seen: _Seen, index: Tensor) -> _Motion:
    """What patches (H,) say by themselves."""
    pose = compose(seen.pose[:, index], inverse(seen.start[index]).expand_as(seen.pose[:, index]))
    return _Motion(pose, seen.place[:, index], seen.angle[:, index], seen.pose[:, index, :2], seen.good[:, index])


def _of_members(seen: _Seen, members: Tensor) -> _Motion:
    """That of a body of the patches where ``members`` (R,)."""
    layout = Layout.of(seen.start, [members.nonzero()[:, 0].tolist()])
    found = fuse(seen.pose, seen.covariance, seen.good & members, layout)
    known = found.freedom >= 0
    spread = torch.where(known[..., None, None], found.covariance, 1.0)
    pose = compose(found.pose, inverse(layout.start).expand_as(found.pose))
    place = (spread[..., 0, 0] + spread[..., 1, 1]) / 2
    return _Motion(pose, place, spread[..., 2, 2], found.pose[..., :2], known)


def _misfit(seen: _Seen, motion: _Motion) -> tuple[Tensor, Tensor]:
    """How badly motions explain patches: the mean squared distance (H, R) over the frames in which both are known,
    infinite where these are few; and how vague they are, (H, R): the logarithm of the variance with which they expect
    a patch, over that of the patch. The sum is what the likelihood loses."""
    there = torch.cat(
        (
            transform(motion.pose, seen.start[:, :2]),
            (motion.pose[..., 2:] + seen.start[:, 2])[..., None],
        ),
        -1,
    )  # (F, H, R, 3)
    off = wrapped(seen.pose[:, None] - there)
    arm = (there[..., :2] - motion.at[:, :, None]).square().sum(-1)
    place, angle = seen.place[:, None], seen.angle[:, None]
    wide = place + motion.place[..., None] + arm * motion.angle[..., None]
    turned = angle + motion.angle[..., None]
    distance = off[..., :2].square().sum(-1) / wide + off[..., 2].square() / turned
    vague = 2 * (wide / place).log() + (turned / angle).log()
    both = (seen.good[:, None] & motion.known[..., None]).to(distance.dtype)
    count = both.sum(0)
    misfit, vague = ((v * both).sum(0) / count.clamp(min=1) for v in (distance.clamp(max=FARTHEST), vague))
    return torch.where(count >= FEWEST_FRAMES, misfit, torch.inf), vague


def _next(seen: _Seen, free: Tensor, known: Tensor) -> Tensor | None:
    """Of the ``free`` patches (R,) those of a body (R,) bool, None if there is none: as single patches lead to it that
    expect the others sharply, or vaguely, as where they are far apart; what is sharper in the end."""
    sharp, best, most = known.clamp(max=UNKNOWN), None, 0.0
    for counted in (sharp, known):
        members = _largest(seen, free, counted)
        if members is not None:
            gain = float(_gained(*_misfit(seen, _of_members(seen, members)), members, sharp)[0])
            best, most = (members, gain) if gain > most else (best, most)
    return best


def _largest(seen: _Seen, free: Tensor, known: Tensor) -> Tensor | None:
    """The ``free`` patches (R,) that one motion explains, (R,) bool: the one by which most is explained better than it
    is ``known`` (R,); None if there are no two.

    A patch whose angle is uncertain explains nearly all that is far from it, until those tell their common motion
    themselves. So motions are compared after they are refitted, in the order of what they promised, as long as one
    promises more than the best has kept.
    """
    patches = free.nonzero()[:, 0]
    spread = torch.linspace(0, len(patches) - 1, min(HYPOTHESES, len(patches)), device=patches.device).round().long()
    promise, explained, best, most = torch.zeros_like(known), torch.zeros_like(free), None, 0.0
    for some in patches[spread].split(AT_ONCE) if len(patches) else ():
        promise[some] = _gained(*_misfit(seen, _of_patches(seen, some)), free, known)[0]
    tried = 0
    for promised, r in zip(*(v.tolist() for v in promise.sort(descending=True)), strict=True):
        if promised <= most or tried == REFITTED:
            break
        if not explained[r]:  # by a motion that was refitted, so that its own is the same
            tried += 1
            gain, members = _refitted(seen, _of_patches(seen, patches.new_tensor([r])), free, known)
            explained |= members
            best, most = (members, gain) if gain > most else (best, most)
    return best


def _gained(misfit: Tensor, vague: Tensor, free: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """What motions (H,) explain better than it is ``known`` in all, and which patches, (H, R); nothing of less than
    two."""
    explained = (misfit < EXPLAINED) & (misfit + vague < known) & free
    value = ((known - misfit - vague).clamp(min=0) * explained).sum(1)
    return torch.where(explained.sum(1) >= FEWEST, value, 0.0), explained


def _refitted(seen: _Seen, motion: _Motion, free: Tensor, known: Tensor) -> tuple[float, Tensor]:
    """From a ``motion`` that of what it explains, until that is the same: its gain, and which (R,)."""
    gain, members = _gained(*_misfit(seen, motion), free, known)
    for _ in range(ROUNDS):
        if not float(gain):
            break
        last = members
        gain, members = _gained(*_misfit(seen, _of_members(seen, last[0])), free, known)
        if bool((members == last).all()):
            break
    return float(gain), members[0]


def _competing(seen: _Seen, found: list[Tensor], standing: _Motion | None) -> Groups:
    """All bodies compete for all patches, and each is what it has got, until nothing changes."""
    usable, last, misfit = seen.good.sum(0) >= FEWEST_FRAMES, None, torch.full_like(seen.place[0], torch.inf)
    owner = torch.full_like(usable, -1, dtype=torch.long)
    for _ in range(ROUNDS):
        motions = [_of_members(seen, members) for members in found] + ([] if standing is None else [standing])
        if not motions:
            break
        each, vague = (torch.cat(part) for part in zip(*(_misfit(seen, motion) for motion in motions), strict=True))
        misfit, owner = each.masked_fill(each + vague >= UNKNOWN, torch.inf).min(0)
        owner = torch.where((misfit < EXPLAINED) & usable, owner, -1)
        if last is not None and bool((owner == last).all()):
            break
        last = owner
        found = [owner == k for k in range(len(found)) if int((owner == k).sum()) >= FEWEST]
    groups = sorted((members.nonzero()[:, 0].tolist() for members in found), key=len, reverse=True)
    rest = [] if standing is None else (owner == len(motions) - 1).nonzero()[:, 0].tolist()
    inside = torch.where(owner >= 0, misfit, torch.inf)
    return Groups([*groups, rest] if rest else groups, bool(rest), inside)
