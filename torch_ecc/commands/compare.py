"""A track against sensors, from their files to the errors: what ``torch-ecc compare`` does."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.commands.jobs import CompareJob
from torch_ecc.core.pose import rotation
from torch_ecc.io.comparison import TrackTable, read_sensors, read_track, write_table
from torch_ecc.io.output import check_folder, part, printable, publish
from torch_ecc.io.summary import write_json
from torch_ecc.plots import plot_comparison
from torch_ecc.records.calibration import Calibration
from torch_ecc.records.lags import Signs
from torch_ecc.records.motion import Motion, nearest_errors
from torch_ecc.records.synchrony import Alignment, Unknowns, align_records

UNITS = {"x_nm": 1e3, "y_nm": 1e3, "theta_urad": 1e6}
COMMON = 0.5  # of two records of one motion; noise may be more than a small motion
ODD = 1.1  # a ratio between the sizes of two records that no angle between the axes explains
WORDS = {
    "offset_s": ("offset of the clocks", "s", 1.0),
    "axis_angle_rad": ("axis angle", "deg", 180 / math.pi),
    "x0_um": ("zero of x", "um", 1.0),
    "y0_um": ("zero of y", "um", 1.0),
    "theta0_rad": ("zero of theta", "urad", 1e6),
    "scale": ("scale", "", 1.0),
    "lever_x_um": ("lever arm in x", "um", 1.0),
    "lever_y_um": ("lever arm in y", "um", 1.0),
    "rate_ppm": ("rate of the clocks", "ppm", 1.0),
}
FORMATS = {"frame": "%d", "time_s": "%.6f", "sensor_time_s": "%.6f", "flag": "%s"}


class Comparison(NamedTuple):
    """Both records, what stands between them, the errors (T, 3) um, um, rad by the paper's nearest points, and in words
    from which columns the sensors' record is."""

    frame: Tensor
    track: Motion
    sensors: Motion
    alignment: Alignment
    nearest: Tensor
    columns: str

    @property
    def flags(self) -> list[str]:
        """A word per frame: ok, lost (by the tracker) or no_sensor_sample (none around it)."""
        lost = (~self.track.found).tolist()
        valid = self.alignment.valid.tolist()
        return [
            "lost" if gone else "ok" if good else "no_sensor_sample" for gone, good in zip(lost, valid, strict=True)
        ]


def compare(job: CompareJob) -> Comparison:
    """Read both files and compare them. FileNotFoundError or ValueError for whatever does not fit."""
    check_folder(job.out, "compare")
    unknowns = Unknowns(
        angle=not job.fixed_angle,
        scale=job.scale,
        lever=job.lever,
        rate=job.rate,
        exposure_s=job.exposure_s,
        max_offset_s=job.max_offset_s,
        signs=None if job.signs == "auto" else _signs(job.signs),
    )
    table = read_track(job.track, job.template)
    time, pose, columns = read_sensors(job.sensors, job.columns, job.sensors_hz)
    track, sensors = to_motion(table, job), Motion(torch.from_numpy(time), torch.from_numpy(pose))
    alignment = align_records(track, sensors, unknowns)
    nearest = by_nearest(track, sensors, alignment)
    return Comparison(torch.from_numpy(table.frame), track, sensors, alignment, nearest, columns)


def to_motion(table: TrackTable, job: CompareJob) -> Motion:
    """The track in s, um, um, rad along the stage's axes; NaN where the template was lost."""
    displacement = torch.from_numpy(table.displacement)
    if job.um_per_px is not None:
        pose = Calibration(job.um_per_px, math.radians(job.axis_angle_deg)).to_physical(displacement)
    elif table.displacement_um is not None:
        um = torch.from_numpy(table.displacement_um) @ rotation(torch.tensor(job.axis_angle_deg).double().deg2rad()).mT
        pose = torch.cat((um, displacement[:, 2:]), 1)
    else:
        raise ValueError(f"um_per_px: {job.track} has no columns dx_um and dy_um, so the scale is needed, got none")
    if job.fps is None and table.time_s is None:
        raise ValueError(f"fps: {job.track} has no column time_s, so the frame rate is needed, got none")
    time = table.frame / job.fps if job.fps is not None else table.time_s
    pose = torch.where(torch.from_numpy(table.found)[:, None], pose, math.nan)
    return Motion(torch.as_tensor(time), pose)


