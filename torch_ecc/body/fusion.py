"""Poses and covariances of many patches to one pose per rigid body: generalised least squares with their lever arms.

With the pose p of the body, patch r is expected at f_r(p); it was found at z_r with covariance C_r. What is made least
is the sum of w_r e_r^T C_r^-1 e_r with e_r = z_r - f_r(p): x, y and theta of every patch count, each as much as it
knows. As long as no patch disagrees, all w_r are one. Else a consensus is the start, which less than half of the
patches cannot break however well they agree with each other: of the poses that single patches give for the whole body,
each made better by what agrees with it, that which leaves the least median. From there the weights fall with the
Mahalanobis distance, to zero.

What sigma means: the covariance of a patch tells the noise of the frame and that of its template, about half each. The
template's is drawn once and common to all frames. So sigma is that of the pose since the first frame; poses of a track
scatter among themselves by less, by the frame's part, and the mean of many frames is no better than the template's. The
same holds for chi-square: patches disagree in every frame in the same way, as far as it is their templates' noise.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.body.layout import Layout, wrapped
from torch_ecc.core.pose import unwrap

AGREES, DISAGREES = 12.0, 25.0  # squared Mahalanobis distances: of three components chance passes 12 in 0.7 %
USUAL_MEDIAN = 2.366  # of chi-square with three degrees of freedom
STRANGE = 4.0  # standard deviations of chi-square: of so much, some patches must disagree
INFLATED = 3.0  # standard deviations of chi-square beyond which the covariance tells of it
MANY = 6  # patches that tell more than chi-square of how they scatter
HYPOTHESES = 24  # patches whose own word is tried for the body
STEPS, ROUNDS = 2, 4  # of Gauss-Newton; of weights
AT_ONCE = 64  # bodies for which a consensus is sought together


class Patches(NamedTuple):
    """What was found of R patches in N frames: ``pose`` (N, R, 3), ``precision`` (N, R, 3, 3), the inverse of its
    covariance, and by how much each is believed, ``weight`` (N, R), zero for those that were not found."""

    pose: Tensor
    precision: Tensor
    weight: Tensor

    @staticmethod
    def of(pose: Tensor, covariance: Tensor, good: Tensor) -> Patches:
        """Of poses (N, R, 3) with covariances (N, R, 3, 3), those that are ``good`` (N, R) bool."""
        known = good & (covariance.sum((-1, -2)) + pose.sum(-1)).isfinite()
        one = torch.eye(3, dtype=pose.dtype, device=pose.device)
        precision, info = torch.linalg.inv_ex(torch.where(known[..., None, None], covariance, one))
        known = known & (info == 0) & (precision.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
        return Patches(torch.where(known[..., None], pose, 0.0), precision, known.to(pose.dtype))

    def counting(self, layout: Layout) -> Counting:
        """What makes their normal equations."""
        nothing = layout.gather(self.weight[..., None]) <= 0
        one = torch.eye(3, dtype=self.pose.dtype, device=self.pose.device)
        return Counting(self.precision * self.weight[..., None, None], nothing[..., None] * one)

    def falling(self, distance: Tensor, scale: Tensor | float = 1.0) -> Patches:
        """These, believed the less the larger the squared ``distance`` (..., R) over its ``scale`` (..., 1)."""
        share = ((DISAGREES - distance / scale) / (DISAGREES - AGREES)).clamp(0, 1).square()
        return self._replace(weight=self.weight * share)


class Counting(NamedTuple):
    """Of R patches of G bodies the ``precision`` (..., R, 3, 3) times the weight, and ``unseen`` (..., G, 3, 3), what
    the normal matrix of a body has of which nothing is seen, so that it stays where it is: one, of others zero."""

    precision: Tensor
    unseen: Tensor


class Fusion(NamedTuple):
    """Of G bodies in N frames: ``pose`` (N, G, 3), its ``covariance`` (N, G, 3, 3), ``chi2`` and its degrees of
    ``freedom`` (N, G); of their R patches the ``weight`` (N, R), what is left, ``residual`` (N, R, 3), and its squared
    Mahalanobis ``distance`` (N, R). A body without patches has freedom below zero, and nothing of it means anything."""

    pose: Tensor
    covariance: Tensor
    chi2: Tensor
    freedom: Tensor
    weight: Tensor
    residual: Tensor
    distance: Tensor


def fuse(pose: Tensor, covariance: Tensor, good: Tensor, layout: Layout) -> Fusion:
    """The bodies of a ``layout`` from its patches in N frames: (N, R, 3), (N, R, 3, 3), (N, R) bool -> ``Fusion``.

    On any device; patches that are not good, or in no body, count nothing.
    """
    patches = Patches.of(pose, covariance, good & layout.taken)
    start = middle(layout.bodies(patches.pose), patches.weight, layout)
    found = fitted(patches, layout, start, STEPS)
    if bool((found.distance * found.weight > AGREES).any()):
        found = fitted(patches.falling(found.distance), layout, found.pose, 1)
    doubtful = strange(found, patches.weight, layout)
    if bool(doubtful.any()):
        weight = found.weight.clone()
        for g in doubtful.any(0).nonzero()[:, 0].tolist():
            members = layout.member[g].nonzero()[:, 0]
            own, frames = layout.select(members), doubtful[:, g].nonzero()[:, 0]
            for some in frames.split(AT_ONCE):
                at = some[:, None], members
                weight[at], found.pose[some, g] = consensus(Patches(*(v[at] for v in patches)), own)
        found = fitted(patches._replace(weight=weight), layout, found.pose, 1)
    theta = unwrap(found.pose[..., 2], start[..., 2])
    return found._replace(pose=torch.cat((found.pose[..., :2], theta[..., None]), -1))


def middle(bodies: Tensor, weight: Tensor, layout: Layout) -> Tensor:
    """The median (N, G, 3) of what believed patches say of their bodies (N, R, 3); zero where there is none."""
    told = (layout.member[:, :] > 0) & (weight > 0)[:, None]
    return torch.where(told[..., None], bodies[:, None], torch.nan).nanmedian(2).values.nan_to_num(0.0)


def fitted(patches: Patches, layout: Layout, pose: Tensor, steps: int) -> Fusion:
    """Least squares with the patches' weights, from ``pose`` (N, G, 3) on."""
    units, counting = layout.units, patches.counting(layout)
    for _ in range(steps):
        there, slope = layout.predict(pose[..., layout.body, :])
        step, normal = _step(wrapped(patches.pose - there), slope, counting, layout)
        pose = pose + step / units
    there, _ = layout.predict(pose[..., layout.body, :])
    residual = wrapped(patches.pose - there)
    distance = ((patches.precision @ residual[..., None])[..., 0] * residual).sum(-1)
    chi2, count = layout.gather(torch.stack((patches.weight * distance, patches.weight), -1)).unbind(-1)
    freedom = 3 * count - 3
    inverse = torch.linalg.inv_ex(normal)[0]
    scale = units[:, :, None] * units[:, None]
    covariance = inverse / scale
    excess = chi2 > _beyond(freedom, INFLATED)
    if bool(excess.any()):
        pulled = (slope.mT @ (counting.precision @ residual[..., None]))[..., 0]
        meat = layout.gather((pulled[..., :, None] * pulled[..., None, :]).flatten(-2)).unflatten(-1, (3, 3))
        spread = _spread(normal, inverse @ meat @ inverse, chi2, freedom)
        covariance = torch.where(excess[..., None, None], spread / scale, covariance)
    return Fusion(pose, covariance, chi2, freedom, patches.weight, residual, distance)


