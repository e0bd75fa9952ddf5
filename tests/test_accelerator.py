"""A solve on an accelerator never waits for the host: nothing in it depends on a value, so that a graph can hold it."""

from __future__ import annotations

import accelerator
import pytest
import torch
from click.testing import CliRunner
from results import load
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from torch_ecc import align, prepare
from torch_ecc.core.align import solve
from torch_ecc.core.estimate import Status
from torch_ecc.core.settings import Settings
from torch_ecc.sim.scene.scene import PlaneWaves

SCENE = PlaneWaves.random(seed=1)
FRAME = (150, 170)
WAITS = {"_local_scalar_dense", "item", "nonzero", "masked_select", "unique", "_unique2", "is_nonzero", "equal"}
WAITS |= {"lift_fresh", "lift_fresh_copy"}  # new numbers of the host's


class NoWaiting(TorchDispatchMode):
    """Refuses what copies a value to the host or from it, or gives a tensor whose size depends on values."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.__name__.split(".")[0]
        masks = [x for a in args if isinstance(a, (list, tuple)) for x in a if isinstance(x, torch.Tensor)]
        by_mask = name in ("index", "index_put", "index_put_") and any(m.dtype == torch.bool for m in masks)
        if name in WAITS or by_mask:
            raise AssertionError(f"an accelerator would wait for the host in {func}")
        return func(*args, **(kwargs or {}))


class Recording(NoWaiting):
    """What torch is asked to do, on the memory that it was done on, to be done again."""

    def __init__(self):
        super().__init__()
        self.done = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = super().__torch_dispatch__(func, types, args, kwargs)
        self.done.append((func, args, kwargs or {}, result))
        return result

    def again(self, result, old: tuple[Tensor, ...] = (), new: tuple[Tensor, ...] = ()):
        """What the ``result`` is then, with ``new`` tensors in the place of ``old`` ones."""
        now = dict(zip(map(id, old), new, strict=True))

        def renewed(values):
            return tree_map_only(Tensor, lambda tensor: now.get(id(tensor), tensor), values)

        for func, args, kwargs, came in self.done:
            once_more = func(*renewed(args), **renewed(kwargs))
            now |= zip(map(id, tree_leaves(came)), tree_leaves(once_more), strict=True)
        return renewed(result)


def problem(seed: int, count: int = 6):
    """Templates of one scene with noise, a frame of it for each, and starts up to 2 px and 0.02 rad off; the last
    template crosses the frame's border, the one before it sees another scene."""
    generator = torch.Generator().manual_seed(seed)
    still = torch.tensor([[30.0, 25.0, 0.0]], dtype=torch.float64).expand(count, 3)
    places = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    truth = torch.tensor([60.0, 60.0, -3.0]) + places * torch.tensor([50.0, 30.0, 6.0])
    truth[-1, 0] = 20.0
    images = SCENE.render(truth, FRAME)
    images[-2] = PlaneWaves.random(seed=9).render(truth[:1], FRAME)[0]
    templates = SCENE.render(still, (51, 61)) + torch.randn(count, 1, 51, 61, generator=generator)
    images = images + torch.randn(images.shape, generator=generator)
    off = 4 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 2
    return templates, images.round().clamp(0, 255).to(torch.uint8), truth + off * torch.tensor([1.0, 1.0, 0.01])


@pytest.mark.parametrize(
    ("criterion", "interpolation"), [("ecc", "bspline3"), ("ecc_paper", "bilinear"), ("ssd", "bspline5")]
)
def test_nothing_waits_for_the_host(blind, criterion, interpolation):
    templates, images, start = problem(0)
    reference, settings = prepare(templates, criterion=criterion), Settings(interpolation, backend="torch")
    solve(reference, images, start, settings)  # constants are made
    with NoWaiting():
        found = solve(reference, images, start, settings)
    assert found.status.tolist()[-2:] == [Status.LOST, Status.CONVERGED]


@pytest.mark.parametrize(("interpolation", "scale"), [("bilinear", 1), ("bspline3", 1), ("bspline3", 3)])
def test_it_gives_what_a_cpu_gives(interpolation, scale, request):
    """With a coarser grid first (scale 3) and without, inside the frame and across its border."""
    templates, images, start = problem(1)
    if scale > 1:
        templates, images, start = templates[-3:], images[-3:], start[-3:]
        templates, images = (torch.nn.functional.interpolate(v.float(), scale_factor=3) for v in (templates, images))
        start = start * torch.tensor([3.0, 3.0, 1.0]) + torch.tensor([1.0, 1.0, 0.0])
    reference = prepare(templates)
    assert (reference.coarse is None) == (scale == 1)
    looking = align(reference, images, start, interpolation=interpolation, backend="torch")
    request.getfixturevalue("blind")
    never = align(reference, images, start, interpolation=interpolation, backend="torch")
    assert torch.equal(never.status, looking.status)
    assert torch.equal(never.iterations, looking.iterations)
    assert (never.pose - looking.pose).abs().max() < 1e-4
    # It looks at the patch once more, where the last step has led.
    torch.testing.assert_close(never.sigma, looking.sigma, rtol=3e-2, atol=0)


def test_one_graph_serves_all_frames(blind):
    """Operations recorded on one frame and replayed on another give that frame's poses."""
    templates, images, start = problem(2)
    reference, settings = prepare(templates), Settings(max_iterations=1, backend="torch")

    def pose_and_status(image, pose):
        found = solve(reference, image, pose, settings)
        return found.pose, found.status

    pose_and_status(images, start)  # constants are made
    with Recording() as recording:
        first = pose_and_status(images, start)
    _, others, begin = problem(3)
    replayed, direct = recording.again(first, (images, start), (others, begin)), pose_and_status(others, begin)
    for a, b in zip(replayed, direct, strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(replayed[0], first[0])


def test_what_has_converged_stays(blind):
    """Iterations that are done for the others move nothing, however many there are."""
    templates, images, start = problem(4)
    few, many = (align(prepare(templates), images, start, max_iterations=n, backend="torch") for n in (15, 40))
    assert torch.equal(few.iterations, many.iterations)
    assert (few.pose - many.pose).abs().max() < 1e-9


def test_the_benchmark_runs(tmp_path):
    """In little; what no time is left for is named."""
    out = tmp_path / "figures.json"
    few = ["--device", "cpu", "--counts", "2", "--sizes", "31", "--frames", "2", "--iterations", "2"]
    told = CliRunner().invoke(accelerator.main, [*few, "--ways", "native,eager", "--out", str(out)])
    assert told.exit_code == 0, told.output
    figures = load(out).figures
    assert figures["2 of 31 px, bspline3, eager: poses"].value > 0
    assert figures["2 of 31 px, bspline3, eager: from the CPU's poses"].value < 1e-4
    assert CliRunner().invoke(accelerator.main, [*few, "--minutes", "0"]).exit_code == 0
