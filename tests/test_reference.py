"""Laws of what is prepared once: the Jacobian, the oblique inverse, each criterion's step."""

from __future__ import annotations

import math

import pytest
import torch
from engines import compiled
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc import ECC, SSD, PaperECC, prepare
from torch_ecc.core.align import solve
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.filters import blur
from torch_ecc.core.noise import INSTRUMENT_BLUR, NOISE_RESPONSE
from torch_ecc.core.pose import transform
from torch_ecc.core.reference import reweigh
from torch_ecc.core.sampling import gradients
from torch_ecc.core.settings import Settings
from torch_ecc.sim.scene.scene import PlaneWaves

SCENE = PlaneWaves.random(seed=3)
CRITERIA = [ECC("gain"), ECC("linear"), ECC("quadratic"), PaperECC(), SSD()]


def grid(h: int, w: int) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(h) - (h - 1) / 2, torch.arange(w) - (w - 1) / 2, indexing="ij")
    return torch.stack((x.flatten(), y.flatten()), -1).double()


def analytic_template(h: int, w: int) -> torch.Tensor:
    return SCENE.value(grid(h, w)).reshape(1, 1, h, w).float()


def least_squares(reference):
    """The same reference with the raw template as its own instrument: ordinary least squares."""
    columns = reference.columns._replace(instrument=reference.signal)
    return reweigh(reference._replace(columns=columns), reference.weight > 0)


def rows_agree(a, b, tolerance):
    """Each row to within ``tolerance`` of its own largest entry (rows have different units)."""
    return bool(((a - b).abs().amax(-1) <= tolerance * b.abs().amax(-1)).all())


@pytest.mark.parametrize("size", [(41, 41), (40, 51)])
def test_steepest_descent_images_are_the_derivative_of_the_warped_scene(size):
    points = grid(*size)

    def warped(delta):
        return SCENE.value(transform(delta, points))

    exact = torch.func.jacfwd(warped)(torch.zeros(3, dtype=torch.float64))  # (N, 3)
    G = prepare(analytic_template(*size)).signal[0, :3].T.double()
    inner = (points.abs() < torch.tensor([size[1] / 2 - 5, size[0] / 2 - 5])).all(-1)
    error = (G - exact)[inner].square().mean(0).sqrt() / exact.square().mean(0).sqrt()
    assert error.max() < 0.02  # what a cubic spline leaves at up to 0.25 cycles per px


@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
def test_oblique_inverse_recovers_every_column(criterion):
    """K R^T = 1: a patch that is a combination of the columns gets exactly its coefficients."""
    reference = prepare(analytic_template(31, 27), criterion=criterion)
    R = criterion.columns(reference.signal, reference.uv)
    identity = (reference.K.double() @ R.double().mT)[0]
    scale = R.double().square().mean(-1).sqrt()[0]
    assert torch.allclose(identity * scale[:, None] / scale, torch.eye(len(identity)).double(), atol=1e-3)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 10**6))
def test_ecc_step_is_evangelidis_and_psarakis_with_roles_exchanged(seed):
    """Their closed form for the increment (2008), with the template's Jacobian and the image as target."""
    reference = least_squares(prepare(analytic_template(25, 25), illumination="gain"))
    generator = torch.Generator().manual_seed(seed)
    t = reference.signal[0, 3].double()
    g = 1.3 * t + 10 * torch.randn(len(t), generator=generator, dtype=torch.float64) + 5
    G = reference.signal[0, :3].double()
    t0, g0, G0 = t - t.mean(), g - g.mean(), G - G.mean(1, keepdim=True)
    H = torch.linalg.inv(G0 @ G0.T)
    P = G0.T @ H @ G0
    gain = (t0 @ t0 - t0 @ P @ t0) / (g0 @ t0 - g0 @ P @ t0)
    expected = H @ G0 @ (gain * g0 - t0)
    step = ECC("gain").step(reference, g[None].float())[0].double()
    assert torch.allclose(step, expected, rtol=2e-3, atol=1e-5)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 10**6))
def test_paper_ecc_is_equation_9_to_the_letter(seed):
    reference = least_squares(prepare(analytic_template(25, 25), criterion="ecc_paper"))
    generator = torch.Generator().manual_seed(seed)
    h, J = reference.signal[0, 3].double(), reference.signal[0, :3].double().T
    g = 0.8 * h + 3 * torch.randn(len(h), generator=generator, dtype=torch.float64) - 4
    h0, g0 = h - h.mean(), g - g.mean()
    equation_9 = -torch.linalg.inv(J.T @ J) @ J.T @ (h0 - h0.norm() / g0.norm() * g0)
    step = PaperECC().step(reference, g[None].float())[0].double()
    assert torch.allclose(step, equation_9, rtol=1e-3, atol=1e-6)


