"""Recorded accuracy with tolerance: bias, scatter against the Cramer-Rao bound, honesty of the covariance, light."""

from __future__ import annotations

import math

import pytest
import torch
from scatter import Draws, least, oracle, scatter
from sequences import track_path, under_light

from torch_ecc import Status, align
from torch_ecc.core.covariance import interpolation_error
from torch_ecc.core.pose import inverse, transform, turn
from torch_ecc.core.sampling import SAMPLERS
from torch_ecc.paper.bound import cramer_rao, rounding
from torch_ecc.paper.methods import prepared
from torch_ecc.paper.scheme import Harmonic
from torch_ecc.sim import Sequence
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.light import GradientLight, SpotLight
from torch_ecc.sim.scene.pads import Pads
from torch_ecc.sim.scene.waves import PlaneWaves

SCENE = PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0)
SCENES = {"waves": SCENE, "pads": Pads.wafer()}


@pytest.mark.parametrize(("noise", "turn"), [(0.0, False), (0.0, True), (2.0, True), (5.0, False), (10.0, True)])
def test_scatter_reaches_the_bound_and_the_covariance_says_so(noise, turn):
    count = 120
    found = scatter(SCENE, Draws(noise, count, turn, seed=int(noise)))
    assert (found.status == Status.CONVERGED).all()
    chance = 1 + 2.5 / math.sqrt(2 * count)  # of an rms over so many draws
    # Without noise and without turning, all pixels share one sub-pixel phase, and what the spline misses there adds up:
    # above the bound, but the covariance knows.
    alone = not noise and not turn
    assert (found.ratio <= (1.5 if alone else 1.1) * chance).all(), found.ratio
    assert (found.ratio >= 1 / chance).all(), found.ratio
    assert 0.8 / chance**2 < float(found.nees.mean()) < 1.25 * chance**2
    assert (found.error.mean(0).abs() < 0.4 * found.bound).all(), found.error.mean(0) / found.bound


def test_flat_areas_do_not_add_scatter():
    """Pads are mostly flat: there a noisy template's gradients are nothing but noise."""
    count = 120
    found = scatter(Pads.wafer(), Draws(10.0, count, seed=10))
    chance = 1 + 2.5 / math.sqrt(2 * count)
    assert (found.ratio <= 1.1 * chance).all(), found.ratio
    assert 0.8 / chance**2 < float(found.nees.mean()) < 1.25 * chance**2


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("scene", SCENES)
def test_unrounded_the_tracker_is_exact(scene, turn):
    error = scatter(SCENES[scene], Draws(0.0, 40, turn, bits=None)).error.abs().amax(0)
    assert error[:2].max() < 0.001
    assert error[2] < math.radians(0.001)


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi / 2, -2.5])
@pytest.mark.parametrize("scene", SCENES)
def test_the_oracle_finds_the_exact_pose_in_an_unrounded_frame(scene, angle):
    pose = torch.tensor([100.3, 98.8, angle], dtype=torch.float64)
    grid = torch.cartesian_prod(torch.arange(200), torch.arange(205)).flip(-1).double()
    frame = SCENES[scene].value(transform(inverse(pose), grid)).reshape(200, 205)
    start = pose + torch.tensor([0.3, -0.3, math.radians(0.17)])
    found = oracle(SCENES[scene], frame, start, (121, 111)) - pose
    assert found[:2].abs().max() < 1e-6
    assert found[2].abs() < 1e-7


