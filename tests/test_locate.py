"""Laws of the global search: known poses, equivariance, invariances, masks, ambiguity, recoveries, the command line."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner

from torch_ecc import Locator, Status, Tracker, align, locate, prepare
from torch_ecc.cli import app
from torch_ecc.commands.track import Session, TrackJob
from torch_ecc.core.pose import compose, inverse
from torch_ecc.search.locate import (
    FEWEST,
    GRID_MARGIN,
    aligned,
    detrended_zncc_at,
    image_pyramid,
    pose_distance,
    shortlist,
)
from torch_ecc.sim import Camera, GradientLight, PlaneWaves, Speckle, micrograph
from torch_ecc.track.recover import Recovery

SIZE = (200, 260)
SCENE = PlaneWaves.random(seed=5)


def rows(*poses: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(poses, dtype=torch.float64)


def shot(scene, pose: torch.Tensor, *, noise: float = 0.0, light=None, seed: int = 0, size=SIZE) -> torch.Tensor:
    """Frames (B, 1, h, w) uint8 of a scene at poses (B, 3)."""
    return Camera(size=size, noise_sigma=noise, light=light).capture(scene, pose, seed=seed)


def crop(scene, side: int = 61, **options) -> torch.Tensor:
    """The scene's middle, (1, 1, side, side)."""
    half = (side - 1) / 2
    return shot(scene, rows((half, half, 0)), size=(side, side), **options)


def anywhere(count: int, seed: int, margin: float = 40.0, size=SIZE) -> torch.Tensor:
    u = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    h, w = size
    x, y = margin + u[:, 0] * (w - 1 - 2 * margin), margin + u[:, 1] * (h - 1 - 2 * margin)
    return torch.stack((x, y, (u[:, 2] - 0.5) * math.tau), -1)


def error(found: torch.Tensor, truth: torch.Tensor) -> tuple[float, float]:
    """Largest px and deg."""
    step = found - truth
    turn = torch.remainder(step[..., 2] + math.pi, math.tau) - math.pi
    return float(step[..., :2].norm(dim=-1).max()), math.degrees(float(turn.abs().max()))


@pytest.mark.parametrize(
    "scene",
    [SCENE, micrograph(), Speckle.random(), Speckle.random(count=250_000, sigmas=(0.7, 1.0), seed=1)],
    ids=["waves", "micrograph", "speckle", "fine speckle"],
)
def test_finds_any_pose_in_noise_and_uneven_light(scene):
    """Within 1 px and 1 deg before the last refinement, and then as good as tracking from the truth."""
    light = GradientLight(scale_px=320)
    reference = prepare(crop(scene, 81, noise=5.0))
    locator = Locator(reference, SIZE)
    for k, pose in enumerate(anywhere(6, seed=3, margin=58)):
        frame = shot(scene, pose[None], noise=5.0, light=light, seed=k + 1)
        found = locator(frame)
        assert found.status == Status.CONVERGED
        assert not found.ambiguous
        assert -1 < found.runner_up_score < found.score  # the next best, however bad, is told
        px, deg = error(found.pose - found.estimate.displacement, pose)
        assert px < 1
        assert deg < 1
        tracked = align(reference, frame, pose[None])
        assert error(found.pose, tracked.pose)[0] < 2e-3
        assert abs(float(found.pose[0, 2])) <= math.pi


@pytest.mark.parametrize("scene", [SCENE, micrograph(), Speckle.random()], ids=["waves", "micrograph", "speckle"])
def test_half_way_between_pixels_and_angles_the_target_loses_less_than_the_margin(scene):
    """A rival on the grid that looks exactly like the template does not drive it off the list of candidates."""
    locator = Locator(prepare(crop(scene, 81, noise=3.0)), SIZE)
    level, bank = locator.levels - 1, locator.banks[0]
    reference, scale = locator.pyramids[0][level], torch.tensor([2.0**level, 2.0**level, 1.0]).double()
    for k in (2, 11, 25):
        middle = torch.tensor([30.5 + k, 45.5, float(bank.angles[k : k + 2].mean())]).double()
        image = image_pyramid(shot(scene, (middle * scale)[None], noise=3.0, seed=k).float(), level + 1)[level]
        pose, score = bank.candidates(image[0, 0], 100)
        near = pose_distance(pose, middle, radius=reference.place.radius) < 4
        assert score[near].max() > detrended_zncc_at(reference, image, middle[None]) - GRID_MARGIN


