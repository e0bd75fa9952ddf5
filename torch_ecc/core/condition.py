"""The condition that a pose solves, an increment u of 0: how u changes with the pose, the patch and the template."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.criteria import ECC
from torch_ecc.core.reference import Reference

Gradients = Sequence[Tensor | None]
OfTemplate = Callable[..., Tensor]  # the increment (B, 3) of K, signal and weights, see implicit.Template


class Condition(NamedTuple):
    """Of B patches: ``slope`` (B, 3, 3), by how much u changes with x, y and theta; from gradients by u (B, 3) those
    ``by_patch``, (B, N), and ``by_template``."""

    slope: Tensor
    by_patch: Callable[[Tensor], Tensor]
    by_template: Callable[[Tensor], Gradients]


def condition_of(reference: Reference, values: Tensor, increment: OfTemplate, template: Sequence[Tensor]) -> Condition:
    """At patches with ``values`` (B, 4, N), see ``linearised.Look``, which are brought nearer to 0 where u does not
    change by that; ``increment``: u by the parts of a template."""
    if type(reference.criterion) is ECC:
        return of_ratio(reference.K, values, template)
    U = slope_of_step(reference, values[:, 0])
    return Condition(
        U @ values[:, 1:].mT,
        lambda by: (by[:, None] @ U)[:, 0],
        lambda by: pulled(lambda *parts: (increment(*parts),), template, (by,)),
    )


def of_ratio(K: Tensor, values: Tensor, template: Sequence[Tensor]) -> Condition:
    """Of u = b / a, with b and a the first rows of ``K`` (B, p, N) times the patch: in one look at them. Where a is not
    positive nothing changes."""
    rows, g = K.narrow(1, 0, 4), values[:, 0]
    g -= g[:, :1].clone()  # K does not see a constant
    u, moved = (rows @ values.mT).split((1, 3), 2)
    a = torch.where(u[:, 3:] > 0, u[:, 3:], inf)
    increment = u[:, :3] / a

    def by_u(by: Tensor) -> Tensor:  # by K times the patch, (B, 1, 4)
        by = by[:, None]
        return torch.cat((by, -by @ increment), 2) / a

    def by_template(by: Tensor) -> Gradients:
        if not template[0].requires_grad:
            return [None] * len(template)
        by_rows = torch.nn.functional.pad(by_u(by), (0, K.shape[1] - 4))
        return [by_rows.mT * g[:, None], *[None] * (len(template) - 1)]

    return Condition((moved[:, :3] - increment * moved[:, 3:]) / a, lambda by: (by_u(by) @ rows)[:, 0], by_template)


def slope_of_step(reference: Reference, g: Tensor) -> Tensor:
    """U (B, 3, N) at patches ``g`` (B, N): by how much an increment changes with each pixel of the patch."""
    g = g.detach().requires_grad_()
    with torch.enable_grad():
        rows = [row.sum() for row in reference.criterion.step(reference, g).unbind(1)]
    return torch.stack([torch.autograd.grad(row, g, retain_graph=True)[0] for row in rows], 1)


def pulled(function: Callable[..., Sequence[Tensor]], at: Sequence[Tensor], by: Gradients) -> list[Tensor | None]:
    """The gradients by those arguments of a ``function`` that ask for some, ``at`` their values, from those ``by`` what
    it gives."""
    leaves = [value.detach().requires_grad_(value.requires_grad) for value in at]
    asked = [leaf for leaf in leaves if leaf.requires_grad]
    if not asked or all(value is None for value in by):
        return [None] * len(at)
    with torch.enable_grad():
        values, given = zip(
            *(pair for pair in zip(function(*leaves), by, strict=True) if pair[1] is not None), strict=True
        )
    found = iter(torch.autograd.grad(values, asked, given, allow_unused=True))
    return [next(found) if leaf.requires_grad else None for leaf in leaves]
