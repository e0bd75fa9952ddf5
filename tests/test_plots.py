"""track.png: what the curves show is what the track says, in the right units, at any length."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from torch_ecc import plots
from torch_ecc.plots import plot_track
from torch_ecc.plots.envelope import Envelope, thinned

CODES = {
    "status_codes": np.array([0, 1, 2], np.int8),
    "status_names": np.array(["CONVERGED", "MAX_ITERATIONS", "LOST"]),
}
UM = np.array([[0.5, 0.1], [-0.1, 0.4]])


def track(frames: int = 30, templates: int = 2, **more: Any) -> dict[str, Any]:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(frames, templates, 3, 3)) * 1e-2
    arrays = {
        "displacement": rng.normal(size=(frames, templates, 3)),
        "covariance": root @ np.swapaxes(root, -1, -2),
        "score": rng.uniform(0.9, 1.0, (frames, templates)),
        "status": np.zeros((frames, templates), np.int8),
        "residual_rms": rng.uniform(1, 2, (frames, templates)),
    }
    return arrays | CODES | more


@pytest.fixture
def figure(monkeypatch):
    """Call it as plot_track to get the figure's axes by their labels."""

    def draw(data: Mapping[str, Any]) -> dict[str, Any]:
        kept: list[Figure] = []
        monkeypatch.setattr(plots.track, "save", lambda figure, path, dpi: kept.append(figure) or path)
        plot_track(data, "unused.png")
        return {axes.get_ylabel(): axes for axes in kept[0].axes}

    return draw


def test_writes_a_picture(tmp_path):
    for suffix in ("png", "pdf", "svg"):
        path = tmp_path / "new" / f"track.{suffix}"
        assert plot_track(track(), path, title="a run") == path
    assert sorted(p.name for p in path.parent.iterdir()) == ["track.pdf", "track.png", "track.svg"]  # no .part
    with Image.open(tmp_path / "new" / "track.png") as image:
        assert min(image.size) > 1000
        assert len(np.unique(np.asarray(image.convert("L")))) > 50


def test_reads_what_a_run_leaves(tmp_path):
    np.savez(tmp_path / "track.npz", **track(time_s=np.arange(30) / 25))
    assert plot_track(tmp_path / "track.npz", tmp_path / "track.png").is_file()


def test_curves_are_the_track(figure):
    data = track()
    axes = figure(data)
    for k, name in enumerate(("x displacement (px)", "y displacement (px)", "θ displacement (deg)")):
        scale = np.degrees(1) if k == 2 else 1
        for r, line in enumerate(axes[name].lines):
            np.testing.assert_allclose(line.get_ydata(), scale * data["displacement"][:, r, k])
    sigma = 1e3 * np.sqrt(data["covariance"][:, 1, 0, 0])
    np.testing.assert_allclose(axes["\u03c3 of x (10⁻³ px)"].lines[1].get_ydata(), sigma)
    np.testing.assert_allclose(axes["score"].lines[0].get_ydata(), data["score"][:, 0])
    assert axes["status"].get_xlabel() == "frame"


def test_calibrated_tracks_are_in_micrometres_and_seconds(figure):
    data = track(um_matrix=UM, time_s=np.arange(30) / 25)
    axes = figure(data)
    line = axes["x displacement (µm)"].lines[0]
    np.testing.assert_allclose(line.get_ydata(), data["displacement"][:, 0, :2] @ UM[0])
    np.testing.assert_allclose(line.get_xdata(), data["time_s"])
    variance = UM[1] @ data["covariance"][:, 0, :2, :2] @ UM[1]
    np.testing.assert_allclose(axes["\u03c3 of y (nm)"].lines[0].get_ydata(), 1e3 * np.sqrt(variance))
    assert axes["status"].get_xlabel() == "time (s)"


