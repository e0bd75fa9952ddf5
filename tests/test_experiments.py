"""Laws of the experiments: their scheme, their statistics, and their numbers on versions of a few frames."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc.core.pose import compose, rotation, transform
from torch_ecc.paper import fig3, fig4, robustness, scheme, table1, trials
from torch_ecc.paper.bound import cramer_rao
from torch_ecc.paper.errors import box, by_unit, errors, largest
from torch_ecc.paper.methods import COMPARED, METHODS
from torch_ecc.paper.result import counter
from torch_ecc.sim import Camera, PlaneWaves, Sequence


def nothing() -> None:
    """No progress to tell."""


def test_counter_counts_to_its_total():
    seen = []
    tick = counter(3, lambda done, total: seen.append((done, total)))
    for _ in range(3):
        tick()
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_errors_are_in_px_and_degrees():
    pose = torch.tensor([[1.0, -2.0, math.radians(3)], [0.5, 0.1, 0.0]], dtype=torch.float64)
    assert by_unit(largest(errors(pose, torch.zeros_like(pose)))) == pytest.approx((2.0, 3.0))


def test_motion_has_the_papers_amplitudes():
    path = scheme.TEXT.path() - torch.tensor((*scheme.CENTRE, 0.0))
    assert len(path) == 160
    expected = torch.tensor((100.0, 100.0, math.radians(20))).double()
    assert torch.allclose(path.amax(0), expected)
    assert torch.allclose(-path.amin(0), expected)


def test_template_from_the_first_frame_is_upright_on_whole_pixels_and_its_truth_starts_there():
    path = scheme.CAPTION.path()[3:6]
    cut = scheme.cut_first(path)
    assert torch.equal(cut.start[:2], cut.start[:2].round())
    assert cut.start[2] == 0
    assert torch.allclose(cut.truth(path)[0], cut.start)
    assert torch.allclose(cut.truth(path), Sequence(PlaneWaves.random(), path).truth(cut.start[None, :2])[:, 0])


@pytest.mark.parametrize("size", [121, 60])
def test_template_is_cut_around_its_start(size):
    y, x = torch.meshgrid(torch.arange(480.0), torch.arange(640.0), indexing="ij")
    cut = scheme.cut_reflected()
    inner = slice(scheme.MARGIN, -scheme.MARGIN)
    places = cut.template(torch.stack((x, y)), size)[:, inner, inner]
    assert places.shape == (2, size, size)
    centre = places.flatten(1).mean(1)
    assert (centre - cut.start[:2]).abs().max() <= (0.5 if size % 2 == 0 else 0)


def test_the_bound_of_a_template_that_lies_turned_is_along_its_own_axes():
    """Of gradients by autodiff of the scene as the template sees it."""
    scene, path = PlaneWaves.random(seed=3), scheme.TEXT.path()[7:8]
    own = scheme.cut_first(path).place()
    y, x = torch.meshgrid(*(torch.arange(21) - 10.0,) * 2, indexing="ij")
    points = torch.stack((x.flatten(), y.flatten()), -1).double()
    moved = torch.func.jacfwd(lambda p: scene.value(transform(own, transform(p, points))))(torch.zeros(3).double())
    seen = torch.stack((torch.ones(len(points)).double(), scene.value(transform(own, points))), 1)
    J = moved - seen @ torch.linalg.lstsq(seen, moved).solution
    assert torch.allclose(cramer_rao(scene, (21, 21), 4.0, own), 2 * torch.linalg.inv(J.mT @ J).diagonal().sqrt())


def test_a_scene_kept_is_the_scene_rendered():
    scene, poses = PlaneWaves.random(seed=3), torch.tensor([[30.0, 20.0, 0.2]]).double()
    wide = scheme.Kept(scene.render(poses + torch.tensor((4.0, 4.0, 0.0)), (48, 68)))
    for camera in (Camera(size=(40, 60)), Camera(size=(40, 60), blur_sigma=1.0)):
        assert torch.equal(camera.capture(wide, poses), camera.capture(scene, poses))
    draws = Camera(size=(40, 60), noise_sigma=5.0).capture(wide, poses.expand(2, 3))
    assert not torch.equal(draws[0], draws[1])


def test_uneven_light_is_smooth_and_follows_the_lamp():
    light = scheme.uneven_light().field(torch.zeros(1, dtype=torch.long), scheme.FRAME)
    lamp = scheme.LAMP.field(torch.zeros(1, dtype=torch.long), scheme.FRAME)
    assert float(light.mean()) == pytest.approx(1.0, abs=1e-5)
    both = torch.stack((light.flatten(), lamp.flatten()))
    assert float(torch.corrcoef(both)[0, 1]) > 0.9


@pytest.fixture(scope="module")
def spread():
    return fig3.template_errors(1, 2, nothing)


def test_uneven_light_short(spread):
    """The template in the middle at both ends of the motion: what Fig. 3 promises."""
    names = list(METHODS)
    for kind in spread:
        for name, (px, deg) in fig3.LIMITS.items():
            worst = kind[0, names.index(name)]
            assert worst[0] < px, name
            assert worst[1] < deg, name
    theta = spread[0, 0, :, 1]
    assert theta[names.index("ref34")] > 2 * theta[names.index("gain")]
    assert theta[names.index("ssd")] == pytest.approx(float(theta[names.index("ref34")]), abs=2e-3)


def test_even_light_short():
    found = fig3.sequence_errors(scheme.TEXT.path()[38:41], nothing)
    for name, error in found["without UI"].items():
        px, deg = by_unit(largest(error))
        assert px < fig3.EVEN_LIMIT[0], name
        assert deg < fig3.EVEN_LIMIT[1], name


def test_ratio_is_one_for_errors_at_the_bound_along_the_templates_axes():
    """Two hundred thousand Gaussian errors; a bound that differs along the axes tells which way they turn."""
    theta = torch.linspace(0, 3, 200_000, dtype=torch.float64)
    bound = torch.tensor((0.01, 0.05, 0.2), dtype=torch.float64)
    own = bound * torch.randn(len(theta), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frame = torch.cat(((rotation(theta) @ own[:, :2, None])[:, :, 0], own[:, 2:]), 1)
    noisy = fig4.Noisy({"linear": frame}, theta, bound)
    assert torch.allclose(noisy.ratio("linear"), torch.ones(3, dtype=torch.float64), atol=0.01)
    assert noisy.over("linear") == pytest.approx(1, abs=0.01)


def test_quartiles_are_the_box():
    error = torch.linspace(-3, 1, 401).double()[:, None].expand(-1, 3)
    assert torch.allclose(box(error), torch.full((3,), 2.0).double())


def test_noise_short():
    """Two poses, eight draws: every method scatters about as the Cramer-Rao bound has it, and as the others do."""
    path = scheme.TEXT.path()
    found = fig4.trials(path, torch.tensor([20, 100]), scheme.cut_reflected(), nothing)
    assert list(found) == ["0.001", "0.002", "0.005"]
    for noisy in found.values():
        over = {name: noisy.over(name) for name in COMPARED}
        assert all(0.6 < value < 1.5 for value in over.values()), over
        assert max(over.values()) - min(over.values()) < 0.1, over
    assert torch.allclose(found["0.002"].bound / found["0.001"].bound, torch.tensor(2.0).sqrt().double(), rtol=2e-3)


def times(once: float, each: float) -> table1.Times:
    return table1.Times({table1.T_PRE: [once] * 4, table1.T_IT: [each] * 4}, [4, 6])


def test_crossover_is_where_both_formulas_meet():
    """The paper's own Table I has it at 7.5 / (3.6 - 3.3) = 25."""
    ours, other = times(9.9, 3.6), times(7.5, 3.3)
    assert table1.crossover(ours, other) == pytest.approx(table1.PAPER_CROSSOVER)
    assert table1.crossover(times(9.9, 3.3), other) == math.inf
    both = {"linear": ours, "ref34": other}
    assert table1.per_frame(both, "linear") == pytest.approx(5 * 3.6)
    assert table1.per_frame(both, "ref34") == pytest.approx(7.5 + 5 * 3.3)


