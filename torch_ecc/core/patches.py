"""Cut templates out of a frame, and judge beforehand how well a patch will hold a pose."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.ambient import plain
from torch_ecc.core.criteria import Criterion, make_criterion
from torch_ecc.core.filters import pad
from torch_ecc.core.frame import as_gray, as_mask, require_tensor
from torch_ecc.core.pose import pose_dtype
from torch_ecc.core.reference import MARGIN, SMALLEST, Reference, prepare
from torch_ecc.core.sight import eroded
from torch_ecc.core.verdict import predicted_sigma

QUANTISATION = 1 / 12  # variance of rounding to whole grey levels

Size = int | tuple[int, int] | Sequence[int]
Centers = Tensor | Sequence[Sequence[float]]


class Patches(NamedTuple):
    """Where R templates lie in a frame: ``centers`` (R, 2) float, as asked; ``corner`` (R, 2) int, the top-left pixel;
    ``size`` (h, w); ``mask`` (R, 1, h, w)."""

    centers: Tensor
    corner: Tensor
    size: tuple[int, int]
    mask: Tensor


def locate_patches(where: str, frame: Tensor, centers: Centers, size: Size, mask: Tensor | None) -> Patches:
    """Check ``centers`` (R, 2) as (x, y), ``size`` and ``mask`` against the grey frame (1 or R, 1, H, W).

    Template pixels are frame pixels, never interpolated ones: an even size or a fractional centre only moves the point
    that the pose speaks of. Raises ValueError naming what does not fit.
    """
    h, w = as_size(where, size)
    height, width = frame.shape[-2:]
    try:
        place = torch.as_tensor(centers, dtype=pose_dtype(frame.device), device=frame.device)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: centers must be numbers, (R, 2) as (x, y), got {centers!r}") from error
    if place.dim() != 2 or place.shape[1] != 2 or len(place) == 0:
        raise ValueError(f"{where}: centers must be (R, 2) as (x, y), got {tuple(place.shape)}")
    if not place.isfinite().all():
        raise ValueError(f"{where}: centers must be finite, got {place.tolist()}")
    if len(frame) not in (1, len(place)):
        raise ValueError(f"{where}: frame must be one image or one per template ({len(place)}), got {len(frame)}")
    corner = (place - place.new_tensor((w - 1, h - 1)) / 2).round().long()
    limit = corner.new_tensor((width - w, height - h))
    outside = ((corner < 0) | (corner > limit)).any(-1).nonzero()[:, 0].tolist()
    if outside:
        r = outside[0]
        x, y = place[r].tolist()
        raise ValueError(
            f"{where}: template {r} ({w}x{h} px around x={x:g}, y={y:g}) must lie in the frame of {width}x{height} px"
        )
    kept = (
        torch.ones(len(place), 1, h, w, dtype=frame.dtype, device=frame.device)
        if mask is None
        else as_mask(where, mask, len(place), (h, w))
    )
    return Patches(place, corner, (h, w), kept.to(frame.device))


def unmarked(where: str, patches: Patches, shown: Tensor | None) -> Patches:
    """The ``patches`` without what lies under, or too near, a mark in a frame that shows the scene where ``shown``
    (H, W), by default everywhere. ValueError if nothing of one is left."""
    if shown is None:
        return patches
    (h, w), corner = patches.size, patches.corner
    x = corner[:, :1] + torch.arange(w, device=shown.device)
    y = corner[:, 1:] + torch.arange(h, device=shown.device)
    mask = patches.mask * eroded(shown)[y[:, :, None], x[:, None, :]][:, None]
    empty = (mask.amax((1, 2, 3)) == 0).nonzero().flatten().tolist()
    if empty:
        raise ValueError(f"{where}: frame_mask must show at least one pixel of each template, got none for {empty}")
    return patches._replace(mask=mask)


def as_size(where: str, size: Size) -> tuple[int, int]:
    """(h, w) of a size given as one number or as (h, w)."""
    pair = tuple(size) if isinstance(size, Sequence) else (size, size)
    if len(pair) != 2 or any(not isinstance(n, Integral) or n < SMALLEST for n in pair):
        raise ValueError(f"{where}: size must be one or two whole numbers of at least {SMALLEST} px, got {size!r}")
    if max(pair) >= 1 << 31:
        raise ValueError(f"{where}: size must fit in the frame, got {float(min(max(pair), 10**300)):g} px or more")
    return int(pair[0]), int(pair[1])


class Crop(NamedTuple):
    """What ``prepare`` is called with: ``template`` (R, 1, h, w) with what surrounds it, its ``mask`` (R, 1, h, w) and
    ``centre`` (R, 2)."""

    template: Tensor
    mask: Tensor
    centre: Tensor


def crop(frame: Tensor, patches: Patches) -> Crop:
    """The templates at ``patches`` with what surrounds them, so that their borders have true gradients."""
    h, w = patches.size
    wide = pad(frame, MARGIN)
    x = patches.corner[:, :1] + torch.arange(w + 2 * MARGIN, device=frame.device)
    y = patches.corner[:, 1:] + torch.arange(h + 2 * MARGIN, device=frame.device)
    which = torch.arange(len(frame), device=frame.device)[:, None, None]
    template = wide[which, 0, y[:, :, None], x[:, None, :]][:, None]
    mask = torch.nn.functional.pad(patches.mask, (MARGIN,) * 4)
    middle = patches.corner + patches.centers.new_tensor((w - 1, h - 1)) / 2
    return Crop(template, mask, patches.centers - middle)


def cut(frame: Tensor, patches: Patches, criterion: Criterion) -> Reference:
    """Prepare the templates at ``patches``."""
    template, mask, centre = crop(frame, patches)
    return prepare(template, criterion=criterion, mask=mask, centre=centre)


@plain
@torch.no_grad()
def texture(
    frame: Tensor,
    centers: Centers,
    size: Size,
    *,
    criterion: str | Criterion = "ecc",
    noise: float | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Predicted sigma (R, 3) px, px, rad of poses tracked with these patches, before any tracking: are they any good?

    ``noise``: standard deviation of the camera's noise in grey levels; by default it is estimated from each patch,
    where fine texture counts as noise, so that the prediction errs on the safe side. Rounding of integer frames is
    added.
    Infinite where the texture does not fix the pose (Status.LOW_TEXTURE). Raises ValueError as ``Tracker`` does.
    """
    if noise is not None and not noise >= 0:
        raise ValueError(f"texture: noise must be a standard deviation >= 0 in grey levels, got {noise}")
    gray = as_gray("texture", "frame", frame)
    patches = locate_patches("texture", gray, centers, size, mask)
    reference = cut(gray, patches, make_criterion(criterion))
    level = reference.noise.level
    sigma = level if noise is None else torch.full_like(level, noise)
    rounding = 0.0 if require_tensor("texture", "frame", frame).is_floating_point() else QUANTISATION
    variance = sigma.to(patches.centers) ** 2 + rounding
    return predicted_sigma(reference, reference.normal, variance)
