"""Patches that nothing fixes, and many that go together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor
from work import recorded

from films.shot import Film
from torch_ecc.sim.camera import sensor


def one_edge(count: int, black: float, size: int) -> Iterator[Film]:
    """One straight edge at several angles, nothing moves; where its dark side is ``black`` at 0 it has no noise."""
    for seed in range(count):
        angle = math.radians(25 + 37 * seed)
        x, y = torch.arange(300.0) - 150, torch.arange(300.0)[:, None] - 150
        bright = torch.sigmoid((x * math.cos(angle) + y * math.sin(angle)) / 1.5)[None]
        sigma = 3.0 * (bright.sqrt() if black == 0 else torch.ones_like(bright))
        sources = [sensor.generator(seed, k) for k in range(41)]
        noise = torch.stack([sigma * torch.randn(sigma.shape, generator=source) for source in sources])
        shown = sensor.quantise(black + (170 - black) * bright + noise, 8)
        truth = torch.tensor([[[150.0, 150.0, 0.0]]], dtype=torch.float64).expand(40, 1, 3)
        yield Film(shown, truth[0, :, :2], size, truth, torch.ones(40, 1), math.nan * truth, 0)


def together(data: Path, count: int = 200, size: int = 31) -> Iterator[Film]:
    """Patches of pyvale_rigid that all jump by 25 px, and by 50."""
    work = recorded(data / "pyvale_rigid")
    h, w = work.frames.shape[-2:]
    for k in (3, 4):
        margin = size / 2 + 60
        u = torch.rand(count, 2, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
        centers = (margin + u * torch.tensor([w - 2 * margin, h - 2 * margin])).round()
        truth = torch.nn.functional.pad(centers, (0, 1)) + shift(work.truth[k], work.center)
        shown = work.frames[[0, k + 1, k + 1]]
        truth = truth.expand(2, -1, -1)
        yield Film(shown, centers, size, truth, torch.ones(2, count), math.nan * truth, 0)


def shift(pose: Tensor, center: tuple[float, float]) -> Tensor:
    """How far (3,) a patch at ``center`` has gone whose pose (3,) is now."""
    return pose - pose.new_tensor((*center, 0.0))
