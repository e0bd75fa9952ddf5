"""Laws of templates that learn: a mean is less noisy, a surface that changes is followed, a cover is not learned, and
nothing adds up."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torch_ecc import Status, Tracker
from torch_ecc.core.reference import MARGIN
from torch_ecc.sim import Pads, PlaneWaves, Scene
from torch_ecc.track.ages import UNEVEN, averaged_by, placed
from torch_ecc.track.lessons import AGES, Lessons, shifted

FRAME, SIZE = (110, 120), 61
START = (60.0, 54.0)


def path(count: int) -> Tensor:
    """Poses (F, 3) that never lie alike between pixels, upright on a whole pixel at first."""
    swing = (math.tau * torch.arange(count, dtype=torch.float64) / 23).sin()
    return torch.stack((START[0] + 5.3 * swing, START[1] - 3.7 * swing, math.radians(2) * swing), -1)


def noisy(image: Tensor, number: int, noise: float) -> Tensor:
    """A frame (h, w) of (1, 1, h, w)."""
    return (image + noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(number)))[0, 0]


def film(count: int, noise: float, lost: float = 0.0, seed: int = 3) -> list[Tensor]:
    """Frames of a surface that loses a share of its texture in each, and gets other texture for it."""
    old, new = PlaneWaves.random(seed=seed), PlaneWaves.random(seed=seed + 50)
    images = []
    for k, pose in enumerate(path(count)):
        share = min(k * lost, 1.0)
        image = (1 - share) * old.render(pose[None], FRAME)
        images.append(noisy(image if share == 0 else image + share * new.render(pose[None], FRAME), k, noise))
    return images


def tracked(frames: list[Tensor], **options) -> tuple[Tracker, Tensor, Tensor]:
    """The tracker, its errors (F - 1, 3) and their sigma."""
    tracker = Tracker(frames[0], [START], SIZE, **{"search": False, **options})
    track = tracker.track_sequence(frames[1:])
    assert bool((track.status == Status.CONVERGED).all())
    return tracker, track.pose[:, 0] - path(len(frames))[1:], track.sigma[:, 0]


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_a_mean_of_frames_is_as_much_less_noisy(backend: str) -> None:
    """Nine frames leave a third of the noise."""
    frames = film(60, 10.0)
    tracker, error, sigma = tracked(frames, average=9, backend=backend)
    clean = PlaneWaves.random(seed=3).render(path(1), FRAME)[0, 0]
    x, y, half = int(START[0]), int(START[1]), SIZE // 2
    there = clean[y - half : y + half + 1, x - half : x + half + 1] - 128
    left = tracker.template[0, 0, MARGIN:-MARGIN, MARGIN:-MARGIN] - 128 - there
    assert 2.5 < float((left - there * (left * there).mean() / there.square().mean()).std()) < 3.8
    assert float(tracker.lesson_frames) == 9
    assert float((error / sigma).square().mean().sqrt()) < 1.6


@pytest.mark.parametrize(("speed", "share"), [((0.0, 0.0, 0.0), 1 / 16), ((0.6, -0.4, 0.002), 0.23)])
def test_what_stood_still_or_moved_evenly_lies_where_all_frames_have_it(speed: tuple, share: float) -> None:
    """Over many draws of the first frames, where the template lies is uncertain by that share of one frame's noise."""
    along = torch.tensor(speed, dtype=torch.float64)
    path = torch.tensor((*START, 0.0)).double() + torch.arange(17).double()[:, None] * along
    clean, start = [PlaneWaves.random(seed=3).render(pose[None], FRAME) for pose in path], [START]
    left, plain = [], []
    for draw in range(12):
        frames = [noisy(image, 100 * draw + k, 8.0) for k, image in enumerate(clean)]
        trackers = [Tracker(frames[0], start, SIZE, search=False, average=n) for n in (16, 1)]
        for errors, tracker in zip((left, plain), trackers, strict=True):
            tracker.track_sequence(frames[1:16])
            errors.append(tracker(clean[16][0, 0]).pose[0] - path[16])
        assert float(trackers[0].lesson_share) == pytest.approx(share, abs=0.2 if share < 0.1 else 0.01)
    ratio = torch.stack(left).square().mean(0) / torch.stack(plain).square().mean(0)
    assert float(ratio.mean()) < 2 * share + 0.1