RING = torch.hypot(*torch.meshgrid(*(torch.arange(91) - 45.0,) * 2, indexing="ij")).sub(34).abs() < 10
FINE = Speckle.random(count=250_000, sigmas=(0.7, 1.0), seed=1)


@pytest.mark.parametrize("mask", [None, RING], ids=["all", "ring"])
@pytest.mark.parametrize("scene", [SCENE, micrograph(), FINE], ids=["waves", "micrograph", "fine speckle"])
def test_the_bank_tells_the_zncc_and_half_way_between_angles_less_by_no_more_than_the_margin(scene, mask):
    """On a pixel of the level, whatever the mask."""
    locator = Locator(prepare(crop(scene, 91), mask=mask), SIZE)
    level, bank = locator.levels - 1, locator.banks[0]
    reference, scale = locator.pyramids[0][level], torch.tensor([2.0**level, 2.0**level, 1.0]).double()
    angle = bank.angles[7:9]
    for loss, turn in ((0.03, angle[0]), (0.03, angle[1]), (GRID_MARGIN, angle.mean())):
        pose = torch.stack((torch.tensor(120 // 2**level), torch.tensor(100 // 2**level), turn))[None].double()
        image = image_pyramid(shot(scene, pose * scale).float(), level + 1)[level]
        found, score = bank.candidates(image[0, 0], 20)
        near = pose_distance(found, pose, radius=reference.place.radius) < 6
        assert float(score[near].max()) == pytest.approx(float(detrended_zncc_at(reference, image, pose)), abs=loss)


def test_the_shortlist_is_what_may_still_be_best():
    """s >= max(LEAST_SCORE, s_best - margin) or among the FEWEST best, and of poses within SUPPRESSION px the best."""
    n, radius = 40, torch.tensor(20.0).double()
    score = torch.linspace(0.9, 0.5, n)
    pose = torch.stack((10.0 * torch.arange(n), torch.zeros(n), torch.zeros(n)), -1).double()
    assert shortlist(pose, score, radius=radius, margin=0.2).tolist() == list(range(20))
    assert shortlist(pose, score - 0.4, radius=radius, margin=0.3).tolist() == list(range(20))  # of them none below 0.3
    assert shortlist(pose, score - 0.8, radius=radius, margin=0.3).tolist() == list(range(FEWEST))
    mixed = torch.randperm(n, generator=torch.Generator().manual_seed(0))
    assert (score[mixed][shortlist(pose[mixed], score[mixed], radius=radius, margin=1.0)].diff() < 0).all()
    twins = torch.cat((pose, pose + torch.tensor([0.5, 0.0, math.tau + 0.9 / 20]), pose + torch.tensor([0, 2.0, 0.0])))
    kept = shortlist(twins, torch.cat((score, score - 0.01, score - 0.011)), radius=radius, margin=1.0)
    assert sorted(kept.tolist()) == [*range(n), *range(2 * n, 3 * n)]  # 0.5 + 0.9 px are one pose, 2 px are another


def test_a_move_of_the_frame_moves_the_answer():
    reference, pose = prepare(crop(SCENE)), rows((120.3, 95.6, 0.4))
    first = locate(reference, shot(SCENE, pose)).pose
    for move in anywhere(4, seed=7):
        moved = locate(reference, shot(SCENE, compose(move[None], compose(inverse(pose), pose)))).pose
        expected = compose(compose(move[None], inverse(pose)), first)
        assert error(moved, expected)[0] < 0.02
        assert error(moved, expected)[1] < 0.02


def test_whole_px_and_quarter_turns_are_exact():
    """The same pixels elsewhere: nothing is interpolated, so the answer moves by exactly that."""
    frame = shot(SCENE, rows((110, 90, 0.7)))[0, 0]
    reference = prepare(crop(SCENE))
    base = locate(reference, frame).pose[0]
    shifted = locate(reference, frame.roll((6, -9), (0, 1))).pose[0]
    assert torch.allclose(shifted - base, torch.tensor([-9.0, 6.0, 0.0]).double(), atol=2e-3)
    turned = locate(reference, torch.rot90(frame)).pose[0]  # counter-clockwise: theta grows by a quarter
    assert error(turned, torch.stack((base[1], SIZE[1] - 1 - base[0], base[2] + math.pi / 2)))[0] < 2e-3
    assert error(turned, torch.stack((base[1], SIZE[1] - 1 - base[0], base[2] + math.pi / 2)))[1] < 2e-3


@pytest.mark.parametrize(("gain", "offset"), [(0.2, 0.0), (1.0, 1000.0), (250.0, -3000.0)])
def test_gain_and_offset_change_nothing(gain, offset):
    reference, frame = prepare(crop(SCENE)), shot(SCENE, rows((150, 80, -2.1))).float()
    plain, other = locate(reference, frame), locate(reference, frame * gain + offset)
    assert (plain.pose - other.pose).abs().max() < 1e-3
    assert (plain.score - other.score).abs().max() < 1e-3


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float16, torch.float32, torch.float64])
def test_every_dtype_gives_the_same(dtype):
    reference, frame = prepare(crop(SCENE)), shot(SCENE, rows((150, 80, -2.1)))
    found = locate(reference, frame.to(dtype))
    assert found.pose.dtype == torch.float64
    assert (found.pose - locate(reference, frame).pose).abs().max() < 1e-6


@pytest.mark.parametrize("shape", ["disc", "ring", "corner"])
def test_what_the_mask_leaves_out_does_not_matter(shape):
    """Neither in the template nor around the target in the frame."""
    side = 71
    y, x = torch.meshgrid(*(torch.arange(side) - 35.0,) * 2, indexing="ij")
    r = torch.hypot(x, y)
    mask = {"disc": r < 30, "ring": (r < 34) & (r > 14), "corner": (x < 5) | (y < -10)}[shape]
    template = crop(SCENE, side).float()
    dirty = torch.where(mask, template, 255 * torch.rand(side, side, generator=torch.Generator().manual_seed(0)))
    pose = rows((130.4, 99.7, 2.5))
    frame = shot(SCENE, pose).float()
    gy, gx = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    local = compose(inverse(pose), torch.stack((gx, gy, 0 * gx), -1).double())
    column, row = ((local[..., k] + 35).round().long() for k in (0, 1))
    framed = (column >= 0) & (column < side) & (row >= 0) & (row < side)
    shown = framed & mask[row.clamp(0, side - 1), column.clamp(0, side - 1)]
    other = PlaneWaves.random(seed=77).render(rows((0, 0, 0)), SIZE)
    composed = torch.where(torch.nn.functional.max_pool2d(shown.float()[None, None], 3, 1, 1) > 0, frame, other)
    clean = locate(prepare(template, mask=mask), composed)
    soiled = locate(prepare(dirty, mask=mask), composed)
    assert error(clean.pose, pose)[0] < 0.05
    assert error(soiled.pose, pose)[0] < 0.1  # its gradients at the mask's border are another's


def test_partly_outside():
    reference = prepare(crop(SCENE, 81))
    for pose in (rows((20, 100, 1.0)), rows((130, 185, -2.0)), rows((245, 90, 3.0))):
        found = locate(reference, shot(SCENE, pose))
        assert found.status == Status.CONVERGED
        assert error(found.pose, pose)[0] < 0.05


@pytest.mark.parametrize(("visible", "scored"), [(0.45, True), (0.35, False)])
def test_four_tenths_of_a_template_must_be_in_the_frame(visible, scored):
    """With less the score is -1, and no answer is given."""
    pose = rows((81 * (visible - 0.5), 100, 0))  # beyond the left border, upright
    reference, frame = prepare(crop(SCENE, 81)), shot(SCENE, pose)
    score = detrended_zncc_at(reference, frame.float(), pose)
    assert (score > 0.95) if scored else (score == -1)
    if not scored:
        assert not Status.good(locate(reference, frame).status)


def waves(low: float, high: float) -> PlaneWaves:
    """Equal amplitudes, frequencies from ``low`` to ``high`` cycles per px."""
    u, phase = torch.rand(2, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    angle, frequency = math.tau * torch.arange(100) / 100, math.tau * (low + (high - low) * u[:, None])
    direction = torch.stack((angle.cos(), angle.sin()), -1)
    return PlaneWaves(frequency * direction, torch.full((100,), 3.0).double(), math.tau * phase)


@pytest.mark.parametrize(("low", "high", "level"), [(0.2, 0.25, 0), (0.02, 0.06, 2)])
def test_the_level_that_is_searched_is_the_coarsest_that_holds_the_texture(low, high, level):
    """Waves of 4 to 5 px are gone one level up, but for noise; waves of 16 px and more are there two levels up."""
    scene, pose = waves(low, high), rows((170.4, 110.7, 2.1))
    locator = Locator(prepare(crop(scene, 121, noise=2.0)), (240, 320))
    assert locator.levels - 1 == level
    assert error(locator(shot(scene, pose, noise=2.0, seed=1, size=(240, 320))).pose, pose)[0] < 0.05


@pytest.mark.parametrize("quarters", [0, 1, 3])
def test_a_template_that_is_flat_but_in_its_corners_is_found(quarters):
    tile = crop(waves(0.2, 0.25), 101)[0, 0].float()
    y, x = torch.meshgrid(*(torch.arange(101) - 50.0,) * 2, indexing="ij")
    tile[torch.hypot(x, y) < 56] = 128.0
    frame = waves(0.19, 0.24).render(rows((0, 0, 0)), (240, 320))[0, 0].float()
    frame[60:161, 130:231] = torch.rot90(tile, quarters)
    locator = Locator(prepare(tile), (240, 320))
    found, _ = locator.candidates(image_pyramid(frame[None, None], locator.levels), 0)  # without the matched filter
    assert error(found.pose[:1], rows((180, 110, quarters * math.pi / 2)))[0] < 0.05


def test_aligning_makes_no_candidate_worse():
    """From starts of which some are beyond reach: a step that led to a lower score is not taken."""
    scene, pose = waves(0.1, 0.2), rows((130, 100, 0.5))
    reference, image = prepare(crop(scene)), shot(scene, pose).float()
    u = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    for start in pose + u * torch.tensor([24.0, 24.0, 0.5]):  # one by one: none is suppressed
        moved = aligned(reference, image, start[None])
        before, after = (detrended_zncc_at(reference, image, p) for p in (start[None], moved))
        assert after >= before


def grating(period: float = 9.0) -> torch.Tensor:
    x = torch.arange(SIZE[1], dtype=torch.float64).expand(SIZE)
    return 128 + 60 * (math.tau * x / period).sin()


def dots(period: float = 13.0) -> torch.Tensor:
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SIZE), indexing="ij")
    return 128 + 40 * ((math.tau * x / period).sin() + (math.tau * (y + 0.3 * x) / period).sin())


