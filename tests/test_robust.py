"""What covers a part of a template bends no pose: blocks that do not fit count less, and how many is told."""

from __future__ import annotations

import itertools
import math
from functools import cache

import kornia.filters as KF
import pytest
import torch
from engines import BACKENDS, compiled
from torch import Tensor

from torch_ecc import Status, Tracker, align, prepare
from torch_ecc.core.align import engine_for
from torch_ecc.core.covariance import hidden
from torch_ecc.core.native import engine
from torch_ecc.core.robust import solve, trust
from torch_ecc.core.scale import quantile, weighted_median
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Trust
from torch_ecc.sim.scene.micrograph import micrograph
from torch_ecc.sim.scene.pads import Pads
from torch_ecc.sim.scene.speckle import Speckle
from torch_ecc.sim.scene.waves import PlaneWaves

SIZE, FRAME, MIDDLE = 121, (200, 210), (104.3, 99.6)
SCENES = {
    "waves": PlaneWaves.random(seed=3),
    "pads": Pads.wafer(seed=1),
    "speckle": Speckle.random(seed=2),
    "micrograph": micrograph(4),
}
PATH = torch.tensor([[0, 0, 0], [1.3, -0.8, 0.01], [2.9, -1.2, 0.03], [4.1, -0.4, 0.04]], dtype=torch.float64)
scenes = pytest.mark.parametrize("scene", SCENES)
backends = pytest.mark.parametrize("backend", BACKENDS)


@cache
def shots(scene: str) -> tuple[Tensor, Tensor]:
    """Clean frames (F, H, W) and where the template is in them."""
    poses = PATH + torch.tensor([*MIDDLE, 0.0], dtype=torch.float64)
    return SCENES[scene].render(poses, FRAME)[:, 0].float(), poses


def noisy(frames: Tensor, sigma: float = 2.0, seed: int = 0) -> Tensor:
    """As a camera gives them."""
    noise = torch.randn(frames.shape, generator=torch.Generator().manual_seed(seed))
    return (frames + sigma * noise).round().clamp(0, 255).to(torch.uint8)


def covered(frames: Tensor, share: float, what: str) -> Tensor:
    """A strip over ``share`` of the template in all frames but the first."""
    left = round(MIDDLE[0] - SIZE / 2)
    width = round(share * SIZE)
    texture = PlaneWaves.random(seed=77).render(torch.zeros(1, 3, dtype=torch.float64), FRAME)[0, 0].float()
    strip = {"dark": 0 * texture + 30, "mean": 0 * texture + frames.mean(), "texture": texture}[what]
    out = frames.clone()
    out[1:, :, left - 4 : left + width] = strip[:, left - 4 : left + width]
    return out


def errors(frames: Tensor, poses: Tensor, **options: object) -> tuple[Tensor, object]:
    """In px (at the template's corner for theta), (F, 3), and the track."""
    track = Tracker(frames[0], [MIDDLE], SIZE, **options).track_sequence(frames[1:])
    return (track.pose[:, 0] - poses[1:]) * torch.tensor([1, 1, SIZE / 2**0.5]), track


@pytest.mark.parametrize(
    ("scene", "what", "share", "backend"),
    [
        pytest.param(scene, what, share, "native", marks=compiled)
        for scene in SCENES
        for what, share in [*itertools.product(("dark", "texture"), (0.05, 0.15, 0.3)), ("mean", 0.15)]
    ]
    + [("pads", "texture", 0.15, "torch")],  # what is trusted is told alike for both
)
def test_what_covers_a_part_bends_no_pose(scene, what, share, backend):
    """Right to what noise makes of the rest, and what is told of it is near the truth."""
    frames, poses = shots(scene)
    error, track = errors(noisy(covered(frames, share, what)), poses, backend=backend)
    assert (track.status == Status.CONVERGED).all()
    assert error.abs().max() < 0.05
    assert share < 0.1 or (track.coverage[:, 0] < 1 - 0.5 * share).all()
    assert (track.coverage[:, 0] > 1 - share - 0.14).all()
    assert ((track.pose[:, 0] - poses[1:]).abs() < 5 * track.sigma[:, 0]).all()


@scenes
def test_a_thin_cover_costs_hardly_more_than_what_it_hides(scene):
    """However long it stays."""
    (frames, poses), there = shots(scene), [0, *[1, 2, 3] * 4]
    frames, poses = frames[there], poses[there]
    thin, clear = (
        errors(noisy(some), poses)[0].square().mean().sqrt() for some in (covered(frames, 0.05, "texture"), frames)
    )
    assert thin < 1.6 * clear


