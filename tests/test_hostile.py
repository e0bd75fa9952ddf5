"""Laws of the hostile benchmark: its films keep their truth, it counts right, and undisturbed all is right."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import honesty
import hostile
import soak
from films import covers, disturbed, repeats
from films.shot import SCENES, Film, Shot, eq11, frames, visible_bound
from films.soak import Moment
from results import load

from torch_ecc import Reason, Status, Tracker
from torch_ecc.paper.bound import cramer_rao
from torch_ecc.sim import PlaneWaves

SHORT = eq11(frames(12))
PLACED, FRAME = eq11(frames(), (160.0, 120.0)), (1, 240, 320)


@pytest.fixture(scope="module")
def shot() -> Shot:
    return Shot(SCENES["waves"](0), path=SHORT, size=61, frame=(360, 460))


def test_undisturbed_all_is_right_at_the_bound(shot: Shot) -> None:
    found = honesty.figures([honesty.follow(shot.film(shot.clean))])
    assert found["right"] == found["frames"] == len(SHORT) - 1
    assert found["wrong"] == found["off"] == found["lost"] == 0
    assert found["bound"] < 2
    assert found["sigma"] < 2


@pytest.mark.parametrize("motion", covers.MOTIONS)
@pytest.mark.parametrize("seed", [0, 3])
def test_a_strip_covers_the_share_it_says(motion: str, seed: int) -> None:
    shot = Shot(PlaneWaves.random(9), seed, size=61, frame=(310, 410))
    _, opacity = covers.covered(shot, 0.2, "flat", motion)
    share = 1 - shot.inside(opacity < 0.5).double().mean(1)
    assert float(share.max()) == pytest.approx(0.2, abs=0.02)
    assert share[0] == share[-1] == 0


def test_what_is_seen_bounds_the_error(shot: Shot) -> None:
    """All of it: the bound of the paper; half of it: more; a strip that a wave runs along: nothing fixes the pose."""
    t, J = shot.slopes
    whole = visible_bound(t, J, torch.full((1, len(t)), 1 / 8.0)).diagonal(dim1=1, dim2=2).sqrt()[0]
    torch.testing.assert_close(whole, cramer_rao(shot.scene, (61, 61), 8.0))
    half = torch.arange(len(t))[None] < len(t) // 2
    assert bool((visible_bound(t, J, half / 8.0).diagonal(dim1=1, dim2=2).sqrt()[0] > whole).all())
    assert bool(visible_bound(t, J, torch.zeros(1, len(t))).isinf().all())


def test_rows_at_one_pose_are_a_picture(shot: Shot) -> None:
    image = disturbed.by_rows(shot, lambda k, row: shot.path[k])
    torch.testing.assert_close(image, shot.clean, atol=1e-3, rtol=0)


@pytest.mark.parametrize("family", SCENES)
def test_a_scaled_scene_is_the_same_farther_out(family: str) -> None:
    scene, points = SCENES[family](0), 40 * torch.randn(20, 2, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(disturbed.scaled(scene, 1.1).value(1.1 * points), scene.value(points))


def test_every_disturbance_gives_a_film() -> None:
    """Of the same shape, with a truth for every frame, and none changes the first frame's place."""
    shot = Shot(PlaneWaves.random(20), path=eq11(frames(34)), size=31, frame=(320, 420))
    for name, disturb in hostile.disturbances().items():
        if name.startswith(("cover 10", "twin", "turns", "salt", "lost", "fixed", "noise in r", "photons 30")):
            film = disturb(shot)
            assert film.frames.dtype == torch.uint8, name
            assert film.frames.shape == (len(shot.path), 1, *shot.frame), name
            assert film.truth.isfinite().all(), name
            assert film.seen.shape == film.truth.shape[:2] == (len(shot.path) - 1, 1), name
            assert torch.equal(film.centers, shot.path[:1, :2]), name


def test_counts(shot: Shot) -> None:
    """Right, off within its sigma, wrong, far and wrong, disbelieved, lost; nothing disturbs the last four."""
    n = 6
    truth = torch.zeros(n, 1, 3, dtype=torch.float64)
    film = Film(shot.clean[:0], truth[0, :, :2], 61, truth, torch.ones(n, 1), torch.ones_like(truth), 2)
    error, sigma = torch.zeros(n, 1, 3), torch.full((n, 1, 3), 0.01)
    error[:, 0, 0] = torch.tensor([0.05, 0.2, 0.2, 3.0, 0.01, 9.0])
    sigma[1] = 0.1
    status = torch.tensor([0, 0, 0, 0, Status.MAX_ITERATIONS, Status.LOST], dtype=torch.int8)[:, None]
    found = honesty.figures([honesty.Run(film, error, sigma, status, status, status, status, torch.ones(n))])
    counts = {"converged": 4, "right": 1, "off": 3, "wrong": 2, "far": 1, "after": 2, "disbelieved": 1, "lost": 1}
    assert {name: found[name] for name in counts} == counts
    assert found["recovery"] == math.inf


