"""Laws of reading logs: the same motion in every shape that laboratories write, and each message."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from torch_ecc.io.comparison import read_sensors, read_track
from torch_ecc.io.logs import read_log

COUNT, RATE = 60, 100.0
T = np.arange(COUNT) / RATE
X, Y, THETA = 1200 * np.sin(9 * T), 800 * np.cos(7 * T) - 3, 0.02 * np.sin(5 * T)  # um, um, rad
START = datetime(2024, 3, 5, 23, 59, 59, 700_000, tzinfo=UTC)
ANGLE_URAD = 1e6 * THETA


def table(separator: str, *columns: list[str], end: str = "") -> str:
    return "".join(separator.join(row) + end + "\n" for row in zip(*columns, strict=True))


def cells(values: np.ndarray, digits: int = 6, comma: bool = False) -> list[str]:
    text = [f"{value:.{digits}f}" for value in values]
    return [cell.replace(".", ",") for cell in text] if comma else text


def thousands(values: np.ndarray) -> list[str]:
    return [f"{value:,.3f}".translate(str.maketrans(",.", ".,")) for value in values]


def stamps(form: str) -> list[str]:
    return [(START + timedelta(seconds=t)).strftime(form) for t in T.tolist()]


LABVIEW = """LabVIEW Measurement\t
Separator\tTab
Date\t2024/03/05
Time\t23:59:59.7000000
***End_of_Header***\t

