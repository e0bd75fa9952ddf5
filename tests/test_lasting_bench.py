"""The benchmark of templates that last, in short."""

from __future__ import annotations

from pathlib import Path

import lasting
import pytest
import torch
from click.testing import CliRunner
from films import ageing
from results import load
from torch import Tensor


def test_a_short_run_writes_its_figures(tmp_path: Path) -> None:
    out = tmp_path / "lasting.json"
    done = CliRunner().invoke(lasting.main, ["--quick", "--only", "shutter", "--only", "surface", "--out", str(out)])
    assert done.exit_code == 0, done.output
    figures = load(out).figures
    assert (
        figures["rolling shutter, line_time / theta"].value < 0.03 < figures["rolling shutter, without / theta"].value
    )
    assert figures[f"waves dissolves, renew {lasting.RENEW} / lost"].value == 0


def test_without_noise_a_surface_that_changes_is_followed_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """There all images of it are lines through others, wherever they lie: what is uncertain is not taken."""

    def sense(image: Tensor, seed: int, _: float) -> Tensor:
        return (image + 0.05 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))).float()

    monkeypatch.setattr(ageing, "sense", sense)
    monkeypatch.setattr(ageing, "LIFE", 200)
    run = lasting.follow(ageing.changing("speckle", "dissolves", 0, 92), renew=5)
    assert bool(run.found.all())
    assert float(run.error[:, :2].abs().max()) < 0.05
    assert float((run.error / run.sigma).abs().max()) < 4
