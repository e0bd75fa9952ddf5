"""Simulators: scenes, motion, light, camera (truth is made here, never with the tracker's own interpolation)."""

from torch_ecc.sim.camera import Camera
from torch_ecc.sim.config import Simulation, from_config
from torch_ecc.sim.dataset import SavedSequence, SequenceDataset, save
from torch_ecc.sim.image import ImageScene
from torch_ecc.sim.light import FieldLight, GradientLight, LampDrift, Lights, SpotLight, VignetteLight
from torch_ecc.sim.micrograph import micrograph
from torch_ecc.sim.motion import circle, from_rest, harmonic, placed, ramp, random_walk, steps, table
from torch_ecc.sim.occluder import Occluder
from torch_ecc.sim.retinex import Retinex, multi_scale, single_scale
from torch_ecc.sim.scene import Pads, PlaneWaves, Scene, Speckle, Sum
from torch_ecc.sim.sensor import Drift, noise_sigma
from torch_ecc.sim.sequence import Sequence, check_inside

__all__ = [
    "Camera",
    "Drift",
    "FieldLight",
    "GradientLight",
    "ImageScene",
    "LampDrift",
    "Lights",
    "Occluder",
    "Pads",
    "PlaneWaves",
    "Retinex",
    "SavedSequence",
    "Scene",
    "Sequence",
    "SequenceDataset",
    "Simulation",
    "Speckle",
    "SpotLight",
    "Sum",
    "VignetteLight",
    "check_inside",
    "circle",
    "from_config",
    "from_rest",
    "harmonic",
    "micrograph",
    "multi_scale",
    "noise_sigma",
    "placed",
    "ramp",
    "random_walk",
    "save",
    "single_scale",
    "steps",
    "table",
]
