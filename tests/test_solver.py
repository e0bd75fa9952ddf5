"""Laws of the loop: its acceleration, its longest step, and when it ends."""

from __future__ import annotations

import pytest
import torch
from engines import BACKENDS, CRITERIA, ENGINES, FRAME, SCENE, Problem, compiled

from torch_ecc import PaperECC, Status, align, prepare
from torch_ecc.core import solver
from torch_ecc.core.settings import Settings
from torch_ecc.core.step import LARGEST_SCALE, LONGEST_STEP, State, advance, secant

LEVER = torch.tensor([[1.0, 1.0, 30.0]], dtype=torch.float64)
ENGINE = [pytest.param(solver, id="page"), *(pytest.param(e, marks=compiled, id=n) for n, e in ENGINES.items())]


def stepped(*lengths: float) -> State:
    """After steps of the given lengths, px along x, none of them accelerated."""
    state = State.start(torch.zeros(1, 3, dtype=torch.float64))
    for length in lengths:
        step = torch.tensor([[length, 0.0, 0.0]], dtype=torch.float64)
        state = advance(state, step, LEVER, torch.tensor([True]))._replace(scale=torch.ones(1).double())
    return state


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.79])
def test_two_steps_of_a_geometric_series_tell_its_sum(rate):
    """The second step is lengthened to all that is left: nothing remains to be done."""
    delta = torch.tensor([[0.4 * rate, 0.0, 0.0]], dtype=torch.float64)
    scale, told = secant(stepped(0.4), delta, delta.norm(dim=1))
    assert float(scale * delta[0, 0]) == pytest.approx(0.4 * rate / (1 - rate))
    assert float(told) == pytest.approx(rate)


@pytest.mark.parametrize(("last", "now"), [(1.5, 0.9), (0.4, -0.2), (0.4, 0.39)], ids=["far", "back", "no series"])
def test_other_steps_are_taken_as_they_are(last, now):
    """Far from the answer, beyond it, and where steps do not become shorter."""
    delta = torch.tensor([[now, 0.0, 0.0]], dtype=torch.float64)
    assert secant(stepped(last), delta, delta.norm(dim=1))[0] <= 1.0


def test_a_series_that_hardly_shrinks_is_not_trusted_to_the_end():
    """Of rate 0.85 the sum would be 6.7 steps."""
    delta = torch.tensor([[0.34, 0.0, 0.0]], dtype=torch.float64)
    assert float(secant(stepped(0.4), delta, delta.norm(dim=1))[0]) == pytest.approx(LARGEST_SCALE) == 5


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_an_increment_that_is_not_finite_ends_the_iterations(wrong):
    """Where it was, and as one that need not be waited for."""
    before = stepped(0.4)
    after = advance(before, torch.full((1, 3), wrong, dtype=torch.float64), LEVER, torch.tensor([True]))
    assert torch.equal(after.pose, before.pose)
    assert after.error == 0
    assert torch.equal(after.iterations, before.iterations)


@pytest.mark.parametrize("engine", ENGINE)
@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
def test_no_step_is_longer_than_a_fifth_of_the_template(engine, criterion):
    """Wherever it leads in another scene; some would go farther."""
    longest = []
    for seed in range(12):
        reference, image, start = Problem((31, 31), shown="other", seed=seed).made(criterion)
        bright = 100 * image.float()  # SSD takes that for a lot of motion
        away = (engine.solve(reference, bright, start, Settings("bilinear", 1)).pose - start) * reference.place.lever
        longest.append(float(away.norm() / reference.place.radius))
    assert max(longest) < LONGEST_STEP + 1e-6
    assert max(longest) > 0.9 * LONGEST_STEP or criterion == PaperECC()
    assert LONGEST_STEP == 0.2


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_noisy_template_costs_few_iterations_more(backend):
    """Its noise shortens every step to some half of what is left, so that 0.9 px to 1e-4 px would take more than 13."""
    draw = torch.Generator().manual_seed(0)
    middle, truth = torch.tensor([[[20.0, 20.0, 0.0]], [[60.3, 50.2, 0.4]]], dtype=torch.float64)
    templates = SCENE.render(middle, (41, 41)) + 25 * torch.randn(8, 1, 41, 41, generator=draw)
    start = truth + torch.tensor([[0.7, -0.5, 0.0]])
    found = align(
        prepare(templates), SCENE.render(truth, FRAME).float(), start.expand(8, 3), tolerance=1e-4, backend=backend
    )
    assert (found.status == Status.CONVERGED).all()
    assert found.iterations.double().mean() < 8
