"""Laws of torch's ambient state: autocast, default dtype and device, and inference mode change no pose.

An object is made under a state or before it, and used under it and afterwards: what comes out is always the same. So it
is with cold caches, of which the state then makes the content, and with warm ones that other states have filled.
"""

from __future__ import annotations

import importlib
import pkgutil
import random
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache

import pytest
import torch
from torch import Tensor

import torch_ecc as te
from torch_ecc import servo
from torch_ecc.core import ambient, fused
from torch_ecc.sim.scene.scene import PlaneWaves

BACKENDS = ("native", "torch")
CPU = {"dtype": torch.float64, "device": "cpu"}  # what a user makes is on the CPU, whatever the default is
FLOORS = ("core", "search", "track")
SHAPE, CENTER, SIZE = (72, 80), [(40.0, 36.0)], 25
PATH = [(40, 36, 0), (41.2, 35.3, 0.02), (49.4, 40.6, 0.09), (26.3, 27.8, -1.2)]
# It moves a little; jumps, and is found nearby; jumps, and is found only in the whole frame.
FRAMES = PlaneWaves.random(seed=5).render(torch.tensor(PATH, **CPU), SHAPE)[:, 0].round().clamp(0, 255).byte()
FLOATS = FRAMES.float()
COLOUR = FRAMES[:, None].expand(-1, 3, -1, -1).contiguous()
START = torch.tensor([[1.0, -0.8, 0.01]], **CPU) + torch.tensor([[40.0, 36.0, 0.0]], **CPU)
MOVES = torch.tensor([[1.0, 2, 0.1], [4, -3, 0.2], [-2, 5, 0.3], [0, 1, 0]], **CPU)
STAGE = torch.tensor([[0.3, -1.1], [1.2, 0.9], [-0.5, -2.6], [0, 0]], **CPU)
DISC = (torch.arange(SIZE, **CPU) - 12).square()
DISC = (DISC[:, None] + DISC).float() < 150


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def default_device(device: str) -> Iterator[None]:
    torch.set_default_device(device)
    try:
        yield
    finally:
        torch.set_default_device(None)


@contextmanager
def everything() -> Iterator[None]:
    with ExitStack() as stack:
        for name in ("bfloat16 autocast", "float16 default", "meta default", "inference"):
            stack.enter_context(STATES[name]())
        yield


STATES = {
    "bfloat16 autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "float16 autocast": lambda: torch.autocast("cpu", dtype=torch.float16),
    "float64 default": lambda: default_dtype(torch.float64),
    "float16 default": lambda: default_dtype(torch.float16),
    "meta default": lambda: default_device("meta"),
    "inference": torch.inference_mode,
    "all at once": everything,
}


def tracker(**options):
    return lambda: te.Tracker(FRAMES[0], CENTER, SIZE, **options)


def follow(tracker: te.Tracker) -> list[Tensor]:
    """All that is told of the frames, and all that is kept of them; once it has been there, of the last one."""
    new = torch.equal(tracker.pose, tracker.start)
    track = tracker.track_sequence(FRAMES[1 if new else 3 :])
    return [*track, track.sigma, *tracker.buffers()]


def step(tracker: te.Tracker) -> list[Tensor]:
    return list(tracker(FRAMES[1]))


def found(tracker: te.Tracker) -> list[Tensor]:
    servo.find(tracker, FRAMES[3])
    return [tracker.pose, *tracker(FRAMES[3]), *tracker.buffers()]


def patch(mask: Tensor | None = None) -> te.Reference:
    return te.prepare(FRAMES[0, 24:49, 28:53], mask=mask)


def align(backend: str):
    return lambda reference: list(te.align(reference, FLOATS[1], START, interpolation="bspline5", backend=backend))


def located(found: te.Located) -> list[Tensor]:
    return [*found.estimate, found.score, *found.runner_up, found.runner_up_score, found.ambiguous]


def poses(_: None) -> list[Tensor]:
    p, q = MOVES[:2], MOVES[2:]
    back = te.pose.from_opencv(te.pose.to_opencv(p, (5, 7)), (5, 7)), te.pose.from_se2(te.pose.to_se2(p))
    two = [function(p, q) for function in (te.pose.compose, te.pose.retract, te.pose.ahead)]
    turned = te.pose.transform(p, STAGE[None]), te.pose.unwrap(p[:, 2], q[:, 2])
    return [*back, *two, *turned, te.pose.inverse(p), te.pose.from_matrix(te.pose.matrix(p))]


