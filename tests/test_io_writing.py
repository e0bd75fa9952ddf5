"""Writing a track: what was reported is what the files say, however the run ends, and no half file has a final name."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torch_ecc.io import TrackWriter
from torch_ecc.io.table import Table

NAMES = {0: "CONVERGED", 1: "MAX_ITERATIONS", 2: "LOST", 3: "OUT_OF_VIEW"}
REASONS = {0: "", 1: "MOVING", 2: "COVERED", 3: "OUT_OF_VIEW"}
ORIGINS = {0: "TRACKED", 1: "NEARBY"}
WORDS = {"status_names": NAMES, "reason_names": REASONS, "origin_names": ORIGINS}
FINAL = {"track.csv", "track.npz", "summary.json"}


class Report(NamedTuple):
    pose: Tensor
    displacement: Tensor
    score: Tensor
    status: Tensor
    iterations: Tensor
    covariance: Tensor
    residual_rms: Tensor
    coverage: Tensor
    reason: Tensor
    origin: Tensor


def report(seed: int = 0, templates: int = 2, *, lost: tuple[int, ...] = ()) -> Report:
    generator = torch.Generator().manual_seed(seed)
    displacement = torch.randn(templates, 3, generator=generator, dtype=torch.float64)
    root = torch.randn(templates, 3, 3, generator=generator, dtype=torch.float64)
    covariance = root @ root.mT * 1e-4
    status = torch.zeros(templates, dtype=torch.int8)
    for index in lost:
        status[index] = 2
        covariance[index] = torch.diag(torch.full((3,), math.inf, dtype=torch.float64))
    score = torch.rand(templates, generator=generator)
    return Report(
        displacement + 100,
        displacement,
        score,
        status,
        torch.full((templates,), 4),
        covariance,
        3 * score,
        score,
        status,
        (score > 0.5).to(torch.int8),
    )


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "track.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


# ---- what was reported is what the files say -----------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(
    frames=st.integers(1, 6),
    templates=st.integers(1, 4),
    fps=st.none() | st.floats(0.01, 1e4),
    calibrated=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_files_hold_the_reports(tmp_path_factory, frames, templates, fps, calibrated, seed):
    folder = tmp_path_factory.mktemp("run")
    um = torch.tensor([[0.5, 0.02], [-0.03, 0.4]], dtype=torch.float64) if calibrated else None
    reports = [report(seed + k, templates, lost=(k % templates,) if k % 2 else ()) for k in range(frames)]
    with TrackWriter(folder, **WORDS, fps=fps, um_matrix=um) as writer:
        for item in reports:
            writer.write(item)
    track = np.load(folder / "track.npz")
    found = torch.stack([item.status for item in reports]).numpy() < 2
    for name in Report._fields:
        stacked = torch.stack([getattr(item, name) for item in reports]).numpy()
        if name in ("pose", "displacement"):
            stacked = np.where(found[..., None], stacked, np.nan)  # an old one is none
        np.testing.assert_array_equal(track[name], stacked)
    assert track["displacement"].dtype == track["pose"].dtype == np.float64
    assert dict(zip(track["status_codes"].tolist(), track["status_names"].tolist(), strict=True)) == NAMES
    assert ("time_s" in track) == (fps is not None)
    assert ("um_matrix" in track) == ("displacement_um" in track) == calibrated
    if calibrated:
        np.testing.assert_allclose(track["displacement_um"], track["displacement"][..., :2] @ um.numpy().T)
    check_rows(rows(folder), track, fps)


def check_rows(table: list[dict[str, str]], track: dict[str, np.ndarray], fps: float | None) -> None:
    frames, templates = track["score"].shape
    assert [(int(row["frame"]), int(row["template"])) for row in table] == list(np.ndindex(frames, templates))
    for row in table:
        at = int(row["frame"]), int(row["template"])
        words = ("status", "reason", "origin", "damage")
        found = {name: float(value or "nan") for name, value in row.items() if name not in words}
        assert row["reason"] == REASONS[track["reason"][at]]
        assert row["origin"] == (ORIGINS[track["origin"][at]] if track["status"][at] < 2 else "")
        pose = [found[name] for name in ("x_px", "y_px", "theta_rad")]
        moved = [found[name] for name in ("dx_px", "dy_px", "dtheta_rad")]
        sigma = [found[name] for name in ("sigma_x_px", "sigma_y_px", "sigma_theta_rad")]
        np.testing.assert_allclose(pose, track["pose"][at], atol=1e-6)
        np.testing.assert_allclose(moved, track["displacement"][at], atol=1e-6)
        variance = np.diag(track["covariance"][at])
        np.testing.assert_allclose(sigma, np.sqrt(np.where(variance < np.inf, variance, np.nan)), rtol=1e-3)
        assert found["score"] == pytest.approx(track["score"][at], abs=1e-6)
        assert found["residual_rms"] == pytest.approx(track["residual_rms"][at], rel=1e-3)
        assert found["coverage"] == pytest.approx(track["coverage"][at], abs=1e-3)
        assert found["iterations"] == track["iterations"][at]
        assert row["status"] == NAMES[track["status"][at]]
        assert ("time_s" in row) == (fps is not None)
        if fps:
            assert found["time_s"] == pytest.approx(at[0] / fps, abs=1e-6)
        if "displacement_um" in track:
            np.testing.assert_allclose([found["dx_um"], found["dy_um"]], track["displacement_um"][at], atol=1e-6)


def test_columns_carry_their_units(tmp_path):
    with TrackWriter(tmp_path, **WORDS, fps=10.0, um_matrix=torch.eye(2)) as writer:
        writer.write(report())
    assert (tmp_path / "track.csv").read_text().splitlines()[0] == (
        "frame,template,time_s,x_px,y_px,theta_rad,dx_px,dy_px,dtheta_rad,dx_um,dy_um,"
        "sigma_x_px,sigma_y_px,sigma_theta_rad,score,status,reason,origin,iterations,residual_rms,coverage,damage"
    )


def test_summary(tmp_path):
    given_settings = {"size": (31, 31), "input": Path("a.mp4"), "levels": 2, "limit": math.inf, "mask": None}
    um = torch.tensor([[0.3, 0.0], [0.4, 2.0]], dtype=torch.float64)
    with TrackWriter(tmp_path, **WORDS, fps=20.0, um_matrix=um, settings=given_settings) as writer:
        for k in range(10):
            writer.write(report(k, lost=(1,) if k >= 4 else (0,) if k == 3 else ()))
    found = summary(tmp_path)
    assert (found["complete"], found["reason"], found["frames"], found["templates"]) == (True, None, 10, 2)
    first, second = found["per_template"]
    assert first["status"] == {"CONVERGED": 9, "LOST": 1}
    assert sum(first["origins"].values()) == 9  # of what was lost none
    assert found["origins"] == {
        word: sum(one["origins"].get(word, 0) for one in (first, second)) for word in found["origins"]
    }
    assert (first["lost_frames"], first["first_lost_frame"], first["last_lost_frame"]) == (1, 3, 3)
    assert (second["lost_frames"], second["first_lost_frame"], second["last_lost_frame"]) == (6, 4, 9)
    track = np.load(tmp_path / "track.npz")
    assert first["mean_score"] == pytest.approx(track["score"][:, 0].mean())
    assert first["median_sigma"]["x_px"] == pytest.approx(np.sqrt(np.median(track["covariance"][:, 0, 0, 0])))
    for number, each in enumerate((first, second)):  # where they were seen last
        moved = report((9, 3)[number], lost=()).displacement[number]
        assert list(each["last_displacement"].values()) == pytest.approx(moved.tolist())
    assert second["median_sigma"] == {"x_px": None, "y_px": None, "theta_rad": None}  # mostly lost: infinite
    assert found["um_per_px"] == pytest.approx([0.5, 2.0])
    assert found["settings"] == {"size": [31, 31], "input": "a.mp4", "levels": 2, "limit": None, "mask": None}
    assert found["fps"] == 20.0
    assert found["frames_per_s"] > 0
    assert set(found["versions"]) == {"torch_ecc", "torch", "python"}


def test_doubtful_is_not_lost(tmp_path):
    with TrackWriter(tmp_path, **WORDS) as writer:
        writer.write(report()._replace(status=torch.tensor([1, 3], dtype=torch.int8)))
    assert [template["lost_frames"] for template in summary(tmp_path)["per_template"]] == [0, 1]


# ---- however the run ends ------------------------------------------------------------------------------------------


def run_into(folder: Path, error: BaseException | None, frames: int = 3) -> None:
    with TrackWriter(folder, **WORDS) as writer:
        for k in range(frames):
            writer.write(report(k))
        assert names(folder) == ({"track.csv.part", "track.records.part"} if frames else set())
        if error:
            raise error


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (None, None),
        (KeyboardInterrupt(), "interrupted by the user"),
        (ValueError("frame 3: cut off"), "ValueError: frame 3: cut off"),
        (RuntimeError("out of memory"), "RuntimeError: out of memory"),
        (SystemExit(2), "SystemExit: 2"),
    ],
)
def test_what_was_done_is_kept(tmp_path, error, reason):
    folder = tmp_path / "deep" / "out"
    if error is None:
        run_into(folder, None)
    else:
        with pytest.raises(type(error)):
            run_into(folder, error)
    assert names(folder) == FINAL
    assert (summary(folder)["complete"], summary(folder)["reason"]) == (error is None, reason)
    assert summary(folder)["frames"] == len(np.load(folder / "track.npz")["pose"]) == len(rows(folder)) // 2 == 3


@pytest.mark.parametrize("error", [None, KeyboardInterrupt(), ValueError("no frame")])
def test_nothing_is_created_before_the_first_record(tmp_path, error):
    if error is None:
        run_into(tmp_path / "out", None, frames=0)
    else:
        with pytest.raises(type(error)):
            run_into(tmp_path / "out", error, frames=0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("frames", [0, 3])
def test_interrupt_in_the_middle_of_a_frame(tmp_path, monkeypatch, frames):
    """Files stay in step: the frame that was being written is in neither."""
    with TrackWriter(tmp_path, **WORDS) as writer:
        for k in range(frames):
            writer.write(report(k))
        monkeypatch.setattr(Table, "rows", interrupt)
        with pytest.raises(KeyboardInterrupt):
            writer.write(report(9))
        if frames:
            writer._journal.records_file.write(b"half a record")
            writer._journal.table_file.write(b"3,0,half a r")
    if not frames:
        assert names(tmp_path) == set()
        return
    assert names(tmp_path) == FINAL
    assert summary(tmp_path)["frames"] == len(np.load(tmp_path / "track.npz")["score"]) == len(rows(tmp_path)) // 2 == 3
    assert None not in rows(tmp_path)[-1].values()


def interrupt(*_: object) -> str:
    raise KeyboardInterrupt


def test_a_killed_process_leaves_parts_only(tmp_path):
    code = (
        "import os, sys; sys.path.insert(0, sys.argv[1]); from test_io_writing import WORDS, TrackWriter, report\n"
        "with TrackWriter(sys.argv[2], **WORDS) as writer:\n"
        "    for k in range(5): writer.write(report(k))\n"
        "    os._exit(9)"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parent), str(tmp_path / "out")]
    assert subprocess.run(command, check=False).returncode == 9
    assert names(tmp_path / "out") == {"track.csv.part", "track.records.part"}
    run_into(tmp_path / "out", None)  # the next run is not troubled by them
    assert names(tmp_path / "out") == FINAL


def test_an_earlier_run_stays_until_the_new_one_is_whole(tmp_path):
    run_into(tmp_path, None, frames=5)
    before = {name: (tmp_path / name).read_bytes() for name in FINAL}
    with TrackWriter(tmp_path, **WORDS) as writer:
        writer.write(report())
        assert {name: (tmp_path / name).read_bytes() for name in FINAL} == before
    assert names(tmp_path) == FINAL
    assert summary(tmp_path)["frames"] == len(rows(tmp_path)) // 2 == 1


def test_memory_does_not_grow_with_the_length(tmp_path):
    item = report(templates=8)
    with TrackWriter(tmp_path, **WORDS) as writer:
        writer.write(item)
        tracemalloc.start()
        try:
            for _ in range(500):
                writer.write(item)
            held = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    assert held < 60_000  # of which one record takes 1.4 kB; 500 of them are 700 kB


def test_nor_does_that_of_writing_the_results(tmp_path, monkeypatch):
    """Nor do the results depend on how many frames are looked at together."""
    peaks, told = [], []
    monkeypatch.setattr("torch_ecc.io.summary._VALUES", 800)
    for frames, block in ((100, 1 << 14), (1000, 1 << 14), (1000, 1 << 30)):
        monkeypatch.setattr("torch_ecc.io.journal._BLOCK", block)
        out = tmp_path / str(len(peaks))
        with TrackWriter(out, **WORDS) as writer:
            for k in range(frames):
                writer.write(report(k, templates=8, lost=(k % 5,) if k % 7 == 3 else ()))
            tracemalloc.start()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        told.append([{k: v for k, v in summary(out).items() if k != "frames_per_s"}, (out / "track.npz").read_bytes()])
    assert peaks[1] < 1.3 * peaks[0]
    assert peaks[2] > 3 * peaks[1]
    (ours, npz), (at_once, npz_at_once) = told[1:]
    assert npz == npz_at_once
    for name in ours.keys() - {"per_template"}:
        assert ours[name] == at_once[name]
    for one, other in zip(ours["per_template"], at_once["per_template"], strict=True):
        assert one | {"mean_score": 0, "mean_coverage": 0} == other | {"mean_score": 0, "mean_coverage": 0}
        assert one["mean_score"] == pytest.approx(other["mean_score"], rel=1e-12)


# ---- refused at the door -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0.0}, "fps must be a positive number, got 0.0"),
        ({"fps": math.nan}, "fps must be a positive number, got nan"),
        ({"um_matrix": torch.eye(3)}, r"um_matrix must be \(2, 2\), got \(3, 3\)"),
    ],
)
def test_bad_options(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        TrackWriter(tmp_path, **WORDS, **options)


def test_the_folder_must_be_one(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match=r"TrackWriter: out_dir must be a folder, .*file is a file"):
        TrackWriter(tmp_path / "file", **WORDS)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (report()._replace(score=torch.zeros(3)), r"record.score must be \(2,\), got \(3,\)"),
        (report()._replace(covariance=torch.zeros(2, 3)), r"record.covariance must be \(2, 3, 3\), got \(2, 3\)"),
        (
            report()._replace(status=torch.tensor([0, 7])),
            r"record.status has the code 7, status_names has \[0, 1, 2, 3\]",
        ),
        (report()._replace(reason=torch.tensor([9, 0])), r"record.reason has the code 9, reason_names has"),
        (report(templates=3), "record must have 2 templates as before, got 3"),
    ],
)
def test_bad_records(tmp_path, record, message):
    def run() -> None:
        with TrackWriter(tmp_path, **WORDS) as writer:
            writer.write(report())
            writer.write(record)

    with pytest.raises(ValueError, match=message):
        run()
    assert summary(tmp_path)["frames"] == 1
    assert summary(tmp_path)["complete"] is False
