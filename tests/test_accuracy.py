"""Recorded accuracy with tolerance: bias, scatter against the Cramer-Rao bound, honesty of the covariance, light."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc import Status
from torch_ecc.experiments.accuracy import Draws, Harmonic, scatter, track_path, under_light
from torch_ecc.sim import Sequence
from torch_ecc.sim.camera import Camera
from torch_ecc.sim.light import GradientLight, SpotLight
from torch_ecc.sim.waves import PlaneWaves

SCENE = PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0)


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0, 10.0])
def test_scatter_reaches_the_bound_and_the_covariance_says_so(noise, turn):
    count = 200
    found = scatter(SCENE, Draws(noise, count, turn, seed=int(noise)))
    assert (found.status == Status.CONVERGED).all()
    chance = 1 + 2.5 / math.sqrt(2 * count)  # of an rms over so many draws
    # Without noise and without turning, all pixels share one sub-pixel phase, and what the spline misses there adds up.
    alone = not noise and not turn
    assert (found.ratio <= (1.5 if alone else 1.1) * chance).all(), found.ratio
    assert (found.ratio >= 1 / chance).all(), found.ratio
    assert 0.8 / chance**2 < float(found.nees.mean()) < (1.8 if alone else 1.25) * chance**2
    assert (found.error.mean(0).abs() < 0.4 * found.bound).all(), found.error.mean(0) / found.bound


def test_noise_free_sequence_of_equation_11():
    """20 px and 5 deg, 8 bit: at most 0.001 px and 0.001 deg rms, 0.003 at most."""
    camera = Camera(size=(221, 221))
    run = track_path(Sequence(SCENE, Harmonic(20.0, 5.0, 40).path(camera), camera))
    assert (run.status == Status.CONVERGED).all()
    assert max(run.rms) < 0.001
    assert max(run.largest) < 0.003


def test_two_full_turns():
    """Theta from 0 to 720 deg in steps of 2 deg, unwrapped, as exact at every angle."""
    angles = torch.arange(0, 722, 2) * math.pi / 180
    path = torch.stack((110 + 0 * angles, 110 + 0 * angles, angles), -1).double()
    run = track_path(Sequence(SCENE, path, Camera(size=(221, 221))))
    assert (run.status == Status.CONVERGED).all()
    assert max(run.rms) < 0.001
    assert max(run.largest) < 0.003


@pytest.mark.parametrize(
    ("light", "method", "largest_px", "largest_deg"),
    [
        (GradientLight(scale_px=640), "ecc, linear", 0.003, 0.003),
        (GradientLight(scale_px=640), "ecc, quadratic", 0.003, 0.003),
        (SpotLight(scale_px=640), "ecc, quadratic", 0.01, 0.015),
    ],
)
def test_light_that_varies_across_the_template(light, method, largest_px, largest_deg):
    runs = under_light(SCENE, light, Harmonic(50.0, 10.0, 12))
    assert runs[method].lost == 0
    assert runs[method].largest[0] < largest_px
    assert runs[method].largest[1] < largest_deg
    for plain in ("ssd", "ecc, gain", "ecc_paper"):  # what the columns are for
        assert runs[plain].largest[0] > 3 * runs[method].largest[0]