def fourfold(scene, side: int = 81) -> torch.Tensor:
    """A frame with one target that looks the same after every quarter turn."""
    tile = crop(scene, side)[0, 0].float()
    tile = sum(torch.rot90(tile, k) for k in range(4)) / 4
    frame = PlaneWaves.random(seed=31).render(rows((0, 0, 0)), SIZE)[0, 0]
    frame[60 : 60 + side, 80 : 80 + side] = tile
    return frame


def twins() -> torch.Tensor:
    """Two equal objects in one frame."""
    frame = PlaneWaves.random(seed=31).render(rows((0, 0, 0)), SIZE)[0, 0]
    for x in (20, 150):
        frame[70:131, x : x + 61] = crop(SCENE)[0, 0]
    return frame


AMBIGUOUS = {
    "grating": (grating(), (slice(60, 121), slice(90, 151))),
    "dots": (dots(), (slice(60, 121), slice(90, 151))),
    "fourfold": (fourfold(SCENE), (slice(60, 141), slice(80, 161))),
    "twins": (twins(), (slice(70, 131), slice(20, 81))),
}


@pytest.mark.parametrize("noise", [0.0, 5.0])
@pytest.mark.parametrize("name", AMBIGUOUS)
def test_ambiguity_is_told(name, noise):
    frame, window = AMBIGUOUS[name]
    generator = torch.Generator().manual_seed(1)
    template, image = (f + noise * torch.randn(f.shape, generator=generator) for f in (frame[window], frame))
    found = locate(prepare(template), image)
    assert found.ambiguous
    if name != "grating":
        assert found.runner_up_score > found.score - 0.02
    if name == "fourfold":
        turn = math.degrees(float(found.pose[0, 2] - found.runner_up.pose[0, 2]))
        assert turn % 90 == pytest.approx(0, abs=1) or turn % 90 == pytest.approx(90, abs=1)
        assert (found.pose - found.runner_up.pose)[0, :2].norm() < 1
    if name == "twins":
        assert abs(float(found.pose[0, 0] - found.runner_up.pose[0, 0])) == pytest.approx(130, abs=0.1)


