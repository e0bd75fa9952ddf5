"""Poses carry gradients: those of the whole solve, exactly, whatever engine, criterion and sampler have found them."""

from __future__ import annotations

import pytest
import torch
from engines import BACKENDS, CRITERIA, SAMPLERS, Problem
from test_readme import BLOCKS
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.checkpoint import checkpoint

import torch_ecc as te
from torch_ecc.core import columns as prepared
from torch_ecc.core import linearised, solver
from torch_ecc.core.align import found, solve
from torch_ecc.core.native import adjoint
from torch_ecc.core.native.library import load
from torch_ecc.core.reference import Reference, prepare
from torch_ecc.core.sampling import inside
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Trust
from torch_ecc.core.verdict import judge
from torch_ecc.sim.scene.scene import PlaneWaves

SCENE, OTHER = (PlaneWaves.random(seed=seed) for seed in (1, 9))
FRAME, SIZE = (70, 80), (25, 27)
MIDDLE = torch.tensor([[13.0, 12.0, 0.0]], dtype=torch.float64)
TRUTH = torch.tensor([[40.3, 35.7, 0.1], [44.2, 38.1, -2.0], [8.0, 33.0, 0.7]], dtype=torch.float64)
WHOLE = {"tolerance": 1e-11, "max_iterations": 60, "backend": "torch"}  # until nothing moves any more


def noisy(image: Tensor, seed: int = 0) -> Tensor:
    return image + 4 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))


