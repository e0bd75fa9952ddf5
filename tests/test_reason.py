"""Why a pose is not to be trusted: each reason from what makes it, on every engine, and in every file that tells it."""

from __future__ import annotations

import csv
import json
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from engines import BACKENDS, CRITERIA, Problem
from torch import Tensor

from torch_ecc import Estimate, Reason, Status, Track, Tracker, align
from torch_ecc.cli import app
from torch_ecc.commands.track import Session, TrackJob
from torch_ecc.core.filters import blur
from torch_ecc.sim import Pads, PlaneWaves
from torch_ecc.track.doubt import Past, disbelieved

STATUS = {
    Reason.NONE: Status.CONVERGED,
    Reason.MOVING: Status.MAX_ITERATIONS,
    Reason.OUT_OF_VIEW: Status.OUT_OF_VIEW,
    Reason.UNSURE: Status.LOW_TEXTURE,
    Reason.NOISE: Status.LOW_TEXTURE,
    Reason.DAMAGED: Status.DAMAGED,
}
FRAME, MIDDLE, SIZE = (200, 210), (104.0, 100.0), 101
SCENE, OTHER = PlaneWaves.random(seed=3), PlaneWaves.random(seed=77)
backends = pytest.mark.parametrize("backend", BACKENDS)


def seen(x: float = MIDDLE[0], scene: PlaneWaves = SCENE) -> Tensor:
    """A clean frame (H, W) of the scene around (x, 100)."""
    return scene.render(torch.tensor([[x, MIDDLE[1], 0.0]], dtype=torch.float64), FRAME)[0, 0].float()


def camera(frame: Tensor, seed: int) -> Tensor:
    """With noise of 2, as 8 bits."""
    noise = 2 * torch.randn(frame.shape, generator=torch.Generator().manual_seed(seed))
    return (frame + noise).round().clamp(0, 255).to(torch.uint8)


def covered(share: float) -> Tensor:
    """Another texture over a share of the template, from the left."""
    frame, edge = seen(), round(MIDDLE[0] - SIZE / 2 + share * SIZE)
    frame[:, :edge] = seen(scene=OTHER)[:, :edge]
    return frame


SITUATIONS = {
    Reason.NONE: seen(MIDDLE[0] + 2),
    Reason.COVERED: covered(0.58),
    Reason.UNLIKE: seen(scene=OTHER),
    Reason.INVERTED: 255 - seen(),
    Reason.FLAT: torch.full(FRAME, 90.0),
    Reason.OUT_OF_VIEW: seen(MIDDLE[0] - 120),
}


@backends
@pytest.mark.parametrize("reason", SITUATIONS, ids=lambda reason: reason.name)
def test_what_makes_a_reason(reason, backend):
    """With the search and without it."""
    for search in (True, False):
        first = seen(MIDDLE[0] - 60) if reason is Reason.OUT_OF_VIEW else seen()
        at = (MIDDLE[0] - 60, MIDDLE[1]) if reason is Reason.OUT_OF_VIEW else MIDDLE
        size = 61 if reason is Reason.OUT_OF_VIEW else SIZE
        tracker = Tracker(camera(first, 0), [at], size, backend=backend, search=search)
        if reason is Reason.OUT_OF_VIEW:  # nothing of it is there to be tracked: where it is expected is told
            tracker.pose = tracker.pose - torch.tensor([70.0, 0.0, 0.0])
        found = tracker(camera(SITUATIONS[reason], 1))
        assert Reason(int(found.reason)) is reason
        assert found.status == STATUS.get(reason, Status.LOST)


@backends
@pytest.mark.parametrize("reason", [Reason.DARK, Reason.CLIPPED, Reason.FLAT], ids=lambda reason: reason.name)
def test_whatever_takes_the_contrast_is_told_as_that(reason, backend):
    change = {
        Reason.DARK: lambda f: 0.01 * f,
        Reason.CLIPPED: lambda f: f + 400,
        Reason.FLAT: lambda f: 100 + 0.02 * f,
    }[reason]
    tracker = Tracker(camera(seen(), 0), [MIDDLE], SIZE, backend=backend)
    assert tracker(camera(change(seen()), 1)).reason == reason
    if reason == Reason.CLIPPED:  # and not by something even, as bright as no camera clips
        assert tracker(torch.full_like(camera(seen(), 0), 230)).reason == Reason.FLAT


@backends
def test_what_is_out_of_focus_is_told_as_that(backend):
    """And neither that of which half is covered by something flat, nor another thing."""
    clean = Pads.wafer(seed=1).render(torch.tensor([[*MIDDLE, 0.0]], dtype=torch.float64), FRAME)[0, 0].float()
    soft, half = blur(clean[None, None], 4.0)[0, 0], clean.clone()
    half[:, : int(MIDDLE[0]) + 8] = 60
    for frame, blurs in ((soft, True), (half, False), (blur(seen()[None, None], 4.0)[0, 0], False)):
        tracker = Tracker(camera(clean, 0), [MIDDLE], SIZE, backend=backend, search=False)
        found = tracker(camera(frame, 1))
        assert found.status in (Status.LOST, Status.LOW_TEXTURE)
        assert (found.reason == Reason.BLURRED) == blurs


