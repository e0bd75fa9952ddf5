"""Laws of what stays with a camera: it holds a template where that was cut, and sigma tells."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torch_ecc import Track, Tracker, prepare
from torch_ecc.core.align import solve_again
from torch_ecc.core.leverage import disagreement
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution
from torch_ecc.sim.scene.pads import Pads
from torch_ecc.sim.scene.speckle import Speckle
from torch_ecc.sim.scene.waves import PlaneWaves
from torch_ecc.track import pinned
from torch_ecc.track.lined import NEVER, lined, nothing_due

SHAPE, SIZE, HOME = (110, 120), 61, (60.0, 55.0)
SCENES = 6


def poses(moves: Tensor) -> Tensor:
    """HOME, and then so far (F, 2) px from it: (F + 1, 3)."""
    moves = torch.cat((torch.zeros(1, 2), moves))
    return torch.cat((moves + torch.tensor(HOME), torch.zeros(len(moves), 1)), 1).double()


def filmed(path: Tensor, seed: int, fixed: float, noise: float) -> Tensor:
    """Frames (F, H, W) with a ``fixed`` pattern and ``noise``, grey levels, on a contrast of ten."""
    source = torch.Generator().manual_seed(seed)
    clean = PlaneWaves.random(seed=seed).render(path, SHAPE)[:, 0].float()
    clean = 110 + 10 * (clean - clean.mean()) / clean.std()
    pattern = fixed * torch.randn(SHAPE, generator=source)
    return (clean + pattern + noise * torch.randn(clean.shape, generator=source)).round().clamp(0, 255).to(torch.uint8)


def errors(fixed: float, noise: float) -> tuple[Tensor, Tensor]:
    """x and y of poses at 0.1 to 1 px, off (n, 2), and their sigma."""
    path = poses(torch.tensor([[0.1, 0.05], [-0.3, 0.25], [0.6, -0.4], [0.9, 0.5]]))
    tracks = []
    for seed in range(SCENES):
        frames = filmed(path, seed, fixed, noise)
        tracks.append(Tracker(frames[0], [HOME], SIZE).track_sequence(frames[1:]))
    error = torch.cat([track.pose[:, 0, :2] - path[1:, :2] for track in tracks])
    return error, torch.cat([track.sigma[:, 0, :2] for track in tracks])


def test_sigma_covers_what_a_fixed_pattern_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """It pulls to where the template was cut, by many times what noise alone would do."""
    error, sigma = errors(fixed=3.0, noise=1.5)
    assert 0.6 < (error / sigma).square().mean().sqrt() < 1.5
    monkeypatch.setattr("torch_ecc.track.advance.held", lambda estimate, *_: estimate)
    same, alone = errors(fixed=3.0, noise=1.5)
    assert torch.equal(error, same)
    assert (error / alone).square().mean().sqrt() > 2.5


@pytest.mark.parametrize("noise", [0.5, 2.0, 4.0])
def test_noise_that_is_new_in_every_frame_is_no_pattern(noise: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sigma is as it was, and hardly larger where noise of less than a grey level cannot be told well."""
    _, sigma = errors(fixed=0.0, noise=noise)
    monkeypatch.setattr("torch_ecc.track.advance.held", lambda estimate, *_: estimate)
    more = sigma / errors(fixed=0.0, noise=noise)[1]
    assert more.min() >= 1
    assert more.max() <= (1.0 if noise > 1 else 1.5)


