"""Outlines of templates, in the template's own coordinates: px from its centre."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
import torch
from torch import Tensor

Shape: TypeAlias = tuple[int, int] | Tensor
"""What a template covers: its (h, w) in px, or its mask (h, w), where true or not zero counts."""


def outlines(shape: Shape) -> list[Tensor]:
    """Closed lines (N, 2) float64 of (x, y): the rectangle around the outer pixels, or the parts and holes of the mask.

    ValueError if ``shape`` is neither, or an empty mask.
    """
    if isinstance(shape, Tensor):
        return _mask_outlines(shape)
    h, w = shape
    if h <= 0 or w <= 0:
        raise ValueError(f"outlines: shape must be (h, w) in px, both positive, got {(h, w)}")
    half = torch.tensor((w / 2, h / 2), dtype=torch.float64)
    return [half * torch.tensor(((-1, -1), (1, -1), (1, 1), (-1, 1)), dtype=torch.float64)]


def _mask_outlines(mask: Tensor) -> list[Tensor]:
    if mask.dim() != 2 or not mask.any():
        raise ValueError(f"outlines: a mask must be (h, w) and not empty, got {tuple(mask.shape)}")
    solid = (mask != 0).cpu().numpy().astype(np.uint8)
    contours: Sequence[cv2.typing.MatLike] = cv2.findContours(solid, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
    centre = torch.tensor(((mask.shape[1] - 1) / 2, (mask.shape[0] - 1) / 2), dtype=torch.float64)
    # Half a pixel of simplification takes the stairs out of slanted edges.
    simple = (cv2.approxPolyDP(contour, 0.6, closed=True) for contour in contours)
    return [torch.from_numpy(polygon[:, 0].astype(np.float64)) - centre for polygon in simple]
