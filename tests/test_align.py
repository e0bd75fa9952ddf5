"""Laws of the alignment: truth, invariances, batches, dtypes, devices, visibility, status."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc import Status, align, prepare
from torch_ecc.core.pose import compose, transform
from torch_ecc.sim.scene.scene import PlaneWaves

SCENE = PlaneWaves.random(seed=1)
FRAME = (180, 200)


def at(x: float, y: float, theta: float = 0.0) -> torch.Tensor:
    return torch.tensor([[x, y, theta]], dtype=torch.float64)


def template(h: int = 61, w: int = 61) -> torch.Tensor:
    middle = at((w - 1) / 2, (h - 1) / 2)
    return SCENE.render(middle, (h, w))


def view(pose: torch.Tensor) -> torch.Tensor:
    return SCENE.render(pose, FRAME)


REFERENCE = prepare(template())


@settings(deadline=None, max_examples=25)
@given(st.floats(60, 140), st.floats(60, 120), st.floats(-10, 10), st.integers(0, 99))
def test_finds_the_truth_at_any_angle(x, y, theta, seed):
    truth = at(x, y, theta)
    generator = torch.Generator().manual_seed(seed)
    start = truth + (torch.rand(1, 3, generator=generator) - 0.5) * torch.tensor([2.0, 2.0, 0.05])
    found = align(REFERENCE, view(truth), start)
    assert found.status == Status.CONVERGED
    assert (found.pose - truth)[0, :2].abs().max() < 3e-3
    assert abs(float(found.pose[0, 2] - theta)) < 5e-5
    assert torch.equal(found.displacement, found.pose - start)


@pytest.mark.parametrize("size", [(61, 61), (60, 60), (41, 72), (72, 41), (33, 34)])
def test_sizes_odd_even_and_not_square(size):
    truth = at(98.3, 91.6, 0.3)
    found = align(prepare(template(*size)), view(truth), truth + torch.tensor([[0.5, -0.4, 0.01]]))
    assert (found.pose - truth).abs().max() < 4e-3


@settings(deadline=None, max_examples=10)
@given(st.floats(0.3, 2.0), st.floats(-100, 100))
def test_ecc_does_not_see_gain_and_offset(gain, offset):
    truth = at(100.3, 90.2, 0.1)
    start = truth + torch.tensor([[0.4, 0.3, -0.01]])
    plain, changed = (align(REFERENCE, image, start) for image in (view(truth), gain * view(truth) + offset))
    assert (plain.pose - changed.pose).abs().max() < 1e-3
    assert float(plain.score - changed.score) == pytest.approx(0, abs=1e-4)
    assert float(changed.residual_rms) == pytest.approx(gain * float(plain.residual_rms), rel=0.05)


def test_ssd_does_see_them():
    truth = at(100.3, 90.2, 0.1)
    found = align(prepare(template(), criterion="ssd"), 0.7 * view(truth) + 20, truth)
    assert (found.pose - truth).abs().max() > 1e-2


@pytest.mark.parametrize("criterion", ["ecc", "ecc_paper", "ssd"])
def test_dtypes_and_scales_give_the_same_pose(criterion):
    truth = at(100.3, 90.2, 0.1)
    start = truth + torch.tensor([[0.4, 0.3, -0.01]])
    eight = (template().round().clamp(0, 255), view(truth).round().clamp(0, 255))
    results = []
    for convert in (
        lambda v: v.to(torch.uint8),
        lambda v: (v * 257).to(torch.int32).to(torch.uint16),
        lambda v: v / 255,
        lambda v: v.double(),
        lambda v: v.to(torch.float16),
        lambda v: v.to(torch.uint8).expand(-1, 3, -1, -1),
    ):
        t, image = map(convert, eight)
        results.append(align(prepare(t, criterion=criterion), image, start).pose)
    assert max(float((r - results[0]).abs().max()) for r in results) < 1e-3


def test_a_batch_gives_the_single_results(device):
    generator = torch.Generator().manual_seed(0)
    count = 64
    truth = torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([40.0, 30.0, 6.0])
    truth += torch.tensor([80.0, 75.0, -3.0])
    images = view(truth) + torch.randn(count, 1, *FRAME, generator=generator)
    templates = template().expand(count, 1, 61, 61) + torch.randn(count, 1, 61, 61, generator=generator)
    start = truth + torch.tensor([0.5, 0.5, 0.01])
    batch = align(prepare(templates.to(device)), images.to(device), start.to(device))
    assert batch.pose.device.type == device.type
    for k in range(0, count, 7):
        alone = align(prepare(templates[k : k + 1]), images[k : k + 1], start[k : k + 1])
        for name in ("pose", "score", "covariance"):
            assert torch.allclose(getattr(batch, name)[k].cpu(), getattr(alone, name)[0], atol=1e-4)
        assert batch.status[k] == alone.status[0]


@settings(deadline=None, max_examples=10)
@given(st.permutations(list(range(6))))
def test_order_does_not_matter(order):
    truth = torch.stack([at(80 + 7 * k, 80 + 3 * k, 0.3 * k)[0] for k in range(6)])
    images, start = view(truth), truth + torch.tensor([0.4, -0.4, 0.01])
    reference = prepare(template().expand(6, 1, 61, 61))
    straight, mixed = align(reference, images, start), align(reference, images[order], start[order])
    assert torch.allclose(straight.pose[order], mixed.pose, atol=1e-6)


def test_one_image_serves_many_templates():
    generator = torch.Generator().manual_seed(0)
    truth = at(100.4, 90.3, 0.2)
    start = truth + 0.5 * torch.randn(5, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.01])
    found = align(prepare(template().expand(5, 1, 61, 61)), view(truth), start)
    assert (found.pose - truth).abs().max() < 3e-3


@pytest.mark.parametrize("truth", [(12.3, 90.4, 0.2), (100.2, 171.3, 1.0), (193.4, 8.2, -0.5), (15.0, 14.0, 3.0)])
def test_a_template_partly_outside_is_found_by_its_visible_part(truth):
    truth = at(*truth)
    found = align(REFERENCE, view(truth), truth + torch.tensor([[0.4, -0.3, 0.01]]))
    assert found.status == Status.CONVERGED
    assert (found.pose - truth)[0, :2].abs().max() < 0.01
    whole = align(REFERENCE, view(at(100, 90)), at(100, 90))
    assert (found.sigma > whole.sigma).all()


def test_out_of_view():
    for place in (at(-29.0, 90), at(100, 400), at(5000, -5000)):
        found = align(REFERENCE, view(at(100, 90)), place)
        assert found.status == Status.OUT_OF_VIEW
        assert torch.equal(found.pose, place)
        assert not any(v.isnan().any() for v in found)


HOSTILE = {
    "black": torch.zeros(1, 1, *FRAME),
    "saturated": torch.full((1, 1, *FRAME), 255.0),
    "noise": 128 + 40 * torch.randn(1, 1, *FRAME, generator=torch.Generator().manual_seed(0)),
    "another scene": PlaneWaves.random(seed=99).render(at(100, 90), FRAME),
    "negative": 255 - view(at(100, 90)),
    "huge": 1e30 * view(at(100, 90)) * 0,
    "dark and noisy": torch.rand(1, 1, *FRAME, generator=torch.Generator().manual_seed(0)),
}


@pytest.mark.parametrize("criterion", ["ecc", "ecc_paper", "ssd"])
@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_not_the_template_is_lost_and_never_nan(name, criterion):
    start = at(100, 90)
    found = align(prepare(template(), criterion=criterion), HOSTILE[name], start)
    assert found.status == Status.LOST
    assert torch.equal(found.pose, start)
    assert found.covariance.diagonal(dim1=1, dim2=2).isinf().all()
    assert not any(v.isnan().any() for v in found)
    assert found.score.abs() <= 1


@pytest.mark.parametrize(
    "flat",
    [
        pytest.param(torch.arange(61.0).expand(1, 1, 61, 61), id="ramp"),
        pytest.param(100 * (torch.arange(61.0) > 30).float().expand(1, 1, 61, 61), id="edge"),
        pytest.param(torch.cos(torch.arange(61.0) / 2).expand(1, 1, 61, 61) * 50, id="grating"),
    ],
)
def test_texture_in_one_direction_only_is_low_texture(flat):
    found = align(prepare(flat), flat, at(30, 30))
    assert found.status == Status.LOW_TEXTURE
    assert not any(v.isnan().any() for v in found)


def test_noise_alone_is_no_texture():
    generator = torch.Generator().manual_seed(0)
    flat = 100 + 3 * torch.randn(2, 1, 1, 181, 181, generator=generator)
    found = align(prepare(flat[0, :, :, 60:121, 60:121]), flat[1], at(90, 90))
    assert found.status == Status.LOW_TEXTURE
    edge = flat + 80 * (torch.arange(181) > 90)
    found = align(prepare(edge[0, :, :, 60:121, 60:121]), edge[1], at(90, 90))
    assert found.status == Status.LOW_TEXTURE


@pytest.mark.parametrize(
    ("gradient", "there", "gone"),
    [
        (6.0, Status.CONVERGED, Status.LOST),
        (2.0, Status.CONVERGED, Status.LOST),
        (0.3, Status.LOW_TEXTURE, Status.LOW_TEXTURE),
    ],
    ids=["a third is noise", "a third is where it is coarse", "all but next to nothing is noise"],
)
def test_why_a_noisy_template_is_not_found(gradient, there, gone):
    """Of the information in a template with 10 grey levels of noise and so many per px of texture. Where most of it is
    noise, as coarse as one may look, not even a good match helps, and that is why it is not found; where a third is, it
    must be another scene."""
    draw, middle = torch.Generator().manual_seed(0), at(30, 30)
    scenes = [PlaneWaves.random(seed=k, fmax=0.15, rms_gradient=4.0).render(middle, (61, 61)) for k in (1, 2)]

    def shot(scene: torch.Tensor) -> torch.Tensor:
        return 128 + gradient / 4 * (scene - 128) + 10 * torch.randn(1, 1, 61, 61, generator=draw)

    reference = prepare(shot(scenes[0]))
    found = [align(reference, shot(scene), middle, min_score=0.3).status for scene in scenes]
    assert found == [there, gone]


def test_iterations_run_out():
    truth = at(100.3, 90.2, 0.1)
    found = align(REFERENCE, view(truth), truth + torch.tensor([[1.5, 1.5, 0.0]]), max_iterations=2)
    assert found.status == Status.MAX_ITERATIONS
    assert found.iterations == 2


@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-3])
def test_tolerance_bounds_the_remaining_error(tolerance):
    truth = at(100.3, 90.2, 0.1)
    start = truth + torch.tensor([[1.0, -0.7, 0.02]])
    corner = torch.tensor([[30.0, 30.0]], dtype=torch.float64)
    exact, rough = (align(REFERENCE, view(truth), start, tolerance=t) for t in (1e-7, tolerance))
    assert (transform(exact.pose, corner) - transform(rough.pose, corner)).norm() < tolerance
    assert rough.iterations <= exact.iterations


@settings(deadline=None, max_examples=10)
@given(st.floats(-3, 3))
def test_covariance_turns_with_the_pose(theta):
    """A template with much more texture along x' is uncertain along its own y', wherever that points."""
    y, x = torch.meshgrid(torch.arange(61.0) - 30, torch.arange(61.0) - 30, indexing="ij")
    strip = prepare((60 * torch.cos(x) + 5 * torch.cos(0.7 * y + 1) + 128)[None, None])
    points = torch.stack((torch.arange(121.0).repeat(121), torch.arange(121.0).repeat_interleave(121)), -1).double()
    pose = at(60, 60, theta)
    local = transform(torch.cat((transform(at(0, 0, -theta), -pose[:, None, :2])[:, 0], -pose[:, 2:]), 1), points)[0]
    image = (60 * torch.cos(local[:, 0]) + 5 * torch.cos(0.7 * local[:, 1] + 1) + 128).reshape(1, 1, 121, 121)
    noisy = image + torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    found = align(strip, noisy, pose)
    values, vectors = torch.linalg.eigh(found.covariance[0, :2, :2])
    along = transform(at(0, 0, theta), torch.tensor([[[0.0, 1.0]]], dtype=torch.float64))[0, 0]
    assert values[1] > 20 * values[0]
    assert abs(float(vectors[:, 1] @ along)) == pytest.approx(1.0, abs=0.02)


def honesty(count: int, side: int, of_template: float, noise) -> float:
    """Mean squared error over the covariance, 1 if that is honest, of ``count`` templates with white noise
    ``of_template`` in frames that have what ``noise`` (count, 1, H, W) makes of white noise."""
    draw = torch.Generator().manual_seed(side)
    place = torch.rand(count, 3, generator=draw, dtype=torch.float64) - 0.5
    truth = at(side / 2 + 34, side / 2 + 34) + place * torch.tensor([8.0, 8.0, 0.2])
    white = torch.randn(count, 1, side + 70, side + 70, generator=draw)
    templates = template(side, side) + of_template * torch.randn(count, 1, side, side, generator=draw)
    found = align(prepare(templates), SCENE.render(truth, (side + 70, side + 70)) + noise(white), truth)
    assert (found.status == Status.CONVERGED).all()
    error = (found.pose - truth)[:, :, None]
    return float((error.mT @ torch.linalg.inv(found.covariance) @ error).mean() / 3)


@pytest.mark.parametrize("side", [13, 19, 61])
def test_the_covariance_is_honest_for_templates_of_any_size(side):
    """However few blocks of pixels there are to tell from whether residuals cling together."""
    assert 0.8 < honesty(300, side, 3.0, lambda white: 3 * white) < 1.25


@pytest.mark.parametrize("cling", ["blurred", "rows"])
def test_the_covariance_knows_of_residuals_that_cling_together(cling):
    """Noise alike in neighbouring pixels: as white noise it would be thought to average out, and errors exceed such a
    sigma 2 or 3 times."""
    noise = {
        "blurred": lambda white: 8 * torch.nn.functional.avg_pool2d(white, 5, 1, 2) + white,
        "rows": lambda white: white + 3 * white.roll(1, 0)[..., :1],
    }[cling]
    assert 0.6 < honesty(60, 61, 0.0, noise) < 2.5


def test_the_covariance_knows_where_noise_is():
    """Photons, of which the darker two thirds of a scene give none: all the noise is where the template's gradients
    are, and spread over all of it would count for a third of what it is (2.6)."""
    count, side, draw = 60, 81, torch.Generator().manual_seed(81)

    def counted(pose: torch.Tensor, size: int) -> torch.Tensor:
        light = (SCENE.render(pose, (size, size)) - 150).clamp(min=0)
        return torch.poisson(0.05 * light, generator=draw)

    place = torch.rand(count, 3, generator=draw, dtype=torch.float64) - 0.5
    truth = at(side / 2 + 20, side / 2 + 20) + place * torch.tensor([8.0, 8.0, 0.2])
    reference = prepare(counted(at((side - 1) / 2, (side - 1) / 2).expand(count, 3), side))
    found = align(reference, counted(truth, side + 40), truth)
    good, error = found.status == Status.CONVERGED, (found.pose - truth)[:, :, None]
    square = (error.mT @ torch.linalg.inv(found.covariance) @ error)[:, 0, 0] / 3
    assert int(good.sum()) > 0.9 * count
    assert 0.6 < float(square[good].mean()) < 1.9


@pytest.mark.parametrize(("amplitude", "status"), [(6.0, Status.CONVERGED), (0.8, Status.LOW_TEXTURE)])
def test_a_pose_that_is_known_to_half_a_pixel_is_known(amplitude, status):
    """A clean template with a faint wave along y', 30 grey levels of noise in the frame: sigma is that noise times
    sqrt(2) over the wave's slope and the side, 0.17 px or 1.2 px."""
    y, x = torch.meshgrid(torch.arange(121.0), torch.arange(121.0), indexing="ij")
    scene = (60 * torch.cos(x) + amplitude * torch.cos(0.7 * y + 1) + 128)[None, None]
    noise = 30 * torch.randn(20, 1, 121, 121, generator=torch.Generator().manual_seed(0))
    reference = prepare(scene[..., 30:91, 30:91]).select(torch.zeros(20, dtype=torch.long))
    found = align(reference, scene + noise, at(60, 60).expand(20, 3))
    assert (found.status == status).all()
    if status == Status.CONVERGED:
        expected = 30 * math.sqrt(2) / (0.7 * amplitude * 61)
        assert float(found.sigma[:, 1].mean()) == pytest.approx(expected, rel=0.1)
        assert float((found.pose[:, 1] - 60).square().mean().sqrt()) == pytest.approx(expected, rel=0.4)


