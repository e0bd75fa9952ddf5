"""Stabilised frames: what is rigid with the template stands still, in any kind of frame."""

from __future__ import annotations

import pytest
import torch

import torch_ecc as te
from torch_ecc.sim.scene.waves import PlaneWaves

POSES = torch.tensor([(60.0 + 0.7 * k, 50.0 - 0.4 * k, 0.02 * k) for k in range(6)], dtype=torch.float64)
SCENE = PlaneWaves.random(seed=4).render(POSES, (100, 120))[:, 0]
INNER = (..., slice(25, 75), slice(30, 90))


@pytest.fixture(scope="module")
def track() -> te.Track:
    return te.Tracker(SCENE[0], [(60.0, 50.0), (45.0, 45.0)], 31).track_sequence(SCENE)


def test_what_was_seen_at_first_stands_still(track):
    still = torch.stack(list(te.stabilise(SCENE, track)))
    assert (SCENE - SCENE[0])[INNER].abs().max() > 40
    assert (still - SCENE[0])[INNER].abs().max() < 0.5


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float64])
@pytest.mark.parametrize("channels", [(), (1,), (3,)])
def test_frames_keep_their_kind(track, dtype, channels):
    frames = [frame.expand(*channels, *frame.shape).round().to(dtype) for frame in SCENE]
    for frame, still in zip(frames, te.stabilise(frames, track, template=1), strict=True):
        assert (still.shape, still.dtype) == (frame.shape, dtype)
        assert (still.double() - SCENE[0])[INNER].abs().max() < 1.5


def test_what_was_not_seen_is_black(track):
    *_, last = te.stabilise(SCENE + 1000, track)
    assert (last == 0).any()
    assert not ((last > 0) & (last < 800)).any()


def test_wrong_input(track):
    with pytest.raises(ValueError, match="interpolation must be one of"):
        te.stabilise(SCENE, track, interpolation="magic")
    with pytest.raises(ValueError, match=r"track must be \(F, R, ...\) with a template 2, got \(6, 2, 3\)"):
        te.stabilise(SCENE, track, template=2)
    with pytest.raises(ValueError, match=r"frame 0 must be \(H, W\) or \(C, H, W\), got \(1, 1, 100, 120\)"):
        list(te.stabilise(SCENE[:, None, None], track))
    with pytest.raises(ValueError, match="frames must be 6, as many as the track has, got 3"):
        list(te.stabilise(SCENE[:3], track))
    with pytest.raises(ValueError, match="frames must be 6, as many as the track has, got more"):
        list(te.stabilise([*SCENE, SCENE[0]], track))