def seen(truth: Tensor = TRUTH, noise: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Templates, an image of each and starts; the last of them crosses the frame's border."""
    templates = noisy(SCENE.render(MIDDLE.expand(len(truth), 3), SIZE), noise + 1)
    return templates, noisy(SCENE.render(truth, FRAME), noise), truth + torch.tensor([0.3, -0.2, 0.01])


def exact(reference: Reference) -> Reference:
    """In float64."""
    return reference.map(lambda value: value.double() if value.is_floating_point() else value)


def covered(images: Tensor) -> Tensor:
    """With another scene over a part of what the first templates see."""
    images = images.clone()
    images[:2, :, 20:35, 25:55] = OTHER.render(TRUTH[:1], FRAME)[0, :, 20:35, 25:55].to(images)
    return images


def slope(function, value: Tensor, direction: Tensor, step: float) -> Tensor:
    """The central difference of a function along a direction."""
    return (function(value + step * direction) - function(value - step * direction)) / (2 * step)


def direction(value: Tensor) -> Tensor:
    return torch.randn(value.shape, generator=torch.Generator().manual_seed(7), dtype=value.dtype)


@pytest.mark.parametrize("interpolation", SAMPLERS)
@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
def test_gradcheck_of_the_whole_solve(criterion, interpolation):
    """In float64, by all pixels of images and by the starts; one template crosses the border."""
    templates, images, start = seen()
    reference, settings = exact(prepare(templates, criterion=criterion)), Settings(interpolation, robust=False, **WHOLE)

    def poses(images: Tensor, start: Tensor) -> Tensor:
        return solve(reference, images, start, settings).pose

    values = images.double().requires_grad_(), start.clone().requires_grad_()
    assert torch.autograd.gradcheck(poses, values, eps=1e-4, atol=1e-8, rtol=1e-5, fast_mode=True)


def test_gradcheck_pixel_by_pixel():
    """Those of one image that two templates share, which lie in the middle of both."""
    templates, images, _ = seen()
    reference, settings = exact(prepare(templates[:2])), Settings(robust=False, **WHOLE)
    start = torch.tensor([[40.0, 35.0, 0.1], [40.4, 35.9, 0.1]], dtype=torch.float64)

    def poses(patch: Tensor) -> Tensor:
        view = images[:1].double().index_put((torch.tensor([[0]]), torch.tensor([[0]]), rows[:, None], rows), patch)
        return solve(reference, view, start, settings).pose

    rows = torch.arange(36, 40)
    patch = images[0, 0, 36:40, 36:40].double().requires_grad_()
    assert torch.autograd.gradcheck(poses, patch, eps=1e-4, atol=1e-8, rtol=1e-5)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("field", ["pose", "displacement", "score", "covariance", "residual_rms"])
def test_every_field_has_the_slope_of_the_whole_solve(field, robust):
    """In float64; of a robust one, with a part covered, that of the solve with the weights that it has come to."""
    templates, images, start = seen()
    reference, images = exact(prepare(templates)), (covered(images) if robust else images).double().requires_grad_()
    settings = Settings(robust=robust, **WHOLE)
    value = getattr(solve(reference, images, start, settings), field)
    weight, along = direction(value), direction(images)
    (gradient,) = torch.autograd.grad((value * weight).sum(), images)
    blocks = found(reference, images.detach(), start, settings).trust
    assert (blocks is not None and bool((blocks[:2] < 0.1).any(1).all())) == robust
    trust = None if blocks is None else Trust(torch.arange(3), blocks)

    def weighted(image: Tensor) -> Tensor:
        there = solver.solve(reference, image.detach(), start, settings, trust)._replace(trust=blocks)
        return (getattr(judge(reference, there, start, settings), field) * weight).sum()

    torch.testing.assert_close((gradient * along).sum(), slope(weighted, images, along, 1e-3), rtol=1e-4, atol=0)


@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
def test_by_templates_and_their_weights(criterion, monkeypatch):
    """Through all that is prepared of them, apart from the noise that they are taken to have, and unrounded."""
    templates, images, start = seen(TRUTH[:2])
    mask = 0.5 + torch.rand(2, *SIZE, generator=torch.Generator().manual_seed(3))
    settings, noise = Settings(robust=False, **WHOLE), prepare(templates, mask=mask).noise.level
    monkeypatch.setattr(prepared, "LEVELS", 2**40)
    weight = direction(start)

    def moved(templates: Tensor, mask: Tensor) -> Tensor:
        reference = exact(prepare(templates, criterion=criterion, mask=mask, noise=noise))
        return (solve(reference, images.double(), start, settings).pose * weight).sum()

    values = templates.clone().requires_grad_(), mask.clone().requires_grad_()
    by_template, by_mask = torch.autograd.grad(moved(*values), values)
    along = direction(templates)
    true = slope(lambda t: moved(t, mask), templates, along, 0.1)
    torch.testing.assert_close((by_template * along).sum().double(), true, rtol=2e-3, atol=0)
    along = direction(mask)
    true = slope(lambda m: moved(templates, m), mask, along, 0.01)
    torch.testing.assert_close((by_mask * along).sum().double(), true, rtol=2e-3, atol=0)


@pytest.mark.parametrize("robust", [False, True])
def test_engines_have_the_same_gradients(robust):
    """And the same numbers as without any."""
    templates, images, start = seen()
    images, gradients = covered(images), []
    for backend in (param.values[0] if hasattr(param, "values") else param for param in BACKENDS):
        image, template = images.clone().requires_grad_(), templates.clone().requires_grad_()
        estimate = te.align(prepare(template), image, start, backend=backend, robust=robust)
        plain = te.align(prepare(templates), images, start, backend=backend, robust=robust)
        for value, same in zip(estimate, plain, strict=True):
            assert torch.equal(value, same)
            assert value.requires_grad == same.is_floating_point() or value is estimate.coverage
        gradients.append(torch.autograd.grad(estimate.pose.sum(), (image, template)))
    for native, page in zip(*gradients, strict=True):
        torch.testing.assert_close(native, page, rtol=1e-2, atol=1e-2 * float(page.abs().max()))


@pytest.mark.skipif(load() is None, reason="there is no native engine here")
@pytest.mark.parametrize("interpolation", SAMPLERS)
def test_the_compiled_way_to_the_image_is_that_of_the_page(interpolation):
    """Values, slopes and their transpose, in any direction and across borders, of one image or each its own."""
    more = torch.tensor([[70.3, 60.2, 0.02], [20.2, 20.4, -1.5], [90.4, -3.3, 3.1]], dtype=torch.float64)
    truth = torch.cat((TRUTH + 0.017, more))  # no pixel lies on one, where bilinear values have a kink
    (templates, images, _), settings = seen(truth), Settings(interpolation)
    reference = prepare(templates)
    in_sight = inside(reference.warps(truth), reference.grid.pixels, FRAME)
    for frames in images, images[:1]:
        native = adjoint.look(reference, frames, truth, settings)
        page = linearised.look(exact(reference), frames.double(), truth, settings)
        by_g = direction(native.values[:, 0]) * in_sight
        seen_there = [values * in_sight[:, None] for values in (native.values, page.values)]
        for came, wanted in seen_there, (native.by_image(by_g), page.by_image(by_g.double())):
            torch.testing.assert_close(came.double(), wanted, rtol=0, atol=1e-4 * float(wanted.abs().max()))
    with pytest.raises(ValueError, match="expected by_g, warp"):
        torch.ops.torch_ecc.spread(by_g, truth[1:], truth, reference.grid.pixels, reference.grid.box, [1, 1, 9, 9], 3)
    with pytest.raises(ValueError, match="expected size"):
        adjoint.spread(by_g, reference.warps(truth), truth, reference.grid.pixels, reference.grid.box, [2, 1, 9, 9], 3)


@pytest.mark.parametrize(
    "problem",
    [{"texture": "edge"}, {"shown": "other"}, {"shown": "blank", "dtype": torch.float32}, {"place": "outside"}],
    ids=str,
)
def test_what_was_not_found_takes_the_gradient_to_its_start(problem):
    """And none to image or template, nor NaN: an edge, another scene, a frame without contrast, out of view."""
    problem = Problem(count=2, **problem)
    reference, image, start = problem.made(CRITERIA[1])
    templates = reference.signal[:, 3].reshape(2, 1, *problem.size).clone().requires_grad_()
    image, start = image.float().requires_grad_(), start.requires_grad_()
    for criterion in CRITERIA[-1], CRITERIA[1]:
        with torch.autograd.set_detect_anomaly(True):  # which tells of a NaN on the way too
            estimate = te.align(prepare(templates, criterion=criterion), image, start, min_score=0.9)
            gradients = torch.autograd.grad(estimate.pose.sum(), (image, templates, start), retain_graph=True)
            for field in estimate.score, estimate.residual_rms, estimate.covariance.nan_to_num(posinf=0):
                for gradient in torch.autograd.grad(field.sum(), (image, templates), retain_graph=True):
                    assert gradient.isfinite().all()
        assert not estimate.ok.any()
        assert [bool(gradient.any()) for gradient in gradients] == [False, False, True]
        assert torch.equal(gradients[2], torch.ones_like(start))


def test_what_shows_nothing_leaves_the_others_gradients_as_they_are():
    """Of whatever is asked for, with nothing that is no number on the way; one of them is beyond the frame."""
    templates, images, start = seen()
    reference, start = prepare(templates), start + torch.tensor([[0.0, 0, 0], [500, 500, 0], [0, 0, 0]])
    gradients = []
    for some in ([0, 1, 2], [0, 2]):
        image = images[some].requires_grad_()
        with torch.autograd.set_detect_anomaly(True):
            estimate = te.align(reference.select(torch.tensor(some)), image, start[some])
            parts = estimate.pose, estimate.score, estimate.residual_rms, estimate.covariance.nan_to_num(posinf=0)
            gradients.append(torch.autograd.grad(sum(part.sum() for part in parts), image)[0])
        plain = te.align(reference.select(torch.tensor(some)), images[some], start[some])
        assert all(map(torch.equal, estimate, plain))
    assert not gradients[0][1].any()
    torch.testing.assert_close(gradients[0][[0, 2]], gradients[1], rtol=1e-4, atol=1e-6)


def test_as_torch_asks_for_them():
    """Twice, by a checkpoint, many at once, of a strided image; not of one that changed since, nor derived twice."""
    templates, images, start = seen()
    reference, images = prepare(templates), images.requires_grad_()

    def poses(images: Tensor) -> Tensor:
        return te.align(reference, images, start).pose

    (first,) = torch.autograd.grad(poses(images).sum(), images)
    kept = checkpoint(poses, images, use_reentrant=False).sum()
    for _ in range(2):
        assert torch.equal(torch.autograd.grad(kept, images, retain_graph=True)[0], first)
    strided = images.detach().permute(3, 1, 2, 0).contiguous().permute(3, 1, 2, 0).requires_grad_()
    assert torch.equal(torch.autograd.grad(poses(strided).sum(), strided)[0], first)
    one = poses(images)
    (many,) = torch.autograd.grad(
        one, images, torch.eye(9).double().view(9, 3, 3), is_grads_batched=True, retain_graph=True
    )
    torch.testing.assert_close(many.sum(0), first, rtol=1e-4, atol=1e-4 * float(first.abs().max()))
    (gradient,) = torch.autograd.grad(one.sum(), images, create_graph=True)
    with pytest.raises(RuntimeError, match="grad"):
        torch.autograd.grad(gradient.sum(), images)
    moved = 1 * images
    pose = poses(moved)
    moved.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        pose.sum().backward()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("backend", BACKENDS)
def test_autocast_changes_no_gradient(backend, dtype):
    """Of poses sought within it: by the image asked for there too, by the template after it, as torch itself does."""
    templates, images, start = seen()
    for image in images, images.mT.contiguous().mT:
        found = []
        for autocast in False, True:
            values = image.detach().requires_grad_(), templates.clone().requires_grad_()
            with torch.autocast("cpu", dtype=dtype, enabled=autocast):
                estimate = te.align(prepare(values[1]), values[0], start, backend=backend)
                there = torch.autograd.grad(estimate.pose.sum(), values[0], retain_graph=True)
            found.append((*there, *torch.autograd.grad(estimate.pose.sum() + estimate.score.sum(), values)))
        assert all(map(torch.equal, *found))


def test_nobody_pays_for_what_is_not_asked():
    """While poses are found no patch is sampled for the sake of gradients; and then each once, and back."""
    templates, images, start = seen()
    calls: list[str] = []

    class Listening(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            calls.append(func.__name__)
            return func(*args, **(kwargs or {}))

    counts = []
    for image in (images, images.clone().requires_grad_()):
        with Listening():
            pose = te.align(prepare(templates), image, start, backend="torch").pose
        counts.append(sum("grid_sampler" in name for name in calls))
        calls.clear()
    assert counts[0] == counts[1] > 0
    with Listening():
        pose.sum().backward()
    assert sum("grid_sampler" in name for name in calls) == 12  # of four pairs of taps: value, slopes, transpose


def test_a_start_has_no_share_in_what_was_found():
    templates, images, start = seen()
    start.requires_grad_()
    estimate = te.align(prepare(templates), images, start)
    estimate.pose.sum().backward()
    assert not start.grad.any()
    assert not te.align(prepare(templates), images, start.detach()).pose.requires_grad
    with torch.no_grad():
        assert not te.align(prepare(templates), images, start).pose.requires_grad


def test_under_a_mark_of_the_camera_no_pixel_counts():
    """But for what the spline's prefilter spreads; the tracker's poses have the slope of the whole solve."""
    _, images, _ = seen(TRUTH[:1])
    shown = torch.ones(FRAME, dtype=torch.bool)
    shown[30:34] = False
    frame = images[0].clone().requires_grad_()
    still = noisy(SCENE.render(TRUTH[:1] * 0 + torch.tensor([40.0, 35.0, 0.0]), FRAME), 5)

    def tracked(frame: Tensor) -> Tensor:
        tracker = te.Tracker(still[0], [(40.0, 35.0)], 31, frame_mask=shown, tolerance=1e-7, max_iterations=40)
        return tracker(frame).pose

    pose = tracked(frame)
    (gradient,) = torch.autograd.grad(pose.sum(), frame)
    assert gradient[:, 31:33].abs().max() < 0.03 * gradient.abs().max()
    along = direction(frame)
    true = slope(lambda image: tracked(image.detach()).sum(), frame, along, 0.03)
    torch.testing.assert_close((gradient * along).sum().double(), true, rtol=0.01, atol=0)


@pytest.mark.parametrize("options", [{}, {"levels": 2}, {"prediction": "hold"}, {"robust": False}], ids=str)
def test_a_tracker_gives_gradients_and_keeps_none(options):
    """Frame by frame, a lost one and one that is found by a search between them."""
    path = torch.tensor(
        [[40.0, 35, 0], [40.6, 35.2, 0.02], [300, 300, 0], [50.1, 40.6, 0.1], [50.4, 40.3, 0.1]]
    ).double()
    frames = noisy(SCENE.render(path, FRAME))
    tracker, plain = (te.Tracker(frames[0], [(40.0, 35.0)], 31, **options) for _ in range(2))
    flows = []
    for frame in frames[1:].clone().requires_grad_():
        estimate, same = tracker(frame), plain(frame.detach())
        assert torch.equal(estimate.pose, same.pose)
        (gradient,) = torch.autograd.grad(estimate.pose.sum() + 0 * frame.sum(), frame)
        flows.append(bool(gradient.any()))
        assert not any(part.requires_grad for part in tracker.buffers())
        if not bool(estimate.ok):
            assert not gradient.any()
    assert flows == [True, False, False, True]


def test_a_filter_is_learned_in_front_of_a_tracker():
    """Frames are smeared to one side, so that poses are half a pixel off; what the README's loop learns undoes it."""
    path = torch.zeros(12, 3, dtype=torch.float64)
    path[:, :2] = torch.tensor([40.0, 35.0]) + 1.5 * torch.sin(torch.arange(24).view(12, 2) * 0.4)
    frames = noisy(SCENE.render(path, FRAME))
    smear = torch.tensor([0.0, 0.0, 0.6, 0.3, 0.1]).view(1, 1, 1, 5)
    smeared = nn.functional.conv2d(nn.functional.pad(frames, (2, 2, 0, 0), mode="replicate"), smear)
    tracker = te.Tracker(frames[0], path[:1, :2], 31)
    names = {"torch": torch, "tracker": tracker, "frames": smeared.repeat(6, 1, 1, 1), "poses": path.repeat(6, 1)}
    before = [tracker(frame).pose for frame in smeared]
    exec(next(block for block in BLOCKS if "Adam" in block), names)
    with torch.no_grad():
        after = [names["model"](frame).pose for frame in smeared]
    error = [(torch.cat(poses) - path).square().sum(1).mean().sqrt() for poses in (before, after)]
    assert error[0] > 0.4
    assert error[1] < 0.1