@scenes
def test_blurred_edges_are_not_covered(scene):
    """Edges that fit worse in all of the patch bend no pose more for being believed."""
    frames, poses = shots(scene)
    blurred = KF.gaussian_blur2d(frames[1:, None], (13, 13), (2.0, 2.0))[:, 0]
    error, track = errors(noisy(torch.cat((frames[:1], blurred))), poses)
    assert (track.status == Status.CONVERGED).all()
    assert error.abs().max() < 0.15


@scenes
def test_without_a_cover_it_is_least_squares(scene):
    """To the last digit, whatever the noise."""
    frames, _ = shots(scene)
    for sigma in (0.0, 2.0, 8.0):
        robust, plain = (
            Tracker(frames_[0], [MIDDLE], SIZE, robust=on).track_sequence(frames_[1:])
            for on, frames_ in ((on, noisy(frames, sigma)) for on in (True, False))
        )
        assert torch.equal(robust.pose, plain.pose), sigma
        assert (robust.coverage == 1).all()


@scenes
def test_more_noise_than_ever_is_not_taken_for_a_cover(scene):
    """A template that was averaged over many images, in frames as they come."""
    frames, poses = shots(scene)
    stack = torch.cat((noisy(frames[:1], 0.2), noisy(frames[1:], 6.0)))
    _, track = errors(stack, poses)
    assert (track.status == Status.CONVERGED).all()
    assert (track.coverage > 0.97).all()


@pytest.mark.parametrize("what", ["dark", "texture"])
@backends
def test_where_most_is_covered_nothing_is_believed(what, backend):
    for scene in list(SCENES)[: 1 if backend == "torch" else None]:
        frames, poses = shots(scene)
        error, track = errors(noisy(covered(frames, 0.7, what)), poses, backend=backend, search=False)
        believed = track.status[:, 0] == Status.CONVERGED
        assert (error[believed].abs().amax(1, keepdim=True) < 0.1).all()
        assert not believed.all()


def test_light_does_not_change_what_is_believed():
    """Gain and offset of a frame leave pose and coverage as they are."""
    frames, poses = shots("waves")
    stack = covered(frames, 0.2, "texture") + 2 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(1))
    half = (SIZE - 1) // 2
    x, y = (round(v) for v in MIDDLE)
    reference = prepare(stack[None, None, 0, y - half : y + half + 1, x - half : x + half + 1])
    plain, lit = (align(reference, g[None, None], poses[1:2]) for g in (stack[1], 0.6 * stack[1] + 40))
    torch.testing.assert_close(lit.pose, plain.pose, atol=1e-3, rtol=0)
    torch.testing.assert_close(lit.coverage, plain.coverage, atol=2e-2, rtol=0)


@backends
def test_a_covered_template_bears_on_no_other(backend):
    frames, _ = shots("waves")
    stack = noisy(covered(frames, 0.2, "texture"))
    centers = [MIDDLE, (140.0, 100.0), (135.0, 130.0)]
    together = Tracker(stack[0], centers, 61, backend=backend).track_sequence(stack[1:])
    for r, center in enumerate(centers):
        alone = Tracker(stack[0], [center], 61, backend=backend).track_sequence(stack[1:])
        torch.testing.assert_close(together.pose[:, r], alone.pose[:, 0], atol=1e-4, rtol=0)
        torch.testing.assert_close(together.coverage[:, r], alone.coverage[:, 0], atol=1e-3, rtol=0)


def test_what_was_hidden_is_found_again_behind_what_is_left_of_the_cover():
    frames, poses = shots("micrograph")
    hidden, part = covered(frames, 1.0, "dark"), covered(frames, 0.3, "dark")
    stack = noisy(torch.stack((frames[0], hidden[1], hidden[2], part[3])))
    track = Tracker(stack[0], [MIDDLE], SIZE).track_sequence(stack[1:])
    assert (track.status[:2, 0] == Status.LOST).all()
    assert track.status[2, 0] == Status.CONVERGED
    assert (track.pose[2, 0] - poses[3])[:2].abs().max() < 0.05


def test_sigma_knows_what_a_cover_does_to_the_blocks_beside_it():
    """It ends within them, or the sampler carries its edge there: against the same blocks of the same frame without it,
    of a corner of a pad, which one block fixes or not, behind the same cover a pixel farther and farther."""
    poses = torch.tensor([[160.0, 120.0, 0.0], [145.9, 105.9, -0.15]], dtype=torch.float64)
    first, clean = noisy(Pads.wafer(seed=1).render(poses, (240, 320))[:, 0].float()).float()[:, None, None]
    reference, start, settings, ratios = prepare(first[..., 90:151, 130:191]), poses[1:], Settings(), []
    for left in range(152, 162):
        view = clean.clone()
        view[..., left : left + 6] = 10
        beside = solve(engine_for(reference, view, settings), reference, view, start, settings)
        same = Trust(torch.arange(1), beside.trust)
        clear = engine_for(reference, clean, settings)(reference, clean, start, settings, same)
        unsure = hidden(reference, beside, start.new_tensor([2.0**2 * 2]))
        ratios.append((beside.pose - clear.pose)[0] / unsure[0].diagonal().sqrt())
    assert 0.5 < torch.stack(ratios).square().mean().sqrt() < 1.5


