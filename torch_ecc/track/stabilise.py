"""Frames warped back onto the first one, so that a tracked template stands still in them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from torch_ecc.core.ambient import plain
from torch_ecc.core.estimate import Track
from torch_ecc.core.frame import require_tensor
from torch_ecc.core.pose import compose, inverse, matrix
from torch_ecc.core.sampling import SAMPLERS, Sampler, inside

INTEGERS = (torch.uint8, torch.uint16)


def stabilise(
    frames: Iterable[Tensor], track: Track, *, template: int = 0, interpolation: str = "bspline3"
) -> Iterator[Tensor]:
    """The ``frames``, (H, W) or (C, H, W), moved and turned so that ``template`` of their ``track`` (F, R, ...) stays
    where and as it was at the start: one after the other, of the same shape, dtype and device.

    What the camera did not see becomes 0. Where the template was lost its last good pose counts. ValueError, before
    the first frame, for what does not fit, and for a frame more or less than the track has.
    """
    if interpolation not in SAMPLERS:
        raise ValueError(f"stabilise: interpolation must be one of {list(SAMPLERS)}, got {interpolation!r}")
    if track.pose.dim() != 3 or not -track.pose.shape[1] <= template < track.pose.shape[1]:
        raise ValueError(
            f"stabilise: track must be (F, R, ...) with a template {template}, got {tuple(track.pose.shape)}"
        )
    return _stabilised(frames, motion_since_start(track)[:, template], interpolation)


def _stabilised(frames: Iterable[Tensor], motion: Tensor, interpolation: str) -> Iterator[Tensor]:
    done = 0
    for frame in frames:
        if require_tensor("stabilise", "frame", frame).dim() not in (2, 3):
            raise ValueError(f"stabilise: frame {done} must be (H, W) or (C, H, W), got {tuple(frame.shape)}")
        if done == len(motion):
            raise ValueError(f"stabilise: frames must be {done}, as many as the track has, got more")
        yield warped(frame, motion[done], interpolation)
        done += 1
    if done < len(motion):
        raise ValueError(f"stabilise: frames must be {len(motion)}, as many as the track has, got {done}")


def motion_since_start(track: Track) -> Tensor:
    """The rigid motions (F, R, 3) of the frame that take what was seen at the start to where it is: W(p) o W(start)^-1
    as poses of the frame's own origin."""
    return compose(track.pose, inverse(track.pose - track.displacement))


@plain
@torch.no_grad()
def warped(frame: Tensor, motion: Tensor, interpolation: str) -> Tensor:
    """``frame`` (H, W) or (C, H, W) as it was before the ``motion`` (3,) px, px, rad; integers are rounded."""
    h, w = frame.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(n, device=frame.device, dtype=torch.float32) for n in (h, w)), indexing="ij")
    pixels = torch.stack((x.flatten(), y.flatten(), torch.ones(h * w, device=frame.device)))
    planes = frame.reshape(-1, 1, h, w).float()
    warp = matrix(motion.to(frame.device))[None, :2]
    seen = inside(warp, pixels, (h, w))
    sample = Sampler.of(planes, interpolation)
    values = torch.where(seen, sample(warp.expand(len(planes), 2, 3), pixels), 0.0).reshape(frame.shape)
    if frame.dtype in INTEGERS:
        values = values.round().clamp(0, torch.iinfo(frame.dtype).max)
    return values.to(frame.dtype)
