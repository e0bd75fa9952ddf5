"""Frames in (``open_frames``), results out (``TrackWriter``, ``OverlayWriter``)."""

from torch_ecc.io.frames import FrameError, FrameSource
from torch_ecc.io.reading import open_frames

__all__ = ["FrameError", "FrameSource", "open_frames"]
