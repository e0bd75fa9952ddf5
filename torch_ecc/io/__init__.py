"""Frames in (``open_frames``), results out (``TrackWriter``, ``OverlayWriter``)."""

from torch_ecc.io.frames import Frame, FrameError, FrameSource
from torch_ecc.io.overlay import OverlayWriter
from torch_ecc.io.reading import open_frames
from torch_ecc.io.records import Record, StatusNames
from torch_ecc.io.track import TrackWriter

__all__ = ["Frame", "FrameError", "FrameSource", "OverlayWriter", "Record", "StatusNames", "TrackWriter", "open_frames"]
