"""A tracker's look at a frame asks the host nothing, so that a CUDA graph can repeat it; what repeats it here is what
torch has traced of it."""

from __future__ import annotations

import copy
from functools import partial

import pytest
import torch
from test_accelerator import NoWaiting, Recording

import torch_ecc as te
from torch_ecc.core.pushed import strongest, weakest
from torch_ecc.sim.scene.scene import PlaneWaves
from torch_ecc.track import look

CENTRES = [(30.0, 28.0), (58.0, 40.0)]


def frames(count: int = 4) -> list[torch.Tensor]:
    """Of a scene that moves."""
    k = torch.arange(count, dtype=torch.float64)
    poses = torch.stack((44 + 0.7 * k, 35 - 0.4 * k, 0.01 * k), 1)
    return list(PlaneWaves.random(seed=2).render(poses, (70, 90)).round().to(torch.uint8))


def tracker(first: torch.Tensor, **options) -> te.Tracker:
    return te.Tracker(
        first, CENTRES, 21, **{"backend": "torch", "max_iterations": 2, "robust": False, "search": False} | options
    )


def traced(work, _):
    """``look.recorded`` by the operations that torch sees, on the memory that they had."""
    result = work()  # constants are made
    with Recording() as recording:
        same = work()

    def repeat() -> None:
        for old, new in zip(*map(torch.utils._pytree.tree_leaves, (result, recording.again(same))), strict=True):
            if old is not None:
                old.copy_(new)

    return repeat, result


def done_again(work, _):
    """``look.recorded`` where it is of no matter what is repeated."""
    result = work()

    def repeat() -> None:
        for old, new in zip(*map(torch.utils._pytree.tree_leaves, (result, work())), strict=True):
            if old is not None:
                old.copy_(new)

    return repeat, result


@pytest.fixture
def _graphs(blind, monkeypatch: pytest.MonkeyPatch) -> None:
    """The host looks at nothing, and what was recorded is repeated."""
    monkeypatch.setattr(look, "has_graphs", lambda device: True)
    monkeypatch.setattr(look, "recorded", traced)


@pytest.mark.parametrize(
    "options", [{"robust": True}, {"prediction": "hold"}, {"line_time": 1e-5, "fps": 50.0}], ids=str
)
def test_it_waits_for_nothing(blind, options):
    first, second = frames(2)
    follow = tracker(first, **options)
    image = second[None]
    for put_off in (False, True):
        follow._look.made(image, [image], put_off)  # constants are made
        with NoWaiting():
            start, estimate, *_ = follow._look.made(image, [image], put_off)
        assert start.shape == (2, 3)
        assert te.Status.good(estimate.status).all()


def test_what_was_recorded_serves_all_frames(request):
    """Poses, and what is remembered, as without; records of earlier frames stay what they were."""
    first, *others = frames()
    plain = tracker(first)
    request.getfixturevalue("blind")
    wanted = [plain.track(frame) for frame in others]
    request.getfixturevalue("_graphs")
    follow = tracker(first)
    found = [follow.track(frame) for frame in others]
    assert follow._look.graphs
    for a, b in zip(found, wanted, strict=True):
        assert torch.equal(a.status, b.status)
        assert (a.pose - b.pose).abs().max() < 1e-9
        torch.testing.assert_close(a.covariance, b.covariance)
    assert torch.equal(follow.trust, plain.trust)
    for name, part in follow.state_dict().items():
        if isinstance(part, torch.Tensor):
            torch.testing.assert_close(part, plain.state_dict()[name])


@pytest.mark.usefixtures("_graphs")
def test_it_is_recorded_again_for_what_it_does_not_fit(monkeypatch):
    monkeypatch.setattr(look, "recorded", done_again)
    first, second, third, _ = frames()
    follow = tracker(first)
    follow.track(second)
    graph = follow._look.graphs[True]
    other = copy.deepcopy(follow)
    assert not other._look.graphs
    found = follow.track(third.float())
    assert follow._look.graphs[True] is not graph
    assert (found.pose - other.track(third).pose).abs().max() < 1e-4
    follow.load_state_dict(other.state_dict())
    assert not follow._look.graphs


def test_what_is_put_off_is_done_again(request, monkeypatch):
    """In the frame that needs it, a graph of its own finds what the whole look does, and what it remembers."""
    first, *others = frames()
    others[1] = others[1].clone()
    others[1][..., :20, :] = 250  # over some of both templates
    made = partial(te.Tracker, first, [(36.0, 32.0), (52.0, 38.0)], 41, backend="torch", search=False)
    plain = made()
    request.getfixturevalue("blind")
    wanted = [plain.track(frame) for frame in others]
    assert (wanted[1].coverage < 0.95).all()
    assert (wanted[2].coverage == 1).all()
    monkeypatch.setattr(look, "has_graphs", lambda device: True)
    monkeypatch.setattr(look, "recorded", done_again)
    follow, graphs = made(), []
    for frame, known in zip(others, wanted, strict=True):
        found = follow.track(frame)
        graphs.append(len(follow._look.graphs))
        assert torch.equal(found.status, known.status)
        for name in ("pose", "coverage", "covariance"):
            torch.testing.assert_close(getattr(found, name), getattr(known, name), rtol=1e-5, atol=1e-9)
    assert graphs == [1, 2, 2]
    for name in ("trust", "answered", "score"):
        torch.testing.assert_close(getattr(follow, name), getattr(plain, name))


@pytest.mark.usefixtures("_graphs")
def test_gradients_are_not_recorded():
    first, second, *_ = frames()
    follow = tracker(first)
    frame = second.float().requires_grad_()
    follow.track(frame).pose.sum().backward()
    assert frame.grad.abs().max() > 0
    assert not follow._look.graphs


@pytest.mark.parametrize(("found", "at"), [(weakest, 0), (strongest, 2)])
def test_directions_as_lapack_has_them(found, at):
    """Whatever the units, and of singular matrices too."""
    half = torch.randn(50, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrix = torch.cat((half @ half.mT, 1e-12 * half @ half.mT, torch.diag(half[0].diagonal().square())[None]))
    matrix[-1, 1, 1] = 0
    vector, wanted = found(matrix), torch.linalg.eigh(matrix)[1][:, :, at]
    alike = (vector * wanted).sum(1).abs() / torch.linalg.vector_norm(vector, dim=1)
    assert (alike > 0.99).all()
    assert found(torch.zeros(1, 3, 3, dtype=torch.float64)).isfinite().all()
