"""Laws of the search among places that look alike: what the frame does not repeat decides, at any place and angle."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc import Locator, Status, align, prepare
from torch_ecc.core.filters import blur
from torch_ecc.core.settings import Settings
from torch_ecc.search.locate import image_pyramid, with_half_turns
from torch_ecc.search.matched_filter import whitened_matches

SIZE, HALF = (240, 320), 30


def lines(seed: int, *, faint: float = 5.0, period: float = 9.0) -> torch.Tensor:
    """Parallel lines (h, w) that are the same everywhere but for a ``faint`` grain, in grey levels."""
    generator = torch.Generator().manual_seed(seed)
    grain = blur(torch.randn(1, 1, *SIZE, generator=generator), 0.8)[0, 0]
    return 128 + 60 * (math.tau * torch.arange(SIZE[1]) / period).sin() + faint * grain / grain.std()


def noisy(image: torch.Tensor, seed: int) -> torch.Tensor:
    return image + torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))


def patch(image: torch.Tensor, x: int, y: int) -> torch.Tensor:
    return image[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1]


def turned(x: float, y: float, quarters: int) -> tuple[float, float, float]:
    """Where torch.rot90 takes a place of the frame, and its angle: counter-clockwise, as theta grows."""
    for k in range(quarters):
        x, y = y, (SIZE[1] if k % 2 == 0 else SIZE[0]) - 1 - x
    return x, y, math.remainder(quarters * math.pi / 2, math.tau)


PLACES = [(60, 70, 0), (200, 130, 1), (250, 180, 2), (100, 190, 3)]


def trials() -> list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Template, frame and pose (1, 3)."""
    made = []
    for k, (x, y, quarters) in enumerate(PLACES):
        scene = lines(k)
        frame = torch.rot90(noisy(scene, 100 + k), quarters).contiguous()
        made.append((noisy(patch(scene, x, y), 200 + k), frame, torch.tensor([turned(x, y, quarters)]).double()))
    return made


def off(pose: torch.Tensor, truth: torch.Tensor) -> float:
    """Px at the template's corners."""
    turn = math.remainder(float(pose[0, 2] - truth[0, 2]), math.tau)
    return float((pose - truth)[0, :2].norm()) + HALF * math.sqrt(2) * abs(turn)


def test_the_matched_filter_tells_what_the_coarse_search_cannot():
    alone = []
    for template, frame, truth in trials()[:3]:
        locator = Locator(prepare(template), (frame.shape[-2], frame.shape[-1]))
        first, _ = locator.candidates(image_pyramid(frame[None, None], locator.levels), 0)
        alone.append(off(first.pose[:1], truth))
        found = locator(frame)
        assert found.status == Status.CONVERGED
        assert off(found.pose, truth) < 0.3
    assert sum(e > 5 for e in alone) >= 2  # among such lines the coarse search is lost


def test_angles_come_with_their_half_turns():
    """Each once, in (-pi, pi], whichever of an angle and its half turn comes first."""
    angles = with_half_turns(torch.tensor([3.0, -0.1416, 0.5, 3.001, 0.501, -2.0]), torch.tensor(40.0))
    assert angles.abs().max() <= math.pi
    assert torch.allclose(angles[:3], torch.tensor([3.0, 0.5, -2.0]))
    assert torch.allclose((angles[3:] - angles[:3]).abs(), torch.tensor(math.pi))


def test_rare_texture_is_found_at_full_resolution():
    """The first place is the right one, to the nearest px, at the right one of several turns."""
    turns = torch.arange(4) * math.pi / 2
    for template, frame, truth in trials():
        assert off(whitened_matches(prepare(template), frame, angles=turns, most=3)[:1], truth) < 1


def test_gain_offset_and_a_move_of_the_frame_change_no_place():
    template, frame, truth = trials()[0]
    reference, turns = prepare(template), torch.zeros(1)
    base = whitened_matches(reference, frame, angles=turns, most=1)
    assert off(base, truth) < 1
    for gain, offset in ((0.1, 7.0), (100.0, -3000.0)):
        assert (whitened_matches(reference, frame * gain + offset, angles=turns, most=1) - base).abs().max() < 0.05
    rolled = whitened_matches(reference, frame.roll((17, 45), (0, 1)), angles=turns, most=1)
    assert (rolled - base - torch.tensor([[45.0, 17.0, 0.0]])).abs().max() < 0.05


def test_a_mask_and_a_centre_are_honoured():
    template, frame, truth = trials()[0]
    mask = torch.ones_like(template, dtype=torch.bool)
    mask[:20], mask[:, 45:] = False, False
    soiled = torch.where(mask, template, 255 * torch.rand(template.shape, generator=torch.Generator().manual_seed(0)))
    reference = prepare(soiled, mask=mask, centre=torch.tensor([[5.0, -8.0]]))
    moved = truth + torch.tensor([[5.0, -8.0, 0.0]])
    assert off(whitened_matches(reference, frame, angles=torch.zeros(1), most=1), moved) < 1


@pytest.mark.parametrize("image", [torch.full(SIZE, 90.0), lines(0, faint=0.0), torch.rand(50, 40)])
def test_where_nothing_is_rare_the_answer_is_finite(image):
    """Nothing, nothing but lines, and less than the template."""
    reference = prepare(patch(noisy(lines(0), 1), 100, 100))
    assert whitened_matches(reference, image, angles=torch.tensor([0.0, 1.0]), most=4).shape == (4, 3)
    assert whitened_matches(reference, image, angles=torch.tensor([0.0, 1.0]), most=4).isfinite().all()


@pytest.mark.parametrize("most", [15, 4])
def test_a_refinement_that_slides_far_begins_anew(most):
    """Along the lines a pose comes slowly to its place: the answer is that of a start at the truth all the same."""
    scene = lines(1, faint=3.0)
    frame, truth = noisy(scene, 5), torch.tensor([[150.0, 100.0, 0.0]]).double()
    reference = prepare(noisy(patch(scene, 150, 100), 6))
    locator, image = Locator(reference, SIZE, Settings(max_iterations=most)), frame[None, None]
    tracked = align(reference, image, truth)
    start = truth + torch.tensor([[0.0, 1.6, 0.0]])
    found, _ = locator.refined(image, 0, start)
    assert off(found.pose, tracked.pose) < 0.01
