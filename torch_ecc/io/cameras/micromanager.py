"""Cameras that Micro-Manager drives, through pymmcore-plus."""

from __future__ import annotations

import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from torch_ecc.io.cameras.newest import Newest
from torch_ecc.io.frames import Pixels

POLL_S = 0.0005


@lru_cache(maxsize=1)
def open_core(which: str) -> Any:
    """Micro-Manager's core with the devices of a configuration file, or of its demonstration if that is "demo".

    ValueError if it cannot be loaded, ModuleNotFoundError without pymmcore-plus.
    """
    from pymmcore_plus import CMMCorePlus

    core = CMMCorePlus()
    try:
        core.loadSystemConfiguration(str(_demo(core) if which == "demo" else Path(which).expanduser()))
    except (RuntimeError, OSError) as error:
        raise ValueError(f"open_frames: Micro-Manager cannot load {which!r} ({error})") from error
    # Nobody listens to the core's events, and one that comes while the process ends aborts it.
    super(CMMCorePlus, core).registerCallback(None)
    camera = core.getCameraDevice()
    if which == "demo" and core.hasProperty(camera, "Mode"):
        core.setProperty(camera, "Mode", "Fluorescent Beads")  # which move with the stage
    return core


def _demo(core: Any) -> Path | str:
    """The demonstration: of the test adapters if they are there, else Micro-Manager's own."""
    try:
        from mm_test_adapters import device_adapter_path
    except ModuleNotFoundError:
        return "MMConfig_demo.cfg"
    folder = Path(device_adapter_path())
    core.setDeviceAdapterSearchPaths([str(folder)])
    return folder / "MMConfig_demo.cfg"


def open_micromanager(which: str) -> tuple[Newest, float | None]:
    """The camera of a configuration, running; its rate by its exposure. ValueError if there is none."""
    core = open_core(which or "demo")
    if not core.getCameraDevice():
        raise ValueError(f"open_frames: {which} has no camera")
    camera = stream(core)
    exposure = float(core.getExposure())
    return camera, 1000 / exposure if exposure > 0 else None


def stream(core: Any) -> Newest:
    """The current camera of a core, running until it is closed."""
    core.startContinuousSequenceAcquisition(0)

    def read() -> tuple[Pixels, int] | None:
        while core.getRemainingImageCount() == 0:
            if not core.isSequenceRunning():
                return None
            time.sleep(POLL_S)
        pixels, tags = core.popNextImageAndMD()
        return np.asarray(pixels), int(tags["ImageNumber"])

    return Newest(read, core.stopSequenceAcquisition)
