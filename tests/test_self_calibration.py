"""Laws of the self-calibration: it finds the lens and the stage that made the moves, or tells what they do not tell."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torch_ecc import Calibration, Estimate, Lens, Track, Tracker, calibrate
from torch_ecc.body.layout import Layout, Response
from torch_ecc.sim import Camera, PlaneWaves

LENS = Lens((429.5, 429.5), math.hypot(859, 859) / 2, 0.005, 0.001, 0.0004, -0.0003)
STAGE = Calibration((0.2, -0.21), 0.03)
SIGMA = torch.tensor([0.004, 0.004, 1e-4], dtype=torch.float64)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    frame = Camera(size=(860, 860)).capture(PlaneWaves.random(40), torch.zeros(1, 3).double())[0, 0]
    at = 130 * torch.arange(4, dtype=torch.float64) + 230
    return Tracker(frame, torch.cartesian_prod(at, at), 31)


def path(kind: str, frames: int = 16) -> Tensor:
    """Displacements (F, 3) of the body."""
    angle = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / frames
    none = torch.zeros_like(angle)
    if kind == "circle":
        return torch.stack((180 * angle.cos(), 180 * angle.sin(), 0.05 * (2 * angle).sin()), 1)
    return torch.stack((180 * angle.cos() if kind == "x only" else none, none, none), 1)


def seen(tracker: Tracker, moved: Tensor, seed: int = 0, lens: Lens = LENS) -> Track:
    """What is found of patches behind the ``lens``: noise of the frames, and of the templates once for all."""
    layout = Layout.behind(lens, tracker.start, [range(16)], Response.of(tracker.references[0]))
    there, _ = layout.predict((layout.start + moved)[:, None].expand(-1, 16, 3))
    g = torch.Generator().manual_seed(seed)
    noise = torch.randn(len(moved) + 1, 16, 3, generator=g, dtype=torch.float64) * SIGMA / 2**0.5
    pose, none = there + noise[:1] + noise[1:], torch.zeros(len(moved), 16).double()
    covariance = torch.diag(SIGMA.square()).expand(len(moved), 16, 3, 3)
    codes = none.to(torch.int8)
    one = Estimate(pose, pose - tracker.start, none + 1, codes, codes, covariance, none, codes, none + 1, codes)
    return Track(*one)


def test_the_lens_from_a_rigid_body_alone(tracker):
    """Values and standard deviations; bodies behind it are right wherever they go."""
    errors, moved = [], path("circle")
    for seed in range(6):
        fit = calibrate(seen(tracker, moved, seed), tracker=tracker)
        found = torch.tensor(fit.lens.coefficients) - torch.tensor(LENS.coefficients)
        errors.append(found / torch.tensor([fit.sigma[name] for name in ("k1", "k2", "p1", "p2")]))
        assert 0.8 < fit.chi2 / fit.freedom < 1.2
    assert 0.5 < torch.stack(errors).square().mean() < 1.6
    grid = torch.cartesian_prod(*[torch.linspace(100, 760, 8, dtype=torch.float64)] * 2)
    off = (fit.lens.undistort(grid) - LENS.undistort(grid)) - (fit.lens.undistort(grid) - LENS.undistort(grid)).mean(0)
    assert off.square().mean().sqrt() < 0.01
    assert fit.calibration is None
    assert "k1 = 0.00" in str(fit)


def test_patches_that_are_not_of_the_body_are_left_out(tracker):
    track = seen(tracker, path("circle"))
    pose = track.pose.clone()
    pose[:, 3, 0] += 2.0
    pose[5:, 9] = tracker.start[9]
    fit = calibrate(track._replace(pose=pose), tracker=tracker)
    assert abs(fit.lens.k1 - LENS.k1) < 5 * fit.sigma["k1"]
    assert (fit.weight[:, 3] == 0).all()
    assert (fit.weight[5:, 9] == 0).all()


def test_scale_axes_and_lens_from_commanded_moves(tracker):
    moved, errors = path("circle"), []
    sent = STAGE.to_physical(moved)[:, :2] + torch.tensor([7.0, -2.0])
    sent[3] = torch.nan  # nobody knows
    truth = torch.tensor((*STAGE.scales, STAGE.axis_angle))
    for seed in range(4):
        noise = 0.01 * torch.randn(len(sent), 2, generator=torch.Generator().manual_seed(seed)).double()
        fit = calibrate(seen(tracker, moved, seed), sent + noise, tracker=tracker)
        found = torch.tensor((*fit.calibration.scales, fit.calibration.axis_angle)) - truth
        errors.append(found / torch.tensor([fit.sigma[name] for name in ("f_x", "f_y", "axis_angle")]))
    assert 0.5 < torch.stack(errors).square().mean() < 1.8
    assert 0.004 < fit.residual_um < 0.02
    track = seen(tracker, moved)
    nm = 1e3 * (track.to_um(fit.calibration).displacement[..., :2].mean(1) - STAGE.to_physical(moved)[:, :2])
    assert nm.abs().max() < 10
    plain = Calibration(fit.calibration.um_per_px, fit.calibration.axis_angle)
    assert (1e3 * (track.to_um(plain).displacement[..., :2].mean(1) - STAGE.to_physical(moved)[:, :2])).abs().max() > 10


def test_the_centre_of_a_lens_that_has_one(tracker):
    lens = Lens((400.0, 450.0), LENS.focal, 0.02)
    fit = calibrate(seen(tracker, path("circle"), lens=lens), tracker=tracker, lens=["k1", "center_x", "center_y"])
    for name, value, truth in zip(("center_x", "center_y"), fit.lens.center, lens.center, strict=True):
        assert abs(value - truth) < 5 * fit.sigma[name] < 10


@pytest.mark.parametrize(
    ("kind", "commanded", "lens", "untold"),
    [
        ("still", False, ["k1"], "k1"),
        ("still", False, ["k1", "p1"], "k1, nor p1|p1, nor k1"),
        ("x only", True, ["k1"], "f_y"),
        ("circle", False, ["k1", "center_x", "center_y", "p1", "p2"], "center_"),
        ("still", True, [], "f_"),
    ],
)
def test_moves_that_do_not_tell(tracker, kind, commanded, lens, untold):
    """By the singular values: one direction leaves the other axis open, a centre and p1, p2 go together without k1."""
    moved = path(kind)
    sent = STAGE.to_physical(moved)[:, :2] if commanded else None
    plain = Lens(LENS.center, LENS.focal)
    with pytest.raises(ValueError, match=f"calibrate: these moves do not tell .*({untold})"):
        calibrate(seen(tracker, moved, lens=plain), sent, tracker=tracker, lens=lens)


def test_one_direction_tells_what_it_tells(tracker):
    fit = calibrate(seen(tracker, path("x only")), tracker=tracker, lens=["k1"])
    assert fit.sigma["k1"] < 1e-3


def test_a_command_that_was_not_obeyed_is_named(tracker):
    moved = path("circle", 6)
    sent = STAGE.to_physical(moved)[:, :2]
    sent[2] += sent.norm(dim=1).max()
    with pytest.raises(ValueError, match=r"do not tell .*commanded positions do not fit, number 2 of .* is off by"):
        calibrate(seen(tracker, moved), sent, tracker=tracker, lens=[])


def test_wrong_calls(tracker):
    track = seen(tracker, path("circle", 5))
    for call, message in (
        (lambda: calibrate(track), "a Track needs its tracker="),
        (lambda: calibrate(track.pose[:, 0, :2]), "displacements need commanded moves"),
        (lambda: calibrate(track, tracker=tracker, lens=["k3"]), "lens must name some of k1, k2, .*, got 'k3'"),
        (lambda: calibrate(track, tracker=tracker, lens=[]), "only a lens can be told"),
        (lambda: calibrate(track, torch.zeros(4, 2), tracker=tracker), r"commanded_um must be \(5, 2\), got \(4, 2\)"),
        (lambda: calibrate(Track(*(v[:, :3] for v in track)), tracker=tracker), r"poses must be \(F, 16, 3\)"),
        (lambda: Calibration(0.2, 0.0, LENS).to_physical(track.displacement), "with a lens the pose must be known"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
