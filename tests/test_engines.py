"""Every engine gives what the torch page gives, over random problems inside the frame, across its border, beyond."""

from __future__ import annotations

import random

import pytest
import torch
from engines import BACKENDS, CRITERIA, ENGINES, FRAME, SAMPLERS, SCENE, Problem, compiled
from torch import Tensor

from torch_ecc import Estimate, Status, align, prepare
from torch_ecc.core import solver
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, Trust
from torch_ecc.core.verdict import judge

NUDGE = torch.tensor([1e-4, -7e-5, 2e-6], dtype=torch.float64)  # px, px, rad

engines = pytest.mark.parametrize(
    "engine", [pytest.param(engine, marks=compiled, id=name) for name, engine in ENGINES.items()]
)


def page(
    reference: Reference, image: Tensor, start: Tensor, settings: Settings, blocks: Tensor | None = None
) -> Solution:
    """The page's answer for each template by itself."""
    which = torch.arange(len(start), device=start.device)
    views = [image if len(image) == 1 else image[k : k + 1] for k in range(len(start))]
    trust = [None if blocks is None else Trust(which[:1], blocks[k : k + 1]) for k in range(len(start))]
    parts = [
        solver.solve(reference.select(which[k : k + 1]), view, start[k : k + 1], settings, trust[k])
        for k, view in enumerate(views)
    ]
    return each(lambda *values: torch.cat(values), *parts)


def differs(a: Estimate, b: Estimate) -> Tensor:
    """Templates (B,) of which the iterations, score or residual of two answers are not the same."""
    apart = (a.iterations != b.iterations) | ((a.score - b.score).abs() > 1e-4)
    return apart | ((a.residual_rms - b.residual_rms).abs() > 1e-3 * b.residual_rms + 1e-5)


def ill_posed(
    reference: Reference,
    image: Tensor,
    start: Tensor,
    settings: Settings,
    answer: Estimate,
    blocks: Tensor | None = None,
) -> Tensor:
    """Templates (B,) whose ``answer`` by the page is another one when image and start move by next to nothing: along an
    edge, or in another scene, rounding grows from step to step, and a pixel may be on either side of the border."""
    draw = torch.Generator().manual_seed(0)
    changed = torch.zeros_like(start[:, 0], dtype=torch.bool)
    for size in (-1.0, 1.0, -3.0, 3.0):
        noise = 3e-4 * size * image.float().std() * torch.randn(image.shape, generator=draw).to(image.device)
        there = page(reference, image.float() + noise, start + size * NUDGE.to(start.device), settings, blocks)
        nudged = judge(reference, there, start, settings)
        changed |= differs(nudged, answer)
    return changed


def drawn(seed: int) -> tuple[Problem, Settings]:
    """A problem, the sampler and the budget of a ``seed``."""
    draw = random.Random(seed)
    return Problem.drawn(draw), Settings(draw.choice(SAMPLERS), draw.randint(1, 15))


def bent(reference: Reference, seed: int) -> Reference:
    """The templates seen with a distortion of some percent in every third problem."""
    draw = torch.Generator().manual_seed(seed)
    distortion = 0.04 * torch.rand(len(reference.K), 2, 2, generator=draw, dtype=torch.float64) - 0.02
    return reference.distorted(distortion.to(reference.K.device)) if seed % 3 == 0 else reference


def trusted(reference: Reference, seed: int) -> Tensor:
    """Trust (B, blocks) in each block of templates: whole, none, or anything between."""
    draw = torch.Generator().manual_seed(seed)
    value = torch.rand(reference.blocks.weight.shape, generator=draw)
    return (3 * value - 0.5).clamp(0, 1).to(reference.K.device)


@engines
@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
def test_an_engine_gives_what_the_page_gives(engine, criterion):
    """Status and pose without exception; of what is found all else; of what is not, too, unless it is ill-posed. In
    every other problem some blocks are trusted in part or not at all, in every third the templates are distorted."""
    found = 0
    for seed in range(40):
        problem, settings = drawn(seed + 1000 * CRITERIA.index(criterion))
        reference, image, start = problem.made(criterion)
        reference = bent(reference, seed)
        assert engine.takes(reference, image, settings), problem
        blocks = trusted(reference, seed) if seed % 2 else None
        exact = page(reference, image, start, settings, blocks)
        trust = None if blocks is None else Trust(torch.arange(len(start)), blocks)
        other = engine.solve(reference, image, start, settings, trust)
        a, b = (judge(reference, s._replace(trust=blocks), start, settings) for s in (other, exact))
        good = Status.good(b.status)
        assert torch.equal(a.status, b.status), problem
        near = (1e-3 * b.sigma.where(good[:, None], 0.0)).clamp(min=1e-4)  # an edge fixes the place along it to 0.2 px
        assert ((a.pose - b.pose).abs() < near).all(), problem
        assert torch.equal(a.displacement, a.pose - start), problem
        assert torch.equal(a.covariance.isfinite(), b.covariance.isfinite()), problem
        torch.testing.assert_close(a.sigma[good], b.sigma[good], rtol=1e-3, atol=0, msg=str(problem))
        apart = differs(a, b) & (good | exact.normal.inverse.any(-1).any(-1))  # where nothing is fitted steps are 0 / 0
        if apart.any():
            apart &= good | ~ill_posed(reference, image, start, settings, b, blocks)
        assert not apart.any(), problem
        found += int(good.sum())
    assert found > 10