def _spread(normal: Tensor, sandwich: Tensor, chi2: Tensor, freedom: Tensor) -> Tensor:
    """Covariance (..., 3, 3) where patches disagree by more than their own ones tell: how much they pull on the body,
    each for itself (cluster-robust), but on average not less than chi-square tells; of few patches that one alone."""
    patches, ratio = freedom / 3 + 1, chi2 / freedom.clamp(min=1e-30)
    sandwich = sandwich * (patches / (patches - 1).clamp(min=1e-30))[..., None, None]
    mean = (normal @ sandwich).diagonal(dim1=-2, dim2=-1).mean(-1)
    sandwich = sandwich * (ratio / mean.clamp(min=1e-30)).clamp(min=1.0)[..., None, None]
    plain = torch.linalg.inv_ex(normal)[0] * ratio[..., None, None]
    return torch.where((patches >= MANY)[..., None, None], sandwich, plain)


def _step(residual: Tensor, slope: Tensor, counting: Counting, layout: Layout) -> tuple[Tensor, Tensor]:
    """A Gauss-Newton step (..., G, 3) in the units of ``slope``, and the normal matrix (..., G, 3, 3)."""
    pulls = slope.mT @ (counting.precision @ torch.cat((slope, residual[..., None]), -1))
    total = layout.gather(pulls.flatten(-2)).unflatten(-1, (3, 4))
    normal = total[..., :3] + counting.unseen
    return torch.linalg.solve_ex(normal, total[..., 3:])[0][..., 0], normal


def _beyond(freedom: Tensor, sigmas: float) -> Tensor:
    """A chi-square so many standard deviations above what is expected, infinite without a degree of freedom."""
    return torch.where(freedom > 0, freedom + sigmas * (2 * freedom.clamp(min=0)).sqrt(), torch.inf)


