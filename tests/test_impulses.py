"""Pixels that are black or white by chance are told from the first frame, and cost little."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torch_ecc import Status, Tracker
from torch_ecc.core.impulses import impulses
from torch_ecc.sim import Pads, PlaneWaves

FRAME, SIZE = (150, 160), 81
SCENES = {"waves": PlaneWaves.random(seed=3), "pads": Pads.wafer(seed=1)}
POSES = torch.tensor([[79 + 1.3 * k, 75 - 0.7 * k, 0.01 * k] for k in range(5)], dtype=torch.float64)


def film(scene: str, share: float) -> Tensor:
    """Frames (F, H, W) uint8, a ``share`` of their pixels black or white."""
    source = torch.Generator().manual_seed(0)
    clean = SCENES[scene].render(POSES, FRAME)[:, 0].float()
    shown = clean + 2 * torch.randn(clean.shape, generator=source)
    u = torch.rand(clean.shape, generator=source)
    return torch.where(u < share / 2, 0.0, torch.where(u < share, 255.0, shown)).round().clamp(0, 255).to(torch.uint8)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
@pytest.mark.parametrize("scene", SCENES)
def test_patches_are_tracked_among_them(scene: str, dtype: torch.dtype) -> None:
    frames = film(scene, 0.05).to(dtype)
    with pytest.warns(UserWarning, match="black or white by chance"):
        tracker = Tracker(frames[0], [(79.0, 75.0)], SIZE)
    track = tracker.track_sequence(frames[1:])
    assert (track.status == Status.CONVERGED).all()
    assert (track.pose[:, 0] - POSES[1:])[:, :2].abs().max() < 0.05


def test_what_a_lens_can_show_is_none() -> None:
    """Of a scene, clipped or not, and of white dots alone."""
    for scene in SCENES:
        frame = film(scene, 0.0)[:1, None].float()
        assert impulses(frame) is None
        assert impulses(((frame - 128) * 3 + 128).clamp(0, 255)) is None
    dots = torch.zeros(1, 1, 100, 100)
    dots[..., ::7, ::5] = 255.0
    assert impulses(dots) is None
