"""What the commands can be told: one record each, whose fields are the options and the keys of a configuration file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from itertools import product
from typing import Any

from torch_ecc.core.criteria import CRITERIA, ILLUMINATION
from torch_ecc.core.settings import Settings, described
from torch_ecc.records.calibration import Calibration
from torch_ecc.track.tracker import PREDICTIONS

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
    device: str | None = described(None, "without it, the CPU", example="cuda")

    def options(self) -> dict[str, Any]:
        """The keyword arguments of ``Tracker``."""
        return {each.name: getattr(self, each.name) for each in fields(Tracking) if each.init}


@dataclass(frozen=True, kw_only=True)
class TrackJob(Tracking):
    """Settings of ``torch-ecc track``."""

    input: str = field(
        metadata={
            "words": "a video, a folder or glob of images, a multi-page TIFF, .npy, .npz, a camera index",
            "example": "video.mp4",
        }
    )
    centers: tuple[Point, ...] = described(
        (), "centre of each template, px: x to the right, y down, pixel centres at integers", example=((320.0, 240.0),)
    )
    size: int | tuple[int, int] | None = described(
        None, "side of the templates, px; in a file also [height, width]", example=121
    )
    polygons: tuple[tuple[Point, ...], ...] = described(
        (),
        "outline of each template, frame px, instead of a square or within it",
        example=(((314, 213), (340, 186), (364, 193), (364, 228), (352, 241)),),
    )
    reference: str | None = described(
        None, "image to cut the templates from; without it, the first frame of the input", example="first.png"
    )
    template: tuple[str, ...] = described(
        (),
        "image of each template, instead of size: found anywhere, at any angle, nearest to its centre if given",
        example=("crop.png",),
    )
    out: str = described("torch-ecc-out", "folder for track.csv, track.npz, track.png, summary.json and overlay.mp4")
    overlay: bool = described(True, "write overlay.mp4")
    um_per_px: float | Point | None = described(
        None,
        "scale of the camera, adds micrometres; in a file also [x, y], negative against a stage's axis",
        example=0.35,
    )
    axis_angle_deg: float = described(0.0, "from the camera's axes to the stage's")
    fps: float | None = described(
        None, "frames per second, adds times; without it, the video's own if it has one", example=100.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_rate(self.fps)

    def calibration(self) -> Calibration | None:
        """Pixels to micrometres, None if the scale is not given."""
        if self.um_per_px is None:
            return None
        return Calibration(self.um_per_px, math.radians(self.axis_angle_deg))


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


def _check_rate(hz: float | None, name: str = "fps") -> None:
    if hz is not None and not 0 < hz < math.inf:
        raise ValueError(f"{name}: expected a rate > 0 in Hz, got {hz:g}")
