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

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from torch_ecc.core import linearised
from torch_ecc.core.ambient import plain
from torch_ecc.core.condition import Gradients, condition_of, pulled
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.native import adjoint
from torch_ecc.core.normal import Normal
from torch_ecc.core.pose import turn
from torch_ecc.core.reference import Reference, each, reweigh
from torch_ecc.core.sampling import inside, is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, counted_pixels, summed


def wanted(reference: Reference, image: Tensor, start: Tensor) -> bool:
    """Whether anybody asks for the gradients of poses."""
    some = reference.K.requires_grad or image.requires_grad or start.requires_grad
    return some and torch.is_grad_enabled()


def attached(
    reference: Reference, image: Tensor, start: Tensor, found: Solution, settings: Settings
) -> tuple[Reference, Solution]:
    """What an engine has ``found`` of B templates in (B or 1, 1, H, W) from ``start`` (B, 3) on, its numbers as they
    are, with the gradients that they have at that place, and the ``reference`` to judge it by. Those of templates
    without a solution are 0."""
    visible, trusted = in_sight(reference, reference.warps(found.pose), image), believed(reference, found)
    counted = counted_pixels(reference, visible, trusted)
    seen = reference if counted is None else reweigh(reference, counted)
    in_view = reference.weight if visible is None else reference.weight * visible
    template = Template(seen.K, seen.signal, seen.weight, in_view)
    place = Place(each(torch.Tensor.detach, seen._replace(coarse=None)), found, trusted, settings)
    of_template = seen.normal if seen.K.requires_grad else ()
    pose, gain, sums, total, *normal = answered(place, image, start, *template, *of_template)
    found = found._replace(pose=pose, gain=gain, sums=sums, total=total)
    if not normal:
        return reference, found
    found = found._replace(normal=Normal(*normal))
    return (reference.judged_by(found.normal) if counted is None else reference), found


class Template(NamedTuple):
    """What of a ``reference.Reference`` has gradients: ``K`` and ``signal``, the ``weight`` (B, N) of the pixels that
    count, and that of those ``seen``, see ``solution.summed``."""

    K: Tensor
    signal: Tensor
    weight: Tensor
    seen: Tensor


class Place(NamedTuple):
    """Where templates were ``found``: the ``reference`` of the pixels that count there, how far their blocks are
    ``trusted`` (B, blocks), and by which ``settings``."""

    reference: Reference
    found: Solution
    trusted: Tensor | None
    settings: Settings

    def of(self, template: Template) -> Reference:
        """The reference of a ``template``."""
        columns = self.reference.columns._replace(signal=template.signal, weight=template.weight)
        return self.reference._replace(K=template.K, columns=columns)

    def sums(self, g: Tensor, *template: Tensor) -> Sequence[Tensor]:
        """``solution.summed`` of the patches ``g`` (B, N)."""
        given = Template(*template)
        return summed(self.of(given), g, given.seen, self.trusted)

    def increment(self, g: Tensor, *template: Tensor) -> Tensor:
        """That which the criterion asks for, (B, 3)."""
        reference = self.of(Template(*template))
        return reference.criterion.step(reference, g)


class _Context(FunctionCtx):
    place: Place
    saved_tensors: tuple[Tensor, ...]


class _Answer(torch.autograd.Function):
    """Pose, gain and sums of templates found in an ``image`` at a ``Place``, and their normal equations if these have
    gradients too."""

    @staticmethod
    def forward(place: Place, image: Tensor, start: Tensor, *template: Tensor) -> tuple[Tensor, ...]:
        found = place.found
        numbers = found.pose, found.gain, found.sums, found.total, *found.normal
        return tuple(number.clone() for number in numbers[: len(template)])  # as many of the normal equations

    @staticmethod
    def setup_context(
        ctx: _Context, inputs: tuple[Place, Tensor, Tensor, *tuple[Tensor, ...]], output: tuple[Tensor, ...]
    ) -> None:
        ctx.place, image, _, *template = inputs
        ctx.save_for_backward(image, *template[: len(Template._fields)])
        ctx.set_materialize_grads(False)

    @staticmethod
    @once_differentiable
    def backward(ctx: _Context, by_pose: Tensor | None, *by_sums: Tensor | None) -> tuple[Tensor | None, ...]:
        image, *template = ctx.saved_tensors
        by_image, by_template = gradients(ctx.place, image, template, by_pose, by_sums)
        return None, by_image, torch.zeros_like(ctx.place.found.pose), *by_template