def test_timing_short():
    """Every method is timed as often as asked, and tracks to its iterations."""
    found = table1.measure(2, 2, lambda done, total: None)
    assert list(found) == list(METHODS)
    for name, t in found.items():
        assert list(t.ms) == list(table1.WORKS)
        assert {len(t.iterations), *map(len, t.ms.values())} == {2}
        assert min(map(min, t.ms.values())) > 0, name
        assert 1 < max(t.iterations) <= 15, name


def test_pairs_jump_and_turn_as_asked_at_places_that_stay_the_same():
    (near, second), (far, _) = trials.pairs(9, 2.0, 1.0), trials.pairs(9, 30.0, 0.0)
    assert torch.equal(near.pose, far.pose)
    truth = near.truth(second)
    assert torch.allclose((truth - trials.MIDDLE)[:, :2].norm(dim=1), torch.tensor(2.0).double())
    assert torch.allclose(truth[:, 2].abs().rad2deg(), torch.tensor(1.0).double())
    place = compose(trials.MIDDLE * torch.tensor((-1.0, -1.0, 0.0)), near.pose)
    assert torch.allclose(compose(truth, place), second)


def test_corner_error_bounds_what_moves_at_the_corner():
    truth = torch.tensor([[160.0, 160.0, 0.3]]).double()
    pose = truth + torch.tensor([[0.3, -0.4, 0.002]]).double()
    assert float(trials.corner_error(truth + torch.tensor((3.0, 4.0, 0.0)), truth, 121)) == pytest.approx(5)
    corner = torch.tensor([[60.5, 60.5, 0.0]]).double()
    moved = (compose(pose, corner) - compose(truth, corner))[0, :2].norm()
    assert moved <= trials.corner_error(pose, truth, 121) + 1e-3