@backends
def test_too_few_iterations_for_the_way(backend):
    tracker = Tracker(camera(seen(), 0), [MIDDLE], SIZE, backend=backend, max_iterations=1, search=False)
    found = tracker(camera(seen(MIDDLE[0] + 1.5), 1))
    assert (found.reason, found.status) == (Reason.MOVING, Status.MAX_ITERATIONS)


@backends
def test_too_much_noise_for_the_texture(backend):
    tracker = Tracker(camera(seen(), 0), [MIDDLE], 21, backend=backend, min_score=0.1, search=False)
    noise = 80 * torch.randn(FRAME, generator=torch.Generator().manual_seed(1))
    assert tracker(seen() + noise).reason == Reason.UNSURE


@backends
def test_texture_that_is_none(backend):
    """One edge fixes nothing along itself; noise is another one in every frame."""
    reference, image, start = Problem(texture="edge", seed=1).made(CRITERIA[0])
    assert align(reference, image, start, backend=backend).reason == Reason.NOISE
    flat = torch.full(FRAME, 100.0)
    with pytest.warns(UserWarning, match="too little texture"):
        tracker = Tracker(camera(flat, 0), [MIDDLE], 31, backend=backend)
    assert tracker(camera(flat, 1)).reason == Reason.NOISE


def test_of_equal_places_none_is_taken_and_that_is_why():
    """Of equal parts all but the template's own are in sight."""
    y, x = np.mgrid[0:300, 0:300].astype(float)
    u, v = np.abs((x - 150 + 30) % 60 - 30), np.abs((y - 150 + 30) % 60 - 30)
    parts = torch.from_numpy(70 + 100 / (1 + np.exp(u - 18)) / (1 + np.exp(v - 12))).float()
    hidden = parts.clone()
    hidden[114:187, 114:187] = 90
    tracker = Tracker(camera(parts, 0), [(150.0, 150.0)], 61)
    found = tracker(camera(hidden, 1))
    assert (found.reason, found.status) == (Reason.AMBIGUOUS, Status.LOST)
    assert tracker(camera(parts, 2)).reason == Reason.NONE


def test_what_has_slid_away_is_elsewhere():
    tracker = Tracker(camera(seen(), 0), [MIDDLE], SIZE)
    past, found = Past.of(dict(tracker.named_buffers())), tracker(camera(seen(), 1))
    home = past.home
    slid = found._replace(pose=found.pose + torch.tensor([40.0, 0.0, 0.0]))
    weak = found._replace(score=0.8 * found.score)
    part = weak._replace(pose=found.pose - torch.tensor([MIDDLE[0], 0.0, 0.0]))
    looks = (slid, [True], 6), (slid, [False], 0), (found, [True], 0), (weak, [True], 0), (part, [True], 6)
    for estimate, suspects, reason in looks:
        start = part.pose if estimate is part else home
        told = disbelieved(estimate, suspects, start, past, tracker.references[0], camera(seen(), 1))
        assert (told.reason, told.status) == (reason, Status.LOST if reason else Status.CONVERGED)


def test_a_frame_that_nobody_sees_is_damaged():
    tracker = Tracker(camera(seen(), 0), [MIDDLE], SIZE)
    assert tracker.skip().reason == Reason.DAMAGED
    track = tracker.track_sequence([camera(seen(), 1), None, camera(seen(), 2)])
    assert track.reason[:, 0].tolist() == [Reason.NONE, Reason.DAMAGED, Reason.NONE]


@backends
def test_every_reason_goes_with_its_status(backend):
    """Over random problems of every kind; and nothing that converged has one."""
    draw, told = random.Random(5), set()
    for _ in range(100 if backend == "native" else 30):
        problem = Problem.drawn(draw)
        reference, image, start = problem.made(draw.choice(CRITERIA))
        found = align(reference, image, start, backend=backend, max_iterations=draw.choice([1, 15]))
        assert found.reason.dtype == found.status.dtype == torch.int8
        for reason, status in zip(found.reason.tolist(), found.status.tolist(), strict=True):
            soft = reason == Reason.BLURRED and status == Status.LOW_TEXTURE
            assert soft or STATUS.get(Reason(reason), Status.LOST) == status, problem
            told.add(reason)
    assert told >= {Reason.NONE, Reason.MOVING, Reason.UNLIKE, Reason.FLAT, Reason.OUT_OF_VIEW, Reason.UNSURE}


def test_a_reason_of_ones_own_does_not_reach_the_next_frame():
    """What is given out is the caller's to write into."""
    tracker = Tracker(camera(seen(), 0), [MIDDLE], SIZE)
    tracker(camera(seen(), 1)).reason.fill_(7)
    found = tracker(camera(seen(), 2))
    assert (found.reason, found.origin) == (0, 0)