def test_what_moved_unevenly_lies_where_the_first_frame_has_it() -> None:
    """Nothing else tells where it was then."""
    tracker, _, _ = tracked(film(12, 5.0), average=10)
    assert float(tracker.lesson_share) == 1


def test_a_surface_that_changes_is_followed() -> None:
    """Within what sigma says; what follows only the first frame loses it."""
    frames = film(100, 2.0, 1 / 80)
    tracker, error, sigma = tracked(frames, renew=5)
    assert float((error / sigma).square().mean().sqrt()) < 2.5
    assert float(error[:, :2].abs().max()) < 0.25
    assert float(sigma[-1, 0]) > 3 * float(sigma[0, 0])
    alone = Tracker(frames[0], [START], SIZE, search=False).track_sequence(frames[1:])
    assert bool((alone.status == Status.LOST).any())
    assert int(tracker.lesson_rounds) == 20


def test_what_does_not_change_stays_where_it_is() -> None:
    """Forty times anew, and not a thousandth of a pixel off on average; the first mean to the last bit what it was."""
    still = PlaneWaves.random(seed=4).render(path(1), FRAME)
    tracker = Tracker(noisy(still, 0, 2.0), [START], SIZE, renew=5)
    early = [tracker(noisy(still, k, 2.0)).pose[0] for k in range(1, 6)]
    first, place = tracker.lesson_older[:, 0].clone(), tracker.lesson_places[:, 0].clone()
    pose = torch.stack([*early, *(tracker(noisy(still, k, 2.0)).pose[0] for k in range(6, 201))])
    assert int(tracker.lesson_rounds) == 40
    assert torch.equal(tracker.lesson_older[:, 0], first)
    assert torch.equal(tracker.lesson_places[:, 0], place)
    drift = pose[100:].mean(0) - pose[5:105].mean(0)
    assert float(drift[:2].abs().max()) < 2e-3
    assert int(tracker.lesson_held) == AGES


def test_the_first_frame_stays_among_what_later_ones_are_placed_by() -> None:
    """As it was, first of all, and as far off as those that were placed by it, if these tell it."""
    still = [noisy(PlaneWaves.random(seed=3).render(path(1), FRAME), k, 6.0) for k in range(17)]
    tracker = Tracker(still[0], [START], SIZE, search=False, renew=8)
    first = tracker.template.clone()
    tracker.track_sequence(still[1:])
    assert int(tracker.lesson_held) == 3
    assert torch.equal(tracker.lesson_older[:, 0], first[:, 0])
    one, mean = tracker.lesson_places[0, :2, :2]
    assert float(one.norm()) > 1e-4  # it was off by its noise
    assert float((mean - one).norm()) < float(one.norm())


@pytest.mark.parametrize("level", [0.0, 240.0])
@pytest.mark.parametrize("moving", [False, True])
def test_a_cover_is_not_learned(level: float, moving: bool) -> None:
    """A strip that lies over it for three rounds leaves the template as it was beneath."""
    frames = film(60, 2.0) if moving else [film(1, 2.0)[0]] * 60
    for k, frame in enumerate(frames):
        if 12 <= k < 48:
            frames[k] = frame.clone()
            frames[k][50:57, 20:95] = level
    tracker = Tracker(frames[0], [START], SIZE, renew=10)
    before = tracker.template.clone()
    track = tracker.track_sequence(frames[1:])
    assert int(tracker.lesson_rounds) >= 3
    assert bool((track.status == Status.CONVERGED).all())
    changed = (tracker.template - before)[0, 0, MARGIN:-MARGIN, MARGIN:-MARGIN]
    assert float(changed.abs().max()) < 12  # its contrast is 40, that of the strip 100


