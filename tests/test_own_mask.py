"""Laws of what of a template moves with the rest of it."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import torch_ecc as te
from torch_ecc.core.pose import matrix
from torch_ecc.sim.scene.scene import PlaneWaves

SIZE, FRAME, COUNT = 61, (160, 180), 14
PART, BEHIND = PlaneWaves.random(seed=5), PlaneWaves.random(seed=6)


def grid() -> Tensor:
    row = torch.arange(SIZE, dtype=torch.float64) - (SIZE - 1) / 2
    y, x = torch.meshgrid(row, row, indexing="ij")
    return torch.stack((x, y), -1)


def film(inside: Tensor | None) -> tuple[Tensor, Tensor]:
    """Frames (F, H, W) of a part that moves over a still background, and its poses; ``inside`` (h, w): which pixels of
    the template it takes, None for all and beyond."""
    time = torch.arange(COUNT, dtype=torch.float64)
    pose = torch.stack((80 + 1.5 * time, 75 + 0.8 * time, 0.02 * time), 1)
    shots, behind = PART.render(pose, FRAME)[:, 0], BEHIND.render(torch.zeros(1, 3).double(), FRAME)[0, 0]
    if inside is not None:
        y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in FRAME), indexing="ij")
        back = torch.linalg.inv(matrix(pose))
        for k in range(COUNT):
            own = torch.stack((x, y, torch.ones_like(x)), -1) @ back[k].T
            column, row = ((own[..., i] + (SIZE - 1) / 2).round().long() for i in (0, 1))
            there = (column >= 0) & (column < SIZE) & (row >= 0) & (row < SIZE)
            there &= inside[row.clamp(0, SIZE - 1), column.clamp(0, SIZE - 1)]
            shots[k] = torch.where(there, shots[k], behind)
    source = torch.Generator().manual_seed(0)
    return (shots + 2 * torch.randn(shots.shape, generator=source)).round().clamp(0, 255).to(torch.uint8), pose


SHAPES = {
    "disc": grid().norm(dim=-1) < 27,
    "half": grid()[..., 0] + 0.4 * grid()[..., 1] < 8,
    "corner cut": ~((grid()[..., 0] > 5) & (grid()[..., 1] < -5)),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_what_moves_with_the_rest_is_found_and_tracks_better(shape: str) -> None:
    """To within half a block; plain least squares is bent by the rest, and no more so with the mask."""
    frames, truth = film(SHAPES[shape])
    at = [tuple(truth[0, :2].tolist())]
    track, bent = (te.Tracker(frames[0], at, SIZE, robust=on).track_sequence(frames) for on in (True, False))
    mask = te.suggest_mask(frames, track, SIZE)
    assert mask.shape == (1, SIZE, SIZE)
    assert float((mask[0] & ~SHAPES[shape]).double().mean()) < 0.04
    assert float((~mask[0] & SHAPES[shape]).double().mean()) < 0.16
    again = te.Tracker(frames[0], at, SIZE, mask=mask, robust=False).track_sequence(frames)
    off, before = ((t.pose[:, 0] - truth)[1:].abs().amax(0) for t in (again, bent))
    assert (off < torch.tensor([0.08, 0.08, math.radians(0.15)])).all(), (off, before)
    assert off[:2].amax() < 0.5 * before[:2].amax()


def test_of_what_moves_as_one_nothing_is_left_out() -> None:
    """Also if the light changes."""
    frames, truth = film(None)
    light = torch.linspace(0.7, 1.1, COUNT)[:, None, None]
    for shown in (frames, (frames * light).round().clamp(max=255).to(torch.uint8)):
        track = te.Tracker(shown[0], [tuple(truth[0, :2].tolist())], SIZE).track_sequence(shown)
        assert te.suggest_mask(shown, track, SIZE).all()


def test_what_has_not_moved_tells_nothing() -> None:
    frames, truth = film(SHAPES["half"])
    still = frames[:1].expand(8, -1, -1)
    track = te.Tracker(frames[0], [tuple(truth[0, :2].tolist())], SIZE).track_sequence(still)
    assert te.suggest_mask(still, track, SIZE).all()
    few = te.Tracker(frames[0], [tuple(truth[0, :2].tolist())], SIZE).track_sequence(frames[:3])
    assert te.suggest_mask(frames[:3], few, SIZE).all()


def test_frames_must_be_those_of_the_track() -> None:
    frames, truth = film(None)
    track = te.Tracker(frames[0], [tuple(truth[0, :2].tolist())], SIZE).track_sequence(frames)
    with pytest.raises(ValueError, match="suggest_mask: frames must be 14, as many as the track has, got 13"):
        te.suggest_mask(frames[1:], track, SIZE)
    with pytest.raises(ValueError, match="suggest_mask: track must be"):
        te.suggest_mask(frames, te.Track(*(value[0] for value in track)), SIZE)