def converted(fit: te.CalibrationFit) -> list[Tensor]:
    """In float32, which autocast would not leave alone; eighths, which the last digit of a fit does not move."""
    fx, fy = (round(8 * f) / 8 for f in fit.calibration.scales)
    calibration, moves = te.Calibration((fx, fy), axis_angle=0.3), MOVES.float()
    physical = calibration.to_physical(moves)
    return [fit.sigma, physical, calibration.to_pixels(physical), calibration.covariance(torch.diag_embed(moves.abs()))]


def nothing() -> None:
    return None


# How an object is made, and what is asked of it.
CALLS = {
    **{f"Tracker, {name}": (tracker(backend=name, search=name != "torch"), follow) for name in BACKENDS},
    "levels, ssd": (tracker(backend="torch", levels=2, criterion="ssd"), step),
    "quadratic light, a mask": (tracker(illumination="quadratic", mask=DISC), step),
    "tensors that the state has made": (
        lambda: te.Tracker(FLOATS[0] + 0, CENTER, SIZE, mask=DISC.float() + 0),
        lambda tracker: list(tracker(FLOATS[1] + 0)),
    ),
    "colour": (lambda: te.Tracker(COLOUR[0], CENTER, SIZE), lambda tracker: list(tracker(COLOUR[1]))),
    "Tracker.find": (lambda: te.Tracker.find(FRAMES[0, 24:49, 28:54], FRAMES[1])[0], step),
    "servo.find": (tracker(), found),
    **{f"align, {name}": (patch, align(name)) for name in BACKENDS},
    "a mask": (lambda: patch(DISC), align("torch")),
    "locate": (patch, lambda reference: located(te.locate(reference, COLOUR[3]))),
    "Locator": (lambda: te.Locator(patch(), SHAPE), lambda locator: located(locator(FRAMES[3]))),
    "texture": (nothing, lambda _: [te.texture(COLOUR[0], CENTER, SIZE)]),
    "pose": (nothing, poses),
    "Calibration": (lambda: te.calibrate(MOVES, STAGE), converted),
}
QUICK = [name for name in CALLS if name not in {"Tracker, native", "Tracker, torch", "servo.find"}]
FEW = {"float16 autocast", "float64 default", "all at once"}  # what is at once with others, only with them
cases = pytest.mark.parametrize(("name", "state"), [(n, s) for n in CALLS for s in STATES if n in QUICK or s in FEW])


@cache
def caches() -> list:
    """Of constants, all but the compiled engine's."""
    names = [m.name for m in pkgutil.walk_packages(te.__path__, "torch_ecc.") if m.name.split(".")[1] in FLOORS]
    if not fused.installed():  # its kernels need Triton
        names = [name for name in names if not name.startswith("torch_ecc.core.fused.")]
    values = [value for name in names for value in vars(importlib.import_module(name)).values()]
    return [v for v in values if hasattr(v, "cache_clear") and v.__module__ != "torch_ecc.core.native.library"]


def forget() -> None:
    for each in caches():
        each.cache_clear()


@cache
def expected(name: str) -> tuple[list[Tensor], list[Tensor]]:
    """What comes out without any state, the first time and the second."""
    make, use = CALLS[name]
    made = make()
    return tuple([value.clone() for value in use(made)] for _ in range(2))


def assert_same(came: list[Tensor], wanted: list[Tensor]) -> None:
    for a, b in zip(came, wanted, strict=True):
        assert a.dtype == b.dtype
        assert a.device == b.device
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12, equal_nan=True)  # lstsq differs by 1e-15 from call to call


@pytest.fixture(autouse=True)
def _plain() -> Iterator[None]:
    for name in CALLS:
        expected(name)
    yield
    assert torch.get_default_dtype() == torch.float32
    assert torch.zeros(1).device.type == "cpu"


@cases
def test_what_was_made_before_a_state_serves_in_it_and_afterwards(name: str, state: str) -> None:
    """Plainly made, used under the state, and plainly again."""
    (make, use), (first, second) = CALLS[name], expected(name)
    made = make()
    with STATES[state]():
        came = use(made)
    assert_same(came, first)
    assert_same(use(made), second)


