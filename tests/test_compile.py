"""torch.compile and torch.export take the page as one graph, without a break, and their poses are those of the page.

The graphs are run without a code generator: what they hold is the matter here (``benchmarks/accelerator.py`` times the
generated code).
"""

from __future__ import annotations

from functools import partial

import pytest
import torch
from test_accelerator import problem
from torch import Tensor, nn

import torch_ecc as te
from torch_ecc.core import robust, solver
from torch_ecc.core.sampling import prefilter
from torch_ecc.core.settings import Settings

TRACED = pytest.mark.skipif(torch.__version__ < (2, 13), reason="older versions trace less")
FEW = {"max_iterations": 2, "backend": "torch"}  # tracing takes its time


@pytest.fixture
def blindly(request: pytest.FixtureRequest):
    """``te.align`` as where the host looks at nothing."""

    def align(*args, **options) -> te.Estimate:
        request.getfixturevalue("blind")
        return te.align(*args, **options)

    return align


def assert_same(came, wanted) -> None:
    """To 1e-6 px; codes equal, and all else to rounding."""
    for a, b in zip(came, wanted, strict=True):
        assert a.dtype == b.dtype
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6 if a is came[0] else 1e-5, equal_nan=True)


@TRACED
def test_align_is_one_graph(blindly, monkeypatch):
    """Robust as it is by default, but for the number of rounds, which are alike."""
    monkeypatch.setattr(robust, "FEW_ROUNDS", 1)
    templates, images, start = problem(0)
    reference, options = te.prepare(templates), FEW | {"max_iterations": 1}
    compiled = torch.compile(te.align, backend="aot_eager", fullgraph=True, dynamic=False)
    came = compiled(reference, images, start, **options)
    _, others, begin = problem(3)
    again = compiled(reference, others, begin, **options)
    assert_same(came, blindly(reference, images, start, **options))
    assert_same(again, blindly(reference, others, begin, **options))


class Step(nn.Module):
    """A frame and poses to the next poses and their statuses."""

    def __init__(self, reference: te.Reference) -> None:
        super().__init__()
        self.reference = reference

    def forward(self, frame: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        estimate = te.align(self.reference, frame, pose, robust=False, **FEW)
        return estimate.pose, estimate.status


@TRACED
def test_a_step_is_exported(blindly):
    """With fixed sizes."""
    templates, images, start = problem(0)
    reference = te.prepare(templates)
    program = torch.export.export(Step(reference), (images, start))
    _, others, begin = problem(3)
    pose, status = program.module()(others, begin)
    wanted = blindly(reference, others, begin, robust=False, **FEW)
    assert (pose - wanted.pose).abs().max() < 1e-6
    assert torch.equal(status, wanted.status)


def test_the_prefilter_is_an_operator():
    """Its schema, its shapes and its values."""
    image = torch.randn(2, 1, 20, 30)
    torch.library.opcheck(torch.ops.torch_ecc.prefilter, (image, "bspline3", 1))
    assert torch.equal(torch.ops.torch_ecc.prefilter(image, "bspline5", 2), prefilter(image, "bspline5", 2))


@TRACED
def test_iterations_are_a_loop(blind):
    """However many there are: the graph is as long."""
    templates, images, start = problem(0)
    reference, sizes = te.prepare(templates), []

    def counting(module, inputs):
        sizes.append(len(module.graph.nodes))
        return graph_for(module, inputs)

    for most, backend in ((4, "eager"), (15, "aot_eager")):
        torch.compiler.reset()
        graph_for = torch._dynamo.lookup_backend(backend)
        solve = partial(solver.solve, settings=Settings(max_iterations=most, backend="torch"))
        came = torch.compile(solve, backend=counting, fullgraph=True, dynamic=False)(reference, images, start)
        wanted = solve(reference, images, start)
        assert_same((came.pose, came.iterations, came.sums), (wanted.pose, wanted.iterations, wanted.sums))
    assert sizes[0] == sizes[1]
