"""The method that the paper compares with, its ref. 34: SSD whose Jacobian and Hessian are made anew at every frame.

Inverse additive (Hager and Belhumeur, IEEE TPAMI 20(10), 1998). With dI/dx = grad h R^T at the solution, the Jacobian
of the sampled patch by the pose is

    J(theta) = grad h R(theta)^T [ I | dR/dtheta x' ] = [ grad h R(theta)^T | grad h (y', -x') ],

taken at the theta where a frame starts and kept during that frame's iterations p <- p - (J^T J)^-1 J^T (g - h).

grad h is that of the slightly blurred template. Raw differences hold the template's own noise, which inflates the
Hessian: with the noise of Fig. 4 steps become so short that 15 of them lose the motion of the paper's simulation.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.filters import blur
from torch_ecc.core.noise import INSTRUMENT_BLUR
from torch_ecc.core.pose import rotation
from torch_ecc.core.reference import MARGIN
from torch_ecc.core.sampling import Sampler, gradients, make_sampler
from torch_ecc.core.solver import COARSE_TOLERANCE

PAPER_ITERATIONS = 15  # at most, of every method
TOLERANCE = 1e-3  # px at the template's corner


def jacobian(gradient: Tensor, theta: Tensor) -> Tensor:
    """J(theta) (R, N, 3) of templates with ``gradient`` (R, 2, h, w) at angles (R,), eqs. (7), (8)."""
    x, y, _ = pixels((gradient.shape[-2], gradient.shape[-1]))
    gx, gy = gradient.flatten(2).unbind(1)
    turned = gradient.flatten(2).mT @ rotation(theta).mT.to(gradient.dtype)
    return torch.cat((turned, (gx * y - gy * x)[..., None]), -1)


def pixels(size: tuple[int, int]) -> Tensor:
    """Homogeneous pixel positions (3, N) about the middle of a template (h, w)."""
    y, x = torch.meshgrid(*(torch.arange(n) - (n - 1) / 2 for n in size), indexing="ij")
    return torch.stack((x.flatten(), y.flatten(), torch.ones(x.numel())))


class Ref34:
    """R templates of h x w px, each with ``MARGIN`` px around it, from their poses (R, 3) on: ``track`` every frame.

    The samplers, the bilinear iterations first and the stop rule are those of the tracker.
    """

    def __init__(self, templates: Tensor, pose: Tensor, interpolation: str = "bspline3") -> None:
        self.pose, self.interpolation = pose.clone(), interpolation
        self.iterations = torch.zeros(len(pose), dtype=torch.int64)  # of the last frame
        inner = (slice(None), slice(None), slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
        self.gradient = gradients(blur(templates.float(), INSTRUMENT_BLUR))[inner].contiguous()
        self.h = templates[inner].flatten(1).float()
        h, w = (n - 2 * MARGIN for n in templates.shape[-2:])
        self.pixels = pixels((h, w))
        self.box = self.pixels[:, [0, w - 1, h * w - 1, (h - 1) * w]]
        radius = float(self.box[:2, 0].norm())
        self.lever = pose.new_tensor((1.0, 1.0, radius))

    def precompute(self) -> Tensor:
        """What this method does before each frame: J(theta) and (J^T J)^-1 J^T, (R, 3, N)."""
        J = jacobian(self.gradient, self.pose[:, 2])
        solve: Tensor = torch.linalg.inv((J.mT @ J).double()).to(J.dtype) @ J.mT
        return solve

    def sampler(self, image: Tensor, interpolation: str) -> Sampler:
        """The sampler of frames (1 or R, 1, H, W), float32, around the present poses."""
        return make_sampler(interpolation, image, self.warp(), self.box)

    def warp(self) -> Tensor:
        """2x3 warps (R, 2, 3) of the present poses."""
        return torch.cat((rotation(self.pose[:, 2]), self.pose[:, :2, None]), -1)

    def iterate(self, sample: Sampler, solve: Tensor) -> Tensor:
        """One step with the constants ``solve`` of this frame; its length (R,) in px at the farthest pixel."""
        error = sample(self.warp(), self.pixels) - self.h
        delta = (solve @ error[:, :, None])[:, :, 0].to(self.pose.dtype)
        self.pose = self.pose - delta
        length: Tensor = torch.linalg.vector_norm(delta * self.lever, dim=-1)
        return length

    def track(self, frame: Tensor) -> Tensor:
        """Poses (R, 3) px, px, rad in the next frame (1 or R, 1, H, W)."""
        image, solve = frame.float(), self.precompute()
        budget, self.iterations = PAPER_ITERATIONS, torch.zeros_like(self.iterations)
        if self.interpolation != "bilinear":
            coarse = budget * 2 // 3
            self._stage(self.sampler(image, "bilinear"), solve, COARSE_TOLERANCE, coarse)
            budget -= coarse
        self._stage(self.sampler(image, self.interpolation), solve, TOLERANCE, budget)
        return self.pose

    def _stage(self, sample: Sampler, solve: Tensor, tolerance: float, budget: int) -> None:
        """Steps until what their shrinking series still lacks is below ``tolerance`` px for every template."""
        last = torch.full_like(self.pose[:, 0], torch.inf)
        for _ in range(budget):
            length = self.iterate(sample, solve)
            self.iterations += 1
            rate = torch.where(last.isfinite(), length / last, 0.5).clamp(0.05, 0.95)
            if not bool((length * rate / (1 - rate) > tolerance).any()):
                break
            last = length
