"""Live cameras as a source of frames: ``camera:KIND:WHICH``, or whatever has a ``grab``."""

from __future__ import annotations

import atexit
import time
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Final

from torch_ecc.io.cameras.newest import WAIT_S, Camera, Newest
from torch_ecc.io.frames import Arrival, FrameError, Medium, Raw

KINDS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {  # where they are opened, and the extra that brings their library
        "opencv": ("open_opencv", ""),
        "micromanager": ("open_micromanager", "micromanager"),
        "basler": ("open_basler", "basler"),
        "aravis": ("open_aravis", "aravis"),
        "test": ("open_test", ""),
    }
)
PREFIX = "camera:"
_MODULES = {"test": "test_pattern"}


def open_live(address: str) -> Medium:
    """The camera at ``camera:KIND:WHICH``, where a number alone is OpenCV's. ValueError if it cannot be opened."""
    kind, _, which = address.removeprefix(PREFIX).partition(":")
    if kind.isdecimal() and not which:
        kind, which = "opencv", kind
    if kind not in KINDS:
        raise ValueError(
            f"open_frames: a camera is {PREFIX}KIND:WHICH, KIND one of {', '.join(KINDS)}, got {address!r}"
        )
    if (kind, which) not in _OPEN or _OPEN[kind, which][0].ended:
        _OPEN[kind, which] = _opened(kind, which)
    camera, fps = _OPEN[kind, which]
    return medium_of(camera, f"camera {which or kind}", fps)


def close_cameras() -> None:
    """All that were opened by their address: they run on until then."""
    for camera, _ in _OPEN.values():
        camera.close()
    _OPEN.clear()


_OPEN: dict[tuple[str, str], tuple[Newest, float | None]] = {}  # a device can be opened once: all share it
atexit.register(close_cameras)  # their threads must not be in a driver when the interpreter ends


def _opened(kind: str, which: str) -> tuple[Newest, float | None]:
    opener, extra = KINDS[kind]
    module = import_module(f"torch_ecc.io.cameras.{_MODULES.get(kind, kind)}")
    open_it: Callable[[str], tuple[Newest, float | None]] = getattr(module, opener)
    try:
        return open_it(which)
    except ModuleNotFoundError as error:
        how = f"pip install 'torch-ecc[{extra}]'"
        raise ValueError(f"open_frames: a {kind} camera needs {error.name}: {how}") from error


def medium_of(camera: Camera, name: str, fps: float | None = None) -> Medium:
    """Frames of a camera from when they are asked for, numbered from 0 by its own count, at the times of their
    arrival. It ends only where it is asked for no more, or with a FrameError."""

    def read(numbers: range) -> Iterator[Raw]:
        first, number = camera.grab(), -1
        if first is not None and time.perf_counter() - first.time_s > WAIT_S:  # one of before
            first = camera.grab()
        shot = None if first is None else first._replace(lost=0)
        while shot is not None and first is not None:
            number = shot.number - first.number
            if number >= numbers.stop:
                return
            if number in numbers:
                arrival = Arrival(shot.time_s, shot.lost)
                yield Raw(number, shot.pixels, shot.time_s - first.time_s, arrival=arrival)
            shot = camera.grab()
        raise FrameError(number + 1, f"{name} delivers no frame any more")

    return Medium(read, None, fps, live=True)