def test_moving_the_scene_moves_the_pose():
    """Equivariance: the frame moved by W(q) gives the pose W(q) o W(p)."""
    p, q = at(90.2, 88.1, 0.3), at(8.7, -5.3, 0.1)
    moved = compose(q, p)
    a = align(REFERENCE, view(p), p + 0.3 * torch.tensor([[1.0, 1.0, 0.01]]))
    b = align(REFERENCE, view(moved), moved)
    assert torch.allclose(compose(q, a.pose), b.pose, atol=3e-3)


def test_describe_has_a_sentence_for_every_status():
    for code in Status:
        assert Status.describe(code).endswith(".")
        assert math.isfinite(len(Status.describe(torch.tensor(int(code)))))
    with pytest.raises(ValueError, match="99"):
        Status.describe(99)


@pytest.mark.parametrize("backend", ["torch", "auto"])
@pytest.mark.parametrize("interpolation", ["bilinear", "bspline3"])
def test_a_template_may_come_from_beyond_its_first_neighbourhood(interpolation, backend):
    """Only the surroundings of the start are read or prefiltered at first; what leaves them is found all the same."""
    scene, truth = PlaneWaves.random(seed=3, fmax=0.016, rms_gradient=0.2), at(112.0, 82.0, 0.05)
    start = truth + torch.tensor([[-30.0, 5.0, 0.0]])
    reference = prepare(scene.render(at(30, 30), (61, 61)))
    frame = scene.render(truth, FRAME).round().clamp(0, 255).to(torch.uint8)
    options = {"interpolation": interpolation, "backend": backend, "max_iterations": 40}
    far, near = (align(reference, frame, pose, **options) for pose in (start, truth))
    assert far.status == near.status == Status.CONVERGED
    assert (far.pose - near.pose).abs().max() < 1e-3  # the tolerance
