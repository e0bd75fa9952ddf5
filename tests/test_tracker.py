"""Laws of the tracker over every engine: state, prediction, loss, recovery, masks, streams, devices, memory."""

from __future__ import annotations

import copy
import gc
import math
import sys
from functools import partial
from itertools import pairwise

import pytest
import torch
from engines import BACKENDS

import torch_ecc
from torch_ecc import SequenceError, Status, Tracker, texture
from torch_ecc.sim.scene.scene import PlaneWaves

SCENE = PlaneWaves.random(seed=5)
FRAME = (200, 240)
CENTERS = [(70.0, 80.0), (150.0, 100.0), (110.4, 90.7)]

once = pytest.mark.parametrize("backend", BACKENDS[:1], indirect=True)  # what has nothing to do with the engine


@pytest.fixture(autouse=True, params=BACKENDS)
def backend(request, monkeypatch):
    """Every tracker made here has it."""
    monkeypatch.setattr(sys.modules[__name__], "Tracker", partial(torch_ecc.Tracker, backend=request.param))
    return request.param


def poses(*rows: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def frames(path: torch.Tensor) -> torch.Tensor:
    """Frames (F, H, W) uint8 of the scene on a stage that moves along ``path`` (F, 3)."""
    return SCENE.render(path, FRAME)[:, 0].round().clamp(0, 255).to(torch.uint8)


def rigid(path: torch.Tensor, centers=CENTERS) -> torch.Tensor:
    """Where the points that were at ``centers`` in the first frame are: (F, R, 3)."""
    from torch_ecc.core.pose import compose, inverse

    start = torch.cat((torch.tensor(centers), torch.zeros(len(centers), 1)), 1).double()
    local = compose(inverse(path[:1]), start)
    return compose(path[:, None].expand(-1, len(centers), 3), local[None].expand(len(path), -1, 3))


PATH = torch.stack(
    [poses((110 + 4 * math.sin(k / 4), 95 - 3 * math.sin(k / 5), 0.05 * math.sin(k / 6)))[0] for k in range(24)]
)


@pytest.mark.parametrize("prediction", ["hold", "velocity"])
@pytest.mark.parametrize("levels", [1, 2])
def test_tracks_many_templates_of_one_frame(prediction, levels):
    stack = frames(PATH)
    tracker = Tracker(stack[0], CENTERS, (51, 60), prediction=prediction, levels=levels)
    track = tracker.track_sequence(stack[1:])
    assert track.pose.shape == (23, 3, 3)
    assert (track.status == Status.CONVERGED).all()
    assert (track.pose - rigid(PATH)[1:])[..., :2].abs().max() < 0.01
    assert torch.allclose(track.displacement, track.pose - tracker.start)
    assert track.sigma.shape == (23, 3, 3)


def test_many_templates_give_the_single_results():
    stack = frames(PATH)
    generator = torch.Generator().manual_seed(0)
    centers = torch.rand(64, 2, generator=generator) * torch.tensor([150.0, 110.0]) + 45
    together = Tracker(stack[0], centers, 41).track_sequence(stack[1:5])
    for r in range(0, 64, 9):
        alone = Tracker(stack[0], centers[r : r + 1], 41).track_sequence(stack[1:5])
        assert (together.pose[:, r] - alone.pose[:, 0]).abs().max() < 1e-4
        assert torch.equal(together.status[:, r], alone.status[:, 0])


def test_first_frame_is_where_it_started():
    stack = frames(PATH)
    estimate = Tracker(stack[0], CENTERS, 51)(stack[0])
    assert (estimate.displacement.abs() < 1e-5).all()
    assert (estimate.score > 0.9999).all()


@once
def test_track_and_call_are_the_same():
    stack = frames(PATH)
    a, b = (Tracker(stack[0], CENTERS, 51) for _ in range(2))
    assert torch.equal(a.track(stack[1]).pose, b(stack[1]).pose)


@once
def test_colour_frames_and_grey_frames():
    stack = frames(PATH)
    rgb = stack[:, None].expand(-1, 3, -1, -1)
    a = Tracker(stack[0], CENTERS, 51).track_sequence(stack[1:6])
    b = Tracker(rgb[0], CENTERS, 51).track_sequence(rgb[1:6])
    assert (a.pose - b.pose).abs().max() < 1e-4


def test_streams_have_a_frame_each():
    other = PlaneWaves.random(seed=6).render(PATH, FRAME)[:, 0].round().clamp(0, 255).to(torch.uint8)
    pair = torch.stack((frames(PATH), other), 1)[:, :, None]  # (F, 2, 1, H, W)
    track = Tracker(pair[0], CENTERS[:2], 51).track_sequence(pair[1:])
    assert (track.pose - rigid(PATH, CENTERS[:2])[1:])[..., :2].abs().max() < 0.01


def test_velocity_prediction_follows_where_hold_does_not():
    """A turn about a far point: constant in the template's own axes, 7 px and 3 deg per frame."""
    angle = torch.arange(12) * math.radians(3.0)
    path = torch.stack((120 - 0 * angle, 100 - 0 * angle, angle), -1).double()
    path[:, 0] += 0.5 * torch.arange(12) ** 1.5
    stack = frames(path)
    center = [(60.0, 60.0)]
    velocity = Tracker(stack[0], center, 41, prediction="velocity").track_sequence(stack[1:])
    hold = Tracker(stack[0], center, 41, prediction="hold").track_sequence(stack[1:])
    assert (velocity.status == Status.CONVERGED).all()
    assert velocity.iterations[3:].sum() < hold.iterations[3:].sum()


def test_a_constant_turn_is_as_little_work_as_standing_still():
    """About a point 50 px away, 9 px and 10 deg per frame: from the third frame on the start is the answer."""
    angle = torch.arange(8) * math.radians(10.0)
    path = torch.stack((120 - 0 * angle, 100 - 0 * angle, angle), -1).double()
    stack, center = frames(path), [(170.0, 100.0)]
    turning = Tracker(stack[0], center, 61).track_sequence(stack[1:])
    still = Tracker(stack[0], center, 61).track_sequence(stack[:1].expand(2, -1, -1))
    assert (turning.iterations[2:] <= still.iterations[-1]).all()


@pytest.mark.parametrize("shift", [(12.0, 5.0, 0.0), (25.0, -18.0, 0.0), (-8.0, 20.0, 0.3)])
def test_a_jump_beyond_the_basin_is_searched_for(shift):
    stack = frames(poses((110, 95, 0), (110 + shift[0], 95 + shift[1], shift[2])))
    center = [(110.0, 95.0)]
    estimate = Tracker(stack[0], center, 61)(stack[1])
    assert estimate.status == Status.CONVERGED
    assert (estimate.displacement[0] - torch.tensor(shift)).abs().max() < 5e-3


def hostile() -> dict[str, torch.Tensor]:
    good = frames(PATH)[5]
    generator = torch.Generator().manual_seed(0)
    occluded = good.clone()
    occluded[:, 110:] = 30
    return {
        "blank": torch.full_like(good, 90),
        "saturated": torch.full_like(good, 255),
        "dark": torch.zeros_like(good),
        "noise": (128 + 40 * torch.randn(FRAME, generator=generator)).clamp(0, 255).to(torch.uint8),
        "half occluded": occluded,
        "negative": 255 - good,
    }


@pytest.mark.parametrize("name", hostile())
def test_a_lost_template_keeps_its_last_good_pose_and_is_found_again(name):
    stack = frames(PATH)
    tracker = Tracker(stack[0], [(110.0, 95.0)], 61)
    before = tracker.track_sequence(stack[1:5]).pose[-1]
    for _ in range(2):
        estimate = tracker(hostile()[name])
        assert not Status.good(estimate.status).any()
        assert torch.equal(estimate.pose, before)
        assert not any(v.isnan().any() for v in estimate)
    after = tracker(stack[8])
    assert after.status == Status.CONVERGED
    assert (after.pose[0] - rigid(PATH, [(110.0, 95.0)])[8, 0])[:2].abs().max() < 0.01


def test_leaving_and_entering_the_frame():
    x = torch.cat((torch.arange(110, 260, 6.0), torch.arange(260, 110, -6.0)))
    path = torch.stack((x, torch.full_like(x, 95.0), torch.zeros_like(x)), -1).double()
    track = Tracker(frames(path[:1])[0], [(110.0, 95.0)], 61).track_sequence(frames(path)[1:])
    assert (track.status == Status.OUT_OF_VIEW).any()
    inside = path[1:, 0] < 205
    assert (track.status[inside] == Status.CONVERGED).all()
    assert (track.pose[inside, 0] - path[1:][inside])[:, :2].abs().max() < 0.01
    partly = (path[1:, 0] > 212) & (path[1:, 0] < 235) & (track.status[:, 0] == Status.CONVERGED)
    assert partly.sum() >= 4
    assert (track.pose[partly, 0] - path[1:][partly])[:, :2].abs().max() < 0.03


def test_a_mask_leaves_out_what_does_not_move():
    """A moving disc on a still background: the square takes in the background, the disc's mask does not."""
    y, x = torch.meshgrid(torch.arange(200.0), torch.arange(240.0), indexing="ij")
    background = PlaneWaves.random(seed=9).render(poses((0, 0, 0)), FRAME)[0, 0]
    path = poses((110, 95, 0), (111.3, 94.2, 0.02), (112.9, 93.1, 0.05))
    stack = []
    for pose, image in zip(path, SCENE.render(path, FRAME)[:, 0], strict=True):
        stack.append(torch.where((x - pose[0]) ** 2 + (y - pose[1]) ** 2 < 26**2, image, background))
    disc = (x[:61, :61] - 30) ** 2 + (y[:61, :61] - 30) ** 2 < 22**2
    masked = Tracker(stack[0], [(110.0, 95.0)], 61, mask=disc).track_sequence(stack[1:])
    square = Tracker(stack[0], [(110.0, 95.0)], 61, robust=False).track_sequence(stack[1:])
    error = [(t.pose[:, 0] - path[1:])[:, :2].abs().max() for t in (masked, square)]
    assert error[0] < 0.01
    assert error[1] > 0.1


def test_texture_predicts_the_scatter():
    """Predicted sigma against the scatter of poses tracked with that noise."""
    generator = torch.Generator().manual_seed(0)
    still = SCENE.render(poses((110.3, 95.4, 0)), FRAME)
    noise = 4.0

    def shot() -> torch.Tensor:
        return (still + noise * torch.randn(still.shape, generator=generator)).round().clamp(0, 255).to(torch.uint8)

    centers = torch.rand(40, 2, generator=generator) * torch.tensor([150.0, 110.0]) + 45
    predicted = texture(shot(), centers, 61, noise=noise)
    errors = torch.stack([Tracker(shot(), centers, 61)(shot()).displacement for _ in range(8)])
    ratio = errors.square().mean((0, 1)).sqrt() / predicted.square().mean(0).sqrt()
    assert ((ratio > 0.8) & (ratio < 1.25)).all(), ratio


@once
def test_texture_says_which_patch_is_better():
    x = torch.arange(240.0).expand(200, 240)
    flat = torch.full(FRAME, 100.0)
    frame = torch.where(x < 120, SCENE.render(poses((110, 95, 0)), FRAME)[0, 0], flat)
    frame = frame + torch.randn(FRAME, generator=torch.Generator().manual_seed(0))
    good, bad = texture(frame, [(60.0, 100.0), (190.0, 100.0)], 61)
    assert (good[:2] < 0.02).all()
    assert bad.isinf().all()


@once
def test_a_sequence_error_keeps_the_track_so_far():
    stack = list(frames(PATH))
    stack[7] = stack[7][:-1]
    with pytest.raises(
        SequenceError, match=r"frame 6: track: frame must be 1 image of 240x200 px as the first"
    ) as caught:
        Tracker(stack[0], CENTERS, 51).track_sequence(stack[1:], stop_at_damage=True)
    assert caught.value.track.pose.shape == (6, 3, 3)
    with pytest.raises(SequenceError) as caught:
        Tracker(stack[0], CENTERS, 51).track_sequence([stack[1].numpy(), stack[2]])
    assert caught.value.track is None


@once
def test_a_sequence_goes_on_after_damage():
    """Missing, cropped, not finite: each its status, the last good pose, and neighbours as if nothing had been."""
    stack = list(frames(PATH))[:9]
    wanted = Tracker(stack[0], CENTERS, 51).track_sequence(stack)
    damaged = [*stack[:2], None, stack[3], stack[4][:-1], stack[5] * torch.nan, *stack[6:]]
    track = Tracker(stack[0], CENTERS, 51).track_sequence(damaged)
    bad = torch.tensor([False, False, True, False, True, True, False, False, False])
    assert ((track.status == Status.DAMAGED) == bad[:, None]).all()
    assert track.covariance[bad].diagonal(dim1=-2, dim2=-1).isinf().all()
    assert all(value.dtype == other.dtype for value, other in zip(track, wanted, strict=True))
    assert torch.equal(track.pose[2], track.pose[1])
    assert (track.pose - wanted.pose)[~bad].abs().max() < 2e-3


def test_everything_moves_to_a_device(device):
    stack = frames(PATH).to(device)
    tracker = Tracker(stack[0], CENTERS, 51)
    moved = Tracker(stack[0].cpu(), CENTERS, 51).to(device)
    chosen = Tracker(stack[0].cpu(), CENTERS, 51, device=device)
    results = [t(stack[1].cpu()) for t in (tracker, moved, chosen)]
    for result in results:
        assert all(value.device.type == device.type for value in result)
        assert (result.pose - results[0].pose).abs().max() < 1e-6
    assert torch.equal(copy.deepcopy(tracker)(stack[2]).pose, tracker(stack[2]).pose)


@pytest.mark.parametrize("backend", ["torch"], indirect=True)
def test_the_accelerator_path_gives_the_same_on_a_cpu(request):
    """Never looking at a value, as on an accelerator, changes nothing but the cost."""
    stack = frames(PATH)
    looking = Tracker(stack[0], CENTERS, 51).track_sequence(stack[1:8])
    request.getfixturevalue("blind")
    never = Tracker(stack[0], CENTERS, 51).track_sequence(stack[1:8])
    assert (looking.pose - never.pose).abs().max() < 1e-4
    assert torch.equal(looking.status, never.status)
    assert torch.equal(looking.iterations, never.iterations)


@once
def test_memory_stays_flat_over_a_long_stream():
    """Peak memory of a process must not grow with the number of frames (5,000 in all, short of storing poses)."""
    stack = frames(PATH)[:, 40:150, 50:170].contiguous()
    tracker = Tracker(stack[0], [(60.0, 55.0)], 31, interpolation="bilinear", max_iterations=3)
    for k in range(200):
        tracker(stack[k % 24])
    gc.collect()
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(800):
        tracker(stack[k % 24])
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 3_000  # kB


@pytest.mark.parametrize("size", [*range(55, 67), 12, 15])
def test_masks_of_any_outline(size):
    stack = frames(PATH)
    middle = (size - 1) / 2
    y, x = torch.meshgrid(torch.arange(size) - middle, torch.arange(size) - middle, indexing="ij")
    center = [(110.0 + (size % 2 == 0) / 2, 95.0 + (size % 2 == 0) / 2)]
    for mask in (x * x + y * y <= middle**2, x.abs() + y.abs() <= middle, y < x):
        track = Tracker(stack[0], center, size, mask=mask).track_sequence(stack[1:3])
        assert (track.status == Status.CONVERGED).all()
        assert (track.pose - rigid(PATH, center)[1:3])[..., :2].abs().max() < 0.05


@pytest.mark.parametrize("pedestal", [0, 3000, 20000, 60000])
@pytest.mark.parametrize("illumination", ["gain", "linear", "quadratic"])
def test_a_high_pedestal_changes_nothing(pedestal, illumination):
    """16-bit cameras with an offset, thermal images in kelvin: little contrast on a lot of light."""
    stack = SCENE.render(PATH[:3], FRAME)[:, 0] / 2
    plain = Tracker(stack[0], CENTERS, 61, illumination=illumination)(stack[2])
    raised = Tracker(stack[0] + pedestal, CENTERS, 61, illumination=illumination)(stack[2] + pedestal)
    assert (raised.status == Status.CONVERGED).all()
    assert (raised.pose - plain.pose).abs().max() < 1e-3


MODES = {"gain": [], "linear": ["u", "v"], "quadratic": ["u", "v", "u * u", "v * v", "u * v"]}


@pytest.mark.parametrize(("illumination", "mode"), [(name, mode) for name, modes in MODES.items() for mode in modes])
def test_each_mode_of_light_is_fitted(illumination, mode):
    """A gain that varies as the name says, along each axis, moves no pose and leaves no residual."""
    frame = SCENE.render(PATH[:1], FRAME)[0, 0]
    (x, y), size = CENTERS[0], 61
    v, u = torch.meshgrid(torch.arange(FRAME[0]) - y, torch.arange(FRAME[1]) - x, indexing="ij")
    shade = 1 + 0.3 * eval(mode, {"u": u / (size / 2), "v": v / (size / 2)})
    estimate = Tracker(frame, CENTERS[:1], size, illumination=illumination)(frame * shade)
    assert estimate.displacement.abs().max() < 1e-3
    assert estimate.residual_rms < 0.05


@pytest.mark.parametrize("shape", [(8, 64), (7, 200), (100, 5), (5, 100)])
def test_frames_of_few_rows_or_columns(shape):
    frame = 255 * torch.rand(shape, generator=torch.Generator().manual_seed(0))
    estimate = Tracker(frame, [((shape[1] - 1) / 2, (shape[0] - 1) / 2)], shape)(frame)
    assert (estimate.displacement.abs() < 1e-3).all()


def test_texture_finer_than_the_coarse_levels():
    frame = 100.0 * ((torch.arange(100)[:, None] + torch.arange(100)) % 2)
    estimate = Tracker(frame, [(50.0, 50.0)], 41)(frame)
    assert estimate.status == Status.LOW_TEXTURE  # a spline through such pixels is level at each of them
    assert torch.equal(estimate.displacement, torch.zeros(1, 3, dtype=torch.float64))


@once
def test_casting_a_model_leaves_the_tracker_exact():
    stack = frames(PATH)
    model = torch.nn.Sequential(Tracker(stack[0], CENTERS, 51))
    for cast in (model.half, model.float, model.double):
        cast()
        assert model[0].pose.dtype == torch.float64
        assert (model(stack[1]).status == Status.CONVERGED).all()


@once
def test_an_estimate_can_be_changed_without_harm():
    stack = frames(PATH)
    tracker = Tracker(stack[0], CENTERS, 51)
    estimate = tracker(stack[1])
    estimate.pose.add_(50)
    assert (tracker(stack[2]).status == Status.CONVERGED).all()


def test_a_template_is_found_again_when_partly_outside():
    stack = frames(poses((110, 95, 0), (96, 81, 0)))
    estimate = Tracker(stack[0], [(20.0, 20.0)], 41)(stack[1])
    assert estimate.status == Status.CONVERGED
    assert (estimate.displacement[0, :2] + 14).abs().max() < 0.02


def test_a_wrong_place_that_looks_half_right_is_not_believed():
    """Cells alike but for a small mark: after a jump by one cell the nearest optimum is the neighbour's."""
    y, x = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    cells = 128 + 50 * torch.sin(x * math.tau / 20) * torch.sin(y * math.tau / 20)
    noise = torch.randn(1, 1, 40, 54, generator=torch.Generator().manual_seed(0))
    marks = torch.nn.functional.interpolate(noise, (240, 320), mode="bicubic")[0, 0]
    scene = cells + 18 * marks
    frames = torch.stack((scene, scene.roll(20, -1)))
    centers = [(150.0, 120.0)]
    plain, watchful = (Tracker(frames[0], centers, 61, search=search, robust=search) for search in (False, True))
    believed, found = plain(frames[1]), watchful(frames[1])
    assert Status.good(believed.status)  # it looks like it ...
    assert abs(float(believed.pose[0, 0]) - 170) > 10  # ... and is not
    assert found.status == Status.CONVERGED
    assert found.pose[0, :2].tolist() == pytest.approx([170, 120], abs=0.05)


@once
def test_the_usual_score_is_that_of_some_twenty_frames():
    """A single frame hardly changes what is expected; after sixty alike it is what they are."""
    stack = frames(PATH[:1])
    noisy = stack[0] + 30 * torch.randn(FRAME, generator=torch.Generator().manual_seed(0))
    tracker = Tracker(stack[0], CENTERS[:1], 51, search=False)
    first, usual = tracker.score.clone(), []
    for _ in range(60):
        estimate = tracker(noisy)
        usual.append(((tracker.score - first) / (estimate.score - first)).item())
    assert estimate.score < 0.95 * first
    assert 0 < usual[0] < 0.1
    assert usual[19] > 0.5
    assert 0.9 < usual[-1] < 1
    assert all(a < b for a, b in pairwise(usual))


def test_after_a_loss_the_velocity_is_that_of_all_frames_since():
    """Lost for three frames and found 7 px on: next it is looked for 1.75 px farther, not 7."""
    stack = frames(poses((110, 95, 0), (117, 95, 0)))
    tracker = Tracker(stack[0], [(110.0, 95.0)], 61)
    for _ in range(3):
        assert not Status.good(tracker(torch.full_like(stack[0], 90)).status)
    assert tracker(stack[1]).status == Status.CONVERGED
    assert (tracker.velocity[0] - torch.tensor([1.75, 0.0, 0.0])).abs().max() < 0.01
    still = tracker(stack[1])
    assert (still.displacement[0] - torch.tensor([7.0, 0.0, 0.0])).abs().max() < 0.01


def test_a_stranger_that_looks_a_little_like_it_is_not_taken_for_it():
    """Its place is empty, and far away there is what resembles it by 0.65: enough for a match, not for a return."""
    still = SCENE.render(poses((110, 95, 0)), FRAME)[0, 0] - 128
    other = PlaneWaves.random(seed=8).render(poses((110, 95, 0)), FRAME)[0, 0] - 128
    patch = (slice(65, 126), slice(80, 141))
    mixed = (still / still[patch].std() + 1.17 * other / other[patch].std())[patch] * 15
    for amount, status in ((mixed, Status.LOST), (still[patch], Status.CONVERGED)):
        moved = torch.full(FRAME, 128.0)
        moved[130:191, 170:231] += amount
        assert Tracker(still + 128, [(110.0, 95.0)], 61)(moved).status == status


@once
@pytest.mark.parametrize("noise", [2.0, 10.0, 25.0])
def test_what_is_expected_at_first_is_what_comes(noise):
    """The score of a frame as noisy as the template's, known before there is one."""
    shots = SCENE.render(PATH[:1], FRAME) + noise * torch.randn(
        5, 1, *FRAME, generator=torch.Generator().manual_seed(0)
    )
    tracker = Tracker(shots[:1], CENTERS, 61)
    expected = tracker.score.clone()
    found = torch.stack([tracker(shot[None]).score for shot in shots[1:]]).mean(0)
    assert (found - expected).abs().max() < 0.03


def test_displacement_counts_from_the_start_however_a_pose_was_found(backend):
    """Two jumps, the second from where a search has found it: pose minus start in every frame."""
    stack = frames(poses((110, 95, 0), (128, 90, 0), (110, 95, 0), (111, 95, 0)))
    tracker = Tracker(stack[0], [(110.0, 95.0)], 61)
    for frame in stack[1:]:
        estimate = tracker(frame)
        assert estimate.status == Status.CONVERGED
        assert torch.equal(estimate.displacement, estimate.pose - tracker.start)
