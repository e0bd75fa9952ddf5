"""Configuration files: every key known, every type checked, every default written in configs/."""

from __future__ import annotations

import dataclasses
import inspect
import re
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ecc import Tracker
from torch_ecc.cli import app
from torch_ecc.commands.jobs import Align, CompareJob, TrackJob
from torch_ecc.commands.options import track_toml
from torch_ecc.commands.track import Session
from torch_ecc.config import fill, paragraphs, read_toml
from torch_ecc.core.settings import Settings

CONFIGS = Path(__file__).parents[1] / "configs"


def test_fills_a_job():
    job = fill(TrackJob, {"input": "a.mp4", "centers": [[1, 2.5]], "size": [31, 41], "um_per_px": 1}, "job.toml")
    assert job.centers == ((1.0, 2.5),)
    assert job.size == (31, 41)
    assert job.um_per_px == 1.0
    assert job.levels == 1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"centre": [[1, 2]]}, r"job.toml: unknown key 'centre' \(did you mean 'centers'\?\)"),
        ({"zzz": 1}, r"job.toml: unknown key 'zzz' \(known keys: .*input, centers, size.*\)"),
        ({"input": 3}, "job.toml: input must be a valid string, got 3"),
        ({"levels": 1.5}, "job.toml: levels must be a valid integer, got 1.5"),
        ({"levels": True}, "job.toml: levels must be a valid integer, got True"),
        ({"overlay": 1}, "job.toml: overlay must be a valid boolean, got 1"),
        ({"fps": "fast"}, "job.toml: fps must be a valid number, got 'fast'"),
        ({"centers": [[1, 2], [1, 2, 3]]}, r"job.toml: centers\[1\] must have 2 values, got \[1, 2, 3\]"),
        ({"centers": [[1]]}, r"job.toml: centers\[0\] must have more values, got \[1\]"),
        ({"centers": 5}, "job.toml: centers must be a list, got 5"),
        ({"size": "big"}, "job.toml: size must be a valid integer or a list, got 'big'"),
        ({"um_per_px": [1, "a"]}, r"job.toml: um_per_px\[1\] must be a valid number, got 'a'"),
    ],
)
def test_says_what_is_wrong(values, message):
    with pytest.raises(ValueError, match=message):
        fill(TrackJob, {"input": "a.mp4"} | values, "job.toml")


def test_a_broken_or_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="config: no such file"):
        read_toml(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("size = = 3")
    with pytest.raises(ValueError, match=r"bad.toml is not valid TOML: .*line 1"):
        read_toml(tmp_path / "bad.toml")


OFFERED = {each.name: each for own in paragraphs(TrackJob) for each in own}
SHOWN = TrackJob(input="video.mp4", centers=((320.0, 240.0),), size=121)  # what the shipped file has uncommented


def written(*options: str) -> str:
    """What ``torch-ecc track ... --write-config`` prints."""
    done = CliRunner().invoke(app, ["track", *options, "--write-config"], catch_exceptions=False)
    assert done.exit_code == 0
    return done.output


def test_the_shipped_file_is_what_the_command_writes():
    assert (CONFIGS / "track.toml").read_text() == written()


def test_the_file_has_every_setting_at_its_default():
    assert fill(TrackJob, tomllib.loads(written()), "written") == SHOWN
    everything = tomllib.loads(re.sub(r"(?m)^#(\w+ = )", r"\1", written()))
    assert everything.keys() == OFFERED.keys()
    job = fill(TrackJob, everything, "written")
    for name, each in OFFERED.items():
        assert getattr(job, name) == getattr(SHOWN, name) or each.metadata["example"] is not None, name


def test_given_options_are_written():
    job = fill(TrackJob, tomllib.loads(written("a.mp4", "--template", "b.png", "--tolerance", "1e-4")), "written")
    assert job == TrackJob(input="a.mp4", template=("b.png",), tolerance=1e-4)


@settings(max_examples=50, deadline=None)
@given(
    st.text(min_size=1),
    st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)), min_size=1),
    st.one_of(st.integers(1, 999), st.tuples(st.integers(1, 999), st.integers(1, 999))),
    st.floats(1e-300, 1e300),
)
def test_a_written_job_is_read_as_it_was(name, centers, size, tolerance):
    values = {"input": name, "out": name, "centers": centers, "size": size, "tolerance": tolerance, "search": False}
    assert fill(TrackJob, tomllib.loads(track_toml(values)), "written") == fill(TrackJob, values, "given")


def test_a_file_is_written_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        done = CliRunner().invoke(app, ["track", "--write-config", "job.toml"])
        assert (tmp_path / "job.toml").read_text() == (CONFIGS / "track.toml").read_text()
    assert "write-config: job.toml is already there and was left as it is" in str(done.exception)


def test_what_is_written_is_checked():
    for option, message in (("--tolerance=0", "tolerance: expected a length in px > 0"), ("--backend=x", "backend: ")):
        done = CliRunner().invoke(app, ["track", option, "--write-config"])
        assert message in str(done.exception)
        assert not done.output


@pytest.mark.parametrize(("command", "kind"), [("track", TrackJob), ("compare", CompareJob), ("servo", Align)], ids=str)
def test_options_say_what_the_fields_say(command, kind):
    """Every setting that has words is an option, with its default and its known words."""
    said = " ".join(CliRunner().invoke(app, [command, "--help"]).output.split())
    hidden = {p.name for p in app.commands[command].params if isinstance(p, click.Argument)}
    for each in dataclasses.fields(kind):
        if each.metadata and each.init and each.name not in hidden:
            assert each.metadata["words"][1:] in said, each.name
            assert "|".join(each.metadata.get("known", ())) in said, each.name
            if type(each.default) in (int, float, str):
                assert f"[default: {each.default}]" in said.replace("- ", "-"), each.name


def test_settings_are_written_once():
    """The tracker's constructor has the defaults of the record, and its words are those that the tracker knows."""
    parameters = inspect.signature(Tracker).parameters
    for name, value in SHOWN.options().items():
        assert parameters[name].default == value, name
    frame = (100 * torch.rand(90, 90, generator=torch.Generator().manual_seed(0)) + 50).to(torch.uint8)
    for name in ("criterion", "illumination", "interpolation", "prediction"):
        for word in OFFERED[name].metadata["known"]:
            Tracker(frame, [(45.0, 45.0)], 31, **{name: word})
        with pytest.raises(ValueError, match=f"{name}: expected one of .*'magic'"):
            TrackJob(input="a.mp4", **{name: "magic"})


def test_settings_reach_the_engine(tmp_path):
    """From the command line, by the job, to the record that the solver is given."""
    np.save(tmp_path / "video.npy", np.random.default_rng(0).integers(0, 255, (2, 90, 90), dtype=np.uint8))
    other = {
        "interpolation": "bilinear",
        "max_iterations": 7,
        "tolerance": 0.01,
        "min_score": 0.7,
        "min_visible": 0.4,
        "robust": False,
        "backend": "torch",
    }
    assert other.keys() == {each.name for each in dataclasses.fields(Settings)} & OFFERED.keys()
    options = [f"--{name.replace('_', '-')}={value}" for name, value in other.items() if value is not False] + [
        "--no-robust"
    ]
    text = written(str(tmp_path / "video.npy"), "--center", "45", "45", "--size", "31", "--no-robust", *options)
    session = Session(fill(TrackJob, tomllib.loads(text), "written"))
    assert session.tracker.settings == Settings(**other)
