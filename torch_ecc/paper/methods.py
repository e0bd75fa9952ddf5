"""The methods that are compared, each as Algorithm 1: templates prepared once, every frame started at the last pose."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.align import align
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.reference import MARGIN, Reference, prepare
from torch_ecc.paper.ref34 import Ref34

PAPER_ITERATIONS = 15


class Aligned:
    """Templates (R, 1, h + 2 MARGIN, w + 2 MARGIN) prepared once with ``options``, then aligned frame by frame.

    ``found``: the record of the last frame. What is not found stays where it was.
    """

    found: Estimate
    iterations: Tensor

    def __init__(self, templates: Tensor, pose: Tensor, options: Mapping[str, Any], interpolation: str) -> None:
        self.reference = prepared(templates, options)
        self.pose, self.interpolation = pose.clone(), interpolation

    def track(self, frame: Tensor) -> Tensor:
        """Poses (R, 3) in the next frame."""
        settings: dict[str, Any] = {"interpolation": self.interpolation, "max_iterations": PAPER_ITERATIONS}
        self.found = align(self.reference, frame, self.pose, **settings)
        self.pose, self.iterations = self.found.pose, self.found.iterations
        return self.pose


def prepared(templates: Tensor, options: Mapping[str, Any]) -> Reference:
    """Everything constant of templates that come with their surroundings."""
    mask = torch.zeros(templates.shape[-2:], dtype=torch.bool)
    mask[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    return prepare(templates, mask=mask, **options)


Follower = Aligned | Ref34  # both have ``pose``, ``track`` and the ``iterations`` that the last frame took


class Method(NamedTuple):
    """A method's name in words, how it is drawn, and its options; None are those of ref. 34, which prepares nothing."""

    label: str
    colour: str
    dashes: str
    options: Mapping[str, Any] | None

    def start(self, templates: Tensor, pose: Tensor, interpolation: str = "bspline3") -> Follower:
        """A follower of templates (R, 1, h + 2 MARGIN, w + 2 MARGIN) that are at poses (R, 3) now."""
        if self.options is None:
            return Ref34(templates, pose, interpolation=interpolation, max_iterations=PAPER_ITERATIONS)
        return Aligned(templates, pose, self.options, interpolation)


METHODS: dict[str, Method] = {
    "gain": Method("ecc, gain (the paper's ECC)", "#e69f00", "-", {"illumination": "gain"}),
    "linear": Method("ecc, linear (default)", "#0b6e4f", "-", {"illumination": "linear"}),
    "quadratic": Method("ecc, quadratic", "#56b4e9", "--", {"illumination": "quadratic"}),
    "ecc_paper": Method("ecc_paper (eq. 9 to the letter)", "#7b4ea3", ":", {"criterion": "ecc_paper"}),
    "ssd": Method("ssd", "#c8553d", "-", {"criterion": "ssd"}),
    "ref34": Method("ref. 34 (SSD, Hessian anew)", "#333333", ":", None),
}


def errors(pose: Tensor, truth: Tensor) -> Tensor:
    """Pose minus truth, (..., 3) px, px, rad -> px, px, deg."""
    return (pose - truth) * pose.new_tensor((1.0, 1.0, math.degrees(1.0)))


def largest(error: Tensor) -> tuple[float, float]:
    """Largest error (px, deg) of (..., 3) px, px, deg; px: the larger of x and y."""
    x, y, theta = error.abs().flatten(0, -2).amax(0).tolist()
    return max(x, y), theta