def test_a_cover_that_creeps_is_not_learned() -> None:
    """Half a pixel per frame."""
    frames = [frame.clone() for frame in film(60, 2.0)]
    for k in range(10, 60):
        frames[k][:, 28 : 28 + (k - 10) // 2] = 30.0
    tracker = Tracker(frames[0], [START], SIZE, renew=10)
    before = tracker.template.clone()
    tracker.track_sequence(frames[1:])
    assert float((tracker.template - before)[..., MARGIN:-MARGIN, MARGIN:-MARGIN].abs().max()) < 20


@pytest.mark.parametrize("criterion", ["ecc", "ecc_paper"])
def test_light_is_not_learned(criterion: str) -> None:
    """Frames of another gain and offset each: the mean is in the first frame's light."""
    frames = [(0.7 + 0.05 * (k % 9)) * frame + k % 7 for k, frame in enumerate(film(10, 1.0))]
    tracker = Tracker(frames[0], [START], SIZE, average=10, criterion=criterion)
    before = tracker.template.clone()
    tracker.track_sequence(frames[1:])
    assert int(tracker.lesson_rounds) == 1
    assert float((tracker.template - before).std()) < 1.3


def test_each_template_learns_by_itself() -> None:
    """One that is covered waits; the other does not, and both are what they would be alone."""
    frames = [frame.clone() for frame in film(9, 2.0)]
    for k in range(2, 5):
        frames[k][:, 62:] = 100.0
    places = [(40.0, 50.0), (80.0, 56.0)]
    both = Tracker(frames[0], places, 31, average=6, search=False)
    alone = [Tracker(frames[0], [place], 31, average=6, search=False) for place in places]
    for tracker in (both, *alone):
        tracker.track_sequence(frames[1:])
    assert both.lesson_rounds.tolist() == [1, 1]
    for r, tracker in enumerate(alone):
        torch.testing.assert_close(both.template[r], tracker.template[0], atol=1e-3, rtol=0)


def test_another_handle_of_the_state_follows() -> None:
    """What one handle has learned, the other tracks with."""
    frames = film(8, 2.0)
    tracker = Tracker(frames[0], [START], SIZE, average=4)
    handle = copy.copy(tracker)
    tracker.track_sequence(frames[1:6])
    twin = copy.deepcopy(tracker)
    assert torch.equal(handle(frames[6]).pose, twin(frames[6]).pose)
    assert float(handle.references[0].noise.frames) == 4


def test_a_state_with_fewer_ages_is_filled() -> None:
    """Saved when fewer were kept, or before they had places: it goes on as it was."""
    frames = film(11, 2.0)
    tracker, other = (Tracker(frames[0], [START], SIZE, renew=4, search=False) for _ in range(2))
    tracker.track_sequence(frames[1:10])
    state = tracker.state_dict()
    state["lesson_older"] = state["lesson_older"][:, :3].clone()
    state["lesson_places"] = state["lesson_places"][:, :3].clone()
    other.load_state_dict(state)
    assert torch.equal(other(frames[10]).pose, copy.deepcopy(tracker)(frames[10]).pose)
    del state["lesson_places"]
    other.load_state_dict(state)
    assert other.lesson_places.shape == (1, AGES, 3)
    del state["lesson_lead"]
    with pytest.raises(ValueError, match="a tracker's state must be whole, got one without lesson_lead"):
        other.load_state_dict(state)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"average": 0}, "average: expected a whole number of frames from 1 on, got 0"),
        ({"average": 2.5}, "average: expected a whole number of frames from 1 on, got 2.5"),
        ({"average": True}, "average: expected a whole number of frames from 1 on, got True"),
        ({"renew": 1}, "renew: expected a whole number of frames from 2 on, got 1"),
    ],
)
def test_numbers_of_frames_are_refused(options: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Tracker(film(1, 2.0)[0], [START], SIZE, **options)


def test_who_learns_nothing_holds_nothing() -> None:
    """A tracker that is not told to learn has no such state."""
    names = dict(Tracker(film(1, 2.0)[0], [START], SIZE).named_buffers())
    assert not any(name.startswith("lesson") for name in names)
    assert len(Lessons._fields) == 16


def test_what_is_new_does_not_feign_a_shift_once_it_has_been_seen() -> None:
    """Means of a surface that becomes another one, each off its place: all of them together find the places back, to
    better than one of them and the first one alone."""
    old, new = (PlaneWaves.random(seed=k).render(path(1), FRAME)[:, :, 10:98, 16:104] for k in (3, 53))
    share = torch.arange(8).view(8, 1, 1, 1) / 10
    noise = 0.5 * torch.randn(8, 1, 88, 88, generator=torch.Generator().manual_seed(1))
    off = 0.02 * torch.arange(8)[:, None].double() * torch.tensor((1.0, -0.7, 3e-3)).double() / 7
    images = shifted((1 - share) * old + share * new + noise, "bspline3", -off, off[:, :2] * 0)[:, 0]
    counted, centre = torch.ones(1, 1, 88, 88), torch.zeros(1, 2)

    def last(which: list[int]) -> tuple[Tensor, Tensor]:
        """By how much the last one of them is off after a few passes, and sigma."""
        some, total = images[which], off.new_zeros(len(which), 3)
        for _ in range(5):
            there = torch.ones(1, len(which), dtype=torch.bool)
            found = placed(some[None], there, torch.tensor([0.25]), counted, centre, torch.zeros(1))
            some = shifted(some[:, None], "bspline3", found.step[0], total[:, :2] * 0)[:, 0]
            total = total + found.step[0]
        return (total[-1] - off[-1])[:2], found.covariance[0, -1].diagonal()[:2].sqrt()

    error, sigma = last(list(range(8)))
    alone, _ = last([0, 7])
    assert float(error.norm()) < 0.5 * float(alone.norm())
    assert float((error / sigma).abs().max()) < 3


def test_two_textures_that_fade_into_each_other_leave_a_plane() -> None:
    """Few edges, each near one of the new texture: what of a drift is outside of the plane of both textures tells where
    the last mean lies, better than that edges are seldom alike does."""
    count, errors, ratios = 12, [], []
    share = torch.linspace(0, 0.7, count, dtype=torch.float64)
    there, counted, centre = torch.ones(1, count, dtype=torch.bool), torch.ones(1, 1, 121, 121), torch.zeros(count, 2)
    for seed in range(4):
        chance = torch.Generator().manual_seed(seed)
        off = share[:, None] * torch.tensor((0.1, -0.05, 0.0)).double()
        off[1:, :2] += 0.01 * torch.randn(count - 1, 2, generator=chance, dtype=torch.float64)
        poses = off + torch.tensor((60.0, 60.0, 0.0)).double()
        old, new = (Pads.wafer(seed=100 + 2 * seed + k).render(poses, (121, 121)) for k in (0, 1))
        images = (1 - share).view(-1, 1, 1, 1) * old + share.view(-1, 1, 1, 1) * new
        images = (images + 0.64 * torch.randn(images.shape, generator=chance)).float()
        total = torch.zeros(count, 3, dtype=torch.float64)
        for _ in range(4):
            right = shifted(images, "bspline3", total, centre)[None, :, 0]
            found = placed(right, there, torch.tensor([0.41]), counted, centre[:1], torch.zeros(1))
            total = total + found.step[0]
        error = (total + off)[-1, :2]
        errors.append(error)
        ratios.append(error / found.covariance[0, -1].diagonal()[:2].sqrt())
    assert float(torch.stack(errors).square().mean().sqrt()) < 0.012
    assert float(torch.stack(ratios).square().mean().sqrt()) < 2


@pytest.mark.parametrize("scene", [PlaneWaves.random, Pads.wafer])
def test_where_places_change_one_after_the_other_sigma_says_so(scene: Callable[..., Scene]) -> None:
    """What changes evenly, as one cell of frequencies or another would have it, is no drift; where it does not, that is
    seen, and never forgotten: then all of it is asked at once, and says how little it knows."""
    count, ratios, chances = 10, [], []
    time, drift = torch.linspace(0, 0.6, count, dtype=torch.float64), torch.tensor((0.6, -0.3, 0.0)).double()
    there, counted, centre = torch.ones(1, count, dtype=torch.bool), torch.ones(1, 1, 121, 121), torch.zeros(count, 2)
    for seed in range(4):
        chance = torch.Generator().manual_seed(seed)
        begun = 0.75 * torch.rand(1, 1, 6, 6, generator=chance, dtype=torch.float64)
        begun = torch.nn.functional.interpolate(begun, (121, 121), mode="bilinear", align_corners=True)
        off = time[:, None] * drift
        poses = off + torch.tensor((60.0, 60.0, 0.0)).double()
        old, new = (scene(seed=100 + 2 * seed + k).render(poses, (121, 121)).double() for k in (0, 1))
        noise = 0.64 * torch.randn(old.shape, generator=chance)
        even = (torch.lerp(old[:1], new[:1], time.view(-1, 1, 1, 1)) + noise).float()
        images = (torch.lerp(old, new, ((time.view(-1, 1, 1, 1) - begun) / 0.25).clamp(0, 1)) + noise).float()
        total, uneven = torch.zeros(count, 3, dtype=torch.float64), torch.zeros(1)
        chances.append(float(placed(even[None, :, 0], there, torch.tensor([0.41]), counted, centre[:1], uneven).uneven))
        for _ in range(3):
            right = shifted(images, "bspline3", total, centre)[None, :, 0]
            found = placed(right, there, torch.tensor([0.41]), counted, centre[:1], uneven)
            total, uneven = total + found.step[0], torch.maximum(uneven, found.uneven)
            assert bool((found.uneven == uneven).all())
        assert float(uneven) > UNEVEN
        ratios.append((total + off)[-1, :2] / found.covariance[0, -1].diagonal()[:2].sqrt())
    assert sorted(chances)[-2] < 0.6 * UNEVEN  # of few pads one scene in eight looks uneven
    assert float(torch.stack(ratios).square().mean().sqrt()) < 2  # 3.9 and 5.9 if it were taken for even


def test_steps_are_averaged_by_their_covariances() -> None:
    """What is known only along x says nothing of y; what is not known at all does not count, and where nothing is known
    the first one stands."""
    one, two = torch.tensor([[[1.0, 0.0, 0.0], [5.0, 5.0, 5.0]]]), torch.tensor([[[4.0, 2.0, 1.0], [7.0, 7.0, 7.0]]])
    known = torch.diag(torch.tensor((1.0, 4.0, 1.0)))
    wide = torch.diag(torch.tensor((2.0, 4.0, 1e12)))
    nothing = torch.full((3, 3), torch.inf)
    step, covariance = averaged_by(
        (one, torch.stack((known, nothing))[None]), (two, torch.stack((wide, nothing))[None])
    )
    assert torch.allclose(step[0], torch.tensor([[2.0, 1.0, 0.0], [5.0, 5.0, 5.0]]), atol=1e-5)
    assert torch.allclose(covariance[0, 0].diagonal(), torch.tensor((2 / 3, 2.0, 1.0)), atol=1e-5)
    assert torch.equal(covariance[0, 1], nothing)


def test_pixels_without_a_number_are_no_exception() -> None:
    """Steps of images that nobody could place are not finite, and nothing is raised."""
    images = torch.rand(1, 3, 40, 40, generator=torch.Generator().manual_seed(2))
    images[0, 1, 5, 5] = torch.nan
    there, noise = torch.ones(1, 3, dtype=torch.bool), torch.ones(1)
    found = placed(images, there, noise, torch.ones(1, 1, 40, 40), torch.zeros(1, 2), torch.zeros(1))
    assert found.step.shape == (1, 3, 3)
    assert bool(found.uneven.isfinite().all())  # which is kept: one bad mean must not spoil all others


def test_nothing_that_has_changed_is_not_uneven() -> None:
    """Of images that are the same, as of a simulator without noise, rounding is left, in no place as in another."""
    image = PlaneWaves.random(seed=3).render(path(1), FRAME)[:, :, 10:98, 16:104].float()
    there, noise = torch.ones(1, 5, dtype=torch.bool), torch.full((1,), 1e-6)
    same = image.expand(1, 5, -1, -1)
    assert float(placed(same, there, noise, torch.ones(1, 1, 88, 88), torch.zeros(1, 2), torch.zeros(1)).uneven) < 2
