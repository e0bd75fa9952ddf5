"""What the tags of a TIFF tell of its scale and its clock: ImageJ's, OME's, Zeiss LSM's and Micro-Manager's."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from torch_ecc.io.frames import nominal_rate

_UM = {"nm": 1e-3, "um": 1.0, "µm": 1.0, "μm": 1.0, "\\u00b5m": 1.0, "micron": 1.0, "microns": 1.0, "mm": 1e3, "m": 1e6}
_SECONDS = {"ms": 1e-3, "msec": 1e-3, "s": 1.0, "sec": 1.0, "second": 1.0, "min": 60.0, "h": 3600.0, "hour": 3600.0}
_MICRO_MANAGER = 51123


class Tags(NamedTuple):
    """``um_per_px`` (x, y), nominal rate in Hz and the time in s of a frame and its plane; each None if unknown."""

    um_per_px: tuple[float, float] | None = None
    fps: float | None = None
    time_s: Callable[[int, int], float | None] = lambda frame, plane: None


def read_tags(tif: Any, position: int, planes: Sequence[int]) -> Tags:
    """Of a file, whose ``planes`` of a stage ``position`` are read. What is there and makes no sense is passed over."""
    for read in (_ome, _lsm, _imagej, _micro_manager):
        try:
            tags = read(tif, position, planes)
        except (ET.ParseError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            continue
        if tags is not None:
            return tags
    return Tags()


def _every(seconds: float | None) -> tuple[float | None, Callable[[int, int], float | None]]:
    """Rate and times of frames that follow each other in ``seconds``."""
    if not seconds or not 0 < seconds < math.inf:
        return None, Tags().time_s
    return 1 / seconds, lambda frame, plane: frame * seconds


def _scale(x: float, y: float) -> tuple[float, float] | None:
    return (x, y) if 0 < x < math.inf and 0 < y < math.inf else None


def _imagej(tif: Any, _: int, __: Sequence[int]) -> Tags | None:
    if tif.imagej_metadata is None:
        return None
    told, page = tif.imagej_metadata, tif.pages.first
    interval = told.get("finterval")
    fps, time_s = _every(interval and float(interval) * _SECONDS.get(str(told.get("tunit", "s")), math.nan))
    unit, scale = _UM.get(str(told.get("unit", "")).strip().lower()), None
    if unit:
        (a, b), (c, d) = (page.tags[name].value for name in ("XResolution", "YResolution"))
        scale = _scale(b / a * unit, d / c * unit)
    return Tags(scale, fps, time_s)


def _ome(tif: Any, position: int, planes: Sequence[int]) -> Tags | None:
    if tif.ome_metadata is None:
        return None
    root = ET.fromstring(tif.ome_metadata)
    pixels = [each for each in root.iter() if each.tag.rpartition("}")[2] == "Pixels"][position]
    told, scale = pixels.attrib, None
    if "PhysicalSizeX" in told:
        x, y = (
            float(told.get(f"PhysicalSize{a}", told["PhysicalSizeX"])) * _UM[told.get(f"PhysicalSize{a}Unit", "µm")]
            for a in "XY"
        )
        scale = _scale(x, y)
    times = _ome_times(pixels)
    if times:
        rate = nominal_rate(times[plane] for plane in planes if plane in times)
        return Tags(scale, rate, lambda frame, plane: times.get(plane))
    return Tags(scale, *_every(float(told.get("TimeIncrement", 0)) * _SECONDS[told.get("TimeIncrementUnit", "s")]))


def _ome_times(pixels: ET.Element) -> dict[int, float]:
    """By number of the plane, in the order in which the file's axes run, its time in s."""
    order = [letter for letter in reversed(pixels.attrib["DimensionOrder"]) if letter not in "XY"]
    sizes = {letter: int(pixels.attrib[f"Size{letter}"]) for letter in order}
    times = {}
    for plane in pixels:
        told = plane.attrib
        if plane.tag.rpartition("}")[2] != "Plane" or "DeltaT" not in told:
            continue
        number = 0
        for letter in order:
            number = number * sizes[letter] + int(told[f"The{letter}"])
        times[number] = float(told["DeltaT"]) * _SECONDS[told.get("DeltaTUnit", "s")]
    return times


def _lsm(tif: Any, _: int, __: Sequence[int]) -> Tags | None:
    if tif.lsm_metadata is None:
        return None
    told = tif.lsm_metadata
    times = [float(each) for each in told.get("TimeStamps", ())]
    scale = _scale(told["VoxelSizeX"] * 1e6, told["VoxelSizeY"] * 1e6)
    return Tags(scale, nominal_rate(times), lambda frame, plane: times[frame] if frame < len(times) else None)


def _micro_manager(tif: Any, _: int, __: Sequence[int]) -> Tags | None:
    if not tif.is_micromanager:
        return None

    def told(plane: int) -> dict[str, Any]:
        try:
            tag = tif.pages[plane].tags.get(_MICRO_MANAGER)
        except Exception:  # the page is damaged, which its reading tells
            return {}
        return tag.value if tag is not None and isinstance(tag.value, dict) else {}

    def time_s(frame: int, plane: int) -> float | None:
        elapsed = told(plane).get("ElapsedTime-ms")
        return None if elapsed is None else float(elapsed) / 1000

    size = float(told(0).get("PixelSizeUm", 0))
    return Tags(_scale(size, size), None, time_s)
