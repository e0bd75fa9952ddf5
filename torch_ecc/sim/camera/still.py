"""Scenes and lights from a still image in a file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_ecc.sim.camera.light import FieldLight
from torch_ecc.sim.scene.image import ImageScene
from torch_ecc.sim.scene.retinex import Retinex, single_scale


def read_still(path: Path | str) -> Tensor:
    """A still as grey levels of 0..255: (h, w) float64; 8 and 16 bit, colour turned to grey, floats taken as they are.

    ValueError, with the path, if there is no such file or it is no image.
    """
    if not Path(path).is_file():
        raise ValueError(f"read_still: no such still: {path}")
    image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise ValueError(f"read_still: not an image: {path}")
    white = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}.get(image.dtype, 255.0)
    return torch.from_numpy(image.astype(np.float64) * (255.0 / white))


def image_scene(
    path: Path | str,
    *,
    reflected: bool = True,
    sigma: float = 80.0,
    scale: float = 1.0,
    origin: tuple[float, float] | None = None,
) -> ImageScene:
    """The scene of a still, of its ``reflected`` component by default (single-scale Retinex of ``sigma`` px).

    ``scale`` scene px per still px; ``origin`` (x, y) still px of the scene's origin, the centre unless given.
    """
    image = read_still(path)
    surface = _split(image, sigma).surface()[0, 0] if reflected else image
    return ImageScene.of(surface, scale=scale, origin=origin)


def image_light(path: Path | str, *, sigma: float = 80.0) -> FieldLight:
    """The light that fell on a still: its incident component (single-scale Retinex of ``sigma`` px)."""
    return FieldLight(_split(read_still(path), sigma).incident[0, 0])


def _split(image: Tensor, sigma: float) -> Retinex:
    return single_scale(image[None, None], sigma)
