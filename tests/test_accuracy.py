"""Recorded accuracy with tolerance: bias, scatter against the Cramer-Rao bound, honesty of the covariance."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc import Status, Tracker, align, prepare
from torch_ecc.experiments.bound import QUANTISATION, cramer_rao
from torch_ecc.pose import compose, inverse
from torch_ecc.reference import MARGIN
from torch_ecc.sim.scene import PlaneWaves

SCENE = PlaneWaves.random(fmax=0.25, rms_gradient=7.0, seed=0)
MIDDLE, FRAME, SIZE = 110.0, (221, 221), 121


def quantised(frames: torch.Tensor, noise: float, generator: torch.Generator) -> torch.Tensor:
    noisy = frames + noise * torch.randn(frames.shape, generator=generator)
    return noisy.round().clamp(0, 255).to(torch.uint8)


def errors(noise: float, draws: int, *, turn: bool, seed: int = 0):
    """(draws, 3) pose errors and their normalised squares over 3; template and frame are drawn anew each time.

    The template itself is cut at random sub-pixel places of the scene, so that its rounding is drawn anew too.
    """
    generator = torch.Generator().manual_seed(seed)
    middle = torch.tensor([[MIDDLE, MIDDLE, 0.0]], dtype=torch.float64)
    phase, shift = torch.rand(2, draws, 3, generator=generator, dtype=torch.float64) - 0.5
    first = middle + phase * torch.tensor([1.0, 1.0, 0.0])
    second = first + shift * torch.tensor([20.0, 20.0, 2 * math.pi if turn else 0.0])
    truth = compose(second, compose(inverse(first), middle.expand(draws, 3)))
    half = SIZE // 2 + MARGIN
    cut = slice(int(MIDDLE) - half, int(MIDDLE) + half + 1)
    mask = torch.zeros(2 * half + 1, 2 * half + 1, dtype=torch.bool)
    mask[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    near = truth + torch.tensor([0.3, -0.3, math.radians(0.17)])
    found = []
    for k in range(0, draws, 50):
        part = slice(k, k + 50)
        template, image = (quantised(SCENE.render(p[part], FRAME), noise, generator) for p in (first, second))
        found.append(align(prepare(template[:, :, cut, cut], mask=mask), image, near[part]))
    error = torch.cat([f.pose for f in found]) - truth
    covariance = torch.cat([f.covariance for f in found])
    assert (torch.cat([f.status for f in found]) == Status.CONVERGED).all()
    nees = (error[:, None] @ torch.linalg.solve(covariance, error[:, :, None])).flatten() / 3
    return error, nees


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0, 10.0])
def test_scatter_reaches_the_bound_and_the_covariance_says_so(noise, turn):
    draws = 250
    error, nees = errors(noise, draws, turn=turn, seed=int(noise))
    bound = cramer_rao(SCENE, (SIZE, SIZE), 2 * (noise**2 + QUANTISATION))
    rms = error.square().mean(0).sqrt()
    chance = 1 + 2.5 / math.sqrt(2 * draws)  # of an rms over so many draws
    assert (rms <= (1.1 if noise or turn else 1.5) * chance * bound).all(), rms / bound
    assert (rms >= bound / chance).all(), rms / bound
    # Without noise and without turning, all pixels share one sub-pixel phase, and what the spline misses there adds up.
    assert 0.8 / chance**2 < float(nees.mean()) < (1.25 if noise or turn else 1.8) * chance**2
    assert (error.mean(0).abs() < 0.4 * bound).all(), error.mean(0) / bound


def test_noise_free_sequence_of_equation_11():
    """20 px and 5 deg, 8 bit: at most 0.001 px and 0.001 deg rms, 0.003 at most."""
    j = torch.arange(41) / 40 * 2 * math.pi
    poses = torch.stack((20 * j.cos(), 20 * j.cos(), math.radians(5) * j.cos()), -1).double()
    poses = poses - poses[0] + torch.tensor([MIDDLE, MIDDLE, 0.0])
    poses[:, :2] += 20
    frames = SCENE.render(poses, (221, 221)).round().clamp(0, 255).to(torch.uint8)
    track = Tracker(frames[0], [poses[0, :2].tolist()], SIZE).track_sequence(frames[1:])
    error = (track.pose[:, 0] - poses[1:]) * torch.tensor([1.0, 1.0, 180 / math.pi])
    assert (track.status == Status.CONVERGED).all()
    assert (error.square().mean(0).sqrt() < 0.001).all()
    assert error.abs().max() < 0.003


def test_two_full_turns():
    """Theta from 0 to 720 deg in steps of 2 deg, unwrapped, as exact at every angle."""
    angles = torch.arange(0, 722, 2) * math.pi / 180
    poses = torch.stack((torch.full_like(angles, MIDDLE), torch.full_like(angles, MIDDLE), angles), -1).double()
    frames = (f.round().clamp(0, 255).to(torch.uint8) for f in map(SCENE.render, poses[:, None], [FRAME] * len(poses)))
    tracker = Tracker(next(frames)[0], [(MIDDLE, MIDDLE)], SIZE)
    track = tracker.track_sequence(frame[0] for frame in frames)
    error = (track.pose[:, 0] - poses[1:]) * torch.tensor([1.0, 1.0, 180 / math.pi])
    assert (track.status == Status.CONVERGED).all()
    assert float(track.pose[-1, 0, 2]) == pytest.approx(4 * math.pi, abs=1e-4)
    assert (error.square().mean(0).sqrt() < 0.001).all()
    assert error.abs().max() < 0.003
