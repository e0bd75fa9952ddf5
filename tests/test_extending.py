"""A criterion, a sampler or a light of one's own is made in one place, and a tracker tracks with it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import comb, factorial

import pytest
import torch
from torch import Tensor

from torch_ecc import SSD, Status, Tracker
from torch_ecc.core import criteria, sampling
from torch_ecc.core.criteria import Fit, Prepared
from torch_ecc.core.pose import inverse, transform
from torch_ecc.core.sampling import Kernel, Pairs, Slopes
from torch_ecc.sim.scene.scene import PlaneWaves

SCENE = PlaneWaves.random(seed=5)
FRAME, CENTER, SIZE = (150, 180), [(90.0, 75.0)], 61
STEPS = torch.arange(6, dtype=torch.float64)
PATH = torch.stack((90 + 2.3 * STEPS, 75 - 1.7 * STEPS + 0.2 * STEPS**2, 0.03 * STEPS), -1)


def error(stack: Tensor, **options) -> float:
    """Largest error of a tracked path, px at the corner; all of it must be tracked."""
    track = Tracker(stack[0], CENTER, SIZE, **options).track_sequence(stack[1:])
    assert (track.status == Status.CONVERGED).all()
    off = (track.pose[:, 0] - PATH[1:]).abs()
    return float((off[:, :2].norm(dim=1) + off[:, 2] * SIZE / 2).max())


@dataclass(frozen=True)
class Offset:
    """Squared differences that leave one offset of the grey levels free: g = t + G b + c."""

    def columns(self, signal: Tensor, uv: Tensor) -> Tensor:
        """[G, 1]."""
        return torch.cat((signal[:, :3], torch.ones_like(signal[:, 3:])), 1)

    def step(self, reference: Prepared, g: Tensor) -> Tensor:
        """b."""
        return (reference.K[:, :3] @ (g - reference.signal[:, 3])[:, :, None])[:, :, 0]

    def fit(self, reference: Prepared, g: Tensor) -> Fit:
        """g - t - c; the gain is 1."""
        difference = g - reference.signal[:, 3]
        offset = (reference.K[:, 3:] @ difference[:, :, None])[:, :, 0]
        return Fit(difference - offset, torch.ones_like(g[:, 0]))


class Differentiated(Offset):
    """The same by autograd."""

    def step(self, reference: Prepared, g: Tensor) -> Tensor:
        """The slope of b along ones."""
        with torch.enable_grad():
            ones = torch.ones(len(g), 3, requires_grad=True)
            return torch.autograd.grad((super().step(reference, g) * ones).sum(), ones)[0]


@pytest.mark.parametrize("levels", [1, 2])
@pytest.mark.parametrize("criterion", ["offset", Offset(), Differentiated()], ids=str)
def test_a_criterion(criterion, levels, monkeypatch):
    """Made for another offset in every frame, which squared differences alone take for motion; by name or as it is."""
    monkeypatch.setitem(criteria.CRITERIA, "offset", lambda light: Offset())
    stack = SCENE.render(PATH, FRAME)[:, 0] + 3 * (STEPS % 3)[:, None, None]
    assert error(stack, criterion=criterion, levels=levels) < 5e-3
    assert error(stack, criterion=SSD(), levels=levels) > 5e-2


def septic(f: Tensor) -> Pairs:
    """The eight taps of the B-spline of degree 7."""

    def spline(x: Tensor) -> Tensor:
        return sum((-1) ** k * comb(8, k) * (4 - x.abs() - k).clamp(min=0) ** 7 for k in range(4)) / factorial(7)

    w = [spline(f - k) for k in range(-3, 5)]
    return [(k - 3, w[k] + w[k + 1], w[k + 1]) for k in (0, 2, 4, 6)]


def septic_slopes(f: Tensor) -> Slopes:
    """By how much they change with f."""

    def slope(x: Tensor) -> Tensor:
        rises = sum((-1) ** k * comb(8, k) * (4 - x.abs() - k).clamp(min=0) ** 6 for k in range(4)) / factorial(6)
        return -x.sign() * rises

    w = [slope(f - k) for k in range(-3, 5)]
    return [(w[k] + w[k + 1], w[k + 1]) for k in (0, 2, 4, 6)]


def test_a_sampler(monkeypatch):
    """The smoother the spline, the less it gets wrong: every degree beats the one below."""
    taps = (2416 / 5040, 1191 / 5040, 120 / 5040, 1 / 5040)
    monkeypatch.setitem(sampling.SAMPLERS, "bspline7", Kernel(septic, septic_slopes, taps, 14, 0.8803, aliases=False))
    stack = PlaneWaves.random(seed=5, fmax=0.3).render(PATH, FRAME)[:, 0]
    errors = [error(stack, interpolation=name, tolerance=1e-5) for name in sampling.SAMPLERS]
    assert all(a > 3 * b for a, b in pairwise(errors)), errors


def cubic(uv: Tensor) -> Tensor:
    """All that varies linearly, quadratically or with the cube of one coordinate."""
    return torch.cat((criteria.ILLUMINATION["quadratic"](uv), uv**3), 1)


def test_a_light(monkeypatch):
    """Which goes with the target, and varies over it as no other light does."""
    monkeypatch.setitem(criteria.ILLUMINATION, "cubic", cubic)
    stack = SCENE.render(PATH, FRAME)[:, 0]
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in FRAME), indexing="ij")
    points = torch.stack((x.flatten(), y.flatten()), -1)
    for k in range(1, len(PATH)):
        u, v = (2 / (SIZE - 1) * transform(inverse(PATH[k]), points)).clamp(-1.5, 1.5).T.reshape(2, *FRAME)
        stack[k] *= 1 + 0.3 * u**3 - 0.2 * v**3 + 0.1 * u
    assert error(stack, illumination="cubic") < 5e-3
    assert error(stack, illumination="quadratic", robust=False) > 5e-2
