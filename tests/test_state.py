"""Laws of a tracker's state: it is the tracker. Saved, loaded, copied or moved, it goes on as if nothing had been."""

from __future__ import annotations

import copy
import io
import pickle
import subprocess
import sys

import pytest
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_avg_fn, get_ema_multi_avg_fn

from torch_ecc import Status, Tracker
from torch_ecc.sim.scene.scene import PlaneWaves
from torch_ecc.track.lined import unknown_lines

SHAPE, SIZE = (96, 112), (31, 29)
HERE, THERE = [(40.0, 36.0), (60.4, 50.7)], [(70.0, 55.0), (33.0, 60.2)]
PATH = [(56, 48, 0), (57.2, 47.3, 0.02), (58.1, 46.9, 0.03), (59.5, 46.2, 0.05), (60.8, 45.8, 0.06), (61.9, 45.0, 0.08)]
SCENE = PlaneWaves.random(seed=5)
FRAMES = SCENE.render(torch.tensor(PATH, dtype=torch.float64), SHAPE)[:, 0].round().clamp(0, 255).to(torch.uint8)
BLANK = torch.full_like(FRAMES[0], 90)
OTHER = PlaneWaves.random(seed=6).render(torch.tensor(PATH[:1], dtype=torch.float64), SHAPE)[0, 0].round().clamp(0, 255)
DISC = ((torch.arange(31.0) - 15).square()[:, None] + (torch.arange(29.0) - 14).square()) < 190
KINDS = {
    "one": {},
    "levels": {"levels": 2},
    "masks": {"mask": torch.stack((DISC, ~DISC))},
    "hold": {"prediction": "hold"},
    "ssd": {"criterion": "ssd"},
    "average": {"average": 3},
    "renew": {"renew": 2},
    "shutter": {"line_time": 2e-4, "fps": 50.0},
}


@pytest.fixture(params=["native", "torch"])
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


def made(frame: Tensor = FRAMES[0], centers: list = HERE, size=SIZE, **options) -> Tracker:
    return Tracker(frame, centers, size, **options)


def used(frames: int = 2, **options) -> Tracker:
    """On its way: it has a velocity."""
    tracker = made(**options)
    tracker.track_sequence(FRAMES[1 : 1 + frames])
    return tracker


def through_a_file(state: object) -> object:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def frozen(tracker: Tracker) -> list[Tensor]:
    """All that a tracker goes by, as it is now."""
    return [value.clone() for value in (*tracker.buffers(), tracker.references[0].K)]


def assert_goes_on_as(a: Tracker, b: Tracker, frames: Tensor = FRAMES[3:]) -> None:
    """Both tell the same of the next frames, bit for bit."""
    assert all(map(torch.equal, a.buffers(), b.buffers()))
    for one, other in zip(a.track_sequence(frames), b.track_sequence(frames), strict=True):
        assert torch.equal(one, other)
    assert all(map(torch.equal, a.buffers(), b.buffers()))


@pytest.mark.parametrize(("kind", "backend"), [*((k, "native") for k in KINDS), ("one", "torch"), ("masks", "torch")])
def test_a_state_makes_another_tracker_this_one(kind: str, backend: str) -> None:
    """A tracker of other patches of another picture goes on as the one whose state it has loaded."""
    options = {"backend": backend, **KINDS[kind]}
    tracker, other = used(**options), made(OTHER, THERE, **{**options, "mask": None})
    assert str(other.load_state_dict(through_a_file(tracker.state_dict()))) == "<All keys matched successfully>"
    assert_goes_on_as(other, tracker)
    assert not torch.equal(made(OTHER, THERE, **options)(FRAMES[3]).pose, tracker.pose)


def test_a_state_holds_what_is_lost(backend: str) -> None:
    """After frames without the templates, they are searched for in the same order and found at the same place."""
    tracker, other = used(backend=backend), made(OTHER, THERE, backend=backend)
    for _ in range(3):
        assert not Status.good(tracker(BLANK).status).any()
    other.load_state_dict(through_a_file(tracker.state_dict()))
    assert tracker.suspect_frames.tolist() == [3, 3]
    assert_goes_on_as(other, tracker, torch.cat((BLANK[None], FRAMES[3:])))


def test_a_state_holds_whose_turn_it_is() -> None:
    """Of more lost templates than are searched for in one frame, the next ones are the next ones."""
    centers = [(30.0 + 4 * k, 40.0 + k) for k in range(10)]
    tracker, other = (made(centers=centers, size=15) for _ in range(2))
    tracker(BLANK)
    other.load_state_dict(tracker.state_dict())
    assert int(other.turn) > 0
    assert_goes_on_as(other, tracker, torch.stack((BLANK, FRAMES[1])))


