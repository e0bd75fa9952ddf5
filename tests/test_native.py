"""What is the native engine's own: how it reads templates and frames; and no call of its operator ends a process."""

from __future__ import annotations

import copy
import gc
import json
import os
import pickle
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor

import operator_calls
import pytest
import torch
from engines import CRITERIA, FRAME, SCENE, Problem, compiled

from torch_ecc import ECC, SSD, PaperECC, Status, Tracker, align, prepare
from torch_ecc.core import reference
from torch_ecc.core.native import engine as native
from torch_ecc.core.native import entry
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Trust

forking = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes do not fork here")


@compiled
def test_threads_do_not_matter(monkeypatch):
    """Each template is solved by one of them, in whatever order."""
    prepared, image, start = Problem(count=16, place="border", enough=100).made(ECC())
    before, found = torch.get_num_threads(), []
    monkeypatch.setattr(entry, "PIXELS_PER_THREAD", 1)
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(align(prepared, image, start, backend="native"))
    finally:
        torch.set_num_threads(before)
    for one, two, five in zip(*found, strict=True):
        assert torch.equal(one, two)
        assert torch.equal(one, five)


@compiled
def test_frames_are_read_where_they_are():
    """Rows with gaps, columns with gaps and a channel of a larger tensor: the same as a copy of them."""
    prepared, image, start = Problem(enough=100, seed=3).made(ECC())
    plain = align(prepared, image, start)
    wide = torch.nn.functional.pad(image.int(), (3, 5, 2, 4), value=99).to(torch.uint8)
    for view in (
        wide[:, :, 2:-4, 3:-5],
        image.repeat_interleave(2, -1)[..., ::2],
        image.expand(1, 4, -1, -1)[:, 1:2],
    ):
        assert torch.equal(align(prepared, view, start).pose, plain.pose)


@compiled
@pytest.mark.parametrize("options", [{"criterion": "ecc_paper"}, {"levels": 2}, {"interpolation": "bilinear"}, {}])
def test_a_tracker_follows_the_same_path(options):
    centers = [(50.0, 50.0), (80.0, 60.0), (115.0, 20.0)]  # the last one leaves the frame
    steps = torch.linspace(0, 1, 8, dtype=torch.float64)
    middle = torch.tensor([60.0, 50.0, 0.0], dtype=torch.float64)
    poses = middle + torch.stack((14 * steps, -9 * steps**2, 0.1 * steps), -1)
    frames = SCENE.render(poses, FRAME).round().clamp(0, 255).to(torch.uint8)
    tracks = [
        Tracker(frames[0], centers, 29, backend=backend, **options).track_sequence(frames)
        for backend in ("native", "torch")
    ]
    assert torch.equal(*(track.status for track in tracks))
    assert (tracks[0].pose - tracks[1].pose).abs().max() < 2e-4


@compiled
@pytest.mark.parametrize("criterion", [ECC(), SSD(), PaperECC()])
def test_a_mask_of_every_second_pixel(criterion):
    """Pixels two apart are where they are: score, residual and sigma are those of the torch page."""
    mask = torch.zeros(31, 31)
    mask[::2, ::2] = 1
    prepared, image, start = Problem((31, 31), seed=3).made(ECC())
    template = SCENE.render(torch.tensor([[15.0, 15.0, 0.0]], dtype=torch.float64), (31, 31))
    prepared = prepare(template, criterion=criterion, mask=mask)
    fast, slow = (align(prepared, image, start, backend=backend) for backend in ("native", "torch"))
    assert torch.equal(fast.status, slow.status)
    torch.testing.assert_close(fast.residual_rms, slow.residual_rms, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(fast.sigma, slow.sigma, rtol=1e-2, atol=0)


def clean():
    """A template, a frame and a start within the basin, all without noise."""
    still, truth = (torch.tensor([pose], dtype=torch.float64) for pose in ([15.0, 15.0, 0.0], [60.0, 50.0, 0.5]))
    start = truth + torch.tensor([[0.8, -0.6, 0.02]])
    return SCENE.render(still, (31, 31)).float(), SCENE.render(truth, FRAME).float(), start


@compiled
def test_a_mask_that_leaves_few_of_the_first_pixels():
    """Of the coarser grid one pixel counts: the first iterations have nothing to go by, whatever the engine."""
    template, image, start = clean()
    mask = torch.zeros(31, 31)
    mask[1::2, 1::2] = mask[0, 0] = 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reference, "ENOUGH", 50)
        prepared = prepare(template, mask=mask)
    assert prepared.coarse.grid.pixels.shape[1] == 1
    fast, slow = (align(prepared, image, start, max_iterations=4, backend=backend) for backend in ("native", "torch"))
    assert torch.equal(fast.iterations, slow.iterations)
    assert (fast.pose - slow.pose).abs().max() < 1e-4