@engines
def test_some_of_many_are_solved_as_they_are_alone(engine):
    """Those that trust is about, in its order."""
    reference, image, start = Problem((31, 40), 5, seed=4).made(CRITERIA[1])
    index = torch.tensor([3, 0, 3])
    blocks = trusted(reference, 1)[index]
    found = engine.solve(reference, image, start, Settings(), Trust(index, blocks))
    exact = page(reference.select(index), image[index], start[index], Settings(), blocks)
    torch.testing.assert_close(found.pose, exact.pose, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.sums[:, 0], exact.sums[:, 0])
    torch.testing.assert_close(found.normal.bread, exact.normal.bread, rtol=1e-4, atol=1e-2)


@engines
def test_nothing_in_sight_takes_no_iterations(engine):
    """Whatever the criterion."""
    for criterion in CRITERIA:
        reference, image, start = Problem(place="outside").made(criterion)
        for solve in (engine.solve, solver.solve):
            assert solve(reference, image, start, Settings()).iterations.tolist() == [0]


@engines
@pytest.mark.parametrize("criterion", CRITERIA[1:3], ids=str)
def test_the_residual_where_the_pixels_in_sight_are_too_few(engine, criterion):
    """Fewer than the columns: nothing can be fitted, and all that is in sight is left, off its mean."""
    reference, image, start = Problem((21, 21), seed=3).made(criterion)
    start = start * 0 + torch.tensor([-9.5, 50.0, 0.0])
    a, b = (judge(reference, s.solve(reference, image, start, Settings()), start, Settings()) for s in (engine, solver))
    torch.testing.assert_close(a.residual_rms, b.residual_rms, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("place", ["inside", "border"])
def test_a_batch_is_its_elements(backend, place):
    """Templates that end sooner than others in one batch are what they are alone."""
    reference, image, start = Problem((31, 40), 16, place=place, dtype=torch.float32, seed=3).made(CRITERIA[1])
    start[::2] = align(reference, image, start, backend=backend).pose[::2]  # these have next to nothing to do
    many = align(reference, image, start, backend=backend)
    for k in range(len(start)):
        one = align(reference.select(torch.tensor([k])), image[k : k + 1], start[k : k + 1], backend=backend)
        assert (one.pose - many.pose[k]).abs().max() < 1e-5
        if not Status.good(one.status):  # too little in sight to fix it: rounding grows from step to step
            continue
        torch.testing.assert_close(one.residual_rms[0], many.residual_rms[k], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(one.sigma[0], many.sigma[k], rtol=2e-4, atol=0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("interpolation", SAMPLERS)
@pytest.mark.parametrize("enough", [100, 1500])
def test_iterations_run_out_only_when_all_are_spent(backend, interpolation, enough):
    """What the first stage leaves of the budget is the second one's, whatever it is."""
    reference, image, start = Problem((41, 41), 3, enough=enough, seed=5).made(CRITERIA[1])
    for budget in (1, 2, 3, 6, 15, 40):
        found = align(
            reference,
            image,
            start,
            interpolation=interpolation,
            tolerance=1e-13,
            max_iterations=budget,
            backend=backend,
        )
        spent = found.iterations == budget
        assert ((found.status == Status.MAX_ITERATIONS) <= spent).all()
        assert spent.all() or budget > 15


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_second_stage_has_what_the_first_one_leaves(backend):
    """A template so noisy that steps fall short and are many, begun where the first stage has little to do."""
    draw = torch.Generator().manual_seed(0)
    middle, truth = torch.tensor([[[20.0, 20.0, 0.0]], [[60.3, 50.2, 0.4]]], dtype=torch.float64)
    template = SCENE.render(middle, (41, 41)) + 16 * torch.randn(1, 1, 41, 41, generator=draw)
    image = SCENE.render(truth, FRAME).float()
    found = align(prepare(template), image, truth, tolerance=1e-5, max_iterations=12, backend=backend)
    assert found.status == Status.CONVERGED
    assert found.iterations > 12 // 3 + 2
