"""The benchmark of templates that last, in short."""

from __future__ import annotations

from pathlib import Path

import lasting
from click.testing import CliRunner
from results import load


def test_a_short_run_writes_its_figures(tmp_path: Path) -> None:
    out = tmp_path / "lasting.json"
    done = CliRunner().invoke(lasting.main, ["--quick", "--only", "shutter", "--only", "surface", "--out", str(out)])
    assert done.exit_code == 0, done.output
    figures = load(out).figures
    assert (
        figures["rolling shutter, line_time / theta"].value < 0.03 < figures["rolling shutter, without / theta"].value
    )
    assert figures[f"waves dissolves, renew {lasting.RENEW} / lost"].value == 0