@compiled
def test_all_pixels_of_a_mask_with_gaps_are_no_first_stage():
    """Bilinear and all pixels: one stage, in which each step knows the one before."""
    template, image, start = clean()
    mask = torch.zeros(31, 31)
    mask[::2, ::2] = 1
    prepared = prepare(template, mask=mask)
    options = {"interpolation": "bilinear", "tolerance": 1e-9, "max_iterations": 3}
    fast, slow = (
        align(prepared, image, start + torch.tensor([1.2, -0.9, 0.03]), backend=backend, **options)
        for backend in ("native", "torch")
    )
    assert (fast.pose - slow.pose).abs().max() < 3e-5


@compiled
@pytest.mark.parametrize("scale", [2.0**-40, 2.0**-20, 2.0**50])
@pytest.mark.parametrize("criterion", [ECC("quadratic"), PaperECC()])
def test_the_unit_of_grey_levels_does_not_matter(criterion, scale):
    template, image, start = clean()
    plain, scaled = (
        align(prepare(template * unit, criterion=criterion), image * unit, start, backend="native")
        for unit in (1, scale)
    )
    assert plain.status == scaled.status == Status.CONVERGED
    assert (plain.pose - scaled.pose).abs().max() < 1e-5


@compiled
@pytest.mark.parametrize("criterion", [ECC("gain"), PaperECC(), SSD()])
def test_what_is_left_of_a_clean_image_is_told(criterion):
    """A residual of 1e-4 of the contrast, which the difference of two large sums would drown."""
    template, image, start = clean()
    prepared = prepare(template, criterion=criterion)
    fast, slow = (
        align(prepared, image, start, interpolation="bspline5", tolerance=1e-5, backend=backend)
        for backend in ("native", "torch")
    )
    assert slow.residual_rms < 2e-4 * template.std()
    torch.testing.assert_close(fast.residual_rms, slow.residual_rms, rtol=0.1, atol=0)


@compiled
@pytest.mark.parametrize("size", [21, 150])
def test_packed_templates_go_with_their_reference(size):
    """Made once, and gone when the tracker is."""
    frame = torch.rand(1, 1, 200, 200)
    tracker = Tracker(frame, [(100, 100)], size, backend="native")
    tracker.track(frame)
    packed = tracker.references[0].packed
    tracker.track(frame)
    assert tracker.references[0].packed is packed
    planes = weakref.ref(packed.tensors[0])
    del tracker, packed
    gc.collect()
    assert planes() is None


@compiled
@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
@pytest.mark.parametrize("masked", [False, True])
def test_packing_loses_nothing(criterion, masked):
    """What 16 bits hold of a template is exactly what the page has of it."""
    prepared, _, _ = Problem((40, 45), 2, mask="each" if masked else "none").made(criterion)
    planes, weight, numbers = prepared.packed.tensors[:3]
    assert planes.shape[-1] % 16 == 0
    rows, columns = prepared.grid.pixels[1] - prepared.grid.box[1, 0], prepared.grid.pixels[0] - prepared.grid.box[0, 0]
    at = (rows.long(), columns.long())
    unit, level = prepared.columns.unit, prepared.columns.level
    for image, plane, scale, shift in (
        (prepared.columns.instrument[:, 0], 0, unit[:, :1], 0),
        (prepared.columns.instrument[:, 3], 2, unit[:, 1:2], level[:, :1]),
        (prepared.signal[:, 1], 4, unit[:, 2:3], 0),
        (prepared.signal[:, 3], 5, unit[:, 3:], level[:, 1:]),
    ):
        torch.testing.assert_close(planes[:, plane][:, *at] * scale + shift, image, rtol=1e-6, atol=1e-5)
    assert torch.equal(weight.expand(2, 40, -1)[:, *at], prepared.weight)
    assert not weight[:, :, 45:].any() or weight.shape[1] == 1
    assert len(numbers) == 2


@compiled
def test_templates_of_one_row():
    """The mask leaves a single row, the same for all: each template is what it is alone."""
    prepared, image, start = Problem(count=3).made(ECC("gain"))
    mask = torch.zeros(31, 40)
    mask[15] = 1
    prepared = prepare(SCENE.render(start, (31, 40)), illumination="gain", mask=mask)
    many = native.solve(prepared, image, start, Settings())
    for k in range(3):
        one = native.solve(prepared.select(torch.tensor([k])), image[k : k + 1], start[k : k + 1], Settings())
        assert torch.equal(one.sums[0], many.sums[k])


@compiled
def test_templates_of_float32_poses_take_the_torch_page():
    """As they come from a device without float64."""
    prepared, image, start = Problem(enough=100, seed=3).made(ECC())
    single = prepared.map(lambda v: v.float() if v.dtype == torch.float64 else v)
    assert (align(single, image, start).pose - align(prepared, image, start).pose).abs().max() < 1e-3


@pytest.fixture(scope="module")
def outcomes() -> dict[str, str]:
    """What becomes of each direct call of the operator."""
    run = subprocess.run([sys.executable, operator_calls.__file__], check=True, capture_output=True, text=True)
    return json.loads(run.stdout)