def test_fine_texture_that_goes_along_is_no_pattern(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a template was taken to have of noise is missing from all frames, also far away: from then on it is none."""
    path = poses(torch.tensor([[0.25, 0.25], [1.2, 0.8], [2.2, 1.6], [3.1, 2.3], [2.3, 1.6], [1.2, 0.8], [0.25, 0.25]]))
    spectrum = torch.fft.fft2(torch.randn(SHAPE, generator=torch.Generator().manual_seed(0)).double())
    y, x = (torch.fft.fftfreq(n, dtype=torch.float64) for n in SHAPE)
    spectrum *= x.square() + y[:, None].square() < 0.35**2
    dx, dy = (path[:, :2] - torch.tensor(HOME)).unsqueeze(2).unbind(1)
    phase = torch.exp(-2j * torch.pi * (dx[:, None] * x + dy[:, None] * y[:, None]))
    shown = (110 + 12 * torch.fft.ifft2(spectrum * phase).real).float()
    tracker = Tracker(shown[0], [HOME], SIZE)
    track = tracker.track_sequence(shown[1:])
    assert bool((track.status == 0).all())
    assert float(tracker.fixed) == pinned.TEXTURE
    monkeypatch.setattr("torch_ecc.track.advance.held", lambda estimate, *_: estimate)
    alone = Tracker(shown[0], [HOME], SIZE).track_sequence(shown[1:])
    assert track.sigma[0, 0, 0] > 1.5 * alone.sigma[0, 0, 0]
    assert torch.equal(track.sigma[3:], alone.sigma[3:])


def drifting(seed: int, step: float = 0.06, count: int = 25) -> tuple[Tensor, Tensor]:
    """A slow drift (F + 1, 3), and its frames (F + 1, H, W) behind a dark stripe and grains of dust: far more contrast
    than the scene has."""
    time = torch.arange(1, count + 1, dtype=torch.float32)
    path = poses(torch.stack((-step * time, 0.5 * step * time), 1))
    y, x = torch.arange(SHAPE[0])[:, None], torch.arange(SHAPE[1])
    marks = ((x + 0.2 * y - 78).abs() < 4) | ((x - 45).square() + (y - 40).square() < 12)
    return path, torch.where(marks, 12 + torch.zeros_like(marks), filmed(path, seed, 0.0, 1.0)).to(torch.uint8)


def wrong(track: Track, path: Tensor) -> Tensor:
    """Which of the frames (F,) are believed 0.1 px off, by more than 5 sigma."""
    error, sigma = (track.pose[:, 0] - path[1:]).abs()[:, :2], track.sigma[:, 0, :2]
    return (track.status[:, 0] == 0) & ((error > 0.1) & (error > 5 * sigma)).any(1)


@pytest.mark.parametrize("seed", range(3))
def test_sigma_covers_what_a_mark_does_to_a_slow_drift(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before so much is left of any block that it could be told, and between the frames in which one looks for it."""
    path, frames = drifting(seed)
    track = Tracker(frames[0], [HOME], SIZE).track_sequence(frames[1:])
    assert not wrong(track, path).any()
    monkeypatch.setattr("torch_ecc.track.advance.held", lambda estimate, *_: estimate)
    assert wrong(Tracker(frames[0], [HOME], SIZE).track_sequence(frames[1:]), path).any()


def before_lines(axis: int, seed: int, offset: float) -> tuple[Tensor, Tensor]:
    """A slow drift (F + 1, 3), and its frames (F + 1, H, W) from a sensor whose columns, or rows for the ``axis`` 1,
    have offsets of their own, on a contrast of fifteen."""
    path = poses(torch.arange(1, 23)[:, None] * torch.tensor([[-0.11, -0.066] if axis == 0 else [0.066, 0.11]]))
    clean, source = Speckle.random(seed=seed).render(path, SHAPE)[:, 0].float(), torch.Generator().manual_seed(seed)
    lines = offset * torch.randn((1, SHAPE[1]) if axis == 0 else (SHAPE[0], 1), generator=source)
    shown = 110 + 15 * (clean - clean.mean()) / clean.std() + lines
    return path, (shown + 1.5 * torch.randn(clean.shape, generator=source)).round().clamp(0, 255).to(torch.uint8)


@pytest.mark.parametrize("axis", [0, 1])
def test_sigma_covers_what_lines_that_stay_do_to_a_slow_drift(axis: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """They hold it along one axis; by how much is told from what they leave a little off, and remembered."""

    def ratio(seed: int) -> Tensor:
        path, frames = before_lines(axis, seed, 4.0)
        track = Tracker(frames[0], [HOME], SIZE).track_sequence(frames[1:])
        assert (track.status == 0).all()
        return ((track.pose[:, 0] - path[1:]) / track.sigma[:, 0])[4:, axis]

    ratios = torch.stack([ratio(seed) for seed in (0, 2)])
    assert ratios.abs().max() < 2.2
    assert ratios.square().mean().sqrt() < 1.5
    monkeypatch.setattr("torch_ecc.track.advance.lined", lambda estimate, *_: estimate)
    assert ratio(2).abs().max() > 4


def test_a_sensor_without_lines_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sigma is as if nobody asked, also before a scene of straight edges along both axes; noise is some by chance."""
    for seed, scene in enumerate(
        [*(Speckle.random(seed=k) for k in range(2)), *(Pads.wafer(seed=k) for k in range(2))]
    ):
        path = poses(torch.arange(1, 20)[:, None] * torch.tensor([[-0.18, 0.15]]))
        clean, source = scene.render(path, SHAPE)[:, 0].float(), torch.Generator().manual_seed(seed)
        frames = (clean + 1.5 * torch.randn(clean.shape, generator=source)).round().clamp(0, 255).to(torch.uint8)
        tracker = Tracker(frames[0], [HOME], SIZE)
        track = tracker.track_sequence(frames[1:])
        assert (tracker.lines[:, :, 1] > 2).all()
        with monkeypatch.context() as alone:
            alone.setattr("torch_ecc.track.advance.lined", lambda estimate, *_: estimate)
            more = track.sigma / Tracker(frames[0], [HOME], SIZE).track_sequence(frames[1:]).sigma
        assert more.min() >= 1
        assert more.max() < 1.1


def test_the_host_sees_where_no_lines_pull(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever it says so nothing changes, and it says so wherever one is far along both axes."""
    image = Speckle.random(seed=0).render(poses(torch.zeros(0, 2)), SHAPE).float()
    reference, source, said = prepare(image[0, :, 30:91, 30:91]), torch.Generator().manual_seed(0), []
    estimate, found = solve_again(reference, image, torch.tensor([[60.0, 60.0, 0.0]], dtype=torch.float64), Settings())
    for _ in range(60):
        moved, power, due = (torch.rand(2, generator=source, dtype=torch.float64) for _ in range(3))
        moved, power = torch.cat((16 * moved - 8, 2 * moved[:1])), power.masked_fill(power < 0.3, 0.0)
        due = torch.where(due < 0.1, 3.0, NEVER)
        there = estimate._replace(pose=estimate.pose + moved, displacement=moved[None], status=estimate.status * 0)
        state = {"lines": torch.stack((power, due), 1)[None]}
        said.append(nothing_due(state["lines"].tolist(), moved[None, :2].tolist(), there.pose[:, 2].tolist()))
        with monkeypatch.context() as alone:
            alone.setattr("torch_ecc.track.lined.nothing_due", lambda *_: False)
            changed = not torch.equal(lined(there, found, reference, state).covariance, there.covariance)
        assert not (said[-1] and changed)
        asked = bool((moved[:2].abs() > due).any())
        assert said[-1] == (not asked and not changed)
    assert 15 < sum(said) < 45


@pytest.mark.parametrize("axis", [0, 1])
def test_a_template_has_as_much_of_lines_as_it_shows(axis: int) -> None:
    """Offsets of variance v, and nothing of a smooth scene."""
    source = torch.Generator().manual_seed(axis)
    smooth = PlaneWaves.random(seed=1).render(poses(torch.zeros(0, 2)), SHAPE)[0, 0].float()
    lines = 3 * torch.randn((1, SHAPE[1]) if axis == 0 else (SHAPE[0], 1), generator=source)
    for shown, expected in ((smooth, 0.0), (smooth + lines, float(lines.var()))):
        most = prepare(shown).blocks.lined[0]
        assert float(most[axis]) == pytest.approx(expected, rel=0.35, abs=0.3)
        assert float(most[1 - axis]) < 0.3


def effects(reference: Reference, image: Tensor) -> Solution:
    """Of one look at an ``image`` (1, 1, H, W)."""
    settings = Settings(backend="torch", max_iterations=20)
    return solve_again(reference, image, torch.tensor([[*HOME, 0.0]], dtype=torch.float64), settings)[1]


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_blocks_of_high_leverage_disagree_by_what_the_others_have_moved(factor: float) -> None:
    """Not by noise; of what moves they say a part, and the same in any grey levels."""
    still, moved = poses(torch.zeros(1, 2))[:1], poses(torch.tensor([[0.2, -0.1]]))[1:]
    for seed in range(4):
        first, same = (filmed(still, seed + k, 0.0, 0.0)[0].float() for k in (0, 0))
        other = filmed(moved, seed, 0.0, 0.0)[0].float()
        source = torch.Generator().manual_seed(seed)
        bar = (torch.arange(SHAPE[1]) - 70).abs() < 4
        noisy = [torch.where(bar, 5.0, v) + 1.5 * torch.randn(SHAPE, generator=source) for v in (first, same, other)]
        frames = [factor * v[None, None] for v in noisy]
        tracker = Tracker(frames[0][0], [HOME], SIZE)
        reference = tracker.references[0]
        off = [disagreement(reference.leverage, effects(reference, frame)) for frame in frames[1:]]
        assert off[0] is None
        assert off[1] is not None
        assert 0.04 < float(off[1][0, 0].abs()) < 0.4
