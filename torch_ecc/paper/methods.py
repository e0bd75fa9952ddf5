"""The methods that are compared, each as Algorithm 1: templates prepared once, every frame started at the last pose."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.align import align
from torch_ecc.core.pose import retract
from torch_ecc.core.reference import MARGIN, Reference, prepare
from torch_ecc.core.sampling import Sampler, make_sampler
from torch_ecc.paper.ref34 import PAPER_ITERATIONS, Ref34


class Aligned:
    """Templates (R, 1, h + 2 MARGIN, w + 2 MARGIN) prepared once with ``options``, then aligned frame by frame.

    ``status`` and ``iterations`` (R,) are of the last frame. What is not found stays where it was.
    """

    status: Tensor
    iterations: Tensor

    def __init__(self, templates: Tensor, pose: Tensor, options: Mapping[str, Any], interpolation: str) -> None:
        self.pose, self.interpolation = pose.clone(), interpolation
        self.precompute = partial(prepared, templates, options)
        self.reference = self.precompute()

    def track(self, frame: Tensor) -> Tensor:
        """Poses (R, 3) in the next frame."""
        settings: dict[str, Any] = {"interpolation": self.interpolation, "max_iterations": PAPER_ITERATIONS}
        found = align(self.reference, frame, self.pose, robust=False, **settings)  # as ref. 34: plain least squares
        self.pose, self.iterations, self.status = found.pose, found.iterations, found.status
        return self.pose

    def sampler(self, image: Tensor, interpolation: str) -> Sampler:
        """The sampler of frames (1 or R, 1, H, W), float32, around the present poses."""
        return make_sampler(interpolation, image, self.reference.warps(self.pose), self.reference.grid.box)

    def iterate(self, sample: Sampler, reference: Reference) -> None:
        """The bare iteration of Algorithm 1, lines 8 and 9: sample, step, update."""
        g = sample(reference.warps(self.pose), reference.grid.pixels)
        self.pose = retract(self.pose, reference.criterion.step(reference, g).to(self.pose.dtype))


def prepared(templates: Tensor, options: Mapping[str, Any]) -> Reference:
    """Everything constant of templates that come with their surroundings."""
    mask = torch.zeros(templates.shape[-2:], dtype=torch.bool)
    mask[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    return prepare(templates, mask=mask, **options)


# Both have ``pose``, ``track`` and the ``iterations`` that the last frame took; ``iterate`` is one of these, with what
# ``precompute`` returned and a ``sampler`` of the frame.
Follower = Aligned | Ref34


class Method(NamedTuple):
    """A method's name in words, how it is drawn, and its options; None are those of ref. 34, which prepares nothing."""

    label: str
    colour: str
    dashes: str
    options: Mapping[str, Any] | None

    def start(self, templates: Tensor, pose: Tensor, interpolation: str = "bspline3") -> Follower:
        """A follower of templates (R, 1, h + 2 MARGIN, w + 2 MARGIN) that are at poses (R, 3) now."""
        if self.options is None:
            return Ref34(templates, pose, interpolation)
        return Aligned(templates, pose, self.options, interpolation)


METHODS: dict[str, Method] = {
    "gain": Method("ecc, gain (the paper's ECC)", "#e69f00", "-", {"illumination": "gain"}),
    "linear": Method("ecc, linear (default)", "#0b6e4f", "-", {"illumination": "linear"}),
    "quadratic": Method("ecc, quadratic", "#56b4e9", "--", {"illumination": "quadratic"}),
    "ecc_paper": Method("ecc_paper (eq. 9 to the letter)", "#7b4ea3", ":", {"criterion": "ecc_paper"}),
    "ssd": Method("ssd", "#c8553d", "-", {"criterion": "ssd"}),
    "ref34": Method("ref. 34 (SSD, Hessian anew)", "#333333", ":", None),
}
COMPARED = ("linear", "gain", "ecc_paper", "ssd", "ref34")  # where more would show no more