answered: Callable[..., tuple[Tensor, ...]] = _Answer.apply


@plain  # asked for within an autocast too
def gradients(
    place: Place, image: Tensor, template: Sequence[Tensor], by_pose: Tensor | None, by_sums: Gradients
) -> tuple[Tensor | None, Gradients]:
    """By the ``image``, the ``template`` and its normal equations, of those by the pose (B, 3), by what
    ``solution.summed`` gives, and by these equations.

    With one look at the patches, and what leads back from them to the image: never one at more than their
    neighbourhoods.
    """
    found, by_normal = place.found, by_sums[3:]
    look = adjoint.look if adjoint.takes(place.reference, image, place.settings) else linearised.look
    values, by_image = look(place.reference, image, found.pose, place.settings)
    there = shown(found)
    values, template = where_there(there, values, Template(*template))
    condition = condition_of(place.of(template), values, partial(place.increment, values[:, 0]), template)
    inverse, solved = inverse_slope(condition.slope, turn(found.pose[:, 2]))
    solved = solved & there
    by_pose, *by_sums = (None if v is None else only(solved, v, 0.0) for v in (by_pose, *by_sums[:3]))
    by_g, *by_look = pulled(place.sums, (values[:, 0].requires_grad_(), *template), by_sums)
    by_place = torch.zeros_like(found.pose) if by_pose is None else by_pose
    if by_g is not None:
        by_place = by_place + (by_g[:, None] @ values[:, 1:].mT)[:, 0].to(by_place.dtype)
    by_step = only(solved, -(by_place[:, None] @ inverse)[:, 0], 0.0).to(values.dtype)
    by_both = zip(by_look, condition.by_template(by_step), strict=True)
    by_template = [added(solved, *both) for both in (*by_both, *((v,) for v in by_normal))]
    if not image.requires_grad:
        return None, by_template
    by_patch = condition.by_patch(by_step)
    by_g = by_patch if by_g is None else by_g + by_patch
    return by_image(only(solved, by_g, 0.0)), by_template


def shown(found: Solution) -> Tensor:
    """Which (B,) of what was ``found`` has a gain and contrast."""
    return (found.gain > 0) & (found.total[:, 2] > 0)


def where_there(there: Tensor, values: Tensor, template: Template) -> tuple[Tensor, Template]:
    """Patches ``values`` (B, 4, N) and a ``template`` with which all that is derived is finite: as they are of those
    ``there`` (B,), of others, which have no gradients, the whole template as its own patch."""
    if is_cpu(there.device) and bool(there.all()):
        return values, template
    whole = torch.ones_like(template.weight)
    own = torch.cat((template.signal[:, 3:], torch.zeros_like(template.signal[:, :3])), 1)
    weights = (only(there, v, whole).requires_grad_(v.requires_grad) for v in (template.weight, template.seen))
    return only(there, values, own), Template(template.K, template.signal, *weights)


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


def inverse_slope(slope: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """A^-1 (B, 3, 3) of A the ``slope`` (B, 3, 3) along poses with ``axes`` (B, 3, 3), see ``pose.turn``, 0 where there
    is no solution; and where (B,) there is one."""
    inverse, solved = safe_inverse(slope.to(axes.dtype) @ axes)  # in the template's axes it is about 1
    return only(solved, axes @ inverse, 0.0), solved


def added(some: Tensor, *gradients: Tensor | None) -> Tensor | None:
    """The sum of ``gradients`` of templates (B, ...), 0 but for ``some`` (B,)."""
    there = [gradient for gradient in gradients if gradient is not None]
    return only(some, sum(there[1:], there[0]), 0.0) if there else None


def only(some: Tensor, value: Tensor, other: Tensor | float) -> Tensor:
    """The ``value`` (B, ...) of ``some`` templates (B,), of the rest the ``other``; a value that is not finite there is
    none to the gradient either."""
    if is_cpu(some.device) and bool(some.all()):
        return value
    return torch.where(some.view(-1, *[1] * (value.dim() - 1)), value, other)
