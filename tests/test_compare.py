"""``torch-ecc compare`` as a user meets it: files in, figures, words and pictures out, and each message."""

from __future__ import annotations

import csv
import json
import math
import re

import pytest
import torch
from click.testing import CliRunner
from PIL import Image

from torch_ecc.cli import app
from torch_ecc.commands.compare import CompareJob, compare
from torch_ecc.commands.track import STATUS_NAMES
from torch_ecc.core.estimate import Estimate
from torch_ecc.io import TrackWriter

SCALE, ANGLE, OFFSET = 0.25, 0.02, 0.1234  # um per px, rad, s
NOISE_NM = 10.0


def motion(t: torch.Tensor) -> torch.Tensor:
    """A Lissajous figure of 8 um and 200 urad: (T,) s -> (T, 3) um, um, rad."""
    parts = (8 * (2.1 * t).sin(), 6 * (3.3 * t + 0.4).sin(), 2e-4 * (1.7 * t + 1).sin())
    return torch.stack([part - part[0] for part in parts], -1)


def write_track(folder, micrometres: bool = True, fps: float | None = 100.0, lost: range = range(0)) -> str:
    """Two templates; the second one follows the motion, and is lost in some frames."""
    t = torch.arange(0, 3, 0.01).double()
    um = motion(t + OFFSET)
    scatter = torch.randn(300, 3, generator=torch.Generator().manual_seed(0)).double()
    um += NOISE_NM * torch.tensor([1e-3, 1e-3, 1e-6]) * scatter / scatter.square().mean(0).sqrt()
    turn = torch.tensor([[math.cos(ANGLE), math.sin(ANGLE)], [-math.sin(ANGLE), math.cos(ANGLE)]]).double()
    px = torch.cat((um[:, :2] @ turn / SCALE, um[:, 2:]), 1)
    matrix = SCALE * torch.eye(2).double() if micrometres else None
    with TrackWriter(folder, status_names=STATUS_NAMES, fps=fps, um_matrix=matrix) as writer:
        for k in range(300):
            moved = torch.stack((0 * px[k], px[k]))
            status = torch.tensor([0, 2 if k in lost else 0], dtype=torch.int8)
            flat = torch.ones(2)
            covariance = 1e-6 * torch.eye(3).double().expand(2, 3, 3)
            fields = {"pose": moved + 300.0, "displacement": moved, "status": status, "covariance": covariance}
            fields["reason"] = fields["origin"] = 0 * status
            writer.write(Estimate(**{name: fields.get(name, flat) for name in Estimate._fields}))
    return str(folder / "track.csv")


def write_sensors(path, sense: tuple[int, int, int] = (1, 1, 1), gap: range = range(0)) -> str:
    t, header = torch.arange(0, 3.5, 1 / 1024).double(), "time_s,x_um,y_um,theta_urad"
    rows = torch.cat((t[:, None], motion(t) * torch.tensor([1, 1, 1e6]) * torch.tensor(sense)), 1).tolist()
    lines = [",".join(f"{v:.9g}" for v in row) for k, row in enumerate(rows) if k not in gap]
    path.write_text("\n".join((header, *lines)) + "\n")
    return str(path)


