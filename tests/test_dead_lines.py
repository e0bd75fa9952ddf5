"""Lines of a camera that show nothing are told from the first frame, and hold no template where it was."""

from __future__ import annotations

import pytest
import torch
from engines import BACKENDS
from torch import Tensor

from torch_ecc import Status, Tracker
from torch_ecc.core.dead_lines import dead_lines
from torch_ecc.core.filters import blur
from torch_ecc.sim import Pads, PlaneWaves

FRAME, MIDDLE, SIZE = (220, 230), (110.0, 105.0), 91
SCENES = {"waves": PlaneWaves.random(seed=3), "pads": Pads.wafer(seed=1)}
PATH = torch.tensor([[1.3 * k, 0.9 * k, 0.01 * k] for k in range(5)], dtype=torch.float64)
DEAD = [3, 60, 80, 81, 97, 120, 121, 150, 219]


def film(scene: str, level: float = 0.0) -> tuple[Tensor, Tensor]:
    """Frames (F, H, W) uint8 with dead rows, and the poses."""
    poses = PATH + torch.tensor([*MIDDLE, 0.0])
    clean = SCENES[scene].render(poses, FRAME)[:, 0].float()
    clean[:, DEAD] = level
    noise = 2 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    return (clean + noise).round().clamp(0, 255).to(torch.uint8), poses


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("level", [0.0, 255.0])
@pytest.mark.parametrize("across", [False, True])
def test_dead_lines_hold_no_template(backend, scene, level, across):
    frames, poses = film(scene, level)
    if across:  # the mirror image, by its diagonal
        frames, poses = frames.mT, poses[:, [1, 0, 2]] * torch.tensor([1, 1, -1])
    center = tuple(poses[0, :2].tolist())
    with pytest.warns(UserWarning, match="are dead"):
        tracker = Tracker(frames[0], [center], SIZE, backend=backend)
    track = tracker.track_sequence(frames[1:])
    assert (track.status == Status.CONVERGED).all()
    assert (track.pose[:, 0] - poses[1:])[:, :2].abs().max() < 0.1


@pytest.mark.parametrize("scene", SCENES)
def test_which_lines_are_dead(scene):
    frames, _ = film(scene)
    dead = dead_lines(frames[:1, None].float())
    assert dead is not None
    assert set(dead.rows.tolist()) <= set(DEAD)
    assert len(dead.rows) >= len(DEAD) - 3  # at the frame's border there is one side
    assert len(dead.columns) == 0
    assert dead_lines(SCENES[scene].render(PATH[:1] + 100, FRAME)) is None


def test_lines_of_the_scene_are_not_dead():
    """A ruler's, dots in rows, a dark half."""
    y, x = torch.meshgrid(torch.arange(200.0), torch.arange(200.0), indexing="ij")
    noise = 2 * torch.randn(200, 200, generator=torch.Generator().manual_seed(0))
    ruler = 200 - 150 * ((y % 20 < 2) | (x % 25 < 2))
    dots = 200 - 150 * (((y % 12 - 6) ** 2 + (x % 12 - 6) ** 2) < 16)
    half = torch.where(y < 100, 128 + 50 * torch.sin(x / 3) * torch.sin(y / 3), 10.0)
    for picture in (ruler, dots, half):
        assert dead_lines(blur(picture[None, None].float(), 0.9) + noise) is None


def test_what_is_put_in_their_place_lies_beside_them():
    ramp = torch.arange(12.0)[:, None] * 10 + 8 * torch.sin(torch.arange(40.0))
    image = ramp.clone()
    image[[5, 8, 9]] = 500.0
    dead = dead_lines(image[None, None])
    assert dead is not None
    fixed = dead.repair(image[None, None])[0, 0]
    torch.testing.assert_close(fixed[5], ramp[5])
    torch.testing.assert_close(fixed[[8, 9]], ramp[[7, 10]].mean(0).expand(2, -1))
    kept = torch.ones(12, dtype=torch.bool)
    kept[[5, 8, 9]] = False
    assert torch.equal(fixed[kept], ramp[kept])
    for dtype in (torch.uint8, torch.uint16):
        whole = dead.repair(image[None, None].round().clamp(0, 255).to(dtype))[0, 0]
        assert (whole.float() - fixed.round().clamp(0, 255)).abs().max() <= 1
