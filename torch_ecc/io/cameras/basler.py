"""Basler cameras, through pylon; its emulator too, where PYLON_CAMEMU says so."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from torch_ecc.io.cameras.newest import Newest
from torch_ecc.io.frames import Pixels

TIMEOUT_MS = 5000


def open_basler(which: str) -> tuple[Newest, float | None]:
    """The camera with this serial number, the first one without; its rate if it tells. ValueError if it is not there,
    ModuleNotFoundError without pypylon."""
    from pypylon import pylon

    try:
        camera = pylon.InstantCamera(_device(pylon, which))
        camera.Open()
        camera.StartGrabbing(pylon.GrabStrategy_OneByOne)
    except pylon.GenericException as error:
        raise ValueError(f"open_frames: no Basler camera {which} can be opened ({error})") from error

    def read() -> tuple[Pixels, int] | None:
        if not camera.IsGrabbing():
            return None
        result = camera.RetrieveResult(TIMEOUT_MS, pylon.TimeoutHandling_ThrowException)
        with result:
            if not result.GrabSucceeded():
                raise ValueError(f"the Basler camera: {result.ErrorDescription}")
            return np.array(result.Array), int(result.ImageNumber)

    return Newest(read, camera.Close), _rate(pylon, camera)


def _rate(pylon: Any, camera: Any) -> float | None:
    """Hz, by the name that this camera has for it."""
    for name in ("ResultingFrameRate", "ResultingFrameRateAbs"):
        with suppress(pylon.GenericException):
            return float(getattr(camera, name).Value)
    return None


def _device(pylon: Any, which: str) -> Any:
    factory = pylon.TlFactory.GetInstance()
    if not which:
        return factory.CreateFirstDevice()
    wanted = pylon.CDeviceInfo()
    wanted.SetSerialNumber(which)
    return factory.CreateDevice(wanted)