def by_nearest(track: Motion, sensors: Motion, alignment: Alignment) -> Tensor:
    """The paper's errors (T, 3) of the common portion, NaN elsewhere.

    Clocks, zeros and the names and signs of the axes are brought together first; a small angle between them stays.
    """
    errors = torch.full_like(track.pose, math.nan)
    valid = alignment.valid.nonzero()[:, 0]
    common = slice(int(valid[0]), int(valid[-1]) + 1)
    quarters = alignment._replace(axis_angle=math.pi / 2 * round(alignment.axis_angle / (math.pi / 2)), scale=1.0)
    visual = Motion(alignment.at(track.time_s)[common], quarters.moved(track.pose)[common])
    half = track.period_s / 2
    near = sensors.part(float(visual.time_s[0]) - half, float(visual.time_s[-1]) + half)
    errors[common] = nearest_errors(visual, near)
    return errors


def summary(job: CompareJob, found: Comparison) -> dict[str, Any]:
    """The figures of a comparison, in the units of their names."""
    flags, a = found.flags, found.alignment
    values = dict(zip(("x0_um", "y0_um", "theta0_rad"), a.zero.tolist(), strict=True))
    values |= {"offset_s": a.offset_s, "axis_angle_rad": a.axis_angle, "scale": a.scale, "rate_ppm": a.rate_ppm}
    values |= dict(zip(("lever_x_um", "lever_y_um"), a.lever.tolist(), strict=True))
    return {
        "columns": found.columns,
        "frames": {"all": len(flags)} | {word: flags.count(word) for word in ("ok", "lost", "no_sensor_sample")},
        "sensor_samples": len(found.sensors.time_s),
        "sensor_samples_lost": int((~found.sensors.found).sum()),
        "estimated": {name: {"value": values[name], "sigma": sigma} for name, sigma in a.sigma.items()},
        "signs": dict(zip(("x", "y", "theta"), map(int, a.signs.tolist()), strict=True)),
        "rival_offset_s": a.rival_s,
        "sensors_over_track": _ratio(found),
        "shared": _shared(found),
        "converged": a.converged,
        "errors": {"estimated_at_once": _sizes(a.errors), "nearest_points": _sizes(found.nearest)},
        "settings": dataclasses.asdict(job),
    }


def _sizes(errors: Tensor) -> dict[str, dict[str, float]]:
    """rms and largest of errors (T, 3) um, um, rad, in nm and urad, of the components that there are."""
    sizes = {}
    for k, (name, unit) in enumerate(UNITS.items()):
        good = unit * errors[:, k][errors[:, k].isfinite()]
        if len(good):
            sizes[name] = {"rms": float(good.square().mean().sqrt()), "largest": float(good.abs().max())}
    return sizes


def _ratio(found: Comparison) -> float:
    """How many times as far as the track the sensors moved in x and y: 1 unless a unit or scale is wrong."""
    errors = found.alignment.errors[found.alignment.valid][:, :2]
    moved = found.alignment.moved(found.track.pose)[found.alignment.valid][:, :2]
    there = errors.isfinite().all(0)
    m, s = moved[:, there], (moved - errors)[:, there]
    m, s = m - m.mean(0), s - s.mean(0)
    return float((m * s).sum() / m.square().sum())


def _shared(found: Comparison) -> float:
    """The share of the track's motion, as its variance, that the sensors tell: of the component that has most in common
    with theirs."""
    errors, moved = found.alignment.errors[found.alignment.valid], found.alignment.moved(found.track.pose)
    there = errors.isfinite().all(0)
    shares = 1 - errors[:, there].var(0) / moved[found.alignment.valid][:, there].var(0)
    return float(shares.nan_to_num(0.0, 0.0, 0.0).max())


def _signs(text: str) -> Signs:
    """ "+-+" as 1, -1, 1."""
    x, y, theta = (1.0 if sign == "+" else -1.0 for sign in text)
    return x, y, theta