@cases
def test_what_is_made_in_a_state_serves_in_it_and_afterwards(name: str, state: str) -> None:
    """Made and used under the state, which also fills the caches, and then plainly."""
    (make, use), (first, second) = CALLS[name], expected(name)
    forget()
    with STATES[state]():
        made = make()
        came = use(made)
    assert_same(came, first)
    assert_same(use(made), second)


def test_no_state_leaves_anything_behind() -> None:
    """One state after the other, in any order, on the caches that the others have left."""
    order = [(name, state) for name in QUICK for state in (*STATES, None)]
    random.Random(0).shuffle(order)
    forget()
    for name, state in order:
        make, use = CALLS[name]
        with STATES[state]() if state else ExitStack():
            came = use(make())
        assert_same(came, expected(name)[0])


def test_a_tracker_goes_from_state_to_state() -> None:
    """One tracker, another state in every frame."""
    frames = [FRAMES[k % 2] for k in range(1, 1 + len(STATES))]
    tracker, same = (te.Tracker(FRAMES[0], CENTER, SIZE) for _ in range(2))
    for frame, state in zip(frames, STATES.values(), strict=True):
        with state():
            came = tracker(frame)
        assert_same(list(came), list(same(frame)))
    assert not any(part.is_inference() for part in tracker.buffers())
    weight = torch.ones(3, dtype=torch.float64, requires_grad=True)
    pose = tracker(FRAMES[0]).pose
    (pose * weight).sum().backward()  # what a tracker answers with are ordinary tensors
    assert torch.equal(weight.grad, pose[0])


def test_autocast_goes_on_behind_a_door() -> None:
    """A door closes for its own call only, and leaves the state as it found it when it raises."""

    @ambient.plain
    def door(fail: bool) -> Tensor:
        if fail:
            raise ValueError("closed")
        return square @ square

    square = torch.ones(2, 2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert door(False).dtype == torch.float32
        with pytest.raises(ValueError, match="closed"):
            door(True)
        assert (square @ square).dtype == torch.bfloat16


@pytest.mark.parametrize("name", ["align", "locate", "Body"])
def test_what_is_small_is_done_by_one_thread(monkeypatch, name):
    """Others would spin at the end of each small operation: with a core that is busy it takes as long as a time slice.
    Told by what all of them do in the end."""
    scene = PlaneWaves.random(seed=3)
    frame = scene.render(torch.tensor([[60.0, 60.0, 0.0]]), (120, 120))[0, 0]
    tracker, seen, before = te.Tracker(frame, [(40.0, 60.0), (80.0, 60.0)], 31), [], torch.get_num_threads()
    body, reference = te.Body(tracker), te.prepare(frame[45:76, 25:56][None, None])
    calls = {
        "align": lambda: te.align(reference, frame[None, None], torch.tensor([[40.0, 60.0, 0.0]]).double()),
        "locate": lambda: te.locate(reference, frame[None, None]),
        "Body": lambda: body(tracker(frame)),
    }
    inside = {"align": ("core.align", "solve"), "locate": ("search.locate", "_best_two"), "Body": ("body.body", "fuse")}
    module, last = importlib.import_module(f"torch_ecc.{inside[name][0]}"), inside[name][1]
    inner = getattr(module, last)
    monkeypatch.setattr(module, last, lambda *args: (seen.append(torch.get_num_threads()), inner(*args))[1])
    torch.set_num_threads(2)
    try:
        calls[name]()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert set(seen) == {1}


@pytest.mark.parametrize("wanted", [1, 2])
def test_the_number_of_threads_is_the_callers(wanted):
    """A frame is tracked on as many as it is worth, and its caller's number is there again, whatever happens."""
    seen, before = [], torch.get_num_threads()

    def fails() -> None:
        with ambient.threads_for(200), ambient.threads_for(100):
            seen.append(torch.get_num_threads())
            assert ambient.threads_of_caller() == wanted
            raise KeyError

    torch.set_num_threads(wanted)
    try:
        with pytest.raises(KeyError):
            fails()
        seen.append(torch.get_num_threads())
        with ambient.threads_for(ambient.PIXELS_PER_THREAD):
            seen.append(torch.get_num_threads())
    finally:
        torch.set_num_threads(before)
    assert seen == [1, wanted, wanted]
    assert ambient.threads_of_caller() == before
