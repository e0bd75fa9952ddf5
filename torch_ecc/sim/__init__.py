"""Simulators: scenes, motion, light, camera (truth is made here, never with the tracker's own interpolation)."""

from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.dataset import SavedSequence, SequenceDataset, save
from torch_ecc.sim.camera.light import FieldLight, GradientLight, LampDrift, Lights, SpotLight, VignetteLight
from torch_ecc.sim.camera.motion import circle, from_rest, harmonic, placed, ramp, random_walk, steps, table
from torch_ecc.sim.camera.occluder import Occluder
from torch_ecc.sim.camera.sensor import Drift, noise_sigma
from torch_ecc.sim.camera.sequence import Sequence, check_inside
from torch_ecc.sim.config import Simulation, from_config
from torch_ecc.sim.scene.image import ImageScene
from torch_ecc.sim.scene.micrograph import micrograph
from torch_ecc.sim.scene.retinex import Retinex, multi_scale, single_scale
from torch_ecc.sim.scene.scene import Pads, PlaneWaves, Scene, Speckle, Sum
from torch_ecc.sim.stage.hysteresis import Hysteresis
from torch_ecc.sim.stage.microscope import Microscope
from torch_ecc.sim.stage.mounting import Mounting, MountingFit, calibrate_mounting
from torch_ecc.sim.stage.sensors import (
    ErrorBudget,
    SensorRecord,
    Sensors,
    SensorSettings,
    error_budget,
    nonlinear_modes,
)
from torch_ecc.sim.stage.stage import Stage, StageMotion, StageSettings
from torch_ecc.sim.stage.vibration import Floor, Vibration

__all__ = [
    "Camera",
    "Drift",
    "ErrorBudget",
    "FieldLight",
    "Floor",
    "GradientLight",
    "Hysteresis",
    "ImageScene",
    "LampDrift",
    "Lights",
    "Microscope",
    "Mounting",
    "MountingFit",
    "Occluder",
    "Pads",
    "PlaneWaves",
    "Retinex",
    "SavedSequence",
    "Scene",
    "SensorRecord",
    "SensorSettings",
    "Sensors",
    "Sequence",
    "SequenceDataset",
    "Simulation",
    "Speckle",
    "SpotLight",
    "Stage",
    "StageMotion",
    "StageSettings",
    "Sum",
    "Vibration",
    "VignetteLight",
    "calibrate_mounting",
    "check_inside",
    "circle",
    "error_budget",
    "from_config",
    "from_rest",
    "harmonic",
    "micrograph",
    "multi_scale",
    "noise_sigma",
    "nonlinear_modes",
    "placed",
    "ramp",
    "random_walk",
    "save",
    "single_scale",
    "steps",
    "table",
]
