"""Laws of the paper's reference method: its Jacobian, its agreement with SSD, its behaviour under light."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc import align
from torch_ecc.core.pose import transform
from torch_ecc.core.reference import MARGIN
from torch_ecc.core.sampling import gradients
from torch_ecc.paper.methods import prepared
from torch_ecc.paper.ref34 import Ref34, jacobian, pixels
from torch_ecc.sim import PlaneWaves

SCENE = PlaneWaves.random(seed=1)
SIZE = 41 + 2 * MARGIN


def template() -> torch.Tensor:
    middle = torch.tensor([[(SIZE - 1) / 2, (SIZE - 1) / 2, 0.0]], dtype=torch.float64)
    return SCENE.render(middle, (SIZE, SIZE))


@pytest.mark.parametrize("theta", [0.0, 0.4, -2.5])
def test_jacobian_is_the_derivative_of_the_sampled_patch(theta):
    """d/dp of I(W(p; x')) at the solution, by autodiff of the analytic frame I(x) = scene(W(p)^-1 x)."""
    points = pixels((41, 41))[:2].T.double()
    truth = torch.tensor([0.0, 0.0, theta], dtype=torch.float64)
    back = torch.tensor([0.0, 0.0, -theta], dtype=torch.float64)
    exact = torch.func.jacfwd(lambda p: SCENE.value(transform(back, transform(p, points))))(truth)
    inner = slice(MARGIN, -MARGIN)
    J = jacobian(gradients(template())[:, :, inner, inner], truth[2:])[0].double()
    assert ((J - exact).square().mean(0).sqrt() < 0.02 * exact.square().mean(0).sqrt()).all()


@pytest.mark.parametrize("theta", [0.0, 1.0, 4.0])
def test_agrees_with_ssd(theta):
    """Another parametrisation and other steps, the same minimum."""
    truth = torch.tensor([[90.3, 80.6, theta]], dtype=torch.float64)
    frame, start = SCENE.render(truth, (160, 180)), truth + torch.tensor([[0.4, -0.5, 0.01]])
    found = Ref34(template(), start).track(frame)
    ssd = align(prepared(template(), {"criterion": "ssd"}), frame, start).pose
    assert (found - ssd).abs().max() < 1e-3
    assert (found - truth)[0, :2].abs().max() < 3e-3
    assert abs(float(found[0, 2]) - theta) < math.radians(0.005)


def test_sees_gain_and_offset():
    truth = torch.tensor([[90.3, 80.6, 0.2]], dtype=torch.float64)
    found = Ref34(template(), truth).track(0.7 * SCENE.render(truth, (160, 180)) + 20)
    assert (found - truth).abs().max() > 1e-2
