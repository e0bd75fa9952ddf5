"""Laws of sigma where residuals cling together: lines that are brighter, and targets that are strained."""

from __future__ import annotations

import pytest
import torch
from engines import BACKENDS, CRITERIA, Problem
from torch import Tensor

from torch_ecc import Status, align, prepare
from torch_ecc.core.blocks import STRAINS
from torch_ecc.core.clinging import clinging, scale_of
from torch_ecc.core.clinging import strains as strains_shown
from torch_ecc.core.native.engine import solve as native
from torch_ecc.core.settings import Settings
from torch_ecc.core.solver import solve
from torch_ecc.core.strain import few_lines, strained_by, strained_pose, without_strain
from torch_ecc.sim import Pads, PlaneWaves

SIZE, FRAME, MIDDLE = 91, (151, 160), (80.0, 75.0)
SCENES = {"waves": PlaneWaves.random(seed=3), "pads": Pads.wafer(seed=1)}
START = torch.tensor([[*MIDDLE, 0.0]], dtype=torch.float64)


def points(strain: int | None = None, amount: float = 0.0) -> Tensor:
    """Where the target's points are that a frame's pixels (h, w, 2) see, if strained by an ``amount`` at its border."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in FRAME), indexing="ij")
    place = torch.stack((x, y), -1) - START[0, :2]
    if strain is None:
        return place
    half = SIZE / 2
    moved = STRAINS[strain][0](*(place / half).unbind(-1))
    return place - amount * torch.stack(moved, -1)


def cut(picture: Tensor) -> Tensor:
    """The template of a frame (h, w)."""
    x, y, half = int(MIDDLE[0]), int(MIDDLE[1]), SIZE // 2
    return picture[y - half : y + half + 1, x - half : x + half + 1]


def noise(sigma: float, draw: torch.Generator, shape: tuple[int, int] = FRAME) -> Tensor:
    return sigma * torch.randn(shape, generator=draw)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("strain", range(len(STRAINS)))
def test_sigma_covers_a_strained_target(strain, backend):
    """However it is strained: where nothing moves, what moves the pose is within some sigma; to shear by s may be to
    turn by s / 2."""
    for name, scene in SCENES.items():
        draw = torch.Generator().manual_seed(strain)
        clean, changed = (scene.value(p.view(-1, 2)).view(FRAME).float() for p in (points(), points(strain, 0.5)))
        reference = prepare(cut(clean + noise(2.0, draw)))
        found = align(reference, changed + noise(2.0, draw), START, backend=backend)
        assert found.status == Status.CONVERGED, name
        assert ((found.pose - START).abs() < 5 * found.sigma).all(), name
        if STRAINS[strain][1]:
            assert found.sigma[0, 2] > 0.5 * 0.5 / (SIZE / 2), name


@pytest.mark.parametrize("backend", BACKENDS)
def test_sigma_covers_lines_that_are_brighter(backend):
    """As some sensors' are; and of white noise it stays what it is."""
    worst = {}
    for along in ("none", "rows", "columns"):
        ratios = []
        for k, scene in enumerate(SCENES.values()):
            clean = scene.value(points().view(-1, 2)).view(FRAME).float()
            for seed in range(12):
                draw = torch.Generator().manual_seed(100 * k + seed)
                line = {"none": (1, 1), "rows": (FRAME[0], 1), "columns": (1, FRAME[1])}[along]
                first, second = (clean + noise(2.0, draw) + noise(2.0, draw, line) for _ in range(2))
                found = align(prepare(cut(first)), second, START, backend=backend)
                ratios.append((found.pose - START)[0] / found.sigma[0])
        worst[along] = float(torch.stack(ratios).square().mean(0).sqrt().max())
    assert 0.8 < worst["none"] < 1.2
    assert worst["rows"] < 1.6
    assert worst["columns"] < 1.6


@pytest.mark.parametrize("criterion", CRITERIA, ids=str)
def test_patterns_are_what_strains_leave(criterion):
    """From the sums of blocks as from all pixels, under weights too; what they fit is gone."""
    reference, image, start = Problem((40, 43), mask="one", centred=False, dtype=torch.float32).made(criterion)
    found = solve(reference, image, start, Settings())
    strains = strains_shown(reference, found)
    pattern, shift = strains.pattern.float().unflatten(2, (3, -1)), strains.shift.float()
    (gx, gy), grid = reference.signal[0, :2], reference.grid
    x, y = (grid.pixels[:2] - reference.place.centre[0, :, None]) / float(reference.place.radius)
    for k, (moved, _) in enumerate(STRAINS):
        change = sum(g * d for g, d in zip((gx, gy), moved(x, y), strict=True))
        u = reference.K[0] @ change
        left = change - u @ reference.criterion.columns(reference.signal, reference.uv)[0]
        of_pixels = reference.K[0, :3] * left
        direct = torch.zeros_like(pattern[0, k]).index_add_(1, grid.block, of_pixels)
        scale = float(direct.abs().max())
        torch.testing.assert_close(pattern[0, k], direct, rtol=0, atol=2e-3 * scale)
        torch.testing.assert_close(shift[0, :, k], u[:3], rtol=2e-3, atol=1e-5)
        effect = 0.3 * direct[None].double()
        strain, _, certain = strained_by(strains, effect)
        assert certain > 0.99
        assert without_strain(strains, effect, strain).abs().max() < 0.01 * scale
        covariance = strained_pose(strains, strain[:, :, None] * strain[:, None])
        shifted = 0.09 * u[:3].double().square()
        torch.testing.assert_close(covariance[0].diagonal()[:2], shifted[:2], rtol=0.02, atol=1e-6)


def test_engines_agree_on_what_clings_together():
    """Where the template is whole, at the border, and not trusted everywhere."""
    for place in ("inside", "border"):
        reference, image, start = Problem((48, 48), 2, place=place, dtype=torch.float32, seed=7).made(CRITERIA[1])
        one, other = (engine(reference, image, start, Settings()) for engine in (solve, native))
        values = []
        for found in (one, other):
            ones = torch.ones_like(found.gain)
            values.append(clinging(reference, found, 1e-3 * ones, scale_of(reference.grid, found.normal)))
        torch.testing.assert_close(values[0].scatter, values[1].scatter, rtol=2e-2, atol=1e-4)


@pytest.mark.parametrize(
    ("grid", "rows", "columns"), [((15, 21), 15, 21), ((15, 21), 5, 21), ((15, 21), 15, 2), ((9, 9), 4, 4)]
)
def test_lines_that_bear_little_are_none(grid, rows, columns):
    """What lines scatter by chance depends on how many of them bear on the pose, not on how many there are; and is the
    more the fewer they are."""
    share = torch.full((1, 3, *grid), 1e-6)
    share[:, :, :rows, :columns] = 1.0
    times = few_lines(share.flatten(2), grid)
    alone = few_lines(torch.ones(1, 3, rows * columns), (rows, columns))
    assert (times[:, 0] == 1).all()
    assert torch.allclose(times, alone, rtol=1e-3)
    for axis, n in ((1, rows), (2, columns)):
        assert torch.allclose(times[:, axis], torch.tensor((1 + 3 * (2 / n) ** 0.5) * n / max(n - 3, 1)), rtol=1e-3)
