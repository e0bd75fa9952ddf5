"""Matching criteria: which columns explain a sampled patch, and the Gauss-Newton step that follows.

A template of N pixels is a vector t with steepest-descent images G (3 x N: its gradient times eq. 8 at theta = 0). A
criterion names the columns R that a sampled patch g is fitted with; ``reference.prepare`` turns them into one constant
matrix K, and the step is a simple function of K g.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

ILLUMINATION: dict[
    str, Callable[[Tensor], Tensor]
] = {  # what the gain may vary by over [-1, 1]^2, (B, 2, N) -> (B, n, N)
    "gain": lambda uv: uv[:, :0],
    "linear": lambda uv: uv,
    "quadratic": lambda uv: torch.cat((uv, uv * uv, uv[:, :1] * uv[:, 1:]), 1),
}


class Fit(NamedTuple):
    """What a criterion's model leaves of sampled patches: ``residual`` (B, N) and the patch's ``gain`` (B,)."""

    residual: Tensor
    gain: Tensor


class Prepared(Protocol):
    """What a criterion reads of a prepared template, see ``reference.Reference``."""

    @property
    def K(self) -> Tensor:
        """(B, p, N)."""

    @property
    def signal(self) -> Tensor:
        """[G, t], (B, 4, N)."""

    @property
    def weight(self) -> Tensor:
        """(B, N)."""

    @property
    def uv(self) -> Tensor:
        """(B, 2, N)."""


class Criterion(Protocol):
    """What the solver asks of a matching criterion; B templates, N pixels, p columns of which the first 3 are G."""

    def columns(self, signal: Tensor, uv: Tensor) -> Tensor:
        """R (B, p, N) from ``signal`` = [G, t] (B, 4, N) and pixel positions ``uv`` (B, 2, N) scaled to [-1, 1]."""
        ...

    def step(self, reference: Prepared, g: Tensor) -> Tensor:
        """The increment (B, 3) that the sampled patches ``g`` (B, N) ask for; non-finite if they ask for none."""
        ...

    def fit(self, reference: Prepared, g: Tensor) -> Fit:
        """Residual and gain of the sampled patches ``g`` (B, N) under the criterion's model."""
        ...


@dataclass(frozen=True)
class ECC:
    """Enhanced correlation coefficient (eq. 4) with the exact step of its linearised form.

    g = a t + b^T G + c 1 (+ light columns) is fitted and the increment is b / a: the step of Evangelidis and Psarakis
    with the roles of template and image exchanged. ``illumination``: "gain" is the paper's ECC (one gain, one offset);
    "linear" lets the gain vary linearly over the template (columns t x', t y'), "quadratic" adds their squares and
    product. More columns cost next to no time per iteration and some variance on weak templates.
    """

    illumination: str = "linear"

    def __post_init__(self) -> None:
        if self.illumination not in ILLUMINATION:
            raise ValueError(f"illumination: expected one of {list(ILLUMINATION)}, got {self.illumination!r}")

    def columns(self, signal: Tensor, uv: Tensor) -> Tensor:
        """[G, t, 1, t u, t v, t u^2, t v^2, t u v], as many as ``illumination`` asks for: (B, 5 + 0 | 2 | 5, N).

        t stands without its mean, which the column 1 makes up for: on a high pedestal the two would look alike.
        """
        t = signal[:, 3:]
        contrast = t - t.mean(-1, keepdim=True)
        return torch.cat((signal[:, :3], contrast, torch.ones_like(t), t * self.light(uv)), 1)

    def light(self, uv: Tensor) -> Tensor:
        """What the gain may vary by over the template, (B, n, N)."""
        return ILLUMINATION[self.illumination](uv)

    def step(self, reference: Prepared, g: Tensor) -> Tensor:
        """b / a, (B, 3); infinite or NaN where the gain a is not positive."""
        g = g - g.narrow(1, 0, 1)  # K does not see a constant, but its sums stay small
        u = torch.bmm(g.unsqueeze(1), reference.K.narrow(1, 0, 4).mT).squeeze(1)  # many columns take ten times as long
        increment, gain = torch.split_with_sizes(u, (3, 1), 1)
        return increment / gain.relu()

    def fit(self, reference: Prepared, g: Tensor) -> Fit:
        """g minus all columns; the gain is the coefficient a of t."""
        t, g = reference.signal.select(1, 3), g - g.narrow(1, 0, 1)
        u = torch.bmm(g.unsqueeze(1), reference.K.mT)
        slopes, gain = u.narrow(2, 0, 4), u[:, 0, 3:4]
        rest = torch.baddbmm(g.unsqueeze(1), slopes, reference.signal, alpha=-1).squeeze(1)
        if u.shape[2] > 5:
            light = torch.bmm(u.narrow(2, 5, u.shape[2] - 5), self.light(reference.uv)).squeeze(1)
            rest = rest.addcmul(light, t, value=-1)
        return Fit(rest - (u[:, 0, 4:5] - gain * t.mean(-1, keepdim=True)), gain[:, 0])


