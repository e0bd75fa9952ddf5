"""The command line as a user meets it: outputs, words, exit status, interruption, wrong input."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from dataclasses import replace

import click
import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torch_ecc
from torch_ecc import cli
from torch_ecc.cli import app, main, progress_bar
from torch_ecc.commands.track import Session, TrackJob
from torch_ecc.core.native import library
from torch_ecc.sim.scene.waves import PlaneWaves

SCENE = PlaneWaves.random(seed=2)
POSES = torch.stack(
    [torch.tensor([80 + 3 * math.sin(k / 3), 60 - 2 * math.sin(k / 4), 0.03 * k]) for k in range(10)]
).double()


def stack() -> np.ndarray:
    frames = SCENE.render(POSES, (120, 160))[:, 0]
    return frames.round().clamp(0, 255).to(torch.uint8).numpy()


@pytest.fixture
def video(tmp_path):
    np.save(tmp_path / "video.npy", stack())
    return tmp_path / "video.npy"


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "torch_ecc", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_the_version_tells_the_engine():
    """Which instructions, or why there is none."""
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0
    version, engine = f"torch-ecc {torch_ecc.__version__}, torch {torch.__version__}", library.describe()
    assert done.output == f"{version}, engine: {engine}\n"
    assert engine.startswith("native, ") == (library.load() is not None)


def test_track_writes_everything(video, tmp_path):
    out = tmp_path / "out"
    options = ("--center", 80, 60, "--center", 75.5, 64, "--size", 41, "--um-per-px", 0.25, "--fps", 100)
    done = run("track", video, *options, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "Tracked 10 frames" in done.stdout
    assert sorted(p.name for p in out.iterdir()) == [
        "overlay.mp4",
        "summary.json",
        "track.csv",
        "track.npz",
        "track.png",
    ]
    with (out / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20
    last = rows[-2]
    assert abs(float(last["x_px"]) - float(POSES[9, 0] + 80 - POSES[0, 0])) < 0.3
    assert float(last["time_s"]) == pytest.approx(0.09)
    assert float(last["dx_um"]) == pytest.approx(0.25 * float(last["dx_px"]), abs=1e-6)
    assert abs(float(last["theta_rad"]) - 0.27) < 1e-3
    summary = json.loads((out / "summary.json").read_text())
    assert summary["complete"] is True
    assert summary["frames"] == 10
    with np.load(out / "track.npz") as track:
        assert track["covariance"].shape == (10, 2, 3, 3)


def test_a_lost_template_is_reported_in_words(tmp_path):
    frames = stack()
    frames[6:] = 90
    np.save(tmp_path / "video.npy", frames)
    result = CliRunner().invoke(
        app,
        [
            "track",
            str(tmp_path / "video.npy"),
            "--center",
            "80",
            "60",
            "--size",
            "41",
            "--out",
            str(tmp_path / "o"),
            "--no-overlay",
        ],
    )
    assert result.exit_code == 0
    assert "Template 0 was not found in 4 of 10 frames" in result.output
    assert not (tmp_path / "o" / "overlay.mp4").exists()


def test_settings_from_a_file_and_options_win(video, tmp_path):
    config = tmp_path / "job.toml"
    config.write_text(f'input = "{video}"\ncenters = [[80, 60]]\nsize = 31\nout = "{tmp_path}/a"\noverlay = false\n')
    result = CliRunner().invoke(
        app, ["track", "--config", str(config), "--size", "31,41", "--out", str(tmp_path / "b")]
    )
    assert result.exit_code == 0, result.output
    assert not (tmp_path / "a").exists()
    assert json.loads((tmp_path / "b" / "summary.json").read_text())["settings"]["size"] == [31, 41]


def wrong(tmp_path) -> dict[str, tuple[list[str], str]]:
    video = str(tmp_path / "video.npy")
    good = [video, "--center", "80", "60", "--size", "41"]
    (tmp_path / "empty").mkdir()
    (tmp_path / "mixed").mkdir()
    for k, size in enumerate(((120, 160), (120, 161))):
        cv2.imwrite(
            str(tmp_path / "mixed" / f"f{k}.png"), np.random.default_rng(0).integers(0, 255, size).astype(np.uint8)
        )
    (tmp_path / "broken.mp4").write_bytes(b"no video at all" * 100)
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "nothing.tif").write_bytes(b"")
    (tmp_path / "red\x1b[31m[bold]\n.tif").write_text("no TIFF")
    (tmp_path / "deep.toml").write_text(f"centers = {5000 * '['}{5000 * ']'}")
    (tmp_path / "long.toml").write_text(f"size = {5000 * '9'}")
    (tmp_path / "bad.toml").write_text("sise = 3\n")
    np.save(tmp_path / "line.npy", np.zeros(5))
    nan = stack().astype(np.float32)
    nan[0, 60, 80] = np.nan
    np.save(tmp_path / "nan.npy", nan)
    return {
        "no input": ([], "INPUT is missing"),
        "nothing in it": ([str(tmp_path / "nothing.tif"), *good[1:]], "nothing.tif is empty"),
        "control codes": ([str(tmp_path / "red\x1b[31m[bold]\n.tif"), *good[1:]], r"red\x1b[31m[bold]\n.tif cannot be"),
        "nested": (["--config", str(tmp_path / "deep.toml")], "deep.toml is not valid TOML: it is nested too deeply"),
        "many digits": (["--config", str(tmp_path / "long.toml")], "long.toml is not valid TOML: Exceeds the limit"),
        "huge size": ([*good[:-1], f"1{400 * '0'}"], "size must fit in the frame, got 1e+300 px or more"),
        "missing file": (["none.mp4", *good[1:]], "no such file"),
        "empty folder": ([str(tmp_path / "empty"), *good[1:]], "empty"),
        "no match": (["zzz*.png", *good[1:]], "no file matches"),
        "broken video": ([str(tmp_path / "broken.mp4"), *good[1:]], "broken.mp4"),
        "unknown extension": ([str(tmp_path / "notes.txt"), *good[1:]], "'.txt', which is not known"),
        "not a stack": ([str(tmp_path / "line.npy"), *good[1:]], "line.npy"),
        "nan": ([str(tmp_path / "nan.npy"), *good[1:], "--stop-at-damage"], "it holds NaN or infinite values"),
        "no camera": (["97", *good[1:]], "camera 97"),
        "no center": ([video, "--size", "41"], "expected at least one"),
        "no size": ([video, "--center", "80", "60"], "size: expected the side of the templates"),
        "size word": ([*good[:4], "--size", "large"], "size: expected a number of px or HEIGHT,WIDTH, got 'large'"),
        "size negative": ([*good[:4], "--size", "-3"], "size: expected a number of px or HEIGHT,WIDTH, got '-3'"),
        "outside": ([video, "--center", "10", "60", "--size", "41"], "must lie in the frame of 160x120 px"),
        "polygon": ([video, "--polygon", "1,2 3"], "polygon: expected corners as 'X,Y X,Y ...' in px"),
        "polygon of two": ([video, "--polygon", "1,2 3,4"], "needs three or more finite corners"),
        "polygons": (
            [*good, "--polygon", "1,2 3,4 5,1", "--polygon", "1,2 3,4 5,1"],
            r"expected one per center (1), got 2",
        ),
        "zero scale": ([*good, "--um-per-px", "0"], "um_per_px: expected one or two finite numbers other than 0"),
        "zero fps": ([*good, "--fps", "0"], "fps: expected a rate > 0 in Hz, got 0"),
        "criterion": ([*good, "--criterion", "magic"], "criterion: expected one of"),
        "grid": ([video, "--grid", "2", "--size", "141"], "templates in a row, 141x141 px"),
        "grid and center": ([*good, "--grid", "2"], "centers: not with grid"),
        "scale": ([*good, "--um-per-px", "1,2,3"], "um_per_px: expected one number or two as SX,SY, got '1,2,3'"),
        "flip without a scale": ([*good, "--flip-y"], "flip_y: expected with um_per_px"),
        "frames": ([*good, "--frames", "1:a"], "frames: expected FIRST:LAST:STEP"),
        "no such frames": ([*good, "--frames", "90:"], "holds none of the frames that were asked for"),
        "frames backwards": ([*good, "--frames", "9:3"], "frames: expected LAST not to be before FIRST, got '9:3'"),
        "stabilise": ([*good, "--stabilise", "1"], "stabilise: expected a template from 0 to 0, got 1"),
        "levels": ([*good, "--levels", "9"], "levels: expected 1 to 2"),
        "device": ([*good, "--device", "abacus"], "device"),
        "config": ([*good, "--config", str(tmp_path / "bad.toml")], "unknown key 'sise' (did you mean 'size'?)"),
        "no config": ([*good, "--config", str(tmp_path / "none.toml")], "config: no such file"),
        "reference size": (
            [*good, "--reference", str(tmp_path / "mixed" / "f1.png")],
            "reference: expected an image of the input's size 160x120 px, got 161x120 px",
        ),
        "out is a file": ([*good, "--out", str(tmp_path / "notes.txt")], "notes.txt"),
        "mixed sizes": ([str(tmp_path / "mixed"), *good[1:], "--stop-at-damage"], "161 x 120"),
    }


def test_wrong_input_is_one_line_and_leaves_nothing(video, tmp_path, monkeypatch, capsys):
    cases = wrong(tmp_path)
    assert len(cases) >= 25
    for name, (arguments, message) in cases.items():
        out = tmp_path / "out" / name.replace(" ", "-")
        extra = [] if "--out" in arguments else ["--out", str(out)]
        monkeypatch.setattr(sys, "argv", ["torch-ecc", "track", *arguments, *extra])
        with pytest.raises(SystemExit) as caught:
            main()
        said = capsys.readouterr().err
        assert caught.value.code == 2, name
        assert message in said, (name, said)
        assert "Traceback" not in said, name
        assert len([line for line in said.splitlines() if line.startswith("torch-ecc")]) == 1, (name, said)
        if name != "mixed sizes":  # there the first frame was good, and is kept
            assert not out.exists(), name
        else:
            assert json.loads((out / "summary.json").read_text())["complete"] is False


def test_a_damaged_frame_keeps_what_came_before(tmp_path):
    for k, frame in enumerate(stack()):
        cv2.imwrite(str(tmp_path / f"f{k}.png"), frame if k < 7 else frame[:-1])
    job = TrackJob(input=str(tmp_path / "f*.png"), out=str(tmp_path / "o"), centers=((80.0, 60.0),), size=41)
    job = replace(job, stop_at_damage=True)
    with pytest.raises(ValueError, match=r"frame 7: .*160 x 119 px"):
        Session(job).run()
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["complete"] is False
    assert summary["frames"] == 7
    assert (tmp_path / "o" / "track.png").exists()


def test_help_names_the_commands_and_brings_nothing_that_draws_or_reads():
    code = "import sys; from torch_ecc.cli import app; app(['--help'], standalone_mode=False); print(*sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {"demo", "track"} <= set(shown)
    assert not {"matplotlib", "cv2", "av", "dask"} & set(shown)


def test_simulate_and_track_what_was_simulated(tmp_path):
    config = tmp_path / "small.toml"
    config.write_text(
        '[scene]\nkind = "waves"\n[motion]\namplitudes_deg = [5, 5, 2]\npoints = 6\nlead_in = 4\n'
        "[camera]\nsize = [120, 160]\n[template]\nsize = 41\n"
    )
    out = tmp_path / "sequence"
    made = CliRunner().invoke(app, ["simulate", str(config), "--out", str(out)])
    assert made.exit_code == 0, made.output
    command = made.output.splitlines()[-1].split()
    tracked = CliRunner().invoke(app, [*command[1:], "--out", str(tmp_path / "track"), "--no-overlay"])
    assert tracked.exit_code == 0, tracked.output
    with np.load(tmp_path / "track" / "track.npz") as track, (out / "poses.csv").open() as file:
        truth = [[float(row[name]) for name in ("x_px", "y_px", "theta_rad")] for row in csv.DictReader(file)]
        assert np.abs(track["pose"][:, 0] - np.array(truth)).max() < 0.01
    again = CliRunner().invoke(app, ["simulate", str(config), "--out", str(out)])
    assert isinstance(again.exception, ValueError)
    assert "folder must be empty or new" in str(again.exception)


@pytest.mark.parametrize(
    ("raised", "status"),
    [(click.Abort(), 130), (KeyboardInterrupt(), 130), (click.UsageError("no"), 2), (OSError("no"), 2)],
)
def test_the_exit_status_whatever_a_command_ends_with(monkeypatch, raised, status):
    """Ctrl-C may come at any time, not only while frames are tracked."""

    def command(**_):
        raise raised

    monkeypatch.setattr(cli, "app", command)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == status


def test_a_bar_shows_once_something_is_done(capsys):
    """Not before an error."""
    with progress_bar("video", 3) as advance:
        advance(0, None)  # and there it fails
    assert capsys.readouterr().err == ""
    with progress_bar("video", 3) as advance:
        advance(0, None)
        advance()
    assert "1/3" in capsys.readouterr().err