def write(job: CompareJob, found: Comparison) -> dict[str, Any]:
    """Write DIR/errors.csv, comparison.json and comparison.png; returns what is in comparison.json."""
    folder, figures, a = Path(job.out), summary(job, found), found.alignment
    folder.mkdir(parents=True, exist_ok=True)
    columns = {"frame": found.frame.tolist(), "time_s": found.track.time_s.tolist()}
    columns["sensor_time_s"] = a.at(found.track.time_s).tolist()
    for prefix, errors in (("d", a.errors), ("nearest_d", found.nearest)):
        columns |= {f"{prefix}{name}": (unit * errors[:, k]).tolist() for k, (name, unit) in enumerate(UNITS.items())}
    formats = {name: FORMATS.get(name, "%.4f") for name in columns} | {"flag": "%s"}
    write_table(part(folder, "errors.csv"), columns | {"flag": found.flags}, formats)
    write_json(part(folder, "comparison.json"), figures)
    drawn = {"time_s": found.track.time_s, "track": a.moved(found.track.pose), "errors": a.errors}
    drawn |= {
        "sensor_time_s": found.sensors.time_s - a.offset_s,
        "sensors": found.sensors.pose,
        "nearest": found.nearest,
    }
    title = printable(f"{Path(job.track).name} and {Path(job.sensors).name}")
    plot_comparison({name: tensor.numpy() for name, tensor in drawn.items()}, folder / "comparison.png", title=title)
    publish(folder, "errors.csv", "comparison.json")
    return figures


def report(figures: dict[str, Any]) -> str:
    """What ``summary`` says, for people."""
    frames = figures["frames"]
    lines = [f"{frames['ok']} of {frames['all']} frames compared with {figures['sensor_samples']} sensor samples"]
    lines.append(f"  sensors: {figures['columns']}")
    left = {
        "frames lost by the tracker": frames["lost"],
        "frames without a sensor sample around them": frames["no_sensor_sample"],
        "sensor samples without a pose": figures["sensor_samples_lost"],
    }
    lines += [f"  {count} {words}" for words, count in left.items() if count]
    lines += ["", *_error_table(figures["errors"]), "", *_estimates(figures["estimated"]), *_remarks(figures)]
    return "\n".join(lines)


def _error_table(errors: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """rms and largest error of each component, columns as wide as they need to be."""
    names = list(errors["estimated_at_once"])
    rows = [["error: rms (largest)", *(name.replace("_", " in ") for name in names)]]
    for method, sizes in errors.items():
        cells = (sizes.get(name, {"rms": math.nan, "largest": math.nan}) for name in names)
        rows.append([method.replace("_", " "), *(f"{_short(c['rms'])} ({_short(c['largest'])})" for c in cells)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "   ".join(
            cell.rjust(width) if k else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]


def _estimates(estimated: dict[str, dict[str, float]]) -> list[str]:
    """Each parameter with its standard deviation, to the digits that this leaves."""
    lines = []
    for name, item in estimated.items():
        words, unit, factor = WORDS[name]
        value, sigma = factor * item["value"], factor * item["sigma"]
        if not math.isfinite(sigma):
            lines.append(f"{words:<22}not told by this motion (taken as {value:.6g} {unit})".rstrip())
            continue
        digits = min(max(1 - math.floor(math.log10(sigma)), 0), 12) if sigma > 0 else 12
        lines.append(f"{words:<22}{value:.{digits}f} +- {sigma:.{digits}f} {unit}".rstrip())
    return lines


def _remarks(figures: dict[str, Any]) -> list[str]:
    """What a person would point at."""
    lines = []
    other = [name for name, sign in figures["signs"].items() if sign < 0]
    if other:
        signs = "".join("+" if sign > 0 else "-" for sign in figures["signs"].values())
        lines.append(f"The sensors count {' and '.join(other)} the other way than the track does (--signs {signs})")
    ratio = figures["sensors_over_track"]
    if math.isfinite(ratio) and not 1 / ODD < ratio < ODD:
        lines.append(f"The sensors move {ratio:.4g} times as far as the track: are the units and um_per_px right?")
    if figures["shared"] < COMMON and math.isfinite(figures["estimated"]["offset_s"]["sigma"]):
        lines.append(
            f"Only {max(figures['shared'], 0.0):.0%} of the track's motion is the sensors', too: is it the same?"
        )
    if figures["rival_offset_s"] is not None:
        offset = figures["rival_offset_s"]
        lines.append(f"An offset of {offset:.4f} s fits as well: the motion repeats itself, see --max-offset-s")
    if not figures["converged"]:
        lines.append("The estimate was still moving when its iterations ran out: look at comparison.png")
    return lines


def _short(value: float) -> str:
    """Three digits without powers of ten."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
