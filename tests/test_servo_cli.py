"""``torch-ecc servo`` as a user meets it: files, words, exit status, interruption, wrong configurations."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from torch_ecc.cli import app
from torch_ecc.commands import servo as servo_session
from torch_ecc.commands.servo import LogWriter
from torch_ecc.commands.servo_job import ServoJob, setting
from torch_ecc.paper import fig12, fig13
from torch_ecc.paper.servo_trials import single
from torch_ecc.servo import Step

CONFIG = Path(__file__).parents[1] / "configs" / "servo.toml"
FILES = ["errors.png", "log.csv", "overlay.mp4", "steps.png", "summary.json", "velocities.png"]


def toml(value: Any) -> str:
    """A value as TOML, tables inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + "}"
    return "[" + ", ".join(map(toml, value)) + "]" if isinstance(value, list) else json.dumps(value)


def write(path: Path, **changes: Any) -> Path:
    """A small configuration; ``changes`` as in ``setting``."""
    values = setting(0.4, **{"scene": {"kind": "waves", "count": 30}, "control": {"gain": 8.0}} | changes)
    path.write_text("".join(f"{name} = {toml(table)}\n" for name, table in values.items()))
    return path


def test_the_configuration_is_the_experiments_setting():
    assert tomllib.loads(CONFIG.read_text()) == setting()


def test_an_alignment_leaves_everything(tmp_path):
    config, out = write(tmp_path / "servo.toml"), tmp_path / "out"
    done = CliRunner().invoke(app, ["servo", str(config), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "The part is at the desired pose and stays there." in done.output
    assert "nm" in done.output
    assert sorted(path.name for path in out.iterdir()) == FILES
    with (out / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    summary = json.loads((out / "summary.json").read_text())
    assert summary["aligned"] is True
    assert len(rows) == sum(step["frames"] for step in summary["steps"].values())
    assert {row["part"] for row in rows} == {"substrate", "probe"}
    assert {row["omega_rad_per_s"] for row in rows if row["part"] == "probe"} == {"0"}
    assert max(abs(float(rows[-1][f"error_{axis}_px"])) for axis in "xy") < 0.2
    assert summary["tip_miss"]["nm"] < 0.1 * 1e3 * 0.275 / 0.4


def test_what_is_not_aligned_is_said_and_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(servo_session, "pictures", lambda *_: {})
    config = write(tmp_path / "servo.toml", control={"max_frames": 5})
    done = CliRunner().invoke(app, ["servo", str(config), "--out", str(tmp_path / "out"), "--no-overlay"])
    assert done.exit_code == 1
    assert "was not reached in the frames allowed; the stage was stopped." in done.output
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["log.csv", "summary.json"]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["ending"] == "TIME_OUT"


def test_interrupting_keeps_what_was_done(tmp_path, monkeypatch):
    """Ctrl-C while a frame is worked on."""
    config, out, write_row = write(tmp_path / "servo.toml"), tmp_path / "out", LogWriter.write

    def interrupted(self: LogWriter, name: str, step: Step) -> None:
        write_row(self, name, step)
        if step.time > 0.2:
            raise KeyboardInterrupt

    monkeypatch.setattr(LogWriter, "write", interrupted)
    done = CliRunner().invoke(app, ["servo", str(config), "--out", str(out)])
    assert done.exit_code == 130
    assert "Stopped from the keyboard; the stage was stopped." in done.output
    assert sorted(path.name for path in out.iterdir()) == FILES
    assert len((out / "log.csv").read_text().splitlines()) == 1 + 8
    assert json.loads((out / "summary.json").read_text())["ending"] == "INTERRUPTED"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control": {"gain": -1.0}}, "gain must be a finite number > 0, got -1.0"),
        ({"control": {"gian": 1.0}}, r"\[control\]: unknown key 'gian' \(did you mean 'gain'\?\)"),
        ({"sceen": {"kind": "x"}}, r"servo: unknown key 'sceen' \(did you mean 'scene'\?\)"),
        ({"substrate": {"x": {"sped": 1.0}}}, r"\[substrate\]: x: unknown key 'sped'"),
        ({"look": {"scale": -1.0}}, "scale must be > 0"),
        ({"start": {"probe": [900.0, 50.0]}}, "axis 0 reaches from -150 to 150, got position"),
        ({"belief": {"um_per_px": 0.0}}, "um_per_px: expected one or two finite numbers other than 0"),
        ({"align": {"desired": [10.0, 90.0, 0.0]}}, "desired pose is outside the view"),
        ({"substrate": {"x": {"high": 1.0}}, "align": {"desired": [140.0, 96.0, 0.0]}}, "desired pose is unreachable"),
    ],
)
def test_wrong_configurations_have_words(changes, message, tmp_path):
    config, out = write(tmp_path / "servo.toml", **changes), tmp_path / "out"
    done = CliRunner().invoke(app, ["servo", str(config), "--out", str(out)])
    assert isinstance(done.exception, ValueError)
    assert re.search(message, str(done.exception)), done.exception
    assert not out.exists()


@pytest.mark.parametrize("module", [fig12, fig13])
def test_the_figures_are_made_and_keep_their_limits(module, monkeypatch):
    """The experiments as they are, before a texture that is quickly drawn and with fewer pixels."""
    changes = {"scene": {"kind": "waves", "count": 30}, "control": {"gain": 8.0}}
    if module is fig12:
        monkeypatch.setattr(fig12, "setting", lambda scale: setting(0.4, **changes))
    else:
        monkeypatch.setattr(fig13, "QUICK", ("as it is",))
        monkeypatch.setattr(fig13, "SCALE", 0.4)
        monkeypatch.setattr(fig13, "GAIN", 4.0)
        monkeypatch.setattr(fig13, "single", lambda scale, **own: single(scale, **own | {"scene": changes["scene"]}))
    done: list[tuple[int, int]] = []
    outcome = module.run(True, lambda k, total: done.append((k, total)))
    assert done
    assert done[-1][0] <= done[-1][1]
    assert [record.name for record in outcome.records if not record.kept] == []
    assert outcome.pictures[0].name == outcome.name
    assert all(len(row) == len(table.header) for table in outcome.tables for row in table.rows)


def test_a_table_that_is_missing_is_named():
    with pytest.raises(ValueError, match=r"servo: missing table \[align\]"):
        ServoJob.read({})