@pytest.mark.parametrize("bits", [8, 16])
def test_the_oracle_reaches_the_bound_where_rounding_errors_are_independent(bits):
    count = 60
    poses = torch.rand(count, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    poses = torch.tensor([90.0, 90.0, 0.0]) + poses * torch.tensor([1.0, 1.0, math.tau])
    frames = Camera(size=(181, 181), bits=bits).capture(SCENE, poses)[:, 0]
    found = torch.stack([oracle(SCENE, f, p, (121, 121)) for f, p in zip(frames, poses, strict=True)])
    ratio = (found - poses).square().mean(0).sqrt() / cramer_rao(SCENE, (121, 121), rounding(bits))
    chance = 1 + 2.5 / math.sqrt(2 * count)
    assert ((ratio > 1 / chance) & (ratio < chance)).all(), ratio


@pytest.mark.parametrize("turn", [False, True])
def test_on_pads_the_error_is_what_rounding_leaves_to_anyone(turn):
    """Edges along the pixel rows are rounded alike: several bounds, but no more than one who knows the scene has."""
    draws = Draws(0.0, 60, turn)
    found, best = scatter(SCENES["pads"], draws), least(SCENES["pads"], draws)
    ours, theirs, apart = (e.square().mean(0).sqrt() for e in (found.error, best, found.error - best))
    assert (theirs > 2 * found.bound).all(), theirs / found.bound
    assert (ours < 1.2 * theirs).all(), ours / theirs
    assert (apart < 0.5 * theirs).all(), apart / theirs  # the same error in each pair


@pytest.mark.parametrize("interpolation", [name for name, kernel in SAMPLERS.items() if kernel.aliases])
def test_the_covariance_knows_the_samplers_own_error(interpolation):
    """Shifts without noise or rounding: the error is the sampler's alone, and follows the sub-pixel phase."""
    phases = torch.arange(16) / 16
    poses = torch.stack((110 + phases, 110 + phases.flip(0), 0 * phases), -1).double()
    frames = SCENE.render(poses, (221, 221)).float()
    middle = torch.tensor([[110.0, 110.0, 0.0]], dtype=torch.float64)
    reference = prepared(SCENE.render(middle, (221, 221))[:, :, 42:179, 42:179].float(), {})
    rows = [align(reference, f[None], p[None], interpolation=interpolation) for f, p in zip(frames, poses, strict=True)]
    error = torch.cat([row.pose for row in rows])[:, :2] - poses[:, :2]
    sigma = torch.cat([row.sigma for row in rows])[:, :2]
    assert 0.7 < error.square().mean().sqrt() / sigma.square().mean().sqrt() < 1.25


def test_the_samplers_error_adds_up_only_where_pixels_lie_alike():
    poses = torch.tensor([[110.0, 110.0, angle] for angle in (0.0, math.tau / 4, math.pi, 0.3)], dtype=torch.float64)
    frame = SCENE.render(poses[:1], (221, 221)).float()
    reference = prepared(frame[:, :, 42:179, 42:179].expand(4, -1, -1, -1), {})
    variance = interpolation_error(reference, turn(poses[:, 2]), "bspline3").square().sum(-1)[:, 0]
    assert variance[:3] / variance[0] == pytest.approx(1.0, abs=1e-6)
    assert variance[3] < 1e-3 * variance[0]


def test_noise_free_sequence_of_equation_11():
    """20 px and 5 deg, 8 bit: at most 0.001 px and 0.001 deg rms, 0.003 at most."""
    camera = Camera(size=(221, 221))
    run = track_path(Sequence(SCENE, Harmonic(20.0, 5.0, 40).closed(camera.size), camera))
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
    ("light", "methods", "largest_px", "largest_deg"),
    [
        (GradientLight(scale_px=640), ("ecc, linear", "ecc, quadratic"), 0.003, 0.003),
        (SpotLight(scale_px=640), ("ecc, quadratic",), 0.01, 0.015),
    ],
)
def test_light_that_varies_across_the_template(light, methods, largest_px, largest_deg):
    runs = under_light(SCENE, light, Harmonic(20.0, 5.0, 10))
    for method in methods:
        assert runs[method].lost == 0
        assert runs[method].largest[0] < largest_px
        assert runs[method].largest[1] < largest_deg
        for plain in ("ssd", "ecc, gain", "ecc_paper"):  # what the columns are for
            assert runs[plain].largest[0] > 3 * runs[method].largest[0]
