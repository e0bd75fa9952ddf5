"""Align templates with images: the whole solve as one pure function."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from torch import Tensor

from torch_ecc.core import native
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.frame import as_image, require_tensor
from torch_ecc.core.pose import library
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import host_looks, on_host
from torch_ecc.core.settings import Settings
from torch_ecc.core.solver import State, refine
from torch_ecc.core.verdict import judge

PIXELS_AT_ONCE = 2**18  # of templates, per thread
UNSETTLED = -1  # the status of a template at the frame's border, which takes another way


@torch.no_grad()
def align(
    reference: Reference,
    image: Tensor,
    pose: Tensor,
    *,
    interpolation: str = "bspline3",
    max_iterations: int = 15,
    tolerance: float = 1e-3,
    backend: str = "auto",
) -> Estimate:
    """Poses of B prepared templates in their images: (B or 1, 1, H, W), start (B, 3) px, px, rad -> Estimate.

    One image serves all templates without copies. ``displacement`` counts from the start pose, which failed elements
    keep. ``backend``: "auto", "torch" or "native", see settings.Settings. Raises ValueError for bad shapes, dtypes,
    devices, NaN and unknown options.
    """
    if not isinstance(reference, Reference):
        raise ValueError(f"align: reference must come from prepare, got {type(reference).__name__}")
    settings = Settings(interpolation, max_iterations, tolerance, backend=backend)
    gray = as_image("align", "image", image)
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
    """``align`` without its checks: an image of ``as_image``, poses (B, 3) of the reference's pose dtype."""
    templates = native.packed(reference, settings) if native.takes(image) else None
    if templates is not None:
        estimate = native.solve(templates, image, pose)
    else:
        estimate = solve_in_torch(reference, image, pose, settings)
    return settle(reference, image, pose, settings, estimate)


def settle(reference: Reference, image: Tensor, pose: Tensor, settings: Settings, estimate: Estimate) -> Estimate:
    """``estimate`` with those templates solved that it leaves UNSETTLED, at the frame's border, where pixels drop out
    of sight. They are few and take a slower way."""
    left = on_host(estimate.status) == UNSETTLED
    if not left.any():
        return estimate
    rest = torch.as_tensor(left).nonzero()[:, 0]
    part = image if len(image) == 1 else image.float()[rest]  # torch 2.4 cannot index uint16
    return estimate.put(rest, solve_in_torch(reference.select(rest), part, pose[rest], settings, border=True))


def solve_in_torch(
    reference: Reference, image: Tensor, pose: Tensor, settings: Settings, *, border: bool = False
) -> Estimate:
    """``solve`` on any device, with any criterion: what the native path is measured against.

    Without ``border`` templates that come near it are not settled: status UNSETTLED. A CPU does some templates after
    the other, in its cache. Any other device is not stopped for the host to look at a value, so that a CUDA graph can
    hold all of this.
    """
    some = max(PIXELS_AT_ONCE * torch.get_num_threads() // reference.K.shape[-1], 1)
    if border or not host_looks(pose.device) or len(pose) <= some:
        return _solve_at_once(reference, image, pose, settings, border)
    parts = []
    for k in range(0, len(pose), some):
        those = slice(k, k + some)
        view = image if len(image) == 1 else image[those]
        parts.append(_solve_at_once(reference.select(those), view, pose[those], settings, border))
    return Estimate(*map(torch.cat, zip(*parts, strict=True)))


def _solve_at_once(reference: Reference, image: Tensor, pose: Tensor, settings: Settings, border: bool) -> Estimate:
    # Inference mode takes a tenth of the time off many small operations; what leaves it must not be of its tensors.
    with torch.inference_mode() if host_looks(pose.device) else nullcontext():
        start, image = (pose, image.float()) if border else (on_host(pose), image)  # at the border they may go anywhere
        known = reference if border else reference.at_hand
        state, settled = refine(known, image, State.start(known, start), settings, border=border)
        if border:
            start, state = on_host(start), state.convert(on_host)
        estimate = judge(known, state, start, settings, (image.shape[-2], image.shape[-1]) if border else None)
        if not border:
            estimate = estimate._replace(status=library(start).where(settled, estimate.status, UNSETTLED))
    return Estimate(*map(torch.as_tensor, estimate))
