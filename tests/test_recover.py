"""Laws of the searches of a tracker: they never make it worse, a leap is no velocity, and many go together."""

from __future__ import annotations

import json
import math
import warnings

import cv2
import numpy as np
import pytest
import torch

import torch_ecc as te
from torch_ecc import Origin, Status, Tracker
from torch_ecc.core import robust
from torch_ecc.core.pose import compose
from torch_ecc.io import open_frames
from torch_ecc.sim import micrograph
from torch_ecc.sim.scene.scene import PlaneWaves
from torch_ecc.track import tracker as follow
from torch_ecc.track.advance import FARTHEST, beginning, coast
from torch_ecc.track.budget import RESERVE, Budget
from torch_ecc.track.crowd import Crowd
from torch_ecc.track.doubt import Past, of_a_part, plausible, strained
from torch_ecc.track.recover import Recovery
from torch_ecc.track.together import common_motion, gone_together
from torch_ecc.track.watch import Marks, Watch

FRAME = (240, 320)
Y, X = np.mgrid[0 : FRAME[0], 0 : FRAME[1]].astype(float)
SCENE = PlaneWaves.random(seed=5)
RNG = np.random.default_rng(5)


def edge(distance):
    return 1 / (1 + np.exp(-distance / 0.8))


def noisy(image: np.ndarray, rng: np.random.Generator) -> torch.Tensor:
    return torch.from_numpy(np.rint(image + rng.normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8))


def still(*steps: tuple[float, float, float], start=(160.0, 120.0, 0.0)) -> torch.Tensor:
    """Frames (F, 240, 320) uint8 of the waves at ``start`` plus each of ``steps`` (px, px, deg)."""
    poses = torch.tensor([[start[0] + x, start[1] + y, start[2] + math.radians(a)] for x, y, a in steps]).double()
    return SCENE.render(poses, FRAME)[:, 0].round().clamp(0, 255).to(torch.uint8)


def parts(rng: np.random.Generator, spread: float) -> tuple[np.ndarray, np.ndarray, int]:
    """An array of parts of random pitch and shape, which differ by ``spread`` in brightness; the middle of one of them
    and the size of a template around it."""
    pitch, middle = rng.integers(34, 72, 2), np.array([160.0, 120.0])
    half = rng.uniform(7, 0.32 * pitch)
    column, row = np.rint((X - middle[0]) / pitch[0]).astype(int), np.rint((Y - middle[1]) / pitch[1]).astype(int)
    u, v = X - middle[0] - column * pitch[0], Y - middle[1] - row * pitch[1]
    bright = rng.uniform(60, 110) * (1 + spread * rng.normal(size=(41, 41)))[column + 20, row + 20]
    lead = 45 * edge(3 - abs(u - half[0] / 3)) * edge(abs(v) - 0.7 * half[1])
    image = 70 + bright * edge(half[0] - abs(u)) * edge(half[1] - abs(v)) + lead
    return image, middle, int(np.clip(pitch.min() + rng.integers(-6, 20), 31, 81))


