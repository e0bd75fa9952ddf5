"""``torch-ecc track --body`` and ``--bodies``: what is written, and that it is right."""

from __future__ import annotations

import csv
import json
import math

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner

from torch_ecc.cli import app
from torch_ecc.commands.track import Session, TrackJob
from torch_ecc.sim import Camera, PlaneWaves, from_config, harmonic, placed

PATH = placed(harmonic((5.0, 3.0, 0.02), 12), (160.0, 120.0))


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A stage on the left, and a frame that stands still on the right, (12, 240, 320)."""
    camera = Camera(size=(240, 320), noise_sigma=2.0)
    stage = camera.capture(PlaneWaves.random(80), PATH)[:, 0]
    still = camera.capture(PlaneWaves.random(80, seed=5), PATH[:1].expand(12, 3), seed=7)[:, 0]
    folder = tmp_path_factory.mktemp("video")
    np.save(folder / "one.npy", stage.numpy())
    np.save(folder / "two.npy", torch.cat((stage[..., :176], still[..., 176:]), -1).numpy())
    return folder


def read(folder):
    with (folder / "body.csv").open() as file:
        return list(csv.DictReader(file)), json.loads((folder / "body.json").read_text())["bodies"]


def expected(point, k):
    """Where a point of the stage is in frame k."""
    turn = lambda a: np.array([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]])  # noqa: E731
    x0, y0, t0 = PATH[0].tolist()
    x, y, t = PATH[k].tolist()
    return np.array([x, y]) + turn(t) @ turn(t0).T @ (np.array(point) - (x0, y0)), t - t0


def test_one_body(video, tmp_path):
    out = tmp_path / "r"
    arguments = ["track", str(video / "one.npy"), "--grid", "4", "--size", "41", "--body", "--um-per-px", "0.5"]
    done = CliRunner().invoke(app, [*arguments, "--fps", "10", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "Body 0: 12 patches, sigma 0.00" in done.output
    rows, (fact,) = read(out)
    assert len(rows) == 12
    for k, row in enumerate(rows):
        where, theta = expected(fact["reference_point_px"], k)
        for name, value in (("x_px", where[0]), ("y_px", where[1]), ("theta_rad", theta)):
            assert abs(float(row[name]) - value) < 5 * float(row[f"sigma_{name}"]) + 1e-9
        assert float(row["dx_um"]) == pytest.approx(0.5 * float(row["dx_px"]), abs=1e-5)
        assert row["used"] == "12"
        assert float(row["time_s"]) == pytest.approx(k / 10)
    assert fact["patches_that_disagree"] == []
    picture = cv2.imread(str(out / "body.png"))
    assert picture.shape[1] > 1000
    assert (out / "overlay.mp4").is_file()


@pytest.mark.usefixtures("undrawn")
def test_two_bodies_and_what_one_does_as_seen_from_the_other(video, tmp_path):
    job = TrackJob(input=str(video / "two.npy"), grid=6, size=41, bodies=1, out=str(tmp_path), overlay=False)
    finished = Session(job).run()
    rows, (stage, still) = read(finished.folder)
    assert still["stands_still"]
    assert not stage["stands_still"]
    assert stage["reference_point_px"][0] < 176 < still["reference_point_px"][0]
    for row in rows[::2]:
        assert abs(float(row["relative_dx_px"]) - float(row["dx_px"])) < 0.05
        assert float(row["sigma_relative_theta_rad"]) > float(row["sigma_theta_rad"])


@pytest.mark.usefixtures("undrawn")
def test_a_lens_is_told_to_the_simulator_and_to_the_track(tmp_path):
    """What the one bends the other straightens, from numbers and from a file; without it the body is far off."""
    config = {
        "scene": {"kind": "waves", "count": 40},
        "motion": {"kind": "ramp", "points": 7, "end": [60.0, 0.0, 0.0], "lead_in": 0},
        "camera": {"size": [200, 280], "noise_sigma": 1.0, "lens": {"k1": 0.03}},
        "template": {"size": [41, 41]},
    }
    sequence = from_config(config).sequence
    np.save(tmp_path / "v.npy", sequence.batch(0, 7)[:, 0].numpy())
    (tmp_path / "lens.toml").write_text("center = [139.5, 99.5]\nfocal = 171.337\nk1 = 0.03\n")
    errors = []
    for k, lens in enumerate((None, "0.03", str(tmp_path / "lens.toml"))):
        job = TrackJob(input=str(tmp_path / "v.npy"), grid=4, size=41, body=True, out=str(tmp_path / str(k)), lens=lens)
        rows, _ = read(Session(job).run().folder)
        errors.append((float(rows[-1]["dx_px"]) - 60) / float(rows[-1]["sigma_x_px"]))
    assert abs(errors[0]) > 5
    assert max(map(abs, errors[1:])) < 4
    assert errors[1] == pytest.approx(errors[2], abs=0.1)


@pytest.mark.usefixtures("undrawn")
def test_it_goes_on_where_it_was_stopped(video, tmp_path):
    """With body and overlay, as if nothing had happened."""
    whole, parts = (
        TrackJob(input=str(video / "one.npy"), grid=3, size=41, body=True, out=str(tmp_path / name), resume=name == "b")
        for name in "ab"
    )
    Session(whole).run()

    def stop(done: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    assert Session(parts).run(stop).interrupted
    assert len(read(tmp_path / "b")[0]) == 5
    Session(parts).run()
    assert read(tmp_path / "a") == read(tmp_path / "b")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body": True, "bodies": 2}, "body: not with bodies"),
        ({"lens": "0.1"}, "lens: expected with body or bodies, whose poses it straightens; got '0.1' alone"),
        ({"lens": "0.1,wide", "body": True}, "lens: expected a file.toml or k1,k2,p1,p2, got '0.1,wide'"),
        ({"lens": "1,2,3,4,5", "body": True}, "lens: expected at most k1,k2,p1,p2, got '1,2,3,4,5'"),
        ({"lens": "none.toml", "body": True}, "config: no such file: none.toml"),
        ({"lens": "-0.6", "body": True}, "the lens is one to one up to"),
        ({"bodies": 0}, "bodies: expected at least 1, got 0"),
        ({"bodies": 2, "grid": None, "centers": ((160.0, 120.0),)}, "bodies: expected two templates or more, got 1"),
    ],
)
def test_wrong_calls(video, tmp_path, changes, message):
    settings = {"input": str(video / "one.npy"), "grid": 3, "size": 41, "out": str(tmp_path / "x")}
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        Session(TrackJob(**(settings | changes)))
    assert not (tmp_path / "x").exists()