@dataclass(frozen=True)
class PaperECC:
    """Eq. (9) to the letter: J not projected off the template and the constant, light as one gain and one offset."""

    def columns(self, signal: Tensor, uv: Tensor) -> Tensor:
        """J, (B, 3, N)."""
        return signal[:, :3]

    def step(self, reference: Prepared, g: Tensor) -> Tensor:
        """(J^T J)^-1 J^T [ (dh / dg) (g - mean g) - (h - mean h) ], (B, 3): the sign of J's own increment."""
        residual, gain = self.fit(reference, g)
        return (reference.K @ residual[:, :, None])[:, :, 0] / gain[:, None]

    def fit(self, reference: Prepared, g: Tensor) -> Fit:
        """(g - mean g) - (dg / dh) (h - mean h), and dg / dh."""
        h0, dh = centred(reference.signal[:, 3], reference.weight)
        g0, dg = centred(g, reference.weight)
        gain = dg / dh.clamp(min=1e-30)
        return Fit(g0 - gain[:, None] * h0, gain)


@dataclass(frozen=True)
class SSD:
    """Sum of squared differences, the baseline: no gain and no offset."""

    def columns(self, signal: Tensor, uv: Tensor) -> Tensor:
        """G, (B, 3, N)."""
        return signal[:, :3]

    def step(self, reference: Prepared, g: Tensor) -> Tensor:
        """pinv(G) (g - t), (B, 3)."""
        return (reference.K @ (g - reference.signal[:, 3])[:, :, None])[:, :, 0]

    def fit(self, reference: Prepared, g: Tensor) -> Fit:
        """g - t; the gain is 1."""
        return Fit(g - reference.signal[:, 3], torch.ones_like(g[:, 0]))


def centred(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """``values`` (B, N) minus their weighted mean, and the weighted norm (B,) of the rest."""
    mean = (values * weight).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp(min=1e-30)
    rest = values - mean
    return rest, (rest * rest * weight).sum(-1).sqrt()


def safe_inverse(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse (B, n, n), zero where ``matrix`` is singular to float32, and whether it is regular, (B,) bool.

    Rows and columns are brought to unit diagonal first: the columns' units differ by orders of magnitude.
    """
    diagonal = matrix.detach().diagonal(dim1=-2, dim2=-1)
    scale = diagonal.abs().clamp(min=1e-30).rsqrt()
    scale = scale[:, :, None] * scale[:, None, :]
    scaled = matrix * scale
    inverse = torch.linalg.inv_ex(scaled)[0]
    regular = (inverse.abs().sum((-2, -1)) < 1e6) & (diagonal > 0).all(-1)  # NaN and infinity compare as singular
    if matrix.requires_grad:
        inverse = inverse_where(regular, scaled)
    return torch.where(regular[:, None, None], inverse * scale, 0.0), regular


def inverse_where(regular: Tensor, matrix: Tensor) -> Tensor:
    """Inverse (B, n, n) where ``matrix`` is ``regular`` (B,); elsewhere of no meaning, but with a finite gradient."""
    one = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    inverse: Tensor = torch.linalg.inv_ex(torch.where(regular[:, None, None], matrix, one))[0]
    return inverse


CRITERIA: dict[str, Callable[[str], Criterion]] = {  # by name, of an illumination
    "ecc": ECC,
    "ecc_paper": lambda _: PaperECC(),
    "ssd": lambda _: SSD(),
}


def make_criterion(criterion: str | Criterion, illumination: str = "linear") -> Criterion:
    """The criterion of a name ("ecc", "ecc_paper" or "ssd"), or the object itself."""
    if not isinstance(criterion, str):
        if isinstance(criterion, type) or not all(hasattr(criterion, name) for name in ("columns", "step", "fit")):
            raise ValueError(f"criterion: expected a name or an object with columns, step and fit, got {criterion!r}")
        return criterion
    if criterion not in CRITERIA:
        raise ValueError(f"criterion: expected one of {list(CRITERIA)} or an object, got {criterion!r}")
    ECC(illumination)  # a wrong word is told whatever the criterion
    return CRITERIA[criterion](illumination)


def named(criterion: Criterion) -> str:
    """What tells a criterion, in another process too: its own words if it has some, or its class."""
    kind = type(criterion)
    return f"{kind.__module__}.{kind.__qualname__}" if kind.__repr__ is object.__repr__ else repr(criterion)