def run(*arguments: object):
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def test_finds_what_was_put_in(tmp_path):
    track = write_track(tmp_path, lost=range(50, 55))
    sensors = write_sensors(tmp_path / "cds.csv", gap=range(1000, 1100))
    out = tmp_path / "out"
    done = run(track, sensors, "--template", 1, "--out", out)
    assert done.exit_code == 0, done.output
    assert "5 frames lost by the tracker" in done.output
    assert sorted(p.name for p in out.iterdir()) == ["comparison.json", "comparison.png", "errors.csv"]
    figures = json.loads((out / "comparison.json").read_text())
    offset, angle = figures["estimated"]["offset_s"], figures["estimated"]["axis_angle_rad"]
    assert abs(offset["value"] - OFFSET) < 4 * offset["sigma"] < 2e-3
    assert abs(angle["value"] - ANGLE) < 4 * angle["sigma"] < 2e-3
    errors = figures["errors"]["estimated_at_once"]
    assert errors["x_nm"]["rms"] == pytest.approx(NOISE_NM, rel=0.1)
    assert errors["y_nm"]["rms"] == pytest.approx(NOISE_NM, rel=0.1)
    assert figures["errors"]["nearest_points"]["x_nm"]["rms"] > 3 * NOISE_NM  # the paper's keeps the axis angle
    with (out / "errors.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 300
    assert [k for k, row in enumerate(rows) if row["flag"] == "lost"] == list(range(50, 55))
    assert rows[52]["dx_nm"] == ""
    flags = [row["flag"] for row in rows]
    assert 9 <= flags.count("no_sensor_sample") <= 11
    assert figures["frames"] == {word: flags.count(word) for word in ("ok", "lost", "no_sensor_sample")} | {"all": 300}
    squares = [float(row["dx_nm"]) ** 2 for row in rows if row["flag"] == "ok"]
    assert math.sqrt(sum(squares) / len(squares)) == pytest.approx(errors["x_nm"]["rms"], rel=1e-3)
    assert Image.open(out / "comparison.png").size[0] > 1000


def test_units_of_the_angle_and_of_the_track_do_not_matter(tmp_path):
    """Degrees or microradians; micrometres in the track or a scale on the command line; times or a frame rate."""
    with_um, plain = tmp_path / "a", tmp_path / "b"
    first = CompareJob(write_track(with_um), write_sensors(tmp_path / "urad.csv"), template=1)
    header = "theta_deg, y_um ,time_s,x_um"
    t = torch.arange(0, 3.5, 1 / 1024).double()
    x, y, theta = motion(t).unbind(1)
    rows = torch.stack((theta.rad2deg(), y, t, x), 1).tolist()
    (tmp_path / "deg.csv").write_text("\n".join((header, *(",".join(f"{v:.9g}" for v in r) for r in rows))))
    track = write_track(plain, micrometres=False, fps=None)
    second = CompareJob(track, str(tmp_path / "deg.csv"), template=1, um_per_px=SCALE, fps=100.0)
    a, b = compare(first).alignment, compare(second).alignment
    assert a.offset_s == pytest.approx(b.offset_s, abs=1e-7)
    assert torch.allclose(a.errors[a.valid], b.errors[a.valid], atol=2e-6)


def test_the_axis_angle_that_was_found_takes_itself_away(tmp_path):
    job = CompareJob(write_track(tmp_path), write_sensors(tmp_path / "cds.csv"), template=1)
    found = compare(job).alignment
    again = compare(CompareJob(job.track, job.sensors, template=1, axis_angle_deg=math.degrees(found.axis_angle)))
    assert again.alignment.axis_angle == pytest.approx(0, abs=1e-7)
    rms = again.nearest[again.alignment.valid].square().mean(0).sqrt()
    assert rms[:2].max() < 5e-2  # um: half the way between two sensor samples, no angle any more


def test_what_is_estimated_is_up_to_the_user(tmp_path):
    options = ("--scale", "--lever", "--fixed-angle", "--axis-angle-deg", math.degrees(ANGLE), "--max-offset-s", 0.3)
    track, sensors = write_track(tmp_path), write_sensors(tmp_path / "cds.csv")
    assert run(track, sensors, "--template", 1, *options, "--out", tmp_path / "o").exit_code == 0
    found = json.loads((tmp_path / "o" / "comparison.json").read_text())["estimated"]
    assert "axis_angle_rad" not in found
    assert abs(found["scale"]["value"] - 1) < 4 * found["scale"]["sigma"]
    assert abs(found["lever_x_um"]["value"]) < 4 * found["lever_x_um"]["sigma"]


SENSES = {
    "+++": (1, 1, 1),
    "++-": (1, 1, -1),
    "+-+": (1, -1, 1),  # y upwards, theta from x to y
    "+--": (1, -1, -1),
    "-++": (-1, 1, 1),
}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("signs", SENSES)
def test_axes_that_count_the_other_way_are_found_and_said(signs, tmp_path):
    turned = SENSES[signs]
    track, sensors = write_track(tmp_path), write_sensors(tmp_path / "cds.csv", sense=turned)
    done = run(track, sensors, "--template", 1, "--out", tmp_path / "o")
    assert (f"--signs {signs}" in done.output) == (signs != "+++"), done.output
    figures = json.loads((tmp_path / "o" / "comparison.json").read_text())
    assert tuple(figures["signs"].values()) == turned
    offset = figures["estimated"]["offset_s"]
    assert abs(offset["value"] - OFFSET) < 4 * offset["sigma"] < 1e-3
    for name in ("x_nm", "y_nm", "theta_urad"):
        assert figures["errors"]["estimated_at_once"][name]["rms"] == pytest.approx(NOISE_NM, rel=0.1)
    told = run(track, sensors, "--template", 1, "--signs", signs, "--fixed-angle", "--out", tmp_path / "told")
    assert told.exit_code == 0
    again = json.loads((tmp_path / "told" / "comparison.json").read_text())
    assert again["signs"] == figures["signs"]


def test_a_log_without_theta_on_another_clock(tmp_path):
    """In ms since 1970, with a decimal comma; what is not there is asked of nothing, and nothing is glued together."""
    t = torch.arange(0, 3.5, 1 / 1024).double()
    rows = zip((1000 * t + 1.7e12).tolist(), *(1e3 * motion(t)[:, :2]).T.tolist(), strict=True)
    lines = (";".join(f"{value:.4f}" for value in row).replace(".", ",") for row in rows)
    (tmp_path / "stage.csv").write_text("\n".join(("Stamp;X [nm];Y [nm]", *lines)))
    options = ("--columns", "time=Stamp:ms", "--template", 1)
    done = run(write_track(tmp_path), tmp_path / "stage.csv", *options, "--out", tmp_path / "o")
    assert done.exit_code == 0, done.output
    figures = json.loads((tmp_path / "o" / "comparison.json").read_text())
    offset = figures["estimated"]["offset_s"]
    assert abs(offset["value"] - 1.7e9 - OFFSET) < 4 * offset["sigma"] < 1e-3
    assert set(figures["errors"]["estimated_at_once"]) == {"x_nm", "y_nm"}
    assert "theta0_rad" not in figures["estimated"]
    table = [line for line in done.output.splitlines() if line.startswith(("error", "estimated", "nearest"))]
    assert len({len(line) for line in table}) == 1
    assert all(len(re.split(r"\s{3,}", line)) == 3 for line in table)
    with (tmp_path / "o" / "errors.csv").open() as file:
        assert {row["dtheta_urad"] for row in csv.DictReader(file)} == {""}


def test_units_that_are_wrong_are_pointed_at(tmp_path):
    track, sensors = write_track(tmp_path), write_sensors(tmp_path / "cds.csv")
    done = run(track, sensors, "--template", 1, "--columns", "x=x_um:mm, y=y_um:mm", "--out", tmp_path / "o")
    assert "times as far as the track: are the units and um_per_px right?" in done.output


@pytest.mark.usefixtures("undrawn")
def test_two_motions_that_have_little_in_common_are_pointed_at(tmp_path):
    track, sensors = write_track(tmp_path), write_sensors(tmp_path / "cds.csv")
    words = re.compile(r"Only \d+% of the track's motion is the sensors', too: is it the same\?")
    assert not words.search(run(track, sensors, "--template", 1, "--out", tmp_path / "same").output)
    t, g = torch.arange(0, 3.5, 1 / 1024).double(), torch.Generator().manual_seed(1)
    rates, phases = (scale * torch.rand(3, 6, 1, generator=g).double() for scale in (12, math.tau))
    other = (rates * t + phases).sin().sum(1).T * torch.tensor([3.0, 3.0, 80.0])
    lines = (",".join(f"{value:.9g}" for value in row) for row in torch.cat((t[:, None], other), 1).tolist())
    (tmp_path / "other.csv").write_text("\n".join(("time_s,x_um,y_um,theta_urad", *lines)))
    assert words.search(run(track, tmp_path / "other.csv", "--template", 1, "--out", tmp_path / "other").output)


def test_what_did_not_converge_is_exit_2(tmp_path, monkeypatch):
    monkeypatch.setattr("torch_ecc.records.least_squares.SETTLED", -1.0)
    done = run(write_track(tmp_path), write_sensors(tmp_path / "cds.csv"), "--template", 1, "--out", tmp_path / "o")
    assert done.exit_code == 2
    assert "still moving when its iterations ran out" in done.output
    assert (tmp_path / "o" / "comparison.png").is_file()


HEAD = "time_s,x_um,y_um,theta_urad\n"
BAD_SENSORS = {
    "no unit": ("t,x,y,theta_urad\n0,1,2,3\n", "column x has no unit: expected um, "),
    "other unit": ("time_s,x [V],y_um\n0,1,2\n", "column x [V] is in 'V': expected um, "),
    "columns": (
        "A,B,C\n0,1,2\n",
        "no column of times found, see --columns 'time=NAME' and --sensors-hz; columns found: A, B, C",
    ),
    "only times": ("time_s,A\n0,1\n", "no column of x, y or theta found"),
    "two angles": (HEAD.strip() + ",theta_deg\n0,1,2,3,4\n", "theta may be any of theta_urad, theta_deg: choose one"),
    "word": (HEAD + "0,1,2,3\n1,one,2,3\n", "line 3, column x_um: expected a number, got 'one'"),
    "unsorted": (HEAD + "0,1,2,3\n2,1,2,3\n1,1,2,3\n", "line 4: times must increase, 1 follows 2"),
    "no time": (HEAD + "0,1,2,3\n,1,2,3\n", "line 3: time_s must be a finite number"),
    "short row": (HEAD + "0,1,2,3\n1,1,2\n", "line 3 must have 4 cells, got 3"),
    "header only": (HEAD, "expected a header and rows of numbers, found no two columns of numbers"),
    "empty": ("", "expected a header and rows of numbers, found no two columns of numbers"),
    "binary": ("\x00\x01\x02\n\x03", "expected a header and rows of numbers"),
    "no poses": (HEAD + "0,,,\n1,,,\n2,,,\n3,,,\n", "sensors: expected at least 4 samples with a finite pose, got 0"),
}


@pytest.mark.parametrize("case", BAD_SENSORS)
def test_bad_sensor_files(case, tmp_path):
    text, message = BAD_SENSORS[case]
    (tmp_path / "cds.csv").write_text(text)
    done = run(write_track(tmp_path), tmp_path / "cds.csv", "--out", tmp_path / "out", "--template", 1)
    assert isinstance(done.exception, ValueError)
    assert message in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_bad_jobs(tmp_path):
    track, plain = write_track(tmp_path / "a"), write_track(tmp_path / "b", micrometres=False, fps=None)
    sensors = write_sensors(tmp_path / "cds.csv")
    cases = {
        "has the templates 0, 1, got 5": {"track": track, "template": 5},
        "um_per_px: .* has no columns dx_um and dy_um": {"track": plain},
        "fps: .* has no column time_s": {"track": plain, "um_per_px": 0.2},
        "fps: expected a rate > 0 in Hz, got 0": {"track": track, "fps": 0.0},
        "um_per_px: expected one or two finite numbers": {"track": track, "um_per_px": 0.0},
        "max_offset_s: expected a time >= 0": {"track": track, "max_offset_s": -1.0},
        "sensors_hz: expected a rate > 0 in Hz, got -1": {"track": track, "sensors_hz": -1.0},
        "signs: expected one of auto, ": {"track": track, "signs": "up"},
        "the records do not overlap, see max_offset_s": {"track": track, "fps": 1e-3, "max_offset_s": 0.001},
        "compare: out_dir must be a folder": {"track": track, "out": sensors},
        "column template is missing": {"track": sensors},
    }
    for message, settings in cases.items():
        with pytest.raises(ValueError, match=message):
            compare(CompareJob(sensors=sensors, **settings))
    with pytest.raises(FileNotFoundError, match=r"no such file: nowhere\.csv"):
        compare(CompareJob(track, "nowhere.csv"))
