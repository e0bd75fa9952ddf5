"""The gate over benchmark results: what counts as worse, and what it exits with."""

from __future__ import annotations

import math
from pathlib import Path

import gate
import pytest
from click.testing import CliRunner
from results import load, save

from torch_ecc.paper.result import Number

RMS = Number("clean / rms", 0.01, "px", "lower", 0.1)
RATE = Number("poses per second", 100.0, "1/s", "higher", 0.2)
TIME = Number("clean / time", 2.0, "ms", "lower", 0.5)
PEER = Number("peer / rms", 0.01, "px")


def written(path: Path, *figures: Number, **about: str) -> Path:
    save(path, figures, **about)
    return path


def exit_code(tmp_path: Path, old: tuple[Number, ...], new: tuple[Number, ...], **about: str) -> int:
    files = [written(tmp_path / "old.json", *old), written(tmp_path / "new.json", *new, **about)]
    return CliRunner().invoke(gate.main, [str(f) for f in files]).exit_code


def test_a_result_comes_back_as_it_was_saved(tmp_path):
    lost = Number("lost / rms", math.nan, "px", "lower", 0.1)
    result = load(written(tmp_path / "r.json", RMS, RATE, PEER, lost, rounds="3"))
    assert [result.figures[f.name] for f in (RMS, RATE, PEER)] == [RMS, RATE, PEER]
    assert math.isnan(result.figures[lost.name].value)
    assert result.about["rounds"] == "3"
    assert {"torch", "machine", "threads", "opencv-python-headless"} <= result.about.keys()


@pytest.mark.parametrize(
    ("figure", "value", "code"),
    [
        (RMS, 0.01, 0),
        (RMS, 0.0110, 0),
        (RMS, 0.0112, 1),
        (RMS, 0.001, 0),
        (RMS, math.nan, 1),
        (RATE, 81.0, 0),
        (RATE, 79.0, 1),
        (RATE, 500.0, 0),
        (TIME, 2.9, 0),
        (TIME, 3.1, 1),
        (PEER, 9.0, 0),
    ],
)
def test_worse_by_more_than_the_tolerance_fails(tmp_path, figure, value, code):
    assert exit_code(tmp_path, (figure,), (figure._replace(value=value),)) == code


def test_one_bad_figure_among_good_ones_fails(tmp_path):
    assert exit_code(tmp_path, (RMS, RATE), (RMS, RATE._replace(value=1.0))) == 1


def test_rounding_of_another_processor_is_no_regression(tmp_path):
    tiny = RMS._replace(value=1e-6)
    assert exit_code(tmp_path, (tiny,), (tiny._replace(value=9e-5),)) == 0
    assert exit_code(tmp_path, (tiny,), (tiny._replace(value=2e-4),)) == 1


def test_no_figure_may_vanish_or_change_its_unit(tmp_path):
    assert exit_code(tmp_path, (RMS, RATE), (RMS,)) == 1
    assert exit_code(tmp_path, (RMS,), (RMS._replace(unit="deg"),)) == 1
    assert exit_code(tmp_path, (RMS, PEER), (RMS,)) == 0  # a peer may: it may not be installed
    assert exit_code(tmp_path, (RMS,), (RMS, RATE)) == 0


def test_times_of_another_machine_are_not_compared(tmp_path):
    slow, wrong = TIME._replace(value=99.0), RMS._replace(value=99.0)
    assert exit_code(tmp_path, (TIME,), (slow,)) == 1
    assert exit_code(tmp_path, (TIME,), (slow,), machine="another") == 0
    assert exit_code(tmp_path, (TIME,), (slow,), threads="64") == 0
    assert exit_code(tmp_path, (TIME, RMS), (slow, wrong), machine="another") == 1


@pytest.mark.parametrize("text", ["{", "{}", "[]", '{"about": {}, "figures": [{"title": 1}]}'])
def test_a_file_that_is_no_result_is_refused(tmp_path, text):
    bad, good = tmp_path / "bad.json", written(tmp_path / "good.json", RMS)
    bad.write_text(text)
    with pytest.raises(ValueError, match="expected a benchmark's result"):
        load(bad)
    assert CliRunner().invoke(gate.main, [str(good), str(bad)]).exit_code == 2


def test_the_table_names_what_got_worse(tmp_path):
    old, new = written(tmp_path / "a.json", RMS), written(tmp_path / "b.json", RMS._replace(value=1.0))
    text = CliRunner().invoke(gate.main, [str(old), str(new)]).output
    assert RMS.name in text
    assert "1 figures compared, 1 worse" in text
