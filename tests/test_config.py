"""Configuration files: every key known, every type checked, every default written in configs/."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from torch_ecc.commands.track import TrackJob
from torch_ecc.config import fill, read_toml

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
        ({"zzz": 1}, r"job.toml: unknown key 'zzz' \(known keys: input, out, .*\)"),
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


def test_every_default_is_written_in_the_file():
    """configs/track.toml, with its comment signs removed, is exactly the defaults."""
    text = (CONFIGS / "track.toml").read_text()
    written = tomllib.loads(re.sub(r"(?m)^#(\w+ = )", r"\1", text))
    optional = {"reference", "template", "polygons", "device", "um_per_px", "fps"}  # an example stands there
    job = fill(TrackJob, written, "track.toml")
    for field in dataclasses.fields(TrackJob):
        assert field.name in written, field.name
        if field.default is not dataclasses.MISSING and field.name not in optional | {"centers", "size"}:
            assert getattr(job, field.name) == field.default, field.name
    fill(TrackJob, tomllib.loads(text), "track.toml")