@pytest.mark.parametrize("share", [0.05, 0.4])
def test_that_share_of_the_template_is_covered(share):
    (occluder,) = robustness.covered(share).camera.occluders
    opacity = occluder._opacity(torch.zeros(1, dtype=torch.long), trials.FRAME)
    assert float(opacity[..., 100:221, 100:221].mean()) == pytest.approx(share, abs=0.005)


def test_contrast_goes_about_the_mean():
    camera = robustness.dimmed(0.25).camera
    assert camera.gain * robustness.MEAN + camera.offset == robustness.MEAN
    assert camera.gain == 0.25


def test_limits_are_the_last_level_before_the_first_failure():
    swept = robustness.Sweep("blur", (0, 1, 2, 3), lambda v: trials.Change())
    rates = {"linear": [1, 0.9, 0.5, 1], "ssd": [0.5, 1, 1, 1], "gain": [1, 1, 1, 1], trials.UNNOTICED: [0] * 4}
    found = robustness.limits(swept, trials.Found(rates, {}))
    assert found.keys() == {"linear", "ssd", "gain"}
    assert (found["linear"], found["gain"]) == (1, 3)
    assert math.isnan(found["ssd"])


def test_sweep_short():
    """A small jump is found by all, one over another part of the circuit by none but the search of the whole frame;
    the pyramid reaches farther."""
    changes = [trials.Change(jump=jump, turn=0, size=61) for jump in (0.5, 12, 90)]
    found = trials.sweep(changes, 4, nothing, trackers=True)
    for name in (*COMPARED, *trials.TRACKERS):
        assert found.rate[name][0] == 1, name
        assert found.rate[name][2] == ("search" in name), name
        assert found.error[name][0] < 0.05, name
    assert found.rate["linear, 3 levels"][1] >= found.rate["linear"][1]


def test_samplers_short():
    found = trials.sampler_errors(0.0, 4, robustness.SAMPLERS, nothing)
    assert found["bspline3"][-1] < found["bilinear"][-1]
    assert found["bspline3"][-1] < 0.004
