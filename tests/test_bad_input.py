"""Every wrong call of the library has its own sentence: what was wrong, what was expected, what came."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torch_ecc import ECC, Calibration, Tracker, align, calibrate, prepare, texture
from torch_ecc.sim.scene.scene import PlaneWaves

FRAME = (100 * torch.rand(100, 120, generator=torch.Generator().manual_seed(0)) + 50).to(torch.uint8)
GOOD = {"frame": FRAME, "centers": [(60.0, 50.0)], "size": 31}
POSE = torch.zeros(1, 3, dtype=torch.float64)
PATH = torch.tensor([(50, 44, 0), (51.2, 43.3, 0.02), (52.1, 42.9, 0.03)], dtype=torch.float64)
NAN = FRAME.float().clone()
NAN[3, 7] = math.nan


def tracker(**changes):
    return Tracker(**(GOOD | changes))


def reference():
    return prepare(FRAME[None, None, 30:61, 40:71])


CALLS = {
    # the tracker's door
    "frame shape": (
        lambda: tracker(frame=torch.zeros(3)),
        r"Tracker: frame must be \(H, W\), \(C, H, W\) or .*, got \(3,\)",
    ),
    "frame empty": (
        lambda: tracker(frame=torch.zeros(0, 5)),
        r"Tracker: frame must hold pixels, got the empty shape \(0, 5\)",
    ),
    "frame numpy": (
        lambda: tracker(frame=np.zeros((9, 9))),
        r"Tracker: frame must be a torch tensor, got numpy.ndarray",
    ),
    "frame complex": (
        lambda: tracker(frame=FRAME + 0j),
        r"Tracker: frame must be of integers, float \(16 to 64 bits\) or bool, got torch.complex64",
    ),
    "frame float8": (
        lambda: tracker(frame=FRAME.to(torch.float8_e4m3fn)),
        r"Tracker: frame must be of integers, float \(16 to 64 bits\) or bool, got torch.float8_e4m3fn",
    ),
    "frame quantised": (
        lambda: tracker(frame=torch.quantize_per_tensor(FRAME.float(), 1.0, 0, torch.quint8)),
        r"Tracker: frame must be of integers, float \(16 to 64 bits\) or bool, got torch.quint8",
    ),
    "frame int32 too wide": (
        lambda: tracker(frame=FRAME.int() + 2**24),
        "Tracker: frame must hold numbers that float32 holds exactly, got torch.int32 beyond 2\\^24",
    ),
    "frame int64 too wide": (
        lambda: tracker(frame=FRAME.expand(3, -1, -1).long() - 2**40),
        "Tracker: frame must hold numbers that float32 holds exactly, got torch.int64 beyond 2\\^24",
    ),
    "channels": (lambda: tracker(frame=FRAME.expand(2, -1, -1)), r"1, 3 or 4 channels, got \(2, 100, 120\)$"),
    "channels last": (
        lambda: tracker(frame=FRAME[..., None].expand(-1, -1, 3)),
        r"channels last\? use permute\(2, 0, 1\)",
    ),
    "frame nan": (
        lambda: tracker(frame=NAN),
        "frame must be finite, got 1 NaN or infinite values, the first at row 3, column 7",
    ),
    "frame inf": (lambda: tracker(frame=NAN.nan_to_num(torch.inf)), "frame must be finite, got 1 NaN or infinite"),
    "centers shape": (
        lambda: tracker(centers=(60.0, 50.0)),
        r"Tracker: centers must be \(R, 2\) as \(x, y\), got \(2,\)",
    ),
    "centers none": (lambda: tracker(centers=[]), r"centers must be \(R, 2\) as \(x, y\), got \(0,\)"),
    "centers nan": (lambda: tracker(centers=[(math.nan, 5.0)]), r"centers must be finite, got \[\[nan, 5.0\]\]"),
    "centers words": (lambda: tracker(centers="middle"), "centers must be numbers"),
    "template outside": (
        lambda: tracker(centers=[(60.0, 50.0), (10.0, 50.0)]),
        r"template 1 \(31x31 px around x=10, y=50\) must lie in the frame of 120x100 px",
    ),
    "template larger": (lambda: tracker(size=130), r"template 0 \(130x130 px .* must lie in the frame of 120x100 px"),
    "size negative": (lambda: tracker(size=-31), "size must be one or two whole numbers of at least 5 px, got -31"),
    "size zero": (lambda: tracker(size=0), "size must be one or two whole numbers of at least 5 px, got 0"),
    "size float": (lambda: tracker(size=31.5), "size must be one or two whole numbers of at least 5 px, got 31.5"),
    "size three": (lambda: tracker(size=(31, 31, 3)), r"size must be one or two whole numbers .*, got \(31, 31, 3\)"),
    "template flat": (
        lambda: tracker(frame=torch.full((99, 99), 7.0)),
        "must have texture, got one single grey level in template",
    ),
    "mask shape": (
        lambda: tracker(mask=torch.ones(30, 31)),
        r"mask must be \(31, 31\), \(1, 31, 31\) or .*, got \(30, 31\)",
    ),
    "mask empty": (
        lambda: tracker(mask=torch.zeros(31, 31)),
        r"mask must keep at least one pixel of each template, .* \[0\]",
    ),
    "mask negative": (
        lambda: tracker(mask=-torch.ones(31, 31)),
        "mask must hold finite weights >= 0, got values from -1 to -1",
    ),
    "mask numpy": (lambda: tracker(mask=np.ones((31, 31))), "mask must be a torch tensor, got numpy.ndarray"),
    "criterion": (
        lambda: tracker(criterion="ncc"),
        r"criterion: expected one of \['ecc', 'ecc_paper', 'ssd'\] .*'ncc'",
    ),
    "illumination": (
        lambda: tracker(illumination="cubic"),
        r"illumination: expected one of \['gain', .*\], got 'cubic'",
    ),
    "interpolation": (
        lambda: tracker(interpolation="bicubic"),
        r"interpolation: expected one of \['bilinear', .*'bicubic'",
    ),
    "prediction": (
        lambda: tracker(prediction="kalman"),
        r"prediction: expected one of \['hold', 'velocity'\], got 'kalman'",
    ),
    "levels": (lambda: tracker(levels=4), "levels: expected 1 to 2 for templates of 31x31 px, got 4"),
    "iterations": (lambda: tracker(max_iterations=0), "max_iterations: expected a whole number of at least 1, got 0"),
    "iterations float": (lambda: tracker(max_iterations=15.0), "max_iterations: expected a whole number .*, got 15.0"),
    "levels float": (lambda: tracker(levels=2.0), "levels: expected 1 to 2 .*, got 2.0"),
    "criterion class": (lambda: tracker(criterion=ECC), "criterion: expected a name or an object with columns, step"),
    "criterion none": (lambda: tracker(criterion=None), "criterion: expected a name or an object .*, got None"),
    "align template": (lambda: align(FRAME, FRAME, POSE), "align: reference must come from prepare, got Tensor"),
    "prepare centre": (lambda: prepare(FRAME, centre=torch.zeros(3)), r"prepare: centre must be \(1, 2\), got \(3,\)"),
    "tolerance": (lambda: tracker(tolerance=0.0), "tolerance: expected a length in px > 0, got 0"),
    "tolerance inf": (lambda: tracker(tolerance=math.inf), "tolerance: expected a length in px > 0, got inf"),
    "tolerance nan": (lambda: tracker(tolerance=math.nan), "tolerance: expected a length in px > 0, got nan"),
    "min_score": (lambda: tracker(min_score=2.0), "min_score: expected a number from 0 to 1, got 2"),
    "device": (lambda: tracker(device="abacus"), "Tracker: device must be one of this machine, got 'abacus'"),
    "streams": (lambda: tracker(frame=FRAME.expand(3, 1, -1, -1)), r"one image or one per template \(1\), got 3"),
    # later frames
    "another size": (
        lambda: tracker()(FRAME[:-1]),
        "track: frame must be 1 image of 120x100 px as the first, got .* 120x99 px",
    ),
    "track shape": (lambda: tracker().track(torch.zeros(3)), r"track: frame must be \(H, W\), .*, got \(3,\)"),
    "track complex": (lambda: tracker()(FRAME + 0j), "track: frame must be of integers, .* got torch.complex64"),
    "track uint32 too wide": (
        lambda: tracker()((FRAME.long() + 2**25).to(torch.uint32)),
        "track: frame must hold numbers that float32 holds exactly, got torch.uint32",
    ),
    "track nan": (lambda: tracker()(NAN), "track: frame must be finite, got 1 NaN"),
    "no frames": (
        lambda: tracker().track_sequence([]),
        "track_sequence: frames must hold at least one frame, got none",
    ),
    # functions
    "prepare small": (lambda: prepare(FRAME[:4, :4]), "prepare: template must be at least 5x5 px, got 4x4"),
    "prepare flat": (
        lambda: prepare(torch.ones(9, 9)),
        r"prepare: template must have texture, got one single grey level",
    ),
    "align pose": (
        lambda: align(reference(), FRAME, torch.zeros(2, 3)),
        r"pose must be \(1, 3\), one per template, got \(2, 3\)",
    ),
    "align int": (
        lambda: align(reference(), FRAME, POSE.int()),
        "pose must hold finite floating-point numbers, got torch.int32",
    ),
    "align nan": (lambda: align(reference(), FRAME, POSE * math.nan), "pose must hold finite floating-point numbers"),
    "align images": (
        lambda: align(reference(), FRAME.expand(2, 1, -1, -1), POSE),
        r"one per template \(1\), got a batch of 2",
    ),
    "texture noise": (
        lambda: texture(FRAME, [(60, 50)], 31, noise=-1),
        "texture: noise must be a standard deviation >= 0",
    ),
    # calibration
    "zero scale": (lambda: Calibration(0.0), "um_per_px: expected one or two finite numbers other than 0, got 0.0"),
    "nan scale": (lambda: Calibration((0.1, math.nan)), "um_per_px: expected one or two finite numbers other than 0"),
    "three scales": (lambda: Calibration((1.0, 1.0, 1.0)), "um_per_px: expected one or two finite numbers"),
    "angle": (lambda: Calibration(0.1, math.inf), "axis_angle: expected a finite angle in rad, got inf"),
    "moves": (lambda: calibrate(torch.zeros(4, 2), torch.zeros(5, 2)), r"expected displacements \(N, 2 or 3\)"),
    "line": (lambda: calibrate(torch.ones(4, 2), torch.ones(4, 2)), "moves must span the plane, got 4"),
}


@pytest.mark.parametrize("name", CALLS)
def test_says_what_was_wrong(name):
    call, message = CALLS[name]
    with pytest.raises(ValueError, match=message):
        call()


LEVELS = 100 * PlaneWaves.random(seed=5).render(PATH, (90, 100))[:, 0] / 255  # fit int8
TAKEN = [torch.uint16, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint32, torch.uint64]
TAKEN += [torch.float16, torch.bfloat16, torch.float32, torch.float64]


def poses(stack, backend):
    """Of a tracker (2, 3), of ``align`` (1, 3), and the sigma of ``texture`` (1, 3)."""
    center, start = [(50.0, 44.0)], torch.tensor([[40.5, 39.0, 0.01]], dtype=torch.float64)
    track = Tracker(stack[0], center, 31, backend=backend).track_sequence(stack[1:])
    there = align(prepare(stack[0, 20:60, 21:61]), stack[1], start, backend=backend)
    assert not torch.cat((track.status.flatten(), there.status)).any()
    return torch.cat((track.pose[:, 0], there.pose, texture(stack[0], center, 31)))


@pytest.mark.parametrize("backend", ["native", "torch"])
@pytest.mark.parametrize("dtype", TAKEN)
def test_the_same_scene_in_each_dtype_gives_the_same_pose(dtype, backend):
    """Integers of any width, signed or not, and float of any precision that holds the grey levels."""
    stack = LEVELS.round()
    expected = poses(stack.to(torch.uint8), backend=backend)
    came = poses(stack.to(dtype), backend=backend)
    rounding = 3 if dtype.is_floating_point else None  # the row of texture: float is not taken as rounded
    assert (came - expected)[:rounding].abs().max() < 1e-6


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_black_and_white_is_0_and_1(backend):
    """A frame of bool is the frame of its numbers, and one of another dtype may follow."""
    stack = (LEVELS - LEVELS.mean()) > 0
    expected = poses(stack.to(torch.uint8), backend=backend)
    assert (poses(stack, backend=backend) - expected).abs().max() < 1e-6
    made = Tracker(stack[0], [(50.0, 44.0)], 31, criterion="ssd", backend=backend)
    assert (made(stack[1].double()).pose - expected[0]).abs().max() < 0.05


def test_wide_integers_need_not_be_small():
    """Grey levels in the upper half of 32 bits, as some cameras give them, are exact in float32."""
    stack = LEVELS.round().long()
    assert (poses(stack << 20, "torch") - poses(stack, "torch"))[:3].abs().max() < 1e-6


def test_colour_of_integers_is_turned_to_grey():
    """As colour of uint8 is."""
    stack = LEVELS.round()[:, None] * torch.tensor([0.5, 0.8, 1.0])[:, None, None]
    came, expected = (
        Tracker(colour[0], [(50.0, 44.0)], 31).track_sequence(colour[1:])
        for colour in (stack.to(dtype) for dtype in (torch.int32, torch.uint8))
    )
    assert torch.equal(came.pose, expected.pose)


def test_a_template_of_a_reference_is_its_own():
    """What is prepared does not follow the tensors that it was prepared from."""
    centre = torch.zeros(1, 2)
    made = prepare(FRAME, centre=centre)
    centre += 1
    assert torch.equal(made.place.centre, torch.zeros(1, 2))


def test_there_are_many():
    assert len(CALLS) >= 25


def test_another_device_is_refused():
    with pytest.raises(ValueError, match=r"align: pose must be on the reference's device cpu, got meta"):
        align(reference(), FRAME, torch.zeros(1, 3, device="meta"))
