"""GenICam cameras, GigE Vision and USB3 Vision, through Aravis; its own fake camera too, as ``Fake_1``."""

from __future__ import annotations

from typing import Any

import numpy as np

from torch_ecc.io.cameras.newest import Newest
from torch_ecc.io.frames import Pixels

BUFFERS = 16  # pictures that may wait while Python is busy
TIMEOUT_US = 5_000_000
_BITS = 16  # a GenICam pixel format tells its bits per pixel from here on


def open_aravis(which: str) -> tuple[Newest, float | None]:
    """The camera with this id as ``arv-tool`` lists it, the first one without; its rate if it tells. ValueError if it
    is not there, ModuleNotFoundError without PyGObject."""
    Aravis, GLib = _libraries()
    try:
        Aravis.enable_interface("Fake")
        camera = Aravis.Camera.new(which or None)
        stream, size = camera.create_stream(None, None), camera.get_payload()
        for _ in range(BUFFERS):
            stream.push_buffer(Aravis.Buffer.new_allocate(size))
        camera.set_acquisition_mode(Aravis.AcquisitionMode.CONTINUOUS)
        camera.start_acquisition()
        rate = camera.get_frame_rate() if camera.is_frame_rate_available() else None
    except GLib.Error as error:
        raise ValueError(f"open_frames: no GenICam camera {which} can be opened ({error.message})") from error

    def read() -> tuple[Pixels, int]:
        while True:
            buffer = stream.timeout_pop_buffer(TIMEOUT_US)
            if buffer is None:
                raise ValueError("the GenICam camera sends no picture any more")
            try:
                if buffer.get_status() == Aravis.BufferStatus.SUCCESS:  # one that lacks packets counts as lost
                    return _pixels(buffer), int(buffer.get_frame_id())
            finally:
                stream.push_buffer(buffer)

    return Newest(read, camera.stop_acquisition), rate


def _libraries() -> tuple[Any, Any]:
    """Aravis and GLib. ValueError without Aravis itself, which the system's packages bring."""
    import gi

    try:
        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise ValueError("open_frames: an aravis camera needs Aravis: apt install gir1.2-aravis-0.8") from error
    return Aravis, GLib


def _pixels(buffer: Any) -> Pixels:
    """(H, W) or (H, W, 3). ValueError for pixels that do not stand on whole bytes."""
    bits = buffer.get_image_pixel_format() >> _BITS & 0xFF
    if bits not in (8, 16, 24):
        raise ValueError(f"the GenICam camera sends {bits} bits per pixel: set it to Mono8, Mono10, Mono12 or RGB8")
    shape = (buffer.get_image_height(), buffer.get_image_width(), *((3,) if bits == 24 else ()))
    flat = np.frombuffer(buffer.get_data(), "<u2" if bits == 16 else "u1", count=int(np.prod(shape)))
    return flat.reshape(shape).copy()
