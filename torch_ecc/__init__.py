"""Planar pose tracking (x, y, theta) of textured patches, to a thousandth of a pixel, with an honest uncertainty.

``Tracker`` follows patches through a video; ``prepare`` and ``align`` are the pure functions under it; ``locate``
finds a patch anywhere, at any angle; ``texture`` judges it beforehand; ``Calibration`` turns pixels into micrometres.
Conventions: see ``torch_ecc.pose``.
"""

from torch_ecc.core import pose
from torch_ecc.core.align import align
from torch_ecc.core.criteria import ECC, SSD, Criterion, PaperECC
from torch_ecc.core.estimate import Estimate, Origin, Status, Track
from torch_ecc.core.patches import texture
from torch_ecc.core.reference import Reference, prepare
from torch_ecc.records.calibration import Calibration, CalibrationFit, calibrate
from torch_ecc.search.locate import Located, Locator, locate
from torch_ecc.track.tracker import SequenceError, Tracker

__version__ = "0.1.0"

__all__ = [
    "ECC",
    "SSD",
    "Calibration",
    "CalibrationFit",
    "Criterion",
    "Estimate",
    "Located",
    "Locator",
    "Origin",
    "PaperECC",
    "Reference",
    "SequenceError",
    "Status",
    "Track",
    "Tracker",
    "align",
    "calibrate",
    "locate",
    "pose",
    "prepare",
    "texture",
]