def test_there_is_a_sentence_for_each():
    sentences = [Reason.describe(reason) for reason in Reason]
    assert len(set(sentences)) == len(Reason)
    assert all(sentence.endswith(".") for sentence in sentences)
    assert [reason.word for reason in Reason if not reason.word] == [""]


# ---- in the files ------------------------------------------------------------------------------------------------


@pytest.fixture
def video(tmp_path) -> Path:
    """Ten frames: 3 is half covered, 5 and 6 are blank, 8 is damaged; a second patch is only in the first five."""
    frames = torch.stack([camera(seen(MIDDLE[0] + 0.4 * k), k) for k in range(10)]).float()
    frames[3, :, :84] = camera(seen(scene=OTHER), 3)[:, :84].float()
    frames[5:7] = 90
    frames[8, 0, 0] = torch.nan
    np.save(tmp_path / "video.npy", frames.numpy())
    return tmp_path / "video.npy"


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "track.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_files_and_the_last_lines_say_why(video, tmp_path):
    out = tmp_path / "out"
    options = ["--center", "104", "100", "--size", "101", "--um-per-px", "0.5", "--no-overlay", "--out", str(out)]
    done = CliRunner().invoke(app, ["track", str(video), *options])
    assert done.exit_code == 0, done.output
    assert "Template 0 was not found in 2 of 10 frames. It is there in the last one." in done.output
    assert "3 of 10 rows are not to be trusted: 2 flat, 1 damaged" in done.output
    table = rows(out)
    assert [row["reason"] for row in table] == ["", "", "", "", "", "FLAT", "FLAT", "", "DAMAGED", ""]
    for row in table:
        of_pose = [value for name, value in row.items() if name.endswith(("_px", "_rad", "_um"))]
        assert len(of_pose) == 11
        assert all(of_pose) if row["status"] == "CONVERGED" else not any(of_pose)
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["rows"], summary["reasons"], summary["reason"]) == (10, {"FLAT": 2, "DAMAGED": 1}, None)
    (template,) = summary["per_template"]
    assert template["reasons"] == {"FLAT": 2, "DAMAGED": 1}
    assert template["least_coverage"] == pytest.approx(float(table[3]["coverage"]), abs=1e-3)
    assert 0.55 < template["least_coverage"] < 0.85 < template["mean_coverage"] < 1
    with np.load(out / "track.npz") as track:
        names = dict(zip(track["reason_codes"].tolist(), track["reason_names"].tolist(), strict=True))
        assert [names[code] for code in track["reason"][:, 0].tolist()] == [row["reason"] for row in table]
        lost = np.array([5, 6, 8])
        for name in ("pose", "displacement", "displacement_um"):
            assert np.isnan(track[name][lost]).all()
            assert np.isfinite(np.delete(track[name], lost, 0)).all()


def test_a_run_without_trouble_has_no_such_line(tmp_path):
    np.save(tmp_path / "video.npy", torch.stack([camera(seen(), k) for k in range(3)]).numpy())
    options = ["--center", "104", "100", "--size", "61", "--no-overlay", "--out", str(tmp_path / "o")]
    done = CliRunner().invoke(app, ["track", str(tmp_path / "video.npy"), *options])
    assert "not to be trusted" not in done.output
    assert json.loads((tmp_path / "o" / "summary.json").read_text())["reasons"] == {}


def test_what_was_counted_before_an_interruption_counts(video, tmp_path):
    job = TrackJob(input=str(video), out=str(tmp_path / "out"), centers=(MIDDLE, (60.0, 60.0)), size=61, overlay=False)

    def stop(done: int) -> None:
        if done == 7:
            raise KeyboardInterrupt

    first = Session(job).run(stop)
    assert int(first.reasons[Reason.FLAT]) == 4
    last = Session(TrackJob(**{**vars(job), "resume": True})).run()
    assert last.reasons.sum() == 20
    assert (int(last.reasons[Reason.FLAT]), int(last.reasons[Reason.DAMAGED])) == (4, 2)
    assert last.last_reason.tolist() == [0, 0]


def test_records_say_it_in_words(video):
    tracker = Tracker(camera(seen(), 0), [MIDDLE], SIZE)
    blank: Estimate = tracker(torch.full(FRAME, 90, dtype=torch.uint8))
    assert str(blank).endswith("LOST (FLAT), the last good pose")
    assert str(tracker.skip()).endswith("DAMAGED, the last good pose")
    pandas = pytest.importorskip("pandas")
    table: pandas.DataFrame = Track.stack([blank, tracker(camera(seen(), 1))]).to_pandas()
    assert table.reason.tolist() == ["FLAT", "NONE"]
    poses = table[[name for name in table.columns if name.endswith(("_px", "_rad"))]]
    assert poses.shape[1] == 9
    assert poses.isna().all(axis=1).tolist() == [True, False]
