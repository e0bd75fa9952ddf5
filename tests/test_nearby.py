"""Laws of the search near the expected place, and of the tracker that tries it before it searches the whole frame."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc import Status, Tracker
from torch_ecc.core.align import solve
from torch_ecc.core.criteria import make_criterion
from torch_ecc.core.filters import blur
from torch_ecc.core.patches import cut, locate_patches
from torch_ecc.core.pose import compose
from torch_ecc.core.settings import Settings
from torch_ecc.search.nearby import HALF_WIDTH, LARGEST_ANGLE, Nearby, solved_at
from torch_ecc.sim.scene.scene import Pads, PlaneWaves
from torch_ecc.track.recover import AT_ONCE, NEARBY_AT_ONCE, Recovery

FRAME = (240, 320)
LIGHT = make_criterion("ecc", "linear")
MIDDLE = torch.tensor([160.0, 120.0, 0.0], dtype=torch.float64)


def fine(low: float = 0.0, count: int = 200) -> PlaneWaves:
    """Equal amplitudes, frequencies spread evenly from ``low`` to 0.25 cycles per px."""
    u, angle, phase = torch.rand(3, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frequency = math.tau * (low**2 + (0.25**2 - low**2) * u).sqrt()
    waves = frequency[:, None] * torch.stack(((math.tau * angle).cos(), (math.tau * angle).sin()), 1)
    return PlaneWaves(waves, 7 / waves.square().sum().div(4).sqrt().expand(count), math.tau * phase)


SCENES = {"rich": PlaneWaves.random(seed=5), "fine": fine(), "finest": fine(0.15), "pads": Pads.wafer()}


def shots(scene, *steps: tuple[float, float, float]) -> torch.Tensor:
    """Frames (F, 240, 320) uint8 of the scene on a stage at MIDDLE plus each of ``steps`` (px, px, deg)."""
    poses = MIDDLE + torch.tensor([(x, y, math.radians(turn)) for x, y, turn in steps], dtype=torch.float64)
    return scene.render(poses, FRAME)[:, 0].round().clamp(0, 255).to(torch.uint8)


def no_search(self, images, estimate, last, r):
    raise AssertionError("the whole frame was searched")


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(("noise", "edge"), [(2.0, False), (15.0, False), (6.0, True)])
def test_places_are_solved_together_as_one_by_one(count, noise, edge, monkeypatch):
    """Of one template and of several, wanted or not, at once or in parts; in dim pictures, and at an edge whose noise
    is taken for texture until it is pushed, those that are pushed too."""
    generator = torch.Generator().manual_seed(3)
    if edge:
        still = (100 + 80 * ((torch.arange(FRAME[1]) - 160.0) / 2).tanh()).expand(1, 1, *FRAME)
    else:
        still = SCENES["rich"].render(MIDDLE[None], FRAME)
    grain = torch.randn((2, 1, *FRAME), generator=generator)
    given, seen = (still + noise * (blur(grain, 0.7) if edge else grain)).split(1)
    centers = MIDDLE[:2] + torch.tensor([[0.0, 0.0], [1.0, 10.0], [-2.0, -20.0]], dtype=torch.float64)[:count]
    reference = cut(given, locate_patches("", given, centers, (61, 61), None), LIGHT)
    steps = torch.tensor([[0.0, 0.0, 0.0], [0.4, -0.3, 0.002], [70.0, 25.0, 0.1], [0.6, 0.2, 0.0]], dtype=torch.float64)
    place = torch.nn.functional.pad(centers, (0, 1))[:, None] + steps
    wanted = torch.tensor([[True, True, True, True], [True, False, True, False], [False, True, False, True]])[:count]
    monkeypatch.setattr("torch_ecc.search.nearby.SOLVED_AT_ONCE", 3)
    each = solved_at(reference, seen, place, wanted, Settings(robust=False))
    for b, k in wanted.nonzero().tolist():
        alone = solve(reference.select(torch.tensor([b])), seen, place[b, k][None], Settings(robust=False))
        for name, one, other in zip(alone._fields, alone, each, strict=True):
            assert torch.allclose(one[0].double(), other[b, k].double(), rtol=1e-6, atol=1e-7), name


@pytest.mark.parametrize("turn", [0.0, 2.4])
@pytest.mark.parametrize(
    ("name", "size"),
    [(name, size) for name in SCENES for size in [(121, 121), (60, 47), (31, 31)] if name != "pads" or size[0] > 100],
)
def test_the_first_place_is_the_right_one(name, size, turn):
    """Any size, any centre, from any pose."""
    step = torch.tensor([11.3, -8.6, math.radians(5.2)], dtype=torch.float64)
    start = MIDDLE + torch.tensor([0.0, 0.0, turn], dtype=torch.float64)
    moved = compose(start, step)
    frames = SCENES[name].render(torch.stack((MIDDLE, moved)), FRAME)
    reference = cut(frames[:1], locate_patches("", frames[:1], MIDDLE[None, :2] + 0.3, size, None), LIGHT)
    offset = torch.tensor([0.3, 0.3, 0.0], dtype=torch.float64)
    place, score = Nearby.of(reference).candidates(frames[1:], compose(start, offset)[None])
    off = (place[0, 0] - compose(moved, offset)).abs()
    assert off[:2].max() < 0.75, place
    assert off[2] < math.radians(0.75)
    assert score[0].argmax() == 0


SPAN = torch.arange(81) - 40
RADIUS = (SPAN[:, None].square() + SPAN.square()).sqrt()


@pytest.mark.parametrize("mask", [(RADIUS > 15) & (RADIUS < 39), (SPAN > 8).expand(81, 81)], ids=["ring", "one side"])
def test_light_and_what_the_mask_leaves_out_do_not_mislead(mask):
    frames = shots(fine(), (0, 0, 0), (9.2, 7.7, -6)).float()
    moved = frames[1] * torch.linspace(0.5, 1.5, FRAME[1]) + 4 * torch.arange(FRAME[1])
    moved[118:137, 160:178] = 800  # inside the ring, and left of the side
    nearby = Nearby.of(cut(frames[:1, None], locate_patches("", frames[:1, None], MIDDLE[None, :2], 81, mask), LIGHT))
    off = nearby.candidates(moved[None, None], MIDDLE[None])[0][0, 0] - MIDDLE
    assert (off[:2] - torch.tensor([9.2, 7.7])).abs().max() < 0.75
    assert abs(off[2] + math.radians(6)) < math.radians(0.75)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(
    "jump", [(5.1, -3.3, 0.0), (-9.7, 9.1, 3.3), (0.0, 0.9 * HALF_WIDTH, -0.9 * math.degrees(LARGEST_ANGLE))]
)
def test_a_near_jump_needs_no_search_of_the_frame(name, jump, monkeypatch):
    monkeypatch.setattr(Recovery, "search_anywhere", no_search)
    frames = shots(SCENES[name], (0, 0, 0), jump)
    estimate = Tracker(frames[0], MIDDLE[None, :2], 101)(frames[1])
    assert estimate.status == Status.CONVERGED
    truth = torch.tensor([*jump[:2], math.radians(jump[2])])
    assert (estimate.displacement[0] - truth).abs().max() < 0.02


@pytest.mark.parametrize("low", [0.0, 0.15])
def test_fine_texture_that_moves_farther_than_the_basin_is_never_lost(low, monkeypatch):
    """4.4 px per frame in any direction, waves of 4 px and more: no prediction helps."""
    monkeypatch.setattr(Recovery, "search_anywhere", no_search)
    angle = math.tau * torch.rand(8, generator=torch.Generator().manual_seed(1))
    walk = (4.4 * torch.stack((angle.cos(), angle.sin(), 0 * angle), -1)).cumsum(0).tolist()
    frames = shots(fine(low), (0, 0, 0), *walk)
    track = Tracker(frames[0], MIDDLE[None, :2], 121).track_sequence(frames[1:])
    assert (track.status == Status.CONVERGED).all()
    assert (track.displacement[:, 0] - torch.tensor(walk)).abs().max() < 0.01


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.35])
@pytest.mark.parametrize(("shift", "mark", "found"), [(11, 0.3, 11), (7, 0.3, 7), (11, 0.0, -7), (7, 0.0, 7)])
def test_of_places_alike_the_better_is_taken_and_of_equal_ones_the_nearer(shift, mark, found, noise):
    """Cells of 18 px, told from one another by marks of 0.3 of their contrast, or by nothing; noise, as a share of the
    contrast in template and frame, takes from the scores of both."""
    cell = fine().render(MIDDLE[None], FRAME)[0, 0, :, :18].repeat(1, 18)[:, : FRAME[1]]
    marks = mark * (fine(0.15).render(MIDDLE[None], FRAME)[0, 0] - 128)
    generator = torch.Generator().manual_seed(0)
    first, second = (
        (image + noise * cell.std() * torch.randn(FRAME, generator=generator))[None, None]
        for image in (cell + marks, (cell + marks).roll(shift, -1))
    )
    reference = cut(first, locate_patches("", first, MIDDLE[None, :2], 61, None), LIGHT)
    estimate = Nearby.of(reference).find(reference, second, MIDDLE[None], Settings())
    assert (estimate.pose - MIDDLE - torch.tensor([found, 0.0, 0.0])).abs().max() < 0.02 + 0.1 * noise


def grid(count: int) -> torch.Tensor:
    across = torch.linspace(45, 275, count)
    down = torch.linspace(45, 195, count)
    return torch.cartesian_prod(across, down).double()


def test_a_jump_of_the_camera_is_found_for_all_at_once(monkeypatch):
    monkeypatch.setattr(Recovery, "search_anywhere", no_search)
    frames = shots(fine(), (0, 0, 0), (9, -8, 0))
    count = math.isqrt(NEARBY_AT_ONCE)
    estimate = Tracker(frames[0], grid(count), 41)(frames[1])
    assert (estimate.status == Status.CONVERGED).all()
    assert (estimate.displacement - torch.tensor([9.0, -8.0, 0.0])).abs().max() < 0.02
    alone = Tracker(frames[0], grid(count)[5:6], 41)(frames[1])
    assert (alone.pose - estimate.pose[5:6]).abs().max() < 1e-4


def test_streams_of_16_bits_have_a_frame_each():
    steps = (8.3, -6.1, 2.0), (-7.7, 9.4, -3.0)
    frames = [(200 * shots(fine(), (0, 0, 0), step).to(torch.int32)).to(torch.uint16) for step in steps]
    first, second = (torch.stack([pair[k] for pair in frames])[:, None] for k in (0, 1))
    estimate = Tracker(first, MIDDLE[None, :2].expand(2, 2), 61)(second)
    assert (estimate.status == Status.CONVERGED).all()
    truth = torch.tensor([(x, y, math.radians(turn)) for x, y, turn in steps])
    assert (estimate.displacement - truth).abs().max() < 0.02


def test_how_many_are_searched_for_in_one_frame(monkeypatch):
    """Near: NEARBY_AT_ONCE; in the whole frame: AT_ONCE of those; the others have their turn."""
    near, whole = [], []

    def look(self, image, estimate, start, usual, due):
        near.append(due)
        return estimate

    def search(self, images, estimate, last, r):
        whole.append(r)
        return estimate

    monkeypatch.setattr(Recovery, "search_near", look)
    monkeypatch.setattr(Recovery, "search_anywhere", search)
    frame = shots(fine(), (0, 0, 0))[0]
    tracker = Tracker(frame, grid(9), 21)
    for k in range(3):
        tracker(255 * torch.rand(frame.shape))
        assert len(near[k]) == NEARBY_AT_ONCE
        assert len(whole) == AT_ONCE * (k + 1)
    assert len(set(whole)) == 3 * AT_ONCE


def test_a_strange_frame_is_left_as_it_is(device):
    """Nothing like the template near: no NaN, no place that is believed, on any device."""
    frame = shots(fine(), (0, 0, 0))[0]
    noise = 255 * torch.rand(FRAME, generator=torch.Generator().manual_seed(0))
    for image in (torch.zeros(FRAME), torch.full(FRAME, 255.0), noise):
        tracker = Tracker(frame, MIDDLE[None, :2], 61, device=device)
        estimate = tracker(image)
        assert not Status.good(estimate.status).any()
        place, _ = Nearby.of(tracker.references[0]).candidates(image[None, None].to(device), tracker.pose)
        assert place.isfinite().all()


@pytest.mark.parametrize("low", [0.1, 0.15, 0.2])
@pytest.mark.parametrize("size", [61, 121])
@pytest.mark.parametrize("levels", [2, 3])
def test_coarse_levels_never_lead_astray(low, size, levels):
    """Texture that coarse levels do not hold, and motion that needs none of them: found as with one level."""
    scene = fine(low)
    for step in ((0.4, -0.3, 0.3), (-0.5, 0.2, -0.2)):
        frames = shots(scene, (0, 0, 0), step)
        plain, coarse = (
            Tracker(frames[0], MIDDLE[None, :2], size, levels=n, search=False)(frames[1]) for n in (1, levels)
        )
        assert plain.status == coarse.status == Status.CONVERGED
        assert (plain.pose - coarse.pose).abs().max() < 1e-3