def strange(found: Fusion, believed: Tensor, layout: Layout) -> Tensor:
    """Bodies (N, G) of which some patch that was ``believed`` (N, R) disagrees, or too many a little."""
    far = (found.distance > DISAGREES) & (believed > 0)
    some = layout.gather(far.to(believed.dtype)[..., None])[..., 0] > 0
    return (some | (found.chi2 > _beyond(found.freedom, STRANGE))) & (layout.gather(believed[..., None])[..., 0] > 1)


def consensus(patches: Patches, layout: Layout) -> tuple[Tensor, Tensor]:
    """Weights (E, n) of n patches of one body in E frames by what most of them say, and the pose (E, 3) of that."""
    usable, n = patches.weight > 0, patches.weight.shape[1]
    tried = torch.argsort(usable.to(torch.int8), dim=1, descending=True, stable=True)
    count = usable.sum(1, keepdim=True).clamp(min=1)
    spread = torch.arange(min(n, HYPOTHESES), device=tried.device) * count // min(n, HYPOTHESES)
    tried = tried.gather(1, spread.clamp(max=n - 1))  # evenly spread over those that were found
    pose = layout.bodies(patches.pose).gather(1, tried[..., None].expand(-1, -1, 3))[..., None, :]  # (E, H, 1, 3)
    each = Patches(*(v[:, None] for v in patches))  # (E, 1, n, ...)
    own = patches.precision.gather(1, tried[..., None, None].expand(-1, -1, 3, 3))[:, :, None]
    agreeing = _agreeing(each, layout, pose, own, tried)
    for _ in range(STEPS):
        pose, distance = _refit(agreeing, layout, pose)
        median = _quantile(distance, usable[:, None])
        agreeing = each.falling(distance, _scale(median, n))
    pick = torch.arange(len(pose), device=pose.device), median.argmin(1)
    pose, agreeing = pose[pick][:, None], agreeing._replace(weight=agreeing.weight[pick][:, None])
    for _ in range(ROUNDS):
        pose, distance = _refit(agreeing, layout, pose)
        median = _quantile(distance, agreeing.weight > 0)  # of the consensus: others do not widen it
        agreeing = each.falling(distance, _scale(median, n))
    return agreeing.weight[:, 0], pose[:, 0, 0]


def _agreeing(each: Patches, layout: Layout, pose: Tensor, own: Tensor, tried: Tensor) -> Patches:
    """The patches as far as they agree with poses (E, H, 1, 3) of the body that some of them, the ``tried`` (E, H) with
    precisions ``own`` (E, H, 1, 3, 3), give by themselves: the angle of one says little of what is far away."""
    there, slope = layout.predict(pose.expand(*pose.shape[:2], each.weight.shape[-1], 3))
    at = slope.gather(2, tried[..., None, None, None].expand(-1, -1, 1, 3, 3))
    spread = slope @ torch.linalg.inv_ex(at.mT @ own @ at)[0] @ slope.mT
    covariance = torch.linalg.inv_ex(each.precision)[0] + spread
    residual = wrapped(each.pose - there)[..., None]
    distance = (residual.mT @ torch.linalg.inv_ex(covariance)[0] @ residual)[..., 0, 0]
    return each.falling(distance, _scale(_quantile(distance, each.weight > 0), each.weight.shape[-1]))


def _refit(patches: Patches, layout: Layout, pose: Tensor) -> tuple[Tensor, Tensor]:
    """A step of ``pose`` (..., 1, 3), and the squared distances (..., n) of the patches from there."""
    there, slope = layout.predict(pose.expand(*pose.shape[:-2], patches.weight.shape[-1], 3))
    step, _ = _step(wrapped(patches.pose - there), slope, patches.counting(layout), layout)
    pose = pose + step / layout.units
    there, _ = layout.predict(pose.expand_as(there))
    residual = wrapped(patches.pose - there)[..., None]
    return pose, (residual.mT @ patches.precision @ residual)[..., 0, 0]


def _quantile(distance: Tensor, usable: Tensor) -> Tensor:
    """What more than half of the usable ones (..., n) stay below: (...)."""
    ordered = torch.where(usable, distance, torch.inf).sort(-1).values
    half = (usable.sum(-1, keepdim=True) // 2).expand(*ordered.shape[:-1], 1)
    return ordered.gather(-1, half.clamp(max=ordered.shape[-1] - 1))[..., 0]


def _scale(median: Tensor, count: int) -> Tensor:
    """By how much squared distances are larger than they should be, (..., 1), at least one: what covariances do not
    know of. Of a few patches that were picked to agree, the median is too small (Rousseeuw and Leroy, 1987)."""
    return 1 + (1 + 5 / count) ** 2 * (median / USUAL_MEDIAN - 1).clamp(min=0.0)[..., None]