def test_a_tracker_that_was_found_has_a_state_too(backend: str) -> None:
    """Templates of another image, in frames of another size than that."""
    template = FRAMES[0, 20:51, 30:60]
    tracker, _ = Tracker.find(template, FRAMES[1], backend=backend)
    other, _ = Tracker.find(FRAMES[0, 25:56, 45:75], FRAMES[1], backend=backend)
    other.load_state_dict(through_a_file(tracker.state_dict()))
    assert_goes_on_as(other, tracker, FRAMES[2:])


def test_streams_have_a_state_too() -> None:
    """A frame for each template."""
    pair = torch.stack((FRAMES, FRAMES.flip(1)), 1)[:, :, None]
    tracker, other = (Tracker(frame, centers, SIZE) for frame, centers in ((pair[0], HERE), (pair[1], THERE)))
    tracker(pair[1])
    other.load_state_dict(through_a_file(tracker.state_dict()))
    assert_goes_on_as(other, tracker, pair[2:])


REFUSED = {
    "number": (lambda: made(centers=HERE[:1]), "templates must be 1, as this tracker's, got 2"),
    "size": (lambda: made(size=(31, 27)), r"size must be \[31, 27\], as this tracker's, got \[31, 29\]"),
    "criterion": (lambda: made(criterion="ssd"), r"criterion must be SSD\(\), as this tracker's, got ECC\("),
    "illumination": (lambda: made(illumination="gain"), "criterion must be ECC.*'gain'.*, got ECC.*'linear'"),
    "average": (lambda: made(average=5), "average must be 5, as this tracker's, got 1"),
    "levels": (lambda: made(levels=2), "levels must be 2, as this tracker's, got 1"),
    "frame": (
        lambda: made(FRAMES[0, 1:]),
        r"frame must be \[1, 1, 95, 112\], as this tracker's, got \[1, 1, 96, 112\]",
    ),
}


@pytest.mark.parametrize("strict", [True, False])
@pytest.mark.parametrize("name", REFUSED)
def test_a_state_that_does_not_fit_changes_nothing(name: str, strict: bool) -> None:
    """Refused with a sentence, before anything is written."""
    make, sentence = REFUSED[name]
    target, same = make(), make()
    with pytest.raises(ValueError, match=f"load_state_dict: {sentence}"):
        target.load_state_dict(used().state_dict(), strict=strict)
    assert_goes_on_as(target, same, FRAMES[1:, 1:] if name == "frame" else FRAMES[1:])


DAMAGED = {
    "nothing prepared": (lambda s: s.pop("template"), "a tracker's state must be whole, got one without template"),
    "not told of what": (lambda s: s.pop("_extra_state"), "must be whole, got one without _extra_state"),
    "a pose of another": (lambda s: s.update(pose=s["pose"][:1]), r"pose must be \(2, 3\), got \(1, 3\)"),
    "not a number": (lambda s: s.update(velocity=s["velocity"] * torch.nan), "velocity must be finite"),
    "no tensor": (lambda s: s.update(score=[1.0, 1.0]), "score must be a torch tensor, got builtins.list"),
    "flat": (lambda s: s.update(template=0 * s["template"]), "template must have texture"),
}


@pytest.mark.parametrize("strict", [True, False])
@pytest.mark.parametrize("name", DAMAGED)
def test_a_state_is_whole_or_refused(name: str, strict: bool) -> None:
    """What is missing or damaged is told, and changes nothing."""
    damage, sentence = DAMAGED[name]
    state, target, same = used().state_dict(), made(), made()
    damage(state)
    with pytest.raises(ValueError, match=sentence):
        target.load_state_dict(state, strict=strict)
    assert_goes_on_as(target, same, FRAMES[1:])


def test_a_model_that_was_saved_without_a_tracker() -> None:
    """Strictly it is refused; else the tracker stays what it was, and the names of its state are told."""
    state, model, same = nn.Sequential(nn.Linear(2, 2)).state_dict(), nn.Sequential(nn.Linear(2, 2), made()), made()
    with pytest.raises(RuntimeError, match="Missing key"):
        model.load_state_dict(state)
    assert "1.template" in model.load_state_dict(state, strict=False).missing_keys
    assert_goes_on_as(model[1], same, FRAMES[1:])


def test_a_criterion_of_ones_own_is_known_by_its_class() -> None:
    """Two objects of one class that tell nothing of themselves are the same criterion."""

    class Own:
        def __init__(self) -> None:
            inner = made().criterion
            self.columns, self.step, self.fit = inner.columns, inner.step, inner.fit

    tracker, other = (made(criterion=Own(), backend="torch") for _ in range(2))
    tracker(FRAMES[1])
    other.load_state_dict(tracker.state_dict())
    assert_goes_on_as(other, tracker, FRAMES[2:])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda tracker: pickle.loads(pickle.dumps(tracker))])
