"""Laws of the verdict: what its sums mean, and what light that varies across the template does to them."""

from __future__ import annotations

import pytest
import torch
from engines import BACKENDS, CRITERIA, FRAME, SCENE, Problem

from torch_ecc import PaperECC, Status, align, prepare
from torch_ecc.core.reference import reweigh
from torch_ecc.core.solution import summed
from torch_ecc.core.verdict import correlation, detrended


def weighted_correlation(a, b, w, basis):
    """Of a and b (N,) less what the columns of ``basis`` (N, k) explain of each, under weights w, by least squares."""
    root = w.sqrt()[:, None]
    left = [v - basis @ torch.linalg.lstsq(root * basis, root[:, 0] * v).solution for v in (a, b)]
    power = [(w * v * v).sum() for v in left]
    return float((w * left[0] * left[1]).sum() / (power[0] * power[1]).sqrt())


@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
@pytest.mark.parametrize("seed", range(4))
def test_both_correlations_are_what_they_say(criterion, seed):
    """Zero-mean, and off the plane that fits best, of weighted pixels of which some are out of sight."""
    draw = torch.Generator().manual_seed(seed)
    reference, _, _ = Problem((23, 31), mask="one", centred=seed % 2 == 0, seed=seed).made(criterion)
    u, v = reference.uv[0].double()
    part = reweigh(reference, u < 0.4)
    t, w = part.signal[0, 3], part.weight[0].double()
    g = t + 30 * torch.randn(t.shape, generator=draw) + 80 * reference.uv[0, 0] - 50 * reference.uv[0, 1]
    _, sums, total = summed(part, g[None], part.weight)
    torch.testing.assert_close(total[:, :10], sums.double().sum(-1), rtol=1e-5, atol=1e-3)
    effect = sums[0, 7:].double().view(3, *part.grid.blocks)
    clusters = effect, effect.sum(2), effect.sum(1)
    squares = torch.cat([each.square().flatten(1).sum(1) for each in clusters])
    torch.testing.assert_close(total[0, 10:], squares, rtol=1e-5, atol=0)
    one = torch.ones_like(u)
    t, g = t.double(), g.double()
    plain, off = correlation(part.normal, total), detrended(part.normal, total)
    assert float(plain) == pytest.approx(weighted_correlation(t, g, w, one[:, None]), abs=1e-4)
    assert float(off) == pytest.approx(weighted_correlation(t, g, w, torch.stack((one, u, v), 1)), abs=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_faint_texture_on_a_slope_is_found_when_light_turns_the_slope(backend):
    """4 percent of the template are texture; the slope that is all the rest comes out the other way round."""
    middle, truth = torch.tensor([[[30.0, 30.0, 0.0]], [[60.3, 50.2, 0.0]]], dtype=torch.float64)
    u, v = (torch.arange(61.0) - 30) / 30, (torch.arange(FRAME[1]) - 60.3) / 30
    texture = [0.2 * (SCENE.render(pose, shape) - 128) for pose, shape in ((middle, (61, 61)), (truth, FRAME))]
    template, image = (128 + 30 * at + part for at, part in zip((u, v), texture, strict=True))
    image = image * (1 - 0.5 * v.clamp(-1.5, 1.5)).float()
    found = align(prepare(template.float()), image.float(), truth + torch.tensor([0.4, -0.3, 0.005]), backend=backend)
    assert found.score < 0
    assert found.status == Status.CONVERGED
    assert (found.pose - truth).abs().max() < 0.02


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("level", [0.0, 255.0, 60000.0])
@pytest.mark.parametrize("interpolation", ["bilinear", "bspline3", "bspline5"])
def test_a_flat_patch_resembles_nothing(backend, level, interpolation):
    """Its rounding errors are not looked at: the score is 0, not small."""
    for seed in range(5):
        reference, image, start = Problem((11, 12), dtype=torch.float32, seed=seed).made(CRITERIA[1])
        found = align(reference, image * 0 + level, start, interpolation=interpolation, backend=backend)
        assert found.score == 0
        assert found.status == Status.LOST


@pytest.mark.parametrize("criterion", [c for c in CRITERIA if c != PaperECC()], ids=str)
def test_what_the_columns_fit_of_the_noise_is_made_up_for(criterion):
    """Residuals of white noise of variance 4 are smaller than it, and the fewer the pixels, the more so."""
    reference, _, _ = Problem((11, 11), texture="rich", dtype=torch.float32).made(criterion)
    noise = 2 * torch.randn(2000, 121, generator=torch.Generator().manual_seed(0))
    many = reference.select(torch.zeros(2000, dtype=torch.long))
    _, _, total = summed(many, reference.signal[:, 3] + noise, many.weight)
    assert float((total[:, 6] / many.normal.freedom).mean()) == pytest.approx(4, rel=0.04)
