"""Times of the library's own steps: pytest benchmarks/test_speed.py --benchmark-enable -n 0 [--benchmark-group-by=func]

One 121 x 121 template in 640 x 480 uint8 on one thread, by sampler and backend. A plain ``pytest`` does not collect it,
and nothing here asserts a time.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from trackers import options
from work import WORKS, Work

import torch_ecc as te
from torch_ecc.core.sampling import make_sampler
from torch_ecc.core.solver import iterate
from torch_ecc.core.step import State

SAMPLERS = ("bilinear", "bspline3", "bspline5")
BACKENDS = options()
Benchmark = Callable[..., Any]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """As in every comparison."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def work() -> Work:
    """The standard work."""
    return WORKS["clean"].make("clean", 0)


@pytest.fixture(scope="module")
def problem(work: Work):
    """A prepared template, the next frame as (1, 1, H, W) float, and the pose it starts from: 3.1 px off."""
    x, y = (int(v) - work.size // 2 for v in work.center)
    template = work.frames[:1, :, y : y + work.size, x : x + work.size]
    return te.prepare(template), work.frames[1:2].float(), work.truth[:1] + torch.tensor([2.2, -2.2, 0.005])


@pytest.mark.parametrize("criterion", ["ecc", "ecc_paper", "ssd"])
def test_prepare(benchmark: Benchmark, work: Work, criterion: str):
    benchmark(te.prepare, work.frames[:1, :, 200:321, 280:401], criterion=criterion)


@pytest.mark.parametrize("interpolation", SAMPLERS)
def test_make_sampler(benchmark: Benchmark, problem, interpolation: str):
    """Prefilter of a B-spline in the neighbourhood of the patch; nothing for bilinear."""
    reference, image, pose = problem
    benchmark(make_sampler, interpolation, image, reference.warps(pose), reference.grid.box)


@pytest.mark.parametrize("interpolation", SAMPLERS)
def test_sample(benchmark: Benchmark, problem, interpolation: str):
    reference, image, pose = problem
    warp = reference.warps(pose)
    sampler = make_sampler(interpolation, image, warp, reference.grid.box)
    benchmark(sampler, warp, reference.grid.pixels)


@pytest.mark.parametrize("interpolation", SAMPLERS)
def test_one_iteration(benchmark: Benchmark, problem, interpolation: str):
    """The prefilter and one step."""
    reference, image, pose = problem
    benchmark(iterate, reference, image, interpolation, State.start(pose), 1e-3, 1)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("interpolation", SAMPLERS)
def test_align(benchmark: Benchmark, problem, interpolation: str, backend: str):
    """With its checks and its covariance."""
    reference, image, pose = problem
    known = inspect.signature(te.align).parameters
    chosen = {name: value for name, value in BACKENDS[backend].items() if name in known}
    benchmark(te.align, reference, image, pose, interpolation=interpolation, **chosen)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("interpolation", SAMPLERS)
def test_track(benchmark: Benchmark, work: Work, interpolation: str, backend: str):
    """Frame after frame of eq. (11), up to 4.4 px per frame, started from the previous pose."""
    tracker = te.Tracker(
        work.frames[0], [work.center], work.size, interpolation=interpolation, prediction="hold", **BACKENDS[backend]
    )
    frames = itertools.cycle([*work.frames, *work.frames.flip(0)])
    benchmark(lambda: tracker(next(frames)))


@pytest.mark.parametrize("ahead", [False, True])
def test_sequence(benchmark: Benchmark, work: Work, ahead: bool):
    """To and fro through frames that are there already, all of them in one round, and looked at ahead or not."""
    tracker, frames = te.Tracker(work.frames[0], [work.center], work.size), [*work.frames, *work.frames.flip(0)]

    def followed() -> None:
        tracker.look_ahead(frames if ahead else ())
        for frame in frames:
            tracker(frame)

    benchmark(followed)
    benchmark.extra_info["frames"] = len(frames)