def test_a_copy_goes_on_by_itself(copied, kind: str) -> None:
    """A deep copy and a pickle tell the same of the next frames, and neither moves the other."""
    tracker = used(**KINDS[kind])
    twin, before = copied(tracker), frozen(tracker)
    assert twin.settings == tracker.settings
    assert twin.prediction == tracker.prediction
    twin(FRAMES[3])
    assert all(map(torch.equal, frozen(tracker), before))
    assert_goes_on_as(copied(tracker), tracker)


def test_a_shallow_copy_is_another_handle() -> None:
    """It has the same state: a frame that one has seen, the other has seen as well."""
    tracker, same = used(), used()
    handle = copy.copy(tracker)
    assert torch.equal(handle(FRAMES[3]).pose, same(FRAMES[3]).pose)
    assert torch.equal(tracker(FRAMES[4]).pose, same(FRAMES[4]).pose)
    assert handle.pose is tracker.pose
    handle.pose = handle.pose + 1
    assert torch.equal(tracker.pose, handle.pose)


def test_copies_hold_no_more_than_the_state() -> None:
    """What follows from the templates is not in a pickle, nor copied: spectra, packed planes, normal equations."""
    tracker = used(backend="native")
    fresh = len(pickle.dumps(made(backend="native")))
    tracker(OTHER)  # it was searched for, nearby and everywhere
    assert tracker._recovery.locators
    assert len(pickle.dumps(tracker)) < 1.1 * fresh < 1.1 * (sum(part.nbytes for part in tracker.buffers()) + 20_000)
    twin = copy.deepcopy(tracker)
    assert not twin._recovery.locators
    assert "packed" not in vars(twin.references[0])
    assert not any(a.data_ptr() == b.data_ptr() for a, b in zip(twin.buffers(), tracker.buffers(), strict=True))


def test_a_tracker_continues_in_another_process(tmp_path) -> None:
    """Pickled there and back."""
    tracker = used()
    torch.save((tracker, FRAMES[3]), tmp_path / "saved.pt")
    code = (
        "import sys, torch; tracker, frame = torch.load(sys.argv[1], weights_only=False); torch.set_num_threads(1);"
        "torch.save([*tracker(frame)], sys.argv[2])"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / "saved.pt", tmp_path / "told.pt"], check=True)
    for there, here in zip(torch.load(tmp_path / "told.pt"), tracker(FRAMES[3]), strict=True):
        torch.testing.assert_close(there, here, rtol=1e-6, atol=1e-6)


class Model(nn.Module):
    """Something to be trained, around a tracker."""

    def __init__(self, **options) -> None:
        super().__init__()
        self.layer, self.trackers = nn.Linear(3, 3), nn.ModuleList([nn.Sequential(made(**options))])

    @property
    def tracker(self) -> Tracker:
        return self.trackers[0][0]

    def forward(self, frame: Tensor) -> Tensor:
        return self.layer(self.trackers[0](frame).pose.float())


def test_a_model_is_saved_with_its_trackers(backend: str) -> None:
    """In a Sequential in a ModuleList: the state of the whole is that of its parts, refused if a part does not fit."""
    model, other = Model(backend=backend), Model(frame=OTHER, centers=THERE, backend=backend)
    model(FRAMES[1])
    other.load_state_dict(through_a_file(model.state_dict()))
    assert torch.equal(other(FRAMES[2]), model(FRAMES[2]))
    assert_goes_on_as(other.tracker, model.tracker)
    model, same = Model(size=(27, 27)), made(size=(27, 27))
    with pytest.raises(ValueError, match="load_state_dict: size must be"):
        model.load_state_dict(other.state_dict())
    assert_goes_on_as(model.tracker, same, FRAMES[1:])


AVERAGES = {"mean": {}, "each": {"avg_fn": get_ema_avg_fn(0.9)}, "all": {"multi_avg_fn": get_ema_multi_avg_fn(0.9)}}


@pytest.mark.parametrize("average", AVERAGES)
def test_an_average_of_models_tracks_as_the_model_does(average: str, backend: str) -> None:
    """The buffers of the average are the model's own, so its tracker is where the model's is."""
    model, same = Model(backend=backend), made(backend=backend)
    averaged = AveragedModel(model, **AVERAGES[average])
    for frame in FRAMES[1:4]:
        model(frame)
        same(frame)
        averaged.update_parameters(model)
    assert_goes_on_as(averaged.module.tracker, same, FRAMES[4:])


