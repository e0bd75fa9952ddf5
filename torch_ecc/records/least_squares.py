"""Least squares over errors of three components, um, um and rad, whose sizes and correlations nobody knows beforehand.

A fit that takes the errors of successive frames as independent believes itself too much: a tracker's errors go along
with the position between pixels, sensors drift, frames shake. So each component's errors are described by an
autoregression, and what is made least are its innovations (generalised least squares). The covariance is made of their
own products frame by frame (a sandwich), so that it holds too where errors grow with speed, as uneven clocks make them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from torch_ecc.records.whitening import autoregression, whiten

FLOOR = (1e-6, 1e-6, 1e-9)  # um, um, rad: below this a record is exact
STEPS = 50
SETTLED = 0.1  # standard deviations that the last step may still have
PARTS = 10  # of a record, whose means say how well the mean of all is known
LEARNING = 4  # steps in which the description of the errors still follows them

Model: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]
"""All parameters -> residual (V, 3) and Jacobian (V, 3, P) by the free ones; 0 in both for a missing component."""


class _Solution(NamedTuple):
    """Gauss-Newton ``step`` (P,), ``inverse`` (P, P) of the normal matrix, and what it does not fix, ``blind`` (P,)."""

    step: Tensor
    inverse: Tensor
    blind: Tensor


class _Errors(NamedTuple):
    """The errors' autoregression by component, and the standard deviation ``size`` (3,) of their innovations."""

    coefficients: list[Tensor]
    size: Tensor

    @staticmethod
    def of(residual: Tensor) -> _Errors:
        centred = residual - residual.mean(0)
        coefficients = [autoregression(column) for column in centred.T]
        return _Errors(coefficients, _size(_white(centred, coefficients)))

    def white(self, values: Tensor) -> Tensor:
        """Innovations (V - drop, 3, ...) of values (V, 3, ...), in units of their standard deviation."""
        return _white(values, self.coefficients) / self.size.reshape(-1, *[1] * (values.dim() - 2))

    def mean_variance(self, residual: Tensor) -> Tensor:
        """Variance (3,) of the mean of residuals (V, 3): as of a stationary series, and as of ten parts of it."""
        passed = 1 - torch.stack([a.sum() for a in self.coefficients])
        stationary = torch.minimum((self.size / passed).square() / len(residual), residual.var(0))
        parts = torch.stack([part.mean(0) for part in residual.tensor_split(min(PARTS, len(residual)))])
        return stationary.maximum(parts.var(0) / len(parts)).nan_to_num(0.0)


def ordinary(model: Model, p: Tensor, free: list[int]) -> tuple[Tensor, Tensor]:
    """Parameters and residual (V, 3), every component weighted by its own scatter, frames taken as independent."""
    p, used = p.clone(), torch.ones(3, dtype=p.dtype)
    for _ in range(STEPS):
        residual, jacobian = model(p)
        weight = 1 / _size(residual)
        step = solve(residual * weight, jacobian * weight[:, None]).step
        p[free] -= step
        settled = bool(((used / weight - 1).abs() <= 1e-6).all())  # under new weights the next step is no longer small
        if settled and bool((step.abs() <= 1e-9 * (1 + p[free].abs())).all()):
            break
        used = weight
    return p, model(p)[0]


def least_squares(model: Model, p: Tensor, free: list[int], zeros: slice) -> tuple[Tensor, Tensor, bool]:
    """Parameters, the covariance (P, P) of the free ones and whether the steps ended, errors correlated as they are.

    ``zeros``: where among all parameters the zero of each component stands. A zero is the mean of what the others
    leave: under a drift, innovations say next to nothing of it.
    """
    p, errors = p.clone(), _Errors.of(model(p)[0])
    for k in range(STEPS):
        residual, jacobian = model(p)
        errors = _Errors.of(residual) if k < LEARNING else errors
        found = solve(errors.white(residual), errors.white(jacobian))
        p[free] -= found.step
        share = found.step.abs() / (found.inverse.diagonal().sqrt() + 1e-10 * p[free].abs()).clamp(min=1e-300)
        if k >= LEARNING and float(share.max()) <= 1e-3:
            break
    residual, jacobian = model(p)
    p[zeros] -= residual.mean(0)
    return (
        p,
        _covariance(residual - residual.mean(0), jacobian, errors, _places(free, zeros)),
        float(share.max()) <= SETTLED,
    )


def _covariance(residual: Tensor, jacobian: Tensor, errors: _Errors, places: list[tuple[int, int]]) -> Tensor:
    """Sandwich (P, P) from the innovations; ``places``: of each zero among the parameters, with its component."""
    white, design = errors.white(residual), errors.white(jacobian)
    found = solve(white, design)
    influence = (design * white[..., None]).sum(1) @ found.inverse
    share = torch.einsum("nkp,pq,nkq->n", design, found.inverse, design).clamp(max=0.9)  # of the fit, in its own error
    influence = influence / (1 - share)[:, None]
    covariance = influence.mT @ influence
    # A sandwich is a guess from few frames where few of them tell something: it is not let below the plain covariance.
    short = (found.inverse.diagonal() / covariance.diagonal().clamp(min=1e-300)).clamp(min=1.0).sqrt()
    covariance = short[:, None] * covariance * short
    mean, variance = jacobian.mean(0), errors.mean_variance(residual)
    others = torch.eye(len(found.step), dtype=mean.dtype)
    for place, component in places:
        others[place] = -mean[component]
    at = [place for place, _ in places]
    others[:, at] = 0.0
    covariance = others @ covariance @ others.mT
    covariance[at, at] += variance[[component for _, component in places]]
    covariance[found.blind, found.blind] = torch.inf
    return covariance


def solve(residual: Tensor, jacobian: Tensor) -> _Solution:
    """One Gauss-Newton step of weighted residuals (V, 3) and Jacobian (V, 3, P).

    Directions that the residuals do not fix are left alone, and what has a part in them is ``blind``.
    """
    r, J = residual.flatten(), jacobian.flatten(0, 1)
    size = torch.linalg.vector_norm(J, dim=0)
    factor = size.clamp(min=1e-300)
    J = J / factor
    values, vectors = torch.linalg.eigh(J.mT @ J)
    seen = values > 1e-12
    inverse = (vectors * torch.where(seen, 1 / values.clamp(min=1e-300), 0.0)) @ vectors.mT
    blind = ((vectors.square() * ~seen).sum(1) > 1e-6) | (size == 0)
    step = torch.where(size > 0, inverse @ (J.mT @ r) / factor, 0.0)
    inverse = torch.where((size > 0)[:, None] & (size > 0), inverse / torch.outer(factor, factor), 0.0)
    return _Solution(step, inverse, blind)


def _white(values: Tensor, coefficients: list[Tensor]) -> Tensor:
    drop = max(map(len, coefficients))
    return torch.stack([whiten(values[:, k], a, drop) for k, a in enumerate(coefficients)], 1)


def _size(residual: Tensor) -> Tensor:
    """Root mean square (3,), not less than what counts as exact."""
    return residual.square().mean(0).sqrt().maximum(residual.new_tensor(FLOOR))


def _places(free: list[int], zeros: slice) -> list[tuple[int, int]]:
    components = {number: k for k, number in enumerate(range(zeros.start, zeros.stop))}
    return [(place, components[number]) for place, number in enumerate(free) if number in components]
