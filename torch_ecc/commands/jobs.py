"""What the commands can be told: one record each, whose fields are the options and the keys of a configuration file."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any

from torch_ecc.core.criteria import CRITERIA, ILLUMINATION
from torch_ecc.core.settings import Settings, described
from torch_ecc.records.calibration import Calibration
from torch_ecc.track.advance import PREDICTIONS
from torch_ecc.track.budget import income
from torch_ecc.track.max_step import MaxStep

Point = tuple[float, float]
SIGNS = ("auto", *map("".join, product("+-", repeat=3)))  # of x, y and theta


@dataclass(frozen=True, kw_only=True)
class Tracking(Settings):
    """What ``Tracker`` can be told, by the names of its constructor."""

    criterion: str = described("ecc", "what is matched; ecc_paper is eq. 9 to the letter", CRITERIA)
    illumination: str = described("linear", "of ecc: light across the template; gain is one factor", ILLUMINATION)
    levels: int = described(1, "pyramid levels used at once; a template that is not found gets more by itself")
    prediction: str = described(
        "velocity", "start where the last frame ended (hold) or where its step leads", PREDICTIONS
    )
    search: bool = described(True, "look for a lost template in the whole frame, at any angle")
    search_share: float = described(0.5, "of the time, what searches may take at most in the long run; 1: no bound")
    max_step: Point | None = described(
        None, "px and deg, how far a template moves and turns from one frame to the next at most", example=(5.0, 1.0)
    )
    device: str | None = described(None, "without it, the CPU", example="cuda")
    average: int = described(1, "the templates become the mean of so many frames: less noise in dim pictures")
    renew: int | None = described(
        None, "they become the mean of the last so many frames, again and again: surfaces that change", example=20
    )

    line_time: float | None = described(
        None, "s from one row to the next of a rolling shutter; a pose is of when its own row is exposed", example=1e-5
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        MaxStep.of(self.max_step)
        income(self.search_share)

    def options(self) -> dict[str, Any]:
        """The keyword arguments of ``Tracker``."""
        return {each.name: getattr(self, each.name) for each in fields(Tracking) if each.init}


@dataclass(frozen=True, kw_only=True)
class TrackJob(Tracking):
    """Settings of ``torch-ecc track``."""

    input: str = field(
        metadata={
            "words": "a video, a folder or glob of images, a multi-page TIFF, .npy, .npz, camera:KIND:WHICH",
            "example": "video.mp4",
        }
    )
    centers: tuple[Point, ...] = described(
        (), "centre of each template, px: x to the right, y down, pixel centres at integers", example=((320.0, 240.0),)
    )
    size: int | tuple[int, int] | None = described(None, "side of the templates, px, or height and width", example=121)
    polygons: tuple[tuple[Point, ...], ...] = described(
        (),
        "outline of each template, frame px, instead of a square or within it",
        example=(((314, 213), (340, 186), (364, 193), (364, 228), (352, 241)),),
    )
    grid: int | None = described(
        None, "this many templates of that size in a row, and rows to match, where there is texture", example=8
    )
    body: bool = described(False, "all templates are one rigid body: its pose goes into body.csv")
    bodies: int | None = described(
        None, "so many rigid bodies that move, told apart by their motion, beside what stands still", example=2
    )
    lens: str | None = described(
        None,
        "of a body: k1,k2,p1,p2 about the frame's middle, of half its diagonal, or a file.toml of te.Lens",
        example="-0.003,0.0005",
    )
    reference: str | None = described(
        None, "image to cut the templates from; without it, the first frame of the input", example="first.png"
    )
    frame_mask: str | None = described(
        None,
        "image of the frame's size, black where the camera shows a mark of its own: dust, aperture",
        example="mask.png",
    )
    find_marks: bool = described(
        False, "find such marks: what stays where it was in the first frame while the templates move"
    )
    template: tuple[str, ...] = described(
        (),
        "image of each template, instead of size: found anywhere, at any angle, nearest to its centre if given",
        example=("crop.png",),
    )
    frames: str | None = described(
        None, "FIRST:LAST:STEP, numbers of frames from 0, both ends included, each may be left out", example="100:500:2"
    )
    channel: int | None = described(None, "which one of a file's channels, from 0", example=0)
    slice: int | None = described(None, "which one of its slices (depths)", example=0)
    position: int | None = described(None, "which one of its stage positions", example=0)
    out: str | None = described(
        None, "folder for the results; without it, one here, named after the input", example="results"
    )
    force: bool = described(False, "replace the results that the folder holds")
    resume: bool = described(False, "go on where a run in this folder was stopped, killed, or out of disk space")
    stop_at_damage: bool = described(False, "end at the first damaged frame, instead of going on with the next one")
    overlay: bool = described(True, "write overlay.mp4")
    send: str | None = described(
        None, "also send each frame's poses, as one line of JSON: - is the screen, or udp://HOST:PORT", example="-"
    )
    stabilise: int | None = described(
        None, "write stabilised.mp4, in which this template, counted from 0, stands still", example=0
    )
    um_per_px: float | Point | None = described(
        None, "scale of the camera, or that of x and of y; without it, the file's own if it has one", example=0.35
    )
    flip_y: bool = described(False, "the stage counts y upwards: turns the sign of dy_um")
    axis_angle_deg: float = described(0.0, "from the camera's axes to the stage's")
    fps: float | None = described(
        None, "frames per second, instead of the times of the file's own frames", example=100.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_rate(self.fps)
        span(self.frames)
        if self.body and self.bodies is not None:
            raise ValueError("body: not with bodies, which tells the templates apart first")
        if self.bodies is not None and self.bodies < 1:
            raise ValueError(f"bodies: expected at least 1, got {self.bodies}")
        if self.find_marks and self.frame_mask is not None:
            raise ValueError("find_marks: not with frame_mask, which tells of them")

    def calibration(self, of_file: Point | None = None) -> Calibration | None:
        """Pixels to micrometres, None if neither the job nor the file tells the scale."""
        scale = self.um_per_px if self.um_per_px is not None else of_file
        if scale is None:
            if self.flip_y:
                raise ValueError("flip_y: expected with um_per_px, which the file does not tell: it is of micrometres")
            return None
        x, y = Calibration(scale).scales
        return Calibration((x, -y if self.flip_y else y), math.radians(self.axis_angle_deg))

    def rate(self, fps: float | None) -> dict[str, float]:
        """That of the frames that are tracked, of an input with ``fps``, if it matters. ValueError if nobody knows."""
        if self.line_time is None:
            return {}
        if fps is None:
            raise ValueError("line_time: expected with fps, which the input does not tell")
        return {"fps": fps / (span(self.frames).step or 1)}

    def folder(self) -> Path:
        """Where the results go."""
        if self.out is not None:
            return Path(self.out).expanduser()
        given = Path(self.input.strip()).expanduser()
        told = given.resolve().name if given.is_dir() else given.stem
        plain = re.sub(r"[^\w.-]+", "-", told).strip("-.") or given.parent.name or "frames"
        return Path(f"camera-{plain}-track" if plain.isdecimal() and not given.exists() else f"{plain}-track")


@dataclass(frozen=True, kw_only=True)
class BatchJob:
    """Settings of ``torch-ecc batch``, beside those of ``TrackJob`` for all recordings and, by ``match``, for those
    whose name or path a pattern fits; where several patterns fit, the later one wins."""

    recordings: tuple[str, ...]
    out: str = described("torch-ecc-batch", "folder for the results, one in it for each recording")
    scheduler: str | None = described(
        None, "address of a Dask scheduler, as tcp://10.0.0.1:8786; without it, one worker per core here"
    )
    workers: int | None = described(None, "so many workers here, instead of one per core")
    parts: int = described(
        1, "cut recordings that can be gone into anywhere (images, TIFF, arrays) into this many at most; no overlays"
    )
    parquet: bool = described(False, "write poses.parquet, all poses of all recordings in one table")
    retry: bool = described(False, "try those again, too, that failed before and have not changed")
    match: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("workers", "parts"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"{name}: expected 1 or more, got {value}")
        if self.scheduler is not None and not re.fullmatch(r"\w+://\S+|\S+:\d+", self.scheduler):
            raise ValueError(f"scheduler: expected an address as tcp://10.0.0.1:8786, got {self.scheduler!r}")


@dataclass(frozen=True)
class CompareJob:
    """Settings of ``torch-ecc compare``: the files ``track``, a track.csv, and ``sensors``, any log with times and one
    or more of x, y and theta. From ``signs`` on, those of ``synchrony.Unknowns``."""

    track: str
    sensors: str
    out: str = described("torch-ecc-comparison", "folder for the outputs")
    template: int = described(0, "which template of the track")
    columns: str | None = described(
        None,
        "the sensors' columns, by name or number, with a unit if their header has none: 'time=Stamp:ms, x=CH 1:um'",
    )
    sensors_hz: float | None = described(None, "samples per second of the sensors, if they have no times")
    um_per_px: float | Point | None = described(None, "scale of the camera, if the track has no micrometres")
    axis_angle_deg: float = described(0.0, "from the track's axes to the stage's, as far as known")
    fps: float | None = described(None, "frames per second, if the track has no times")
    signs: str = described("auto", "of the track's x, y and theta against the sensors'; auto tries", SIGNS)
    fixed_angle: bool = described(False, "take the axis angle as given (needed with --lever if only theta moves)")
    scale: bool = described(False, "estimate a factor between the records, too")
    lever: bool = described(False, "estimate where the template lies from the sensors' point, too")
    rate: bool = described(False, "estimate how much faster one of the clocks is, too")
    exposure_s: float = described(0.0, "exposure of the camera, which averages the motion")
    max_offset_s: float | None = described(None, "how far the two clocks may be apart; without it, any time")

    def __post_init__(self) -> None:
        _check_rate(self.fps)
        _check_rate(self.sensors_hz, "sensors_hz")
        if self.signs not in SIGNS:
            raise ValueError(f"signs: expected one of {', '.join(SIGNS)}, got {self.signs!r}")


@dataclass(frozen=True)
class Align:
    """What ``torch-ecc servo`` is to reach, and where it writes: see configs/servo.toml."""

    desired: tuple[float, float, float]
    landing: tuple[float, float]
    size: int = 121
    out: str = described("torch-ecc-servo", "folder for the outputs")
    overlay: bool = described(True, "write overlay.mp4")


def span(frames: str | None) -> slice:
    """The frames that FIRST:LAST:STEP means, LAST included. ValueError if it is something else."""
    parts = (frames or "").split(":")
    try:
        first, last, step = (int(part) if part.strip() else None for part in [*parts, "", ""][:3])
    except ValueError:
        parts = ["", "", "", ""]
    if len(parts) > 3 or (first or 0) < 0 or (last or 0) < 0 or (step is not None and step < 1):
        raise ValueError(f"frames: expected FIRST:LAST:STEP, whole numbers from 0 on, got {frames!r}")
    if len(parts) == 1 and first is not None:
        last = first
    if last is not None and last < (first or 0):
        raise ValueError(f"frames: expected LAST not to be before FIRST, got {frames!r}")
    return slice(first, None if last is None else last + 1, step)


def _check_rate(hz: float | None, name: str = "fps") -> None:
    if hz is not None and not 0 < hz < math.inf:
        raise ValueError(f"{name}: expected a rate > 0 in Hz, got {hz:g}")
