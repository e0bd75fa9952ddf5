"""Planar pose tracking (x, y, theta) of textured patches, to a thousandth of a pixel, with an honest uncertainty.

``Tracker`` follows patches through a video; ``prepare`` and ``align`` are the pure functions under it; ``locate``
finds a patch anywhere, at any angle; ``texture`` judges it beforehand; ``Calibration`` turns pixels into micrometres.
Conventions: see ``torch_ecc.pose``.
"""

from torch_ecc import pose
from torch_ecc.align import align
from torch_ecc.calibration import Calibration, CalibrationFit, calibrate
from torch_ecc.criteria import ECC, SSD, Criterion, PaperECC
from torch_ecc.estimate import Estimate, Status, Track
from torch_ecc.locate import Located, Locator, locate
from torch_ecc.patches import texture
from torch_ecc.reference import Reference, prepare
from torch_ecc.tracker import SequenceError, Tracker

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