def spoilt(image: np.ndarray, what: str, middle: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    x, y = middle + rng.uniform(-0.35, 0.35, 2) * size
    distance, turn = np.hypot(X - x, Y - y), rng.uniform(0, math.pi)
    along, across = (
        (X - x) * math.cos(turn) + (Y - y) * math.sin(turn),
        (X - x) * math.sin(turn) - (Y - y) * math.cos(turn),
    )
    covered = {
        "dust": (distance < 3, 20),
        "glint": (distance < rng.uniform(2, 5), 250),
        "needle": ((abs(across) < 1) & (along > 0), 30),
        "cover": (X - middle[0] > rng.uniform(0.2, 0.4) * size, 90),
        "hidden": ((abs(X - middle[0]) < 0.6 * size) & (abs(Y - middle[1]) < 0.6 * size), 90),
    }
    if what == "lamp":
        return image + 90 * np.exp(-((distance / (size / 5)) ** 2) / 2)
    where, level = covered[what]
    return np.where(where, level, image)


@pytest.mark.parametrize("spread", [0.0, 0.05], ids=["equal", "nearly equal"])
@pytest.mark.parametrize("what", ["dust", "glint", "lamp", "needle", "cover", "hidden"])
def test_what_lies_on_a_part_of_an_array_for_a_frame_leads_to_no_other_part(what, spread):
    """Four arrays each: the search changes nothing, and in clean frames again nothing is wrong and believed."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        image, middle, size = parts(rng, spread)
        first, *rest = (
            noisy(each, rng) for each in (image, image, spoilt(image, what, middle, size, rng), image, image)
        )
        watchful, plain = (
            Tracker(first, [tuple(middle)], size, search=on).track_sequence(rest) for on in (True, False)
        )
        assert (watchful.pose - plain.pose).abs().max() < 1e-6
        assert (watchful.status[2:] == Status.CONVERGED).all()
        assert watchful.displacement[2:, :, :2].abs().max() < 0.1


@pytest.mark.parametrize("spread", [0.0, 0.02])
def test_less_noise_than_in_the_first_frame_makes_no_look_alike_the_better_one(spread):
    for seed in range(100, 104):
        rng = np.random.default_rng(seed)
        image, middle, size = parts(rng, spread)
        first = noisy(image + rng.normal(0, 6, image.shape), rng)
        tracker = Tracker(first, [tuple(middle)], size)
        hidden = spoilt(image, "hidden", middle, size, rng)
        for _ in range(2):
            assert tracker(noisy(hidden, rng)).status != Status.CONVERGED
        assert tracker(noisy(image, rng)).displacement[0, :2].abs().max() < 0.2


def test_dust_of_28_px_on_one_of_many_equal_pads():
    y, x = np.mgrid[0:400, 0:480].astype(float)
    u, v = (x - 210) % 60 - 30, (y - 170) % 60 - 30
    pads = 70 + 100 * edge(18 - abs(u)) * edge(14 - abs(v)) + 45 * edge(3 - abs(u - 8)) * edge(abs(v) - 14)
    dusty = np.where(np.hypot(x - 246, y - 195) < 3, 20, pads)
    rng = np.random.default_rng(0)
    tracker = Tracker(noisy(pads, rng), [(240.0, 200.0)], 61)
    for image in (pads, dusty, pads, pads, pads):
        estimate = tracker(noisy(image, rng))
        assert estimate.status == Status.CONVERGED
        assert estimate.origin == Origin.TRACKED
        assert (estimate.pose[0, :2] - torch.tensor([240.0, 200.0])).abs().max() < 0.1


@pytest.mark.parametrize("lost", [1, 5])
def test_a_hidden_template_is_not_taken_for_its_twin(lost):
    """Which is alone in sight as long as the template is hidden, and known from the first frame."""
    image = PlaneWaves.random(seed=31).render(torch.zeros(1, 3).double(), FRAME)[0, 0]
    tile = SCENE.render(torch.tensor([[30.0, 30.0, 0.0]]).double(), (61, 61))[0, 0]
    for x in (30, 200):
        image[70:131, x : x + 61] = tile
    hidden = image.clone()
    hidden[60:141, 20:101] = 128
    tracker = Tracker(image, [(60.0, 100.0)], 61)
    for _ in range(lost):
        assert tracker(hidden).status == Status.LOST
    assert tracker(image).displacement.abs().max() < 1e-3


def test_a_half_that_looks_like_that_of_a_hidden_template_is_not_taken_for_it():
    """At the border of the frame, the rest of what it belongs to out of sight; as a whole it is another one."""
    rng = np.random.default_rng(3)
    part, other = rng.normal(size=(2, 61, 61))
    part = 120 + 60 * np.stack([cv2.GaussianBlur(each, (0, 0), 3) * 6 for each in (part, other)]).clip(-1, 1)
    scene = np.full(FRAME, 60.0)
    scene[90:151, 130:191] = part[0]
    tracker = Tracker(noisy(scene, rng), [(160.0, 120.0)], 61)
    scene[90:151, 130:191] = 60
    scene[:31, 20:81] = part[0][30:]
    for _ in range(4):
        assert tracker.track(noisy(scene, rng)).status == Status.LOST
    scene[:31, 20:81], scene[150:211, 220:281] = 60, part[0]  # a whole one is it
    assert any(bool(tracker.track(noisy(scene, rng)).ok) for _ in range(4))


def test_a_lesser_look_alike_stands_in_no_ones_way():
    """45 px beside the template: a jump by 24 px is believed if its marks leave it 2.4 times as much, and not if it
    is its equal."""
    tile, other = (
        PlaneWaves.random(seed=s).render(torch.tensor([[20.0, 20, 0]]).double(), (41, 41))[0, 0] for s in (5, 12)
    )
    for mark, status in ((0.35, Status.CONVERGED), (0.0, Status.LOST)):
        image = PlaneWaves.random(seed=31).render(torch.zeros(1, 3).double(), FRAME)[0, 0]
        image[100:141, 140:181] = tile
        image[100:141, 185:226] = tile + mark * (other - other.mean()) * tile.std() / other.std()
        draw = torch.Generator().manual_seed(0)
        first, jumped = (
            each + 0.2 * tile.std() * torch.randn(FRAME, generator=draw, dtype=torch.float64)
            for each in (image.double(), image.double().roll(24, 1))
        )
        estimate = Tracker(first, [(160.0, 120.0)], 41)(jumped)
        assert estimate.status == status
        if mark:
            assert (estimate.displacement[0, :2] - torch.tensor([24.0, 0.0])).abs().max() < 0.1


@pytest.mark.parametrize(("share", "off", "kept"), [(0.85, 3.0, True), (0.75, 3.0, False), (0.85, 6.0, False)])
def test_a_place_is_kept_that_looks_about_as_usual_about_where_it_was_expected(share, off, kept):
    """Else what looks unlike itself is searched for in the whole frame."""
    frame = still((0, 0, 0))[0]
    tracker = Tracker(frame, [(160.0, 120.0)], 61)
    estimate, past = tracker(frame), Past.of(tracker.state_dict())
    moved = estimate.pose + torch.tensor([[off, 0.0, 0.0]])
    less = estimate._replace(pose=moved, score=share * past.usual.to(estimate.score))
    assert bool(plausible(less, estimate.pose, past, tracker.references[0].place.radius)) == kept


def test_a_leap_is_no_velocity():
    """Found 14 px on, and there in the next frame; then it moves by 2 px per frame, which is one."""
    stack = still((0, 0, 0), (14, 0, 0), (14, 0, 0), (16, 0, 0), (18, 0, 0))
    tracker = Tracker(stack[0], [(160.0, 120.0)], 61)
    assert tracker(stack[1]).origin == Origin.NEARBY
    assert torch.equal(tracker.velocity, torch.zeros(1, 3).double())
    for k in (2, 3, 4):
        estimate = tracker(stack[k])
        assert estimate.origin == Origin.TRACKED
        assert float(tracker.velocity[0, 0]) == pytest.approx(0.0 if k == 2 else 2.0, abs=0.02)


@pytest.mark.parametrize(
    ("step", "origin"),
    [((1, 1, 0), Origin.TRACKED), ((12, -9, 3), Origin.NEARBY), ((60, 30, 50), Origin.ANYWHERE)],
)
def test_the_origin_says_how_a_pose_was_come_by(step, origin):
    frames = still((0, 0, 0), step)
    estimate = Tracker(frames[0], [(160.0, 120.0)], 61)(frames[1])
    assert estimate.status == Status.CONVERGED
    assert estimate.origin.dtype == torch.int8
    assert estimate.origin.tolist() == [origin]
    reference = te.prepare(frames[0][90:151, 130:191])
    assert te.align(reference, frames[1], estimate.pose).origin.tolist() == [Origin.TRACKED]
    assert te.locate(reference, frames[1]).estimate.origin.tolist() == [Origin.ANYWHERE]


def test_a_score_that_falls_smoothly_is_searched_for_a_few_times_only(monkeypatch):
    """Noise that grows from frame to frame: the place is kept and the whole frame never searched."""
    near = []
    look = Recovery.search_near
    monkeypatch.setattr(Recovery, "search_near", lambda self, *a: near.append(1) or look(self, *a))
    monkeypatch.setattr(Recovery, "search_anywhere", None)
    frame, generator = still((0, 0, 0))[0], torch.Generator().manual_seed(0)
    tracker = Tracker(frame, [(160.0, 120.0)], 61)
    for k in range(40):
        estimate = tracker((frame + 0.4 * k * torch.randn(FRAME, generator=generator)).clamp(0, 255))
        assert estimate.status == Status.CONVERGED
    assert len(near) <= 8


def flat(rng: np.random.Generator) -> torch.Tensor:
    return noisy(100 + 80 * edge(X - 250) + 60 * edge(12 - abs(X - 60)) * edge(9 - abs(Y - 120)), rng)


@pytest.mark.parametrize(
    ("x", "size", "most"), [(160.0, 61, 0), (250.0, 61, 0), (250.0, 31, 7)], ids=["nothing", "edge", "short edge"]
)
def test_a_patch_without_texture_is_told_and_hardly_searched_for(x, size, most, monkeypatch):
    """Where no search can find it never; where that is not so sure in the frames 1, 2, 3, 5, 9, 17 and 33."""
    rng, searched = np.random.default_rng(0), []
    with pytest.warns(UserWarning, match=r"Tracker: template 1: The template has too little texture"):
        tracker = Tracker(flat(rng), [(60.0, 120.0), (x, 120.0)], size)
    monkeypatch.setattr(Recovery, "search_near", lambda self, image, estimate, *_: searched.append(1) or estimate)
    monkeypatch.setattr(Recovery, "search_anywhere", lambda self, images, estimate, past, r: estimate)
    for _ in range(40):
        assert tracker(flat(rng)).status.tolist() == [Status.CONVERGED, Status.LOW_TEXTURE]
    assert len(searched) == most


def test_good_patches_bring_no_warning():
    frame = still((0, 0, 0))[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Tracker(frame, [(160.0, 120.0), (100.0, 100.0)], 41)


def test_the_common_motion_is_that_of_most():
    """Any turn about any point, and a third that went elsewhere."""
    generator = torch.Generator().manual_seed(0)
    start = torch.rand(15, 3, generator=generator).double() * torch.tensor([300.0, 200.0, 6.0])
    motion = torch.tensor([[14.0, -31.0, 0.2]]).double()
    pose = compose(motion.expand_as(start), start)
    pose[:5] += torch.tensor([40.0, 7.0, 1.0])
    assert (common_motion(start, pose) - motion).abs().max() < 1e-9


def test_few_or_scattered_leaps_tell_nothing_of_the_others():
    frames = still((0, 0, 0), (1, 0, 0))
    estimate = Tracker(frames[0], [(60.0 + 20 * k, 120.0) for k in range(8)], 41)(frames[1])
    start, all_ = estimate.pose - torch.tensor([9.0, 9.0, 0.0]), torch.ones(8, dtype=torch.bool)
    assert gone_together(estimate, start, torch.arange(8) < 2) is None  # two of them
    scattered = estimate._replace(pose=estimate.pose * torch.arange(8)[:, None])
    assert gone_together(scattered, start, all_) is None
    together = gone_together(estimate, start, all_)
    assert (together - estimate.pose).abs().max() < 1e-9


@pytest.mark.parametrize("last", [3, 4], ids=["25 px", "50 px"])
def test_where_many_jump_the_others_are_found_by_the_motion_of_some(data, last):
    """200 patches of 31 px of a speckled plate, beyond the reach of the search near."""
    folder = data / "pyvale_rigid"
    truth = json.loads((folder / "truth.json").read_text())["frames"][last]
    first, second = (open_frames(folder / name).first for name in ("ref.png", f"f{last:03d}.png"))
    corner, span = torch.tensor([20.0, 80.0]), torch.tensor([149.0, 299.0])
    centers = corner + span * torch.rand(200, 2, generator=torch.Generator().manual_seed(0))
    estimate = Tracker(first, centers, 31)(second)
    assert (estimate.status == Status.CONVERGED).all()
    assert (estimate.origin != Origin.TRACKED).all()
    assert (estimate.displacement[:, :2] - torch.tensor([truth["tx"], truth["ty"]])).abs().max() < 0.05


def test_two_equal_parts_that_cross_are_told_apart_or_lost():
    """Each is followed; one passes over the other. Nothing is wrong and believed, and both are right again after."""
    part = SCENE.render(torch.tensor([[30.0, 30.0, 0.0]]).double(), (61, 61))[0, 0]
    for beside, speed in ((8, 5), (3, 4), (14, 6)):
        shots = []
        for k in range(31):
            image = torch.full(FRAME, 90.0)
            for x, y in ((60 + speed * k, 100), (60 + 30 * speed - speed * k, 100 + beside)):
                image[y - 30 : y + 31, x - 30 : x + 31] = part
            shots.append(noisy(image.numpy(), np.random.default_rng(k)))
        tracker = Tracker(shots[0], [(60.0, 100.0), (60.0 + 30 * speed, 100.0 + beside)], 61)
        track = tracker.track_sequence(shots[1:])
        way = speed * torch.arange(1.0, 31)
        truth = torch.stack((way, -way), 1)
        off = (track.displacement[:, :, 0] - truth).abs() + track.displacement[:, :, 1].abs()
        assert (off[track.status == Status.CONVERGED] < 0.3).all()
        assert (track.status[-1] == Status.CONVERGED).all()


def test_two_templates_on_one_place_of_which_none_is_expected_there_are_lost():
    image = still((0, 0, 0), (0, 0, 0))
    tracker = Tracker(image[0], [(150.0, 120.0), (170.0, 120.0)], 61)
    estimate = tracker(image[1])
    there = estimate._replace(pose=estimate.pose[:1].expand(2, 3) + torch.tensor([[0.0, 0, 0], [1, 0, 0]]))
    crowd = Crowd(tracker.start[:, :2])
    assert crowd.apart(estimate, estimate.pose) is estimate
    for off, status in ((9.0, Status.LOST), (0.2, Status.CONVERGED)):
        start = there.pose + torch.tensor([[off, 0.0, 0.0], [9.0, 0.0, 0.0]])
        told = crowd.apart(there, start)
        assert told.status.tolist() == [status, Status.LOST]
        assert told.reason[1] == te.Reason.SHARED
        assert told.covariance[1].diagonal().isinf().all()
    found = there._replace(origin=torch.tensor([Origin.NEARBY, Origin.TRACKED]).to(torch.int8))
    assert crowd.apart(found, start).status.tolist() == [Status.LOST, Status.CONVERGED]


def test_what_moves_on_while_it_is_hidden_is_expected_where_it_has_gone():
    """By 5 px per frame, hidden for six of them: it is tracked on without a search."""
    stack = still(*((5 * k, 2 * k, 0) for k in range(13)), start=(110.0, 100.0, 0.0))
    tracker = Tracker(stack[0], [(110.0, 100.0)], 61, search=False)
    for k in range(1, 13):
        hidden = 4 <= k < 10
        estimate = tracker(torch.full_like(stack[0], 90) if hidden else stack[k])
        assert (estimate.status == Status.LOST) == hidden
    assert (estimate.displacement[0] - torch.tensor([60.0, 24.0, 0.0])).abs().max() < 0.05


@pytest.mark.parametrize("step", [1.0, 3.1, 8.0, 50.0])
def test_what_is_hidden_is_expected_nowhere_that_nothing_is_known_of(step):
    """A look-alike is where it would have gone by then: it is expected where it was last."""
    state = beginning(torch.zeros(1, 3, dtype=torch.float64))
    state["velocity"][:] = torch.tensor([step * 0.6, step * 0.8, 0.0])
    gone = []
    for _ in range(20):
        coast(state, torch.tensor([False]))
        gone.append(float(state["velocity"][0, :2].norm()))
    assert max(gone) <= FARTHEST
    assert gone[-1] == 0
    if step < 20:
        assert gone[0] == pytest.approx(2 * step)


def test_a_small_frame_pays_for_a_search_as_one_of_a_usual_video():
    """Else a few searches in the dark take all that a small target has."""
    spent = []
    for pixels in (96 * 80, 640 * 480):
        credit = torch.tensor(100.0, dtype=torch.float64)
        Budget(credit, torch.zeros((), dtype=torch.int64), pixels, 31 * 31, 1.0).spend(0, 20_000_000)
        spent.append(100 - float(credit))
    assert spent[0] == pytest.approx(spent[1], rel=0.2)


@pytest.mark.parametrize("step", [(20.0, 30.0), (60.0, 6.0)])
def test_nothing_is_believed_beyond_the_largest_step(step):
    """A jump of 40 px and 12 deg; four frames later that is no jump any more, and it is found."""
    stack = still((0, 0, 0), (40, 0, 12))
    tracker, free = (Tracker(stack[0], [(160.0, 120.0)], 61, max_step=most) for most in (step, None))
    assert free(stack[1]).status == Status.CONVERGED
    assert tracker(stack[1]).status == Status.LOST
    for _ in range(3):
        estimate = tracker(stack[1])
    assert estimate.status == Status.CONVERGED
    assert (estimate.pose - free.pose).abs().max() < 1e-3


def test_the_largest_step_tells_equal_parts_apart():
    """Pads 60 px apart; one that has been hidden has gone by half that, which may be any of them, or not."""
    u, v = (X - 160) % 60 - 30, (Y - 120) % 60 - 30
    pads = 70 + 100 * edge(14 - abs(30 - abs(u))) * edge(10 - abs(30 - abs(v)))
    moved = np.roll(pads, 26, 1)
    rng = np.random.default_rng(0)
    first, hidden, last = (noisy(image, rng) for image in (pads, np.full(FRAME, 90.0), moved))
    for most, status in ((None, Status.LOST), ((15.0, 2.0), Status.CONVERGED)):
        tracker = Tracker(first, [(160.0, 120.0)], 61, max_step=most)
        tracker(hidden)
        estimate = tracker(last)
        assert estimate.status == status, most
    assert (estimate.displacement[0, :2] - torch.tensor([26.0, 0.0])).abs().max() < 0.1


@pytest.mark.parametrize("jump", [(15, 6), (18, 8), (26, 11)])
def test_of_many_look_alikes_the_nearest_counts(jump):
    """Pads 36 px apart: a search of the whole frame meets some hundred of them, and knows a few."""
    u, v = (X - 160) % 36 - 18, (Y - 120) % 36 - 18
    pads = 70 + 100 * edge(8 - abs(18 - abs(u))) * edge(6 - abs(18 - abs(v)))
    rng, moved = np.random.default_rng(0), np.roll(pads, jump[::-1], (0, 1))
    tracker = Tracker(noisy(pads, rng), [(160.0, 120.0)], 61)
    for _ in range(3):
        estimate = tracker(noisy(moved, rng))
        assert estimate.status == Status.LOST
        assert estimate.reason == te.Reason.AMBIGUOUS


@pytest.mark.parametrize("step", [5.0, (5.0,), (0.0, 1.0), (5.0, float("nan")), ("a", 1.0), (-1.0, 2.0), "ab"])
def test_a_largest_step_is_two_numbers(step):
    with pytest.raises(ValueError, match=r"max_step: expected \(px, deg\) per frame, both > 0, got"):
        Tracker(still((0, 0, 0))[0], [(160.0, 120.0)], 61, max_step=step)


def test_what_is_lost_is_found_where_all_others_are(monkeypatch):
    """One of five is nowhere near where it was last: the others tell where it is, and nothing is searched for."""
    monkeypatch.setattr(Recovery, "due", lambda *_: [])
    stack = still((0, 0, 0), (3, 2, 1), (5, 3, 2))
    tracker = Tracker(stack[0], [(160.0 + x, 120.0 + y) for x, y in ((0, 0), (50, 0), (0, 50), (-50, 0), (0, -50))], 41)
    tracker(stack[1])
    tracker.pose = tracker.pose + torch.tensor([[70.0, 40.0, 1.0], *[[0.0, 0.0, 0.0]] * 4])
    estimate = tracker(stack[2])
    assert (estimate.status == Status.CONVERGED).all()
    assert estimate.origin.tolist() == [Origin.NEARBY, *[Origin.TRACKED] * 4]
    motion = common_motion(tracker.start[1:], estimate.pose[1:])[None]
    assert (compose(motion, tracker.start[:1]) - estimate.pose[:1]).abs().max() < 0.1


def test_searches_take_no_more_than_their_share(monkeypatch):
    """A template that never comes back: of the first searches all are made, and later as many as the frames pay for;
    without a bound as often as ever. Who waits is told why."""
    searched: list[int] = []
    monkeypatch.setattr(
        Recovery, "search_anywhere", lambda self, i, e, p, r: (searched.append(r), self.budget.spend(10**7, 0), e)[2]
    )
    stack, other = still((0, 0, 0), start=(160.0, 120.0, 0.0)), noisy(np.full(FRAME, 90) + 20 * edge(X - 50), RNG)
    counts = {}
    for share in (0.1, 1.0):
        searched.clear()
        tracker = Tracker(stack[0], [(160.0, 120.0)], 31, search_share=share)
        reasons = [int(tracker(other).reason) for _ in range(60)]
        counts[share] = len(searched)
        assert (te.Reason.WAITING in reasons) == (share < 1)
    assert counts[0.1] < counts[1.0]


def test_what_a_search_near_costs_is_earned_where_it_is_needed():
    """By 25 px there and back, over and over, without any credit: all is found."""
    stack = still((0, 0, 0), *[(25 * (k % 4 // 2), -25 * (k % 4 // 2), 0) for k in range(1, 25)])
    tracker = Tracker(stack[0], [(160.0, 120.0)], 61)
    tracker.credit = torch.zeros_like(tracker.credit)
    track = tracker.track_sequence(stack[1:])
    assert (track.status == Status.CONVERGED).all()
    assert (track.origin != Origin.ANYWHERE).all()


def test_what_no_search_can_find_costs_no_more_looks(monkeypatch):
    """Noise alone is not tried where it was last; what is textured, and hidden, is."""
    looks: list[int] = []
    for name in ("from_rest", "disbelieved"):
        real = getattr(follow, name)
        monkeypatch.setattr(follow, name, lambda *given, real=real: (looks.append(1), real(*given))[1])
    rng = np.random.default_rng(0)
    noise = [noisy(np.full(FRAME, 90.0), rng) for _ in range(6)]
    with pytest.warns(UserWarning, match="too little texture"):
        tracker = Tracker(noise[0], [(160.0, 120.0)], 61)
    assert (tracker.track_sequence(noise[1:]).status == Status.LOW_TEXTURE).all()
    assert not looks
    Tracker(still((0, 0, 0))[0], [(160.0, 120.0)], 61)(noise[0])
    assert looks


def test_what_has_turned_back_is_looked_for_where_it_was(monkeypatch):
    """10 px a frame, and then 28 px back: 38 px from where it is expected, which is too far for a search near that."""
    monkeypatch.setattr(Recovery, "search_anywhere", lambda self, images, estimate, *_: estimate)
    stack = still((0, 0, 0), (10, 0, 0), (20, 0, 0), (30, 0, 0), (2, 0, 0))
    track = Tracker(stack[0], [(160.0, 120.0)], 61).track_sequence(stack[1:])
    assert (track.status == Status.CONVERGED).all()
    assert track.origin[-1] == Origin.NEARBY


def test_what_a_search_finds_has_no_marks(monkeypatch):
    """It was not where it was looked for: that is why it has not fitted there."""
    looked: list[int] = []
    monkeypatch.setattr(Watch, "due", lambda self, odd, moved: looked.extend(odd.nonzero()[:, 0].tolist()) or [])
    stack = still((0, 0, 0), (20, -18, 4), (20, -18, 4))
    tracker = Tracker(stack[0], [(160.0, 120.0)], 61)
    assert tracker(stack[1]).origin == Origin.NEARBY
    assert not looked
    tracker(stack[2] * (X < 150))
    assert looked


def test_marks_are_looked_for_in_what_the_camera_has_shown(monkeypatch):
    """Also after a search, which looks at what is left without those that are known."""
    seen: list[torch.Tensor] = []
    found = Marks.found
    monkeypatch.setattr(Marks, "found", lambda self, image, *rest: (seen.append(image), found(self, image, *rest))[1])
    monkeypatch.setattr(Recovery, "unmarked", lambda self, images: [torch.zeros_like(images[0], dtype=torch.float32)])
    stack = still((0, 0, 0), (20, -18, 4))
    hidden = stack[1] * (X < 150)
    Tracker(stack[0], [(160.0, 120.0)], 61)(hidden)
    assert len(seen) == 1
    assert torch.equal(seen[0][0, 0], hidden)


def test_what_is_much_like_a_template_but_another_thing_is_strained():
    """Noise in the frame makes sigma as large as it should be; residuals that cling together much larger."""
    stack = still((0, 0, 0), (3, 2, 1))
    tracker = Tracker(noisy(stack[0].numpy(), np.random.default_rng(0)), [(160.0, 120.0)], 61)
    for noise in (0, 2, 8):
        estimate = tracker((stack[1] + noise * torch.randn(FRAME)).clamp(0, 255))
        assert not strained(tracker.references[0], estimate).any(), noise
    assert strained(tracker.references[0], estimate._replace(covariance=900 * estimate.covariance)).all()


def test_a_search_of_the_whole_frame_leaves_some_for_those_near():
    budget = Budget(torch.tensor(RESERVE / 2), torch.zeros((), dtype=torch.int64), 640 * 480, 31 * 31, 1.0)
    assert budget.left()
    assert not budget.left(RESERVE)


def test_a_dark_frame_is_not_searched(monkeypatch):
    """Nor one that is bright all over; one in which there is anything is."""
    searched: list[int] = []
    monkeypatch.setattr(Recovery, "search_near", lambda self, image, estimate, *_: (searched.append(1), estimate)[1])
    monkeypatch.setattr(Recovery, "search_anywhere", lambda self, images, estimate, past, r: estimate)
    rng = np.random.default_rng(0)
    tracker = Tracker(noisy(still((0, 0, 0))[0].numpy(), rng), [(160.0, 120.0), (100.0, 80.0)], 41)
    for level, reason in ((0, "DARK"), (10, "DARK"), (90, "FLAT"), (255, "CLIPPED")):
        estimate = tracker(noisy(np.full(FRAME, level), rng))
        assert estimate.reason.tolist() == [te.Reason[reason]] * 2
        assert not searched
    tracker(noisy(np.full(FRAME, 90) + 20 * edge(X - 50), rng))
    assert searched


def row_of_parts() -> np.ndarray:
    """Equal parts 42 px apart."""
    u = (X - 160 + 21) % 42 - 21
    return 70 + 100 * edge(12 - abs(u)) * edge(10 - abs(Y - 120)) + 60 * edge(4 - abs(u - 5)) * edge(3 - abs(Y - 124))


@pytest.mark.parametrize("velocity", [20.0, -21.0])
def test_what_was_hidden_is_not_believed_where_a_look_alike_is_expected(velocity):
    """It has stopped; where it would be by now is another part."""
    image, rng = row_of_parts(), np.random.default_rng(1)
    tracker = Tracker(noisy(image, rng), [(160.0, 120.0)], 37)
    tracker.velocity = torch.tensor([[velocity, 0.0, 0.0]])
    hidden = np.where(abs(X - 180) < 120, 90, image)
    assert tracker(noisy(hidden, rng)).status == Status.LOST
    assert abs(float(tracker.velocity[0, 0])) > 38
    estimate = tracker(noisy(image, rng))
    assert estimate.status == Status.CONVERGED
    assert estimate.displacement[0, :2].abs().max() < 0.2


def test_of_a_part_is_what_less_than_half_of_a_template_says():
    """Beyond the border, or not believed; and what is lost is not believed where no more of it is seen."""
    away = 60.0
    frames = still((0, 0, 0), start=(away, 120.0, 0.0))
    tracker = Tracker(frames[0], [(away, 120.0)], 101, search=False)
    found = tracker(frames[0])
    for x, coverage, part in ((-8.0, 1.0, True), (8.0, 1.0, False), (20.0, 0.6, True), (100.0, 0.6, False)):
        there = found._replace(pose=torch.tensor([[x, 120.0, 0.0]]).double(), coverage=torch.tensor([coverage]))
        assert of_a_part(tracker.references[0], there, frames[0]) == part
    for x, tracked in ((8.0, True), (-8.0, False)):
        tracker = Tracker(frames[0], [(away, 120.0)], 101)
        tracker.expect(torch.tensor([[x, 120.0, 0.0]]), torch.zeros(1, 3), torch.tensor([True]))
        tracker.skip()
        found = tracker(still((x - away, 0, 0), start=(away, 120.0, 0.0))[0])
        assert bool((found.status == Status.CONVERGED) & (found.origin == Origin.TRACKED)) == tracked


@pytest.mark.parametrize(("off", "lost"), [((3.0, 1.0, 0.0), False), ((50.0, 0.0, 0.0), True), ((0.0, 0.0, 1.5), True)])
def test_what_was_tracked_far_away_is_doubted(off, lost):
    """Iterating that ends 50 px from where it began, or turned by a quarter, has met something else."""
    stack = still((0, 0, 0), (0, 0, 0))
    tracker = Tracker(stack[0], [(160.0, 120.0)], 61)
    start, past, image = tracker.pose.clone(), Past.of(tracker._buffers), stack[1][None, None]
    estimate = tracker(stack[1])
    moved = estimate._replace(pose=start + torch.tensor([off]))
    assert tracker._recovery.not_misled(image, estimate, start, past) is estimate
    reason = te.Reason.AMBIGUOUS if lost else te.Reason.NONE
    assert tracker._recovery.not_misled(image, moved, start, past).reason.tolist() == [reason]


def test_what_there_is_no_time_to_ask_for_rivals_is_not_believed():
    """Half of it seems to be 6 px from where it was expected: nothing near looks like it, but that must be asked."""
    stack = still((0, 0, 0), (6, 0, 0))
    for credit, status, reason in ((100.0, Status.CONVERGED, te.Reason.NONE), (0.0, Status.LOST, te.Reason.WAITING)):
        tracker = Tracker(stack[0], [(160.0, 120.0)], 61, search=False)
        start, past = tracker.pose.clone(), Past.of(tracker._buffers)
        half = tracker(stack[1])._replace(coverage=torch.tensor([0.6]).double())
        tracker.credit = torch.tensor(credit)
        told = tracker._recovery.not_misled(stack[1][None, None], half, start, past)
        assert (told.status, told.reason) == (status, reason)
        assert float(tracker.credit) < credit or credit == 0


@pytest.mark.parametrize("share", [0, 1.5, -1.0, "half", float("nan")])
def test_a_share_of_the_time_is_a_number(share):
    with pytest.raises(ValueError, match="search_share: expected a share of the time > 0 and at most 1, got"):
        Tracker(still((0, 0, 0))[0], [(160.0, 120.0)], 61, search_share=share)


@pytest.mark.parametrize("hidden", [0, 120])
def test_half_of_a_template_does_not_lead_to_what_is_beside_it(hidden):
    """Parts that repeat, of which half looks like half of the next one: a random jump in every frame ends on none."""
    rng, scene = np.random.default_rng(3), micrograph()
    for _ in range(3):  # the third draw
        jumps = np.vstack((np.zeros(3), np.c_[rng.uniform(-13, 13, (20, 2)), np.zeros(20)]))
    poses = torch.from_numpy(jumps + np.array([160.0, 120.0, 0.0]))
    stack = [noisy(scene.render(pose[None], FRAME)[0, 0].numpy(), rng) for pose in poses]
    for image in stack[3:]:
        image[:, :hidden] = 90
    track = Tracker(stack[0], [(140.0, 60.0), (140.0, 140.0), (140.0, 180.0), (260.0, 100.0)], 31).track_sequence(
        stack[1:]
    )
    off = (track.displacement - torch.from_numpy(jumps[1:, None]))[..., :2].abs().amax(-1)
    wrong = (off > 0.1) & (off > 5 * track.sigma[..., :2].amax(-1))
    assert not bool((wrong & (track.status == Status.CONVERGED)).any())
    assert track.ok.double().mean() > (0.2 if hidden else 0.99)


def test_what_has_jumped_is_searched_for_before_it_is_tried_what_covers_it(monkeypatch):
    """What is covered is not searched for, what is hidden is neither found nor recognised."""
    done: list[str] = []
    for module, name in ((robust, "best_trial"), (Recovery, "search_near")):
        work = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, work=work, name=name: (done.append(name), work(*a))[1])
    stack = still((0, 0, 0), (20, -18, 4), (1, 0, 0))
    cover = noisy(PlaneWaves.random(seed=6).render(torch.zeros(1, 3).double(), FRAME)[0, 0].numpy(), RNG)
    part, whole = (torch.where(torch.from_numpy(where), cover, stack[2]) for where in (X > 175, X > 100))
    for frame, made, status, origin in (
        (stack[1], {"search_near"}, Status.CONVERGED, Origin.NEARBY),
        (part, {"best_trial"}, Status.CONVERGED, Origin.TRACKED),
        (whole, {"search_near", "best_trial"}, Status.LOST, Origin.TRACKED),
    ):
        done.clear()
        estimate = Tracker(stack[0], [(160.0, 120.0)], 61)(frame)
        assert (set(done), estimate.status, estimate.origin) == (made, status, origin)