def test_lost_frames_are_gaps_but_keep_their_score(figure):
    data = track()
    data["status"][10:15, 0], data["status"][20, 0] = 2, 1
    data["covariance"][10:15, 0] = np.diag([np.inf] * 3)
    axes = figure(data)
    gaps = np.isnan(axes["x displacement (px)"].lines[0].get_ydata())
    assert np.flatnonzero(gaps).tolist() == [10, 11, 12, 13, 14]
    assert np.isfinite(axes["score"].lines[0].get_ydata()).all()


def test_long_tracks_are_drawn_as_their_envelope(figure):
    """Few points, and not one spike is lost; a single lost frame shows in the strip."""
    data = track(50_000, 1)
    data["displacement"][31_234, 0, 0] = 77.0
    data["status"][12_345] = 2
    axes = figure(data)
    values = axes["x displacement (px)"].lines[0].get_ydata()
    assert len(values) <= 3000
    assert np.nanmax(values) == 77.0
    assert np.nanmin(values) == np.delete(data["displacement"][:, 0, 0], 12_345).min()
    strip = axes["status"].images[0].get_array()
    assert (strip == 2).sum() == 1
    assert strip.shape[1] <= 1500


def test_long_tracks_are_read_in_blocks(tmp_path, monkeypatch):
    """However they are read, the same is drawn; memory does not grow with their length."""
    data = track(50_000, 2, time_s=np.arange(50_000) / 25, um_matrix=UM)
    data["status"][10_000:20_000, 1] = 2
    np.savez(tmp_path / "track.npz", **data | {"score": np.asfortranarray(data["score"])})
    tracemalloc.start()
    try:
        with np.load(tmp_path / "track.npz") as archive:
            read = thinned(archive)
        held = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert held < 12e6  # of 15e6 that the file has, several times over
    monkeypatch.setattr("torch_ecc.plots.envelope._BLOCK", 1 << 30)
    for ours, at_once in zip(read, thinned(data), strict=True):
        for one, other in zip(ours, at_once, strict=True) if isinstance(ours, Envelope) else [(ours, at_once)]:
            np.testing.assert_array_equal(one, other)


def test_a_frame_of_huge_sigma_does_not_flatten_the_rest(figure):
    data = track(200, 1)
    data["covariance"][50, 0] = np.eye(3) * 1e8
    axes = figure(data)
    low, high = axes["x displacement (px)"].get_ylim()
    assert high - low < 20
    assert axes["\u03c3 of x (10⁻³ px)"].get_ylim()[1] < 1e3


@pytest.mark.parametrize(("frames", "templates"), [(1, 1), (2, 3), (40, 9), (20, 64)])
def test_any_number_of_frames_and_templates(tmp_path, frames, templates):
    plot_track(track(frames, templates), tmp_path / "track.png")


def test_a_track_that_was_never_found(tmp_path):
    data = track(status=np.full((30, 2), 2, np.int8), covariance=np.full((30, 2, 3, 3), np.inf))
    plot_track(data, tmp_path / "track.png")


def test_no_global_state():
    """Neither a window system nor pyplot's list of figures is touched."""
    code = "import sys, torch_ecc.plots; print('matplotlib.pyplot' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "False"


def test_bad_tracks(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        plot_track(tmp_path / "nowhere.npz", tmp_path / "track.png")
    data = track()
    del data["score"], data["status_names"]
    with pytest.raises(ValueError, match=r"plot_track: track must have .*; missing: score, status_names"):
        plot_track(data, tmp_path / "track.png")
    with pytest.raises(ValueError, match="plot_track: track must have at least one frame and template"):
        plot_track(track(0), tmp_path / "track.png")
    assert not list(Path(tmp_path).iterdir())


def test_threads_draw_what_one_draws(tmp_path):
    """And leave matplotlib's settings as they were."""
    data, before = track(5, 1), dict(mpl.rcParams)
    alone = plot_track(data, tmp_path / "alone.png").read_bytes()
    with ThreadPoolExecutor(3) as pool:
        drawn = list(pool.map(lambda k: plot_track(data, tmp_path / f"{k}.png").read_bytes(), range(3)))
    assert drawn == [alone] * 3
    assert dict(mpl.rcParams) == before