def test_ssd_step_is_the_pseudo_inverse_of_the_difference():
    reference = least_squares(prepare(analytic_template(25, 25), criterion="ssd"))
    t, G = reference.signal[0, 3].double(), reference.signal[0, :3].double().T
    g = t + torch.randn(len(t), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = torch.linalg.pinv(G) @ (g - t)
    assert torch.allclose(SSD().step(reference, g[None].float())[0].double(), expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(("illumination", "modes"), [("gain", 0), ("linear", 2), ("quadratic", 5)])
def test_ecc_is_blind_to_the_light_that_it_models(illumination, modes):
    """A gain polynomial of the modelled order, and any offset, ask for no step at all."""
    reference = prepare(analytic_template(31, 31), illumination=illumination)
    u, v = reference.uv[0]
    t = reference.signal[0, 3]
    terms = [u, v, u * u, v * v, u * v][:modes]
    gain = 1.2 + sum((0.1 * (k + 1) * term for k, term in enumerate(terms)), torch.zeros_like(u))
    step = reference.criterion.step(reference, (gain * t + 20)[None])[0]
    assert step.abs().max() < 1e-4
    fit = reference.criterion.fit(reference, (gain * t + 20)[None])
    assert fit.residual.abs().max() < 0.02
    assert float(fit.gain[0]) == pytest.approx(1.2, abs=1e-3)
    more = (gain + 0.5 * u**3) * t  # a light that none of them models does ask for one
    assert reference.criterion.step(reference, more[None])[0].abs().max() > 1e-4


def test_a_gain_that_is_not_positive_asks_for_no_finite_step():
    reference = prepare(analytic_template(25, 25))
    assert not ECC().step(reference, -reference.signal[:, 3]).isfinite().any()


def test_masked_pixels_have_no_influence():
    template = analytic_template(40, 40)
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[12:28, 10:30] = True
    spoiled = torch.where(mask, template, 255 * torch.rand(1, 1, 40, 40))
    wide = torch.nn.functional.max_pool2d(mask[None, None].float(), 9, 1, 4) > 0  # the gradients' own reach
    spoiled = torch.where(wide, template, spoiled)
    a, b = prepare(template, mask=mask), prepare(spoiled, mask=mask)
    assert a.K.shape[-1] == int(mask.sum())
    assert rows_agree(a.K, b.K, 0.02)


def test_weights_scale_out_and_count():
    template = analytic_template(30, 30)
    ones = torch.ones(30, 30)
    assert rows_agree(prepare(template, mask=ones).K, prepare(template, mask=5 * ones).K, 1e-4)
    half = ones.clone()
    half[:, 15:] = 1e-6
    left = torch.zeros(30, 30)
    left[:, :15] = 1
    a = prepare(template, mask=half).K[0].double().reshape(7, 30, 30)[:, :, :15].flatten(1)
    b = prepare(template, mask=left).K[0].double()
    assert rows_agree(a[:3], b[:3], 1e-3)


def test_centre_moves_the_point_that_the_pose_speaks_of():
    """Turning about another point is turning about the middle and then moving."""
    template = analytic_template(31, 31)
    offset = torch.tensor([[3.0, -2.0]])
    a, b = prepare(template), prepare(template, centre=offset)
    gx, gy, turn = a.signal[0, :3]
    assert torch.allclose(b.signal[0, 2], turn - gx * offset[0, 1] + gy * offset[0, 0], atol=1e-2)


def test_radius_is_the_distance_of_the_farthest_pixel():
    assert float(prepare(analytic_template(31, 41)).place.radius[0]) == pytest.approx(math.hypot(15, 20))


def test_reweigh_equals_preparing_the_visible_part():
    """The whole template seen through a window is the template under that window as its mask."""
    template = analytic_template(30, 30)
    seen = torch.zeros(30, 30, dtype=torch.bool)
    seen[:, 8:] = True
    part = reweigh(prepare(template, illumination="gain"), seen.reshape(1, -1))
    middle = torch.zeros(1, 2)
    alone = prepare(template, mask=seen, illumination="gain", centre=middle)
    # (the constant's own row depends on the mean that t is taken off)
    assert rows_agree(part.K[0][:4, seen.flatten()], alone.K[0][:4], 1e-3)
    assert not part.K[0][:, ~seen.flatten()].any()
    for name in ("bread", "meat", "bread_bias"):
        a, b = getattr(part.normal, name), getattr(alone.normal, name)
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-3 * float(b.diagonal(dim1=1, dim2=2).amin()))
    for name in ("total", "freedom", "energy", "white"):
        assert torch.allclose(getattr(part.normal, name), getattr(alone.normal, name), rtol=1e-3)


@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
def test_the_first_pixels_alone_are_a_template(criterion):
    """Every third pixel in x and y, with an inverse of their own: they find the same columns."""
    reference = prepare(analytic_template(121, 131), criterion=criterion)
    few = reference.coarse
    assert few.grid.pixels.shape[1] == 41 * 44
    torch.testing.assert_close(few.grid.pixels, reference.grid.pixels.reshape(3, 121, 131)[:, ::3, ::3].flatten(1))
    columns = criterion.columns(few.signal, few.uv)
    torch.testing.assert_close(few.K @ columns.mT, torch.eye(columns.shape[1])[None], atol=2e-3, rtol=0)
    assert few.coarse is None


def test_a_small_template_keeps_all_pixels():
    reference = prepare(analytic_template(61, 61))
    assert reference.coarse is None


def tensors(name, record):
    """Every tensor in nested records, with the way to it."""
    for field, value in zip(record._fields, record, strict=True):
        if isinstance(value, torch.Tensor):
            yield f"{name}.{field}", value
        elif hasattr(value, "_fields"):
            yield from tensors(f"{name}.{field}", value)


@pytest.mark.parametrize("some", [1, 2, 3])
@pytest.mark.parametrize("masked", [False, True])
def test_many_templates_are_prepared_in_portions(monkeypatch, masked, some):
    """As all at once, whatever the size of a portion."""
    generator = torch.Generator().manual_seed(0)
    templates = analytic_template(121, 131).float() + torch.randn(5, 1, 121, 131, generator=generator)
    mask = torch.rand(5, 121, 131, generator=generator) > 0.1 if masked else None
    together = prepare(templates, mask=mask)
    monkeypatch.setattr("torch_ecc.core.reference.PIXELS_AT_ONCE", some * 121 * 131)
    portions = prepare(templates, mask=mask)
    names, whole = zip(*tensors("", together), strict=True)
    for name, a, b in zip(names, whole, (value for _, value in tensors("", portions)), strict=True):
        torch.testing.assert_close(b, a, rtol=1e-4, atol=1e-4 * float(a.abs().max()), msg=name)


def test_select_keeps_the_order_asked_for():
    reference = prepare(torch.rand(3, 1, 9, 9))
    for order in ([2, 0, 1], [1, 1, 1], [0, 1, 2], [2]):
        assert torch.equal(reference.select(torch.tensor(order)).K, reference.K[order])


@settings(deadline=None, max_examples=20)
@given(st.integers(1, 5), st.integers(0, 999))
def test_safe_inverse_inverts_what_is_regular_and_says_what_is_not(n, seed):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(2, n, n + 3, generator=generator, dtype=torch.float64)
    matrix = root @ root.mT * torch.logspace(-3, 3, n, dtype=torch.float64)
    matrix[1, -1] = matrix[1, 0] * (n > 1)  # singular
    inverse, regular = safe_inverse(matrix)
    assert regular.tolist() == [True, False]
    product = inverse[0] @ matrix[0]
    assert torch.allclose(product, torch.eye(n, dtype=torch.float64), atol=1e-6)
    assert (inverse[1] == 0).all()


def test_what_noise_adds_to_the_normal_equations():
    """Gradients that are white noise leave q (dW/dp)^T dW/dp summed over the pixels that count, times their power."""
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(24, 31, generator=generator) * (torch.arange(31) > 8)
    noisy = analytic_template(24, 31) + 5 * torch.randn(1, 1, 24, 31, generator=generator)
    reference = prepare(noisy, mask=mask, centre=torch.tensor([[2.5, -4.0]]))
    x, y = (reference.grid.pixels[:2] - reference.place.centre[0, :, None]).double()
    one, none = torch.ones_like(x), torch.zeros_like(x)
    J = torch.stack((torch.stack((one, none, y)), torch.stack((none, one, -x))))  # eq. (8) at theta = 0, (2, 3, N)
    q = (reference.weight * reference.columns.wiener)[0].double()
    raw, blurred = NOISE_RESPONSE[INSTRUMENT_BLUR]
    sums = [torch.einsum("kin,kjn,n->ij", J, J, weight) for weight in (q, q * q)]
    torch.testing.assert_close(reference.normal.bread_bias[0], raw * sums[0], rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(reference.normal.meat_bias[0], blurred * sums[1], rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("width", NOISE_RESPONSE)
def test_the_response_of_gradients_to_noise_is_that_to_an_impulse(width):
    """Raw times blurred slope, and blurred slope squared, of white noise of unit variance on average."""
    impulse = torch.zeros(1, 1, 81, 81)
    impulse[..., 40, 40] = 1.0
    raw, blurred = gradients(impulse)[:, 0].double(), gradients(blur(impulse, width))[:, 0].double()
    assert (float((raw * blurred).sum()), float(blurred.square().sum())) == pytest.approx(
        NOISE_RESPONSE[width], rel=1e-5
    )


@pytest.mark.parametrize("backend", ["torch", pytest.param("native", marks=compiled)])
@pytest.mark.parametrize("masked", [False, True])
def test_copies_are_the_template_so_many_times(backend, masked):
    """In its memory, and with the same answers as templates of their own."""
    h, w = 71, 64
    mask = (grid(h, w).norm(dim=-1) < 30).view(h, w) if masked else None
    reference = prepare(analytic_template(h, w), mask=mask)
    copies, own = reference.copies(3), reference.select(torch.zeros(3, dtype=torch.int64))
    assert copies.K.data_ptr() == reference.K.data_ptr()
    image = SCENE.value(grid(140, 150)).reshape(1, 1, 140, 150).float()
    start = torch.tensor([[74.5, 69.5, 0.0], [75.6, 69.0, 0.02], [20.0, 30.0, 1.0]]).double()  # a part is out
    settings = Settings(backend=backend)
    for a, b in zip(solve(copies, image, start, settings), solve(own, image, start, settings), strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-6, equal_nan=True)
    assert reference.copies(1) is reference