@scenes
def test_a_cover_that_stays_is_remembered_and_forgotten_when_it_has_gone(scene):
    """Under it as without a memory, after it as least squares; a state knows of it."""
    frames, poses = shots(scene)
    hidden = covered(frames, 0.25, "dark")
    stack = noisy(torch.stack([frames[0], *[hidden[1]] * 4, frames[2], frames[3]]))
    robust, plain = (Tracker(stack[0], [MIDDLE], SIZE, robust=on) for on in (True, False))
    for k in range(1, 5):
        estimate = robust.track(stack[k])
        assert (estimate.pose[0] - poses[1])[:2].abs().max() < 0.05
        assert 0.6 < float(estimate.coverage) < 0.9
        assert 0.6 < float(robust.trust.mean()) < 0.9
    plain.pose = robust.pose
    for k in (5, 6):
        estimate = robust.track(stack[k])
        assert estimate.coverage == 1
        assert bool((robust.trust == 1).all())
        torch.testing.assert_close(estimate.pose, plain.track(stack[k]).pose, atol=2e-3, rtol=0)


def test_trust_falls_with_what_is_too_much():
    ratio = torch.tensor([[0.0, 1.0, 3.0, 3.3, 6.0, 30.0, math.inf]])
    value = trust(ratio)[0]
    assert value[:3].tolist() == [1, 1, 1]
    assert value.diff()[2:].max() <= 0
    assert value[-2:].tolist() == [0, 0]


def test_a_quantile_and_a_median_no_cover_can_raise():
    """Half of the values may be anything."""
    draw = torch.Generator().manual_seed(0)
    values = torch.rand(3, 100, generator=draw) + 1
    spoilt = values.clone()
    spoilt[:, ::2] = 1e6
    used = torch.ones_like(values, dtype=torch.bool)
    assert (quantile(spoilt, used) < 2.4).all()
    assert (quantile(values, used & (values > 1.5)) > 1.5).all()
    weight = torch.ones_like(values)
    weight[:, ::2] = 0.9
    assert (weighted_median(spoilt, weight) < 2.01).all()
    torch.testing.assert_close(
        weighted_median(values[:, :99], weight[:, :99] * 0 + 1), values[:, :99].median(1, True).values
    )


def test_where_all_that_tells_the_pose_is_covered_the_flat_rest_is_not_enough():
    """A mark on flat ground with a faint pattern, and a sheet of that ground over the mark."""
    y, x = torch.meshgrid(torch.arange(FRAME[0]), torch.arange(FRAME[1]), indexing="ij")
    ground = 100 + 3 * torch.sin(x / 5) * torch.sin(y / 6)
    near = ((x - MIDDLE[0]).abs() < 22) & ((y - MIDDLE[1]).abs() < 22)
    mark = torch.where(near, 60 * torch.sin(x / 2.5) * torch.cos(y / 3.1), 0.0)
    stack = noisy(torch.stack((ground + mark, ground, ground)), 1.0)
    track = Tracker(stack[0], [MIDDLE], SIZE, search=False).track_sequence(stack[1:])
    assert (track.status == Status.LOST).all()


@compiled
def test_a_trial_that_is_no_better_costs_no_normal_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    """One block with more noise than the others is looked at again without it; where that changes nothing, least
    squares stands as it is, and so do its normal equations."""
    frames, poses = shots("waves")
    before, now = (frames[k] + 2 * torch.randn(FRAME, generator=torch.Generator().manual_seed(k)) for k in (0, 1))
    now[96:104, 96:104] += 7 * torch.randn(8, 8, generator=torch.Generator().manual_seed(7))
    reference = prepare(
        before[None, None, 39:160, 44:165], centre=poses[:1, :2].float() - torch.tensor([[104.0, 99.0]])
    )
    made, counted = [], engine.normal_equations
    monkeypatch.setattr(engine, "normal_equations", lambda *of: made.append(of) or counted(*of))
    image, start = now[None, None].contiguous(), poses[1:2]
    plain = solve(engine.solve, reference, image, start, Settings(robust=False))
    found = solve(engine.solve, reference, image, start, Settings())
    assert found.odd is not None
    assert found.trust is None or bool((found.trust == 1).all())
    assert torch.equal(found.pose, plain.pose)
    assert not made