@pytest.mark.parametrize(
    ("noise", "mark", "ambiguous"),
    [
        *[(0.0, 0.08, True), (0.0, 0.2, False)],  # ZNCC lacks to 1, second against first: 0.003 to 0, 0.02 to 0
        *[(0.2, 0.1, True), (0.2, 0.35, False)],  # 0.042 to 0.038, 0.09 to 0.038
        *[(0.3, 0.25, True), (0.3, 0.45, False)],  # 0.103 to 0.08, 0.15 to 0.08
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_look_alike_is_told_from_the_target_by_what_noise_leaves_of_the_difference(noise, mark, ambiguous, seed):
    """A twin with ``mark`` of the contrast in marks of its own; noise in template and frame takes from both scores."""
    tile, other = (crop(PlaneWaves.random(seed=s))[0, 0].float() for s in (5, 12))
    marks = mark * (other - other.mean()) * tile.std() / other.std()
    frame = PlaneWaves.random(seed=31).render(rows((0, 0, 0)), SIZE)[0, 0].float()
    frame[70:131, 20:81], frame[70:131, 150:211] = tile, tile + marks
    generator = torch.Generator().manual_seed(seed)
    template, image = (f + noise * tile.std() * torch.randn(f.shape, generator=generator) for f in (tile, frame))
    found = locate(prepare(template), image)
    assert bool(found.ambiguous) == ambiguous
    assert error(found.pose, rows((50, 100, 0)))[0] < 0.05
    assert error(found.runner_up.pose, rows((180, 100, 0)))[0] < 0.5  # its marks pull


def test_near_tells_which_of_two_is_meant():
    locator = Locator(prepare(crop(SCENE)), SIZE)
    for x in (50.0, 180.0):
        found = locator(twins(), torch.tensor([[x + 12, 80.0]]))
        assert error(found.pose, rows((x, 100, 0)))[0] < 0.05
        assert found.ambiguous


def test_what_is_not_there_is_not_found():
    found = locate(prepare(crop(SCENE)), PlaneWaves.random(seed=99).render(rows((0, 0, 0)), SIZE))
    assert not Status.good(found.status)
    assert found.pose.isfinite().all()
    blank = locate(prepare(crop(SCENE)), torch.full(SIZE, 90.0))
    assert not Status.good(blank.status)
    assert not any(value.isnan().any() for value in (*blank.estimate, blank.score, blank.runner_up_score))


def test_a_batch_is_what_each_gives_alone():
    scenes = [PlaneWaves.random(seed=s) for s in (5, 6, 7)]
    truth = anywhere(3, seed=2)
    templates = torch.cat([crop(scene) for scene in scenes])
    frames = torch.cat([shot(scene, pose[None]) for scene, pose in zip(scenes, truth, strict=True)])
    found = locate(prepare(templates), frames)
    assert found.pose.shape == found.runner_up.pose.shape == (3, 3)
    assert found.score.shape == found.ambiguous.shape == found.status.shape == (3,)
    assert found.estimate.covariance.shape == (3, 3, 3)
    assert error(found.pose, truth)[0] < 0.02
    for b in range(3):
        alone = locate(prepare(templates[b : b + 1]), frames[b : b + 1])
        assert (alone.pose[0] - found.pose[b]).abs().max() < 1e-4
    shared = locate(prepare(templates[:1].expand(2, -1, -1, -1)), frames[:1])
    assert (shared.pose[0] - shared.pose[1]).abs().max() < 1e-5


def test_everything_is_on_one_device(device):
    reference = prepare(crop(SCENE).to(device))
    found = locate(reference, shot(SCENE, rows((150, 80, -2.1))).to(device))
    assert all(value.device.type == device.type for value in (*found.estimate, found.score, found.ambiguous))
    assert error(found.pose.cpu(), rows((150, 80, -2.1)))[0] < 0.02


FRAME = shot(SCENE, rows((110, 90, 0.7)))
CALLS = {
    "reference": (lambda r: locate(FRAME, FRAME), "locate: reference must come from prepare, got Tensor"),
    "shape": (lambda r: locate(r, torch.zeros(3)), r"locate: image must be \(H, W\), .*, got \(3,\)"),
    "nan": (lambda r: locate(r, FRAME * math.nan), "locate: image must be finite"),
    "batch": (
        lambda r: locate(r, FRAME.expand(2, -1, -1, -1)),
        r"image must be 1 of 260x200 px, got \(2, 1, 200, 260\)",
    ),
    "size": (lambda r: Locator(r, (90, 90))(FRAME), r"locate: image must be 1 of 90x90 px, got \(1, 1, 200, 260\)"),
    "near": (lambda r: Locator(r, SIZE)(FRAME, torch.zeros(2)), r"near must be \(1, 2\) or \(1, 3\), got \(2,\)"),
    "interpolation": (lambda r: locate(r, FRAME, interpolation="nearest"), "interpolation: expected one of"),
    "score": (lambda r: locate(r, FRAME, min_score=-1.0), "min_score: expected a number from 0 to 1, got -1"),
}


@pytest.mark.parametrize("name", CALLS)
def test_says_what_was_wrong(name):
    call, message = CALLS[name]
    with pytest.raises(ValueError, match=message):
        call(prepare(crop(SCENE)))


def recover(path: torch.Tensor, visible: list[bool]) -> tuple[list[bool], torch.Tensor]:
    """Whether each frame of a path (F, 3) is tracked, and the poses: where it is not visible, another scene is."""
    other = PlaneWaves.random(seed=41).render(rows((0, 0, 0)), SIZE)[0]
    frames = [f if seen else other for f, seen in zip(shot(SCENE, path, noise=2.0), visible, strict=True)]
    start = crop(SCENE, 61)
    tracker, found = Tracker.find(start, frames[0])
    assert found.status == Status.CONVERGED
    track = tracker.track_sequence(frames)
    return Status.good(track.status[:, 0]).tolist(), track.pose[:, 0]


def test_a_jump_of_100_px_and_60_deg():
    path = rows(*[(70.0 + k, 90, 3.0) for k in range(4)], *[(174.0 - k, 110, 3.0 + math.radians(60)) for k in range(4)])
    tracked, pose = recover(path, [True] * 8)
    assert all(tracked)
    assert (pose - path).abs().max() < 0.02  # theta too: 3.0 + 60 deg is past pi, and not wrapped


def test_twenty_frames_of_occlusion():
    path = rows(*[(70.0 + 3 * k, 90 + k, 0.1 * k) for k in range(28)])
    visible = [k < 3 or k >= 23 for k in range(28)]
    tracked, pose = recover(path, visible)
    assert tracked[:3] == [True] * 3
    assert not any(tracked[3:23])
    assert all(tracked[24:])
    assert (pose[24:] - path[24:]).abs().max() < 0.02


def test_leaving_and_entering_elsewhere():
    away = [(300.0, 300.0, 0.0)] * 6
    path = rows(
        (200, 150, 0.2), (212, 160, 0.2), (224, 170, 0.2), *away, (60, 70, -1.0), (62, 71, -1.1), (64, 72, -1.2)
    )
    tracked, pose = recover(path, [True] * 12)
    assert all(tracked[10:])
    assert (pose[10:] - path[10:]).abs().max() < 0.02


def other() -> torch.Tensor:
    """A frame of nothing but grain."""
    return 255 * torch.rand(SIZE, generator=torch.Generator().manual_seed(0))


def test_a_lost_template_is_searched_for_ever_more_seldom(monkeypatch):
    frames = shot(SCENE, rows((110, 95, 0)))
    tracker = Tracker(frames, [(110.0, 95.0), (60.0, 60.0)], 41)
    searched: list[int] = []
    monkeypatch.setattr(Recovery, "search_anywhere", lambda self, images, found, last, r: searched.append(r) or found)
    total = [0]
    for _ in range(80):
        tracker(other())
        total.append(len(searched))
    count = [(total[a + 16] - total[a]) / 2 for a in (0, 16, 32, 48, 64)]
    assert count[0] == 16
    assert count == sorted(count, reverse=True)
    assert count[-1] <= 4
    assert (tracker(frames).status >= 0).all()


def test_many_lost_templates_come_in_turn(monkeypatch):
    frames = shot(SCENE, anywhere(1, seed=0, margin=90))
    centers = [(x, y) for x in range(30, 230, 20) for y in (40.0, 160.0)]
    tracker = Tracker(frames, centers, 25)
    searched: list[int] = []
    monkeypatch.setattr(Recovery, "search_anywhere", lambda self, images, found, last, r: searched.append(r) or found)
    tracker(other())
    assert len(searched) == 4
    for _ in range(5):
        tracker(other())
    assert set(searched) == set(range(20))


@pytest.fixture
def video(tmp_path):
    path = rows(*[(150 + 2 * k, 80.0 + k, -2.0 + 0.05 * k) for k in range(5)])
    np.save(tmp_path / "video.npy", shot(SCENE, path)[:, 0].numpy())
    cv2.imwrite(str(tmp_path / "crop.png"), crop(SCENE)[0, 0].numpy())
    cv2.imwrite(str(tmp_path / "other.png"), crop(PlaneWaves.random(seed=3))[0, 0].numpy())
    cv2.imwrite(str(tmp_path / "small.png"), crop(SCENE, 51)[0, 0].numpy())
    np.save(tmp_path / "twins.npy", twins()[None].byte().numpy())
    return tmp_path, path


def test_the_command_finds_a_template(video):
    folder, path = video
    options = ["track", str(folder / "video.npy"), "--template", str(folder / "crop.png"), "--out", str(folder / "out")]
    done = CliRunner().invoke(app, options)
    assert done.exit_code == 0, done.output
    with np.load(folder / "out" / "track.npz") as track:
        pose = torch.from_numpy(track["pose"][:, 0])
        assert (track["status"] == 0).all()
    assert (pose - path).abs().max() < 0.02


def job(folder, **options):
    return TrackJob(input=str(folder / "video.npy"), out=str(folder / "out"), **options)


def test_the_command_refuses_what_it_cannot_tell(video):
    folder, _ = video
    template = (str(folder / "crop.png"),)
    wrong = {
        "number 0 is not in the first frame .*score 0": {"template": (str(folder / "other.png"),)},
        "size: not with template": {"template": template, "size": 41},
        "reference: not with template": {"template": template, "reference": "x.png"},
        r"expected images of one size, got \['51x51', '61x61'\] px": {
            "template": (*template, str(folder / "small.png"))
        },
        r"centers: expected one per template \(1\), got 2": {"template": template, "centers": ((1.0, 2.0), (3.0, 4.0))},
    }
    for message, options in wrong.items():
        with pytest.raises(ValueError, match=message):
            Session(job(folder, **options))
    doubtful = TrackJob(input=str(folder / "twins.npy"), template=template)
    with pytest.raises(ValueError, match=r"may be at x=.*, theta=.* or at x=.*a center tells which one is meant"):
        Session(doubtful)
    told = Session(TrackJob(input=str(folder / "twins.npy"), template=template, centers=((170.0, 90.0),)))
    assert error(told.tracker.pose, rows((180, 100, 0)))[0] < 0.05