def test_parts_that_cross_are_seen_and_hidden() -> None:
    film = next(iter(repeats.crossings(1)))
    assert film.truth.shape == (repeats.CROSSING - 1, 2, 3)
    assert float(film.seen[:, 0].min()) < 0.5
    assert bool((film.seen[:, 1] == 1).all())


def test_one_row_by_one_command(tmp_path: Path) -> None:
    out = tmp_path / "hostile.json"
    done = CliRunner().invoke(hostile.main, ["--quick", "--rows", "leap", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert load(out).figures["leap / frames"].value == 90
    refused = CliRunner().invoke(hostile.main, ["--rows", "no such row"])
    assert refused.exit_code == 2
    assert "known are none, cover 5 %" in refused.output


def test_a_soak_can_begin_anew_from_a_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same frames, of which it tells the same."""
    monkeypatch.setattr(soak, "EVERY", 40)
    arguments, found = ["--family", "waves", "--frames", "80", "--states", str(tmp_path)], []
    for more in ([], ["--first", "40"]):
        out = tmp_path / "soak.json"
        done = CliRunner().invoke(soak.main, [*arguments, *more, "--out", str(out)])
        assert done.exit_code == 0, done.output
        found.append([line.rsplit(",", 2)[0] for line in done.output.splitlines() if "frames" in line])
        assert load(out).figures["waves 0 / wrong"].value == 0
    truth = [soak.figures(soak.Soak.of("waves", 0, (0, 80), 61).run()[0][k:])["converged"] for k in (0, 1)]
    assert f"converged {truth[0]}," in found[0][1]
    assert f"converged {truth[1]}," in found[1][0]


def test_what_most_of_a_template_recognises_is_believed() -> None:
    """Half of the blocks are touched by a strip that stands still, so that the median fits no better than least squares
    does: what is left looks like the template."""
    still = soak.Soak.of("pads", 4, (0, 80), 61)
    run = still.part(1, [Moment(n % 40, "cover" if n > 5 else "clean", 0.2) for n in range(1, 80)])
    assert not bool((run.wrong & run.believed).any())
    assert int((run.status > Status.MAX_ITERATIONS).sum()) <= 25


def test_where_it_was_last_it_has_stayed_or_it_is_not_there() -> None:
    """A corner looks like all others once turned by 90 deg: least squares that slides there from the last place, in
    which a lost template is tried, has found another one."""
    run = soak.Soak.of("pads", 21, (0, 150), 61).run()[0][0]
    assert not bool((run.wrong & run.believed).any())


def test_what_was_lost_is_believed_only_where_it_looks_like_itself() -> None:
    """In the dark it has gone on 8 px to where it is not looked for first; least squares slides to another place, and
    a search finds it, if there is time for one."""
    shot = Shot(SCENES["micrograph"](41), 41, PLACED[:28], 61, (240, 320))
    film = shot.film(torch.cat((shot.clean[:15], torch.zeros(9, *FRAME), shot.clean[24:])))
    run = honesty.follow(film)
    assert bool((run.believed & ~run.off)[:14].all())
    assert not bool((run.believed & run.off)[23:].any())
    assert bool(run.believed[-1].all())
    tracker = Tracker(film.frames[0], film.centers, film.size)
    for frame in film.frames[1:24]:
        tracker(frame)
    tracker.credit = torch.full_like(tracker.credit, -99.0)
    told = tracker(film.frames[24])
    assert told.status[0] == Status.LOST
    assert told.reason[0] == Reason.WAITING


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_sigma_of_a_small_patch_covers_a_wide_blur(seed: int) -> None:
    """Which pulls this way and that within the patch: seen in the residuals, not in what they do to the pose."""
    shot = Shot(SCENES["micrograph"](seed), seed, PLACED[:8], 61, (240, 320))
    run = honesty.follow(shot.film(torch.cat((shot.clean[:2], shot.taken(blur_sigma=5.0)[2:]))))
    assert int(run.believed[1:].sum()) >= 2
    assert not bool((run.believed & run.wrong).any())
