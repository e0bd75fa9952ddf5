"""Poses with gradients, by the implicit function theorem, whatever engine has found them.

A pose p solves u(p; I, T) = 0, with u the increment that the criterion asks for. Of ECC u = K_b g / K_a g, so that

    K_b g = 0,        g the patch of the image I sampled at p, K made of the template T and the pixels' weights.

What p does when I and T change follows from that condition alone, not from the iterations that have led to it:

    dp = -A^-1 (U dg + du/dT dT),        A = U dg/dp,        U = du/dg,  of ECC K_b / K_a g,

with dg what a change of I brings to the patch at p, and dg/dp the slopes of the sampled image at the patch's pixels,
along x, along y and around the centre. Where the patch is its template but for gain a and offset, A is a turn by -theta
and dp = -turn(theta) K_b dg / a. Where it is not (noise, a cover, light that no column tells) the condition's slope is
that of the image, not of the template: A has it as it is, which is what makes the derivative exact.

Held fixed: by how much pixels count, in sight or not and as far as their blocks are trusted, so that of a robust solve
the gradient is that of the weighted one at its last weights; and the noise that a template is taken to have, a median.
The start has no share in a pose that was found.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.pose import turn
from torch_ecc.core.reference import Reference, each, reweigh
from torch_ecc.core.sampling import inside, is_cpu, make_sampler
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, counted_pixels, summed


def wanted(reference: Reference, image: Tensor, start: Tensor) -> bool:
    """Whether anybody asks for the gradients of poses."""
    some = reference.K.requires_grad or image.requires_grad or start.requires_grad
    return some and torch.is_grad_enabled()


def attached(reference: Reference, image: Tensor, start: Tensor, found: Solution, settings: Settings) -> Solution:
    """What an engine has ``found`` of B templates in (B or 1, 1, H, W) from ``start`` (B, 3) on, its numbers as they
    are, with the gradients that they have at that place. Those of templates without a solution are 0."""
    warp, pixels = reference.warps(found.pose), reference.grid.pixels
    visible, trusted = in_sight(reference, warp, image), believed(reference, found)
    counted = counted_pixels(reference, visible, trusted)
    seen = reference if counted is None else reweigh(reference, counted)
    sample = make_sampler(settings.interpolation, image.to(seen.K.dtype), warp, reference.grid.box)
    g, slopes = sample(warp, pixels), along_pose(sample.slopes(warp, pixels), warp, found.pose, pixels)
    inverse, solved = inverse_slope(seen, g, slopes, turn(found.pose[:, 2]))
    g = only(solved, g, g.detach())
    if seen.K.requires_grad:
        seen = each(lambda v: only(solved, v, v.detach()), seen._replace(coarse=None))
    pose = root(found.pose, start, seen.criterion.step(seen, g).to(found.pose.dtype), inverse)
    moved = (pose - pose.detach()).to(g.dtype)  # 0, with a gradient
    g = torch.baddbmm(g.unsqueeze(1), moved.unsqueeze(1), slopes).squeeze(1)
    weight = reference.weight if visible is None else reference.weight * visible
    sums = summed(seen, g, weight, trusted)
    look = Solution(pose, found.error, found.iterations, *sums, seen.normal, found.trust, found.odd)
    return each(lambda value, slope: value if slope is value else carried(value, slope), found, look)


class _Root(torch.autograd.Function):
    """The ``pose`` (B, 3) at which the ``increment`` (B, 3) is 0, given the inverse (B, 3, 3) of its slope there."""

    @staticmethod
    def forward(ctx: FunctionCtx, pose: Tensor, start: Tensor, increment: Tensor, inverse: Tensor) -> Tensor:
        ctx.save_for_backward(inverse)
        return pose.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (inverse,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return None, torch.zeros_like(gradient), -(inverse.mT @ gradient.unsqueeze(2)).squeeze(2), None


class _Carried(torch.autograd.Function):
    """A ``value`` as it is, with the gradient of another one of its shape."""

    @staticmethod
    def forward(ctx: FunctionCtx, value: Tensor, other: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[None, Tensor]:
        return None, gradient


root: Callable[..., Tensor] = _Root.apply
carried: Callable[[Tensor, Tensor], Tensor] = _Carried.apply


def in_sight(reference: Reference, warp: Tensor, image: Tensor) -> Tensor | None:
    """Which pixels (B, N) the ``warp`` (B, 2, 3) puts inside the image; None if the host knows that all are."""
    size = (image.shape[-2], image.shape[-1])
    whole = is_cpu(image.device) and bool(inside(warp, reference.grid.box, size).all())
    return None if whole else inside(warp, reference.grid.pixels, size)


def believed(reference: Reference, found: Solution) -> Tensor | None:
    """By how much blocks (B, blocks) have counted in the end: trust, and nothing under a mark of the camera's."""
    if reference.sight is None:
        return found.trust
    clear = (found.sums[:, 0] > 0).to(found.sums.dtype)
    return clear if found.trust is None else found.trust * clear


def along_pose(slopes: Tensor, warp: Tensor, pose: Tensor, pixels: Tensor) -> Tensor:
    """What the ``slopes`` (B, 2, N) of the image make of the patches in the ``warp`` (B, 2, 3) when x, y and theta of
    the ``pose`` (B, 3) grow: (B, 3, N)."""
    offset = torch.cat((warp[:, :, :2], warp[:, :, 2:] - pose[:, :2, None]), 2).to(slopes.dtype) @ pixels
    (gx, gy), (x, y) = slopes.unbind(1), offset.unbind(1)
    return torch.stack((gx, gy, gx * y - gy * x), 1)  # eq. (2): d(x, y) / dtheta = (y, -x)


def inverse_slope(reference: Reference, g: Tensor, slopes: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """A^-1 (B, 3, 3) at patches ``g`` (B, N) with ``slopes`` (B, 3, N) along poses with ``axes`` (B, 3, 3), see
    ``pose.turn``, 0 where there is no solution; and where (B,) there is one."""
    with torch.enable_grad():
        g = g.detach().requires_grad_()
        increment = reference.criterion.step(reference, g)
        rows = [torch.autograd.grad(row.sum(), g, retain_graph=True)[0] for row in increment.unbind(1)]
    slope = (torch.stack(rows, 1) @ slopes.mT).to(axes.dtype) @ axes  # in the template's axes it is about 1
    inverse, regular = safe_inverse(slope)
    solved = regular & increment.isfinite().all(1)
    return only(solved, axes @ inverse, torch.zeros_like(inverse)), solved


def only(some: Tensor, value: Tensor, other: Tensor) -> Tensor:
    """The ``value`` (B, ...) of ``some`` templates (B,), of the rest the ``other``; a value that is not finite there is
    none to the gradient either."""
    return torch.where(some.view(-1, *[1] * (value.dim() - 1)), value, other)
