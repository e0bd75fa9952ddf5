"""Planar pose tracking (x, y, theta) of textured patches, to a thousandth of a pixel, with an honest uncertainty.

``Tracker`` follows patches through a video; ``prepare`` and ``align`` are the pure functions under it; ``locate``
finds a patch anywhere, at any angle; ``texture`` judges it beforehand, ``texture_map`` every place of a frame; ``Body``
makes one pose of many patches, behind a ``Lens``; ``stabilise`` warps frames back onto the first; ``batch`` tracks many
recordings; ``Calibration`` turns pixels into micrometres. Conventions: see ``torch_ecc.pose``.

Names are fetched when they are first used: ``import torch_ecc`` alone does not even bring torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors read; the same places as below
    from torch_ecc.body.body import Body, BodyEstimate
    from torch_ecc.body.calibrate import SelfCalibration, calibrate
    from torch_ecc.body.centre import RotationCentre, rotation_centre
    from torch_ecc.body.grouping import Groups, rigid_groups
    from torch_ecc.commands.batch import Batch, batch
    from torch_ecc.core import pose
    from torch_ecc.core.align import align
    from torch_ecc.core.criteria import ECC, SSD, Criterion, PaperECC
    from torch_ecc.core.estimate import Estimate, Origin, Reason, Status, Track
    from torch_ecc.core.patches import texture
    from torch_ecc.core.reference import Reference, prepare
    from torch_ecc.core.texture_map import TextureMap, texture_map
    from torch_ecc.records.calibration import Calibration, CalibrationFit
    from torch_ecc.records.lens import Lens
    from torch_ecc.search.locate import Located, Locator, locate
    from torch_ecc.track.frame_mask import suggest_frame_mask
    from torch_ecc.track.own_mask import suggest_mask
    from torch_ecc.track.sequence import SequenceError
    from torch_ecc.track.stabilise import stabilise
    from torch_ecc.track.tracker import Tracker

__version__ = "0.1.0"

_PLACES = {
    "body.body": ["Body", "BodyEstimate"],
    "body.calibrate": ["SelfCalibration", "calibrate"],
    "body.centre": ["RotationCentre", "rotation_centre"],
    "body.grouping": ["Groups", "rigid_groups"],
    "commands.batch": ["Batch", "batch"],
    "core.pose": ["pose"],
    "core.align": ["align"],
    "core.criteria": ["ECC", "SSD", "Criterion", "PaperECC"],
    "core.estimate": ["Estimate", "Origin", "Reason", "Status", "Track"],
    "core.patches": ["texture"],
    "core.reference": ["Reference", "prepare"],
    "core.texture_map": ["TextureMap", "texture_map"],
    "records.calibration": ["Calibration", "CalibrationFit"],
    "records.lens": ["Lens"],
    "search.locate": ["Located", "Locator", "locate"],
    "track.frame_mask": ["suggest_frame_mask"],
    "track.own_mask": ["suggest_mask"],
    "track.stabilise": ["stabilise"],
    "track.sequence": ["SequenceError"],
    "track.tracker": ["Tracker"],
}

__all__ = [
    "ECC",
    "SSD",
    "Batch",
    "Body",
    "BodyEstimate",
    "Calibration",
    "CalibrationFit",
    "Criterion",
    "Estimate",
    "Groups",
    "Lens",
    "Located",
    "Locator",
    "Origin",
    "PaperECC",
    "Reason",
    "Reference",
    "RotationCentre",
    "SelfCalibration",
    "SequenceError",
    "Status",
    "TextureMap",
    "Track",
    "Tracker",
    "align",
    "batch",
    "calibrate",
    "locate",
    "pose",
    "prepare",
    "rigid_groups",
    "rotation_centre",
    "stabilise",
    "suggest_frame_mask",
    "suggest_mask",
    "texture",
    "texture_map",
]


def __getattr__(name: str) -> Any:
    for place, names in _PLACES.items():
        if name in names:
            module = import_module(f"torch_ecc.{place}")
            globals()[name] = value = module if name == "pose" else getattr(module, name)
            return value
    raise AttributeError(f"module 'torch_ecc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
