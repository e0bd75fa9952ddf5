"""Align templates with images: the whole solve as one pure function."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.estimate import Estimate
from torch_ecc.frame import as_gray, require_tensor
from torch_ecc.judge import judge
from torch_ecc.reference import Reference
from torch_ecc.solver import Settings, State, refine


@torch.no_grad()
def align(
    reference: Reference,
    image: Tensor,
    pose: Tensor,
    *,
    interpolation: str = "bspline3",
    max_iterations: int = 15,
    tolerance: float = 1e-3,
) -> Estimate:
    """Poses of B prepared templates in their images: (B or 1, 1, H, W), start (B, 3) px, px, rad -> Estimate.

    One image serves all templates without copies. ``displacement`` counts from the start pose, which failed elements
    keep. Raises ValueError for bad shapes, dtypes, devices, NaN and unknown options.
    """
    if not isinstance(reference, Reference):
        raise ValueError(f"align: reference must come from prepare, got {type(reference).__name__}")
    settings = Settings(interpolation, max_iterations, tolerance)
    gray = as_gray("align", "image", image)
    pose = require_tensor("align", "pose", pose)
    b, device = len(reference.K), reference.K.device
    if pose.shape != (b, 3):
        raise ValueError(f"align: pose must be ({b}, 3), one per template, got {tuple(pose.shape)}")
    if len(gray) not in (1, b):
        raise ValueError(f"align: image must be one or one per template ({b}), got a batch of {len(gray)}")
    for name, value in (("image", gray), ("pose", pose)):
        if value.device != device:
            raise ValueError(f"align: {name} must be on the reference's device {device}, got {value.device}")
    if not (pose.is_floating_point() and bool(pose.isfinite().all())):
        raise ValueError(f"align: pose must hold finite floating-point numbers, got {pose.dtype} {pose.tolist()}")
    return solve(reference, gray, pose.to(reference.radius.dtype), settings)


def solve(reference: Reference, image: Tensor, pose: Tensor, settings: Settings) -> Estimate:
    """``align`` without its checks: grey levels (B or 1, 1, H, W), poses (B, 3) of the reference's pose dtype."""
    state = refine(reference, image, State.start(reference, pose), settings)
    return judge(reference, (image.shape[-2], image.shape[-1]), state, pose, settings)