@compiled
@forking
@pytest.mark.parametrize("name", operator_calls.WRONG | operator_calls.ODD)
def test_no_direct_call_of_the_operator_ends_the_process(name, outcomes):
    """What is wrong is refused with a sentence; what is odd may be answered."""
    outcome = outcomes[name]
    kind, _, words = outcome.partition(": ")
    assert outcome == "answer" if "Error" not in kind else len(words.split()) > 3
    assert outcome != "answer" or name not in operator_calls.WRONG


@compiled
@pytest.mark.parametrize("trusting", [False, True])
def test_the_operator_is_what_it_says(trusting):
    """To torch.compile and torch.export: its schema, its fake results and its values."""
    arguments = operator_calls.valid()
    blocks = torch.ops.torch_ecc.solve(*arguments.values())[4].shape[-1]
    trust = {"trust": torch.rand(2, blocks), "which": torch.tensor([2, 0])} if trusting else {}
    torch.library.opcheck(torch.ops.torch_ecc.solve.default, tuple(arguments.values()), trust)


@compiled
def test_the_operator_gives_what_a_call_gives():
    """Compiled or not."""
    prepared, image, start = Problem(count=3, place="border", enough=100).made(ECC())
    found = native.solve(prepared, image, start, Settings())
    how = (3, 15, 1e-3, 2)
    again = torch.compile(torch.ops.torch_ecc.solve, backend="eager", fullgraph=True)(
        image, start, *prepared.packed, *how
    )
    for one, other in zip(found[:6], again, strict=False):
        assert torch.equal(one, other)


@compiled
def test_a_copied_reference_outlives_its_original():
    """A copy has templates of its own, packed where they are."""
    prepared, image, start = Problem(count=2).made(ECC())
    expected = native.solve(prepared, image, start, Settings())
    copies = copy.deepcopy(prepared), pickle.loads(pickle.dumps(prepared))
    del prepared
    for reference_ in copies:
        torch.testing.assert_close(
            native.solve(reference_, image, start, Settings()).pose, expected.pose, rtol=0, atol=0
        )
        assert reference_.packed.memory != b""


@compiled
@forking
def test_a_forked_process_solves_too(monkeypatch):
    """It has none of the threads that have served before."""
    prepared, image, start = Problem(count=16).made(ECC())
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    monkeypatch.setattr(entry, "PIXELS_PER_THREAD", 1)
    try:
        expected = native.solve(prepared, image, start, Settings()).pose
        child = os.fork()
        if child == 0:
            os._exit(0 if torch.equal(native.solve(prepared, image, start, Settings()).pose, expected) else 1)
    finally:
        torch.set_num_threads(before)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@compiled
def test_many_python_threads_at_once(monkeypatch):
    """Each has its own answer, whoever's threads help."""
    monkeypatch.setattr(entry, "PIXELS_PER_THREAD", 1)
    monkeypatch.setattr(entry, "threads_of_caller", lambda: 3)
    problems = [Problem(count=8, seed=seed).made(ECC()) for seed in range(6)]
    alone = [native.solve(*problem, Settings()).pose for problem in problems]
    with ThreadPoolExecutor(6) as pool:
        for _ in range(5):
            together = pool.map(lambda problem: native.solve(*problem, Settings()).pose, problems)
            assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


@compiled
@pytest.mark.parametrize(
    ("image", "start", "trust"),
    [
        (torch.zeros(3, 1, 110, 130), torch.zeros(2, 3).double(), None),
        (torch.zeros(1, 3, 110, 130), torch.zeros(2, 3).double(), None),
        (torch.zeros(1, 1, 110, 130), torch.zeros(1, 3).double(), None),
        (torch.zeros(1, 1, 110, 130), torch.zeros(2, 3).double(), Trust(torch.tensor([2]), torch.ones(1, 42))),
        (torch.zeros(1, 1, 110, 130), torch.zeros(2, 3).double(), Trust(torch.tensor([-1]), torch.ones(1, 42))),
        (torch.zeros(1, 1, 110, 130), torch.zeros(2, 3).double(), Trust(torch.tensor([0]), torch.ones(1, 41))),
        (torch.zeros(1, 1, 110, 130), torch.zeros(2, 3).double(), Trust(torch.tensor([0]), torch.ones(1, 42).double())),
        (torch.zeros(1, 1, 110, 130), torch.zeros(2, 3).double(), Trust(torch.tensor([0.0]), torch.ones(1, 42))),
        (torch.zeros(1, 1, 110, 130), torch.zeros(2, 3).double(), Trust(torch.tensor([0]), torch.ones(1, 84)[:, ::2])),
    ],
)
def test_what_would_be_read_beyond_its_end_is_refused(image, start, trust):
    prepared, _, _ = Problem(count=2).made(ECC())
    with pytest.raises(ValueError, match=r"(solve|trust): expected .* (got|gaps)"):
        native.solve(prepared, image, start, Settings(), trust)


def test_unknown_backend():
    with pytest.raises(ValueError, match=r"backend: expected one of \['auto', 'torch', 'native', 'fused'\], got 'gpu'"):
        Settings(backend="gpu")