Channels\t3\t\t\t
Samples\t60\t60\t60\t
Delta_X\t0.010000\t0.010000\t0.010000\t
***End_of_Header***\t\t\t\t
X_Value\tx [um]\ty [um]\ttheta [urad]\tComment
"""
PLAIN = [cells(T), cells(X), cells(Y), cells(ANGLE_URAD, 4)]
COMMAS = [cells(1e3 * T, 3, True), cells(1e-3 * X, 9, True), cells(1e-3 * Y, 9, True), cells(ANGLE_URAD / 1e3, 7, True)]
XY, NS = PLAIN[1:3], [f"{1_709_683_199_700_000_000 + 10_000_000 * k}" for k in range(COUNT)]
SHAPES = {
    "LabVIEW": LABVIEW + table("\t", *PLAIN, ["start"] + [""] * (COUNT - 1)),
    "Excel": "Time (ms);x (mm);y (mm);theta (mrad)\n" + table(";", *COMMAS) + ";;;\n",
    "units below": "Time;x;y;theta\n[ms];[mm];[mm];[mrad]\n" + table(";", *COMMAS),
    "micro sign": "t;x [µm];y [µm];rz [µrad]\n" + table(";", *PLAIN),
    "Greek": "t [s];x [µm];y [µm];θ_z [µrad]\n" + table(";", *PLAIN),
    "UTF-16": "Time [s]\tPos X (µm)\tPos Y (µm)\tTheta Z (µrad)\n" + table("\t", *PLAIN),
    "quoted": '"Time","X","Y"\n"ms","mm","mm"\n' + table(",", *([f'"{cell}"' for cell in c] for c in COMMAS[:3])),
    "thousands": "t;x [nm];y [nm]\n" + table(";", cells(T), thousands(1e3 * X), thousands(1e3 * Y)),
    "comments": "# rev 3\n# t/s, x/um, y/um, rz/urad\n" + table(", ", *PLAIN) + "# end\n",
    "spaces": "%  t/s      x/um     y/um   theta/urad\n" + table("   ", *PLAIN),
    "ISO": "timestamp,x_um,y_um\n" + table(",", stamps("%Y-%m-%dT%H:%M:%S.%fZ"), *XY),
    "clock": "Date,Time,x_um,y_um\n" + table(",", stamps("%m/%d/%Y"), stamps("%I:%M:%S.%f %p"), *XY),
    "minutes": "time,StageX_um,StageY_um\n"
    + table(",", [f"{59 + int(t + 59) // 60}:{(59 + t) % 60:05.2f}" for t in T.tolist()], *XY),
    "epoch in ns": "time,x_um,y_um\n" + table(",", NS, *XY),
    "no header": table(",", *PLAIN),
    "no times": "n,CH 1,CH 2\n" + table(",", [f"{k}" for k in range(COUNT)], *XY),
    "words": "t,state,x_um,y_um,note\n" + table(",", PLAIN[0], ["RUN"] * COUNT, *XY, ["ok"] * COUNT),
    "separators at the end": "t,x_um,y_um,theta_urad\n" + table(",", *PLAIN, end=","),
    "reversed": "t,x_um,y_um,theta_urad\n" + table(",", *(c[::-1] for c in PLAIN)),
    "theta not wanted": "t,x_um,y_um,theta [V]\n" + table(",", *PLAIN),
}
ENCODINGS = {"Excel": "utf-8-sig", "units below": "cp1252", "micro sign": "cp1252", "UTF-16": "utf-16"}
OPTIONS = {
    "no header": ("time=1, x=2:um, y=3:um, theta=4:urad", None),
    "no times": ("x=CH 1:um; y=CH 2:um", RATE),
    "theta not wanted": ("theta=", None),
}
NO_ANGLE = {"minutes", "quoted", "thousands", "ISO", "clock", "epoch in ns", "no times", "words", "theta not wanted"}


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_holds_the_same_motion(shape, tmp_path):
    (tmp_path / "log").write_bytes(SHAPES[shape].encode(ENCODINGS.get(shape, "utf-8")))
    time, pose, said = read_sensors(tmp_path / "log", *OPTIONS.get(shape, ()))
    angles = shape not in NO_ANGLE
    assert np.allclose(time - time[0], T, atol=1e-6)
    assert np.allclose(pose[:, :2], np.stack((X, Y), 1), atol=2e-3)
    assert np.allclose(pose[:, 2], THETA, atol=1e-9) if angles else np.isnan(pose[:, 2]).all()
    assert ("last row first" in said) == (shape == "reversed")
    assert ("theta = " in said) == angles


def test_times_since_1970_and_midnight(tmp_path):
    for shape, start in (("ISO", START.timestamp()), ("epoch in ns", START.timestamp()), ("clock", 86399.7)):
        (tmp_path / "log").write_text(SHAPES[shape])
        assert read_sensors(tmp_path / "log").time_s[0] == pytest.approx(start, abs=1e-5)


def test_what_is_no_text_is_said(tmp_path):
    for start, kind in ((b"PK\x03\x04", "a workbook"), (b"TDSm", "a TDMS file")):
        (tmp_path / "log").write_bytes(start + bytes(range(256)))
        with pytest.raises(ValueError, match=f"expected a table in text, this is {kind}: save it as CSV first"):
            read_log(tmp_path / "log")


@pytest.mark.parametrize("word", ["", "NaN", "-nan", "#N/A", "---", "NULL", "1.#QNAN", "inf"])
def test_cells_that_are_missing(word, tmp_path):
    x = [word if k in (3, 4, 50) else cell for k, cell in enumerate(PLAIN[1])]
    (tmp_path / "log").write_text("t,x_um,y_um\n" + table(",", PLAIN[0], x, PLAIN[2]))
    pose = read_sensors(tmp_path / "log").pose
    assert np.flatnonzero(~np.isfinite(pose[:, 0])).tolist() == [3, 4, 50]


def test_what_a_logger_that_was_killed_leaves(tmp_path):
    """The last row is broken off and left out; a short row anywhere else is an error with its line."""
    text = "t,x_um,y_um\n" + table(",", *PLAIN[:3])
    (tmp_path / "log").write_text(text[: text.rindex(",")])
    assert len(read_log(tmp_path / "log").lines) == COUNT - 1
    lines = text.splitlines()
    lines[20] = "0.19,1.0"
    (tmp_path / "log").write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="line 21 must have 3 cells, got 2"):
        read_log(tmp_path / "log")


def test_names_that_stand_twice_stay_apart(tmp_path):
    (tmp_path / "log").write_text("t,value,value\n" + table(",", *PLAIN[:3]))
    assert read_log(tmp_path / "log").names == ("t", "value", "value (3)")
    with pytest.raises(ValueError, match=r"columns: .* has no column 'X' for x; columns found: t, value, value \(3\)"):
        read_sensors(tmp_path / "log", "x=X:um")
    pose = read_sensors(tmp_path / "log", "x=value:um, y=value (3):um").pose
    assert np.allclose(pose[:, :2], np.stack((X, Y), 1), atol=1e-5)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("stamp", "columns: expected 'time=NAME, x=NAME:UNIT, ...' with time, x, y, theta, got 'stamp'"),
        ("z=4", "columns: expected"),
        ("", "columns: expected"),
        ("x=A", "column A has no unit: expected um, micron, .*, as in --columns 'x=A:um'"),
        ("x=A:V", "has no column 'A:V' for x"),
        ("x=9:um", "has no column '9' for x"),
        ("theta=A", "as in --columns 'theta=A:deg'"),
    ],
)
def test_bad_columns(columns, message, tmp_path):
    (tmp_path / "log").write_text("t,A,B\n" + table(",", *PLAIN[:3]))
    with pytest.raises(ValueError, match=message):
        read_sensors(tmp_path / "log", columns)


def test_a_track_that_went_through_a_spreadsheet(tmp_path):
    header = "frame;template;dx_px;dy_px;dtheta_rad;status"
    rows = [f"{k};0;{k / 4};-{k / 8};0,001;{'LOST' if k == 2 else 'CONVERGED'}".replace(".", ",") for k in range(9)]
    (tmp_path / "track.csv").write_text("\n".join((header, *rows)), encoding="utf-8-sig")
    track = read_track(tmp_path / "track.csv")
    assert track.displacement[3].tolist() == [0.75, -0.375, 0.001]
    assert np.flatnonzero(~track.found).tolist() == [2]
    assert track.time_s is None
    assert math.isclose(track.frame[-1], 8)
