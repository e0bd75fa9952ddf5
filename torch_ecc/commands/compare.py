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
from torch_ecc.io.output import check_folder, part, publish
from torch_ecc.io.summary import write_json
from torch_ecc.plots import plot_comparison
from torch_ecc.records.calibration import Calibration
from torch_ecc.records.motion import Motion, nearest_errors
from torch_ecc.records.synchrony import Alignment, Unknowns, align_records

UNITS = {"x_nm": 1e3, "y_nm": 1e3, "theta_urad": 1e6}
FORMATS = {"frame": "%d", "time_s": "%.6f", "sensor_time_s": "%.6f", "flag": "%s"}


class Comparison(NamedTuple):
    """Both records, what stands between them, and the errors (T, 3) um, um, rad by the paper's nearest points."""

    frame: Tensor
    track: Motion
    sensors: Motion
    alignment: Alignment
    nearest: Tensor

    @property
    def flags(self) -> list[str]:
        """A word per frame: ok, lost (by the tracker) or no_sensor_sample (none around it)."""
        lost = (~self.track.pose.isfinite().all(1)).tolist()
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
        exposure_s=job.exposure_s,
        max_offset_s=job.max_offset_s,
    )
    table, (time, pose) = read_track(job.track, job.template), read_sensors(job.sensors)
    track, sensors = to_motion(table, job), Motion(torch.from_numpy(time), torch.from_numpy(pose))
    alignment = align_records(track, sensors, unknowns)
    return Comparison(torch.from_numpy(table.frame), track, sensors, alignment, by_nearest(track, sensors, alignment))


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
    turn = pose.new_tensor((1.0, 1.0, -1.0 if job.flip_theta else 1.0))
    pose = torch.where(torch.from_numpy(table.found)[:, None], turn * pose, math.nan)
    return Motion(torch.as_tensor(time), pose)


def by_nearest(track: Motion, sensors: Motion, alignment: Alignment) -> Tensor:
    """The paper's errors (T, 3) of the common portion, both clocks and zeros brought together first, NaN elsewhere."""
    errors = torch.full_like(track.pose, math.nan)
    valid = alignment.valid.nonzero()[:, 0]
    common = slice(int(valid[0]), int(valid[-1]) + 1)
    visual = Motion(track.time_s[common] + alignment.offset_s, track.pose[common] + alignment.zero)
    half = track.period_s / 2
    errors[common] = nearest_errors(
        visual, sensors.part(float(visual.time_s[0]) - half, float(visual.time_s[-1]) + half)
    )
    return errors


def summary(job: CompareJob, found: Comparison) -> dict[str, Any]:
    """The figures of a comparison, in the units of their names."""
    flags, a = found.flags, found.alignment
    values = dict(zip(("x0_um", "y0_um", "theta0_rad"), a.zero.tolist(), strict=True))
    values |= {"offset_s": a.offset_s, "axis_angle_rad": a.axis_angle, "scale": a.scale}
    values |= dict(zip(("lever_x_um", "lever_y_um"), a.lever.tolist(), strict=True))
    return {
        "frames": {"all": len(flags)} | {word: flags.count(word) for word in ("ok", "lost", "no_sensor_sample")},
        "sensor_samples": len(found.sensors.time_s),
        "sensor_samples_lost": int((~found.sensors.pose.isfinite().all(1)).sum()),
        "estimated": {name: {"value": values[name], "sigma": sigma} for name, sigma in a.sigma.items()},
        "converged": a.converged,
        "theta_opposed": _opposed(a.errors[:, 2], found.track.pose[:, 2]),
        "errors": {"estimated_at_once": _sizes(a.errors), "nearest_points": _sizes(found.nearest)},
        "settings": dataclasses.asdict(job),
    }


def _sizes(errors: Tensor) -> dict[str, dict[str, float]]:
    """rms and largest of errors (T, 3) um, um, rad, in nm and urad."""
    good = errors[errors.isfinite().all(1)]
    return {
        name: {
            "rms": unit * float(good[:, k].square().mean().sqrt()),
            "largest": unit * float(good[:, k].abs().max()) if len(good) else math.nan,
        }
        for k, (name, unit) in enumerate(UNITS.items())
    }


def write(job: CompareJob, found: Comparison) -> dict[str, Any]:
    """Write DIR/errors.csv, comparison.json and comparison.png; returns what is in comparison.json."""
    folder, figures, a = Path(job.out), summary(job, found), found.alignment
    folder.mkdir(parents=True, exist_ok=True)
    columns = {"frame": found.frame.tolist(), "time_s": found.track.time_s.tolist()}
    columns["sensor_time_s"] = (found.track.time_s + a.offset_s).tolist()
    for prefix, errors in (("d", a.errors), ("nearest_d", found.nearest)):
        columns |= {f"{prefix}{name}": (unit * errors[:, k]).tolist() for k, (name, unit) in enumerate(UNITS.items())}
    formats = {name: FORMATS.get(name, "%.4f") for name in columns} | {"flag": "%s"}
    write_table(part(folder, "errors.csv"), columns | {"flag": found.flags}, formats)
    write_json(part(folder, "comparison.json"), figures)
    aligned = found.track.pose + a.zero
    aligned[:, :2] = a.scale * found.track.pose[:, :2] @ rotation(torch.tensor(a.axis_angle).double()).mT + a.zero[:2]
    drawn = {"time_s": found.track.time_s, "track": aligned, "errors": a.errors, "nearest": found.nearest}
    drawn |= {"sensor_time_s": found.sensors.time_s - a.offset_s, "sensors": found.sensors.pose}
    title = f"{Path(job.track).name} and {Path(job.sensors).name}"
    plot_comparison({name: tensor.numpy() for name, tensor in drawn.items()}, folder / "comparison.png", title=title)
    publish(folder, "errors.csv", "comparison.json")
    return figures


def report(figures: dict[str, Any]) -> str:
    """What ``summary`` says, for people."""
    frames = figures["frames"]
    lines = [f"{frames['ok']} of {frames['all']} frames compared with {figures['sensor_samples']} sensor samples"]
    left = {
        "frames lost by the tracker": frames["lost"],
        "frames without a sensor sample around them": frames["no_sensor_sample"],
        "sensor samples without a pose": figures["sensor_samples_lost"],
    }
    lines += [f"  {count} {words}" for words, count in left.items() if count]
    lines.append(f"{'errors, rms (largest)':<22}" + "".join(f"{name.replace('_', ' '):>18}" for name in UNITS))
    for method, sizes in figures["errors"].items():
        cells = (f"{size['rms']:.3g} ({size['largest']:.3g})" for size in sizes.values())
        lines.append(f"{method.replace('_', ' '):<22}" + "".join(f"{cell:>18}" for cell in cells))
    for name, item in figures["estimated"].items():
        lines.append(f"{name:<22}{item['value']:>18.7g} +- {item['sigma']:.2g}")
    if figures["theta_opposed"]:
        lines.append("theta runs in opposite directions in the two records: see --flip-theta")
    if not figures["converged"]:
        lines.append("The estimate was still moving when its iterations ran out: look at comparison.png")
    return "\n".join(lines)


def _opposed(errors: Tensor, theta: Tensor) -> bool:
    """Would the other sign of the track's theta (T,) agree better? error = theta - s, so s = theta - error."""
    good = errors.isfinite()
    t, s = theta[good], (theta - errors)[good]
    t, s = t - t.mean(), s - s.mean()
    return bool((t + s).square().sum() < 0.5 * (t - s).square().sum())
