"""Laws of the benchmark of bodies in its short version: on rendered frames, at the bound, and the wrong ones named."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import body
import rigid

from torch_ecc import Lens
from torch_ecc.core.pose import inverse, transform
from torch_ecc.paper.errors import rms
from torch_ecc.sim import Camera

PLAN = rigid.Plan(side=420, across=4, size=41, span=290)


def test_bodies_are_at_the_bound_of_all_patches_and_honest():
    found = rigid.draw(PLAN, 2.0, 25)
    assert (rms(found.error) / PLAN.bound(2.0) < 1.5).all()
    assert 0.5 < found.nees.mean() < 1.5
    assert 0.7 < found.chi2.mean() < 1.3
    assert found.used.double().mean() > 0.99


@pytest.mark.parametrize("wrong", ["covered", "jumped", "another body"])
def test_five_of_sixteen_that_are_wrong_are_named(wrong):
    found = rigid.draw(PLAN, 2.0, 4, wrong, body.APART)
    left = torch.ones(16, dtype=torch.bool)
    left[list(body.APART)] = False
    assert not found.used[:, ~left].any()
    assert found.used[:, left].double().mean() > 0.95
    assert (rms(found.error) / PLAN.bound(2.0, left) < 2.5).all()


def test_frames_drawn_near_patches_are_the_cameras_own():
    """Behind a lens: the quick drawing and the simulator's camera, which are the scene where each pixel looks."""
    lens = Lens((60.0, 50.0), 80.0, 0.01)
    camera = Camera(size=(100, 120), lens=lens, bits=None)
    pose = torch.tensor([[60.0, 50.0, 0.1]], dtype=torch.float64)
    whole = camera.capture(rigid.FEW, pose)[0, 0]
    near = rigid.Near(lens, torch.zeros(1, 2).double(), 20).render(pose, (100, 120))[0, 0]
    torch.testing.assert_close(whole[32:69, 42:79], near[32:69, 42:79])
    looks = transform(inverse(pose[0]), lens.undistort(torch.tensor([[11.0, 93.0]]).double()))
    assert float(whole[93, 11]) == pytest.approx(float(rigid.FEW.value(looks)), abs=1e-3)
    straight = Camera(size=(100, 120), lens=Lens((60.0, 50.0), 80.0), bits=None, blur_sigma=1.0)
    plain = Camera(size=(100, 120), bits=None, blur_sigma=1.0)
    torch.testing.assert_close(straight.capture(rigid.FEW, pose), plain.capture(rigid.FEW, pose), atol=2e-3, rtol=0)


def test_a_lens_that_was_self_calibrated_is_as_good_as_the_known_one():
    lens = Lens((209.5, 209.5), math.hypot(419, 419) / 2, 0.005)
    plan = rigid.Plan(side=420, across=3, size=31, span=160)
    angle = math.tau * torch.arange(4, dtype=torch.float64) / 4
    path = torch.stack((80 * angle.cos(), 80 * angle.sin(), 0.05 * (2 * angle).sin()), 1) + plan.middle
    tracker, track = body._followed(plan, lens, path)
    fit = body.te.calibrate(track, tracker=tracker, lens=["k1"])
    true = body.te.Body(tracker, lens=lens)
    error, residual = body._behind(body.te.Body(tracker, lens=fit.lens), true, track, path, plan)
    assert error[:, :2].square().mean().sqrt() < 0.01
    assert residual < 0.015
    error, without = body._behind(body.te.Body(tracker), true, track, path, plan)
    assert without > 3 * residual
