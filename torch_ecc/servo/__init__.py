"""Visual servoing (section V): a controller that drives any stage to a pose seen in its camera's picture."""

from torch_ecc.servo.alignment import Alignment, Part, align_parts
from torch_ecc.servo.control import Control, Controller
from torch_ecc.servo.detect import find
from torch_ecc.servo.jacobian import Jacobian, StageJacobian
from torch_ecc.servo.loop import servo
from torch_ecc.servo.micromanager import MicroManagerStage
from torch_ecc.servo.plant import Limits, Plant
from torch_ecc.servo.record import Ending, Log, Result, Step, decay_rate

__all__ = [
    "Alignment",
    "Control",
    "Controller",
    "Ending",
    "Jacobian",
    "Limits",
    "Log",
    "MicroManagerStage",
    "Part",
    "Plant",
    "Result",
    "StageJacobian",
    "Step",
    "align_parts",
    "decay_rate",
    "find",
    "servo",
]