@pytest.mark.parametrize("average", AVERAGES)
def test_an_average_of_buffers_finds_its_templates(average: str, backend: str) -> None:
    """An average of poses is a start like any other; templates change by rounding, the model's tracker not at all."""
    model, same = Model(backend=backend), made(backend=backend)
    averaged = AveragedModel(model, use_buffers=True, **AVERAGES[average])
    for frame in FRAMES[1:5]:
        model(frame)
        same(frame)
        averaged.update_parameters(model)
    ours = averaged.module.tracker
    torch.testing.assert_close(ours.template, same.template)
    told, wanted = ours(FRAMES[5]), model.tracker(FRAMES[5])
    assert torch.equal(wanted.pose, same(FRAMES[5]).pose)
    assert (told.status == Status.CONVERGED).all()
    assert (told.pose - wanted.pose).abs().max() < 2e-3


@pytest.mark.parametrize("cast", ["half", "float", "double", "bfloat16"])
def test_a_cast_of_the_model_leaves_the_tracker_exact(cast: str, backend: str) -> None:
    """Poses stay float64 and pixels float32, whatever the layers beside them become."""
    model, same = Model(backend=backend), made(backend=backend)
    for each in (model.tracker, same):
        each(FRAMES[1])
    getattr(model, cast)().to(torch.float16)
    assert model.layer.weight.dtype == torch.float16
    assert_goes_on_as(model.tracker, same, FRAMES[2:])


def test_there_and_back(device: torch.device, backend: str) -> None:
    """To another device, or the same, and back; a state of one device is a state on another."""
    tracker, same = used(backend=backend), used(backend=backend)
    tracker.to(device)
    copied = made(FRAMES[0].to(device), backend=backend)
    copied.load_state_dict(same.state_dict())
    assert (copied(FRAMES[3]).pose - tracker(FRAMES[3]).pose).abs().max() < 1e-9
    tracker.cpu().load_state_dict(same.state_dict())
    assert_goes_on_as(tracker, same)


def test_a_state_keeps_its_identity(backend: str) -> None:
    """It is written in place: a view that was taken once follows, over frames, loads, moves and assignments."""
    tracker, other = made(backend=backend), used(backend=backend)
    parts, view = dict(tracker.named_buffers()), tracker.pose[1, :2]

    def assert_kept() -> None:
        assert all(part is parts[name] for name, part in tracker.named_buffers())
        assert torch.equal(view, tracker.pose[1, :2])

    for frame in (FRAMES[1], BLANK, FRAMES[2]):
        tracker(frame)
        assert_kept()
    for assign in (False, True):
        tracker.load_state_dict(other.state_dict(), assign=assign)
        assert_kept()
        assert torch.equal(view, other.pose[1, :2])
    tracker.to("cpu").double()
    assert_kept()
    tracker.pose = (other.pose + 1).float()
    assert_kept()
    assert tracker.pose.dtype == torch.float64
    assert (tracker.pose - other.pose - 1).abs().max() < 1e-5


def test_an_assigned_pose_is_not_the_users_tensor() -> None:
    """What is assigned is copied: the next frame does not write into it."""
    tracker, mine = made(), torch.tensor([[*c, 0.0] for c in HERE], dtype=torch.float64)
    before = mine.clone()
    tracker.pose = mine
    tracker(FRAMES[1])
    assert torch.equal(mine, before)
    with pytest.raises(ValueError, match=r"Tracker: pose must be \(2, 3\), got \(1, 3\)"):
        tracker.pose = mine[:1]
    with pytest.raises(ValueError, match=r"Tracker: pose must be a torch tensor, got builtins\.list"):
        tracker.pose = mine.tolist()


def test_inference_mode_ends(backend: str) -> None:
    """Made, loaded, moved and used in inference mode, it is used, loaded and saved outside of it, and back."""
    tracker = used(backend=backend)
    with torch.inference_mode():
        inside = made(OTHER, THERE, backend=backend)
        inside.load_state_dict(tracker.state_dict())
        inside.to("cpu")
        twin, pickled = copy.deepcopy(inside), pickle.loads(pickle.dumps(inside))
        saved = inside.state_dict()
    assert_goes_on_as(twin, pickled)
    tracker.load_state_dict(saved)
    assert_goes_on_as(inside, tracker)
    with torch.inference_mode():
        assert_goes_on_as(twin, inside, FRAMES[:2])


def test_a_state_is_a_snapshot_only_when_copied() -> None:
    """As of any module: the tensors of a state_dict are the tracker's own."""
    tracker = made()
    state, kept = tracker.state_dict(), copy.deepcopy(tracker.state_dict())
    tracker(FRAMES[1])
    assert torch.equal(state["pose"], tracker.pose)
    assert not torch.equal(kept["pose"], tracker.pose)


def test_a_state_from_before_is_filled() -> None:
    """That of a tracker which did not know yet of what stays with a camera."""
    tracker, twin = used(), made()
    tracker.lines.copy_(unknown_lines(tracker.start))  # it has not asked for them either
    state = {name: part for name, part in tracker.state_dict().items() if name not in ("fixed", "doubt", "lines")}
    twin.load_state_dict(state)
    assert_goes_on_as(tracker, twin)
