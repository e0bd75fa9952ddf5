"""Marks of a camera (aperture, stripe, dust) told from a sequence that was tracked: they stay put in the frame while a
template moves.

The scene is what the template's pixels show in the median of the frames. Moved along the track it explains a pixel of
the camera, or does not in most frames: there is a mark. What that hides is left out of the scene, which tells more of
the mark, and so on. Where the track is wrong, as one is that follows a mark, there is no scene: then what stands still
while most else changes is a mark.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.ambient import plain
from torch_ecc.core.estimate import Status, Track
from torch_ecc.core.frame import as_gray
from torch_ecc.core.noise import noise_level
from torch_ecc.core.patches import Size, as_size
from torch_ecc.core.pose import inverse, matrix
from torch_ecc.core.sampling import Sampler, inside

MOST = 48  # frames that are compared, evenly spread over the track
FEWEST = 5  # frames that tell of a pixel
ROUNDS, FITS = 6, 4
LEAST = 1e-6  # grey levels
LEAST_NOISE = 0.02  # of the image's contrast
CONTRAST = 0.25  # of the scene's: smaller residuals are no mark, nor are those
EXCESS = 6.0  # times the usual one
STILL = 0.5  # of the residuals: at first only what changes less from frame to frame is a mark, not what it has hidden
WRONG = 2.0  # times the noise: if residuals usually are, so is the track
CHANGE = 1.5  # times the noise: that much must usually change for what does not to be a mark


class Views(NamedTuple):
    """K looks at one template of ``size`` (h, w): the ``image`` (K, 1, H, W) that it was in, where the ``template``'s
    pixels (3, h w) are ``there`` in it, and the ``frame``'s (3, H W) ``back`` in the template, by warps (K, 2, 3); and
    which pixels (K, H, W) of the image it has ``crossed``."""

    size: tuple[int, int]
    image: Tensor
    template: Tensor
    there: Tensor
    frame: Tensor
    back: Tensor
    crossed: Tensor

    @staticmethod
    def of(image: Tensor, pose: Tensor, size: tuple[int, int]) -> Views:
        """At poses (K, 3)."""
        corner = pose.new_tensor((-(size[1] - 1) / 2, -(size[0] - 1) / 2))
        there = matrix(pose)[:, :2]
        there = torch.cat((there[:, :, :2], there[:, :, 2:] + there[:, :, :2] @ corner[:, None]), 2)
        back = matrix(inverse(pose))[:, :2]
        back[:, :, 2] -= corner
        frame = _pixels(image.shape[-2], image.shape[-1], image)
        crossed = inside(back, frame, size).view(-1, *image.shape[2:])
        return Views(size, image, _pixels(*size, image), there, frame, back, crossed)


@plain
@torch.no_grad()
def suggest_frame_mask(frames: Iterable[Tensor], track: Track, size: Size) -> Tensor:
    """Where the camera shows the scene, (H, W) bool, False at marks of its own: what ``Tracker`` takes as
    ``frame_mask``.

    ``frames``: those of the ``track`` (F, R, ...), (H, W) or (C, H, W); ``size`` of the templates. Only what a template
    has moved across is told, and marks by whose own width it has moved; the rest counts as shown. Marks bend the track
    that they are told from: track again with the mask, and ask once more. ValueError for what does not fit.
    """
    sides = as_size("suggest_frame_mask", size)
    some, looks = chosen_frames("suggest_frame_mask", frames, track)
    shown = torch.ones(looks.shape[2:], dtype=torch.bool, device=looks.device)
    for r in range(track.pose.shape[1]):
        good = Status.good(track.status[some, r])
        used = good if int(good.sum()) >= FEWEST else torch.ones_like(good)  # as a wrong track
        pose = track.pose[some[used], r]
        x, y = _around(pose, sides)
        shown[y, x] &= _shown(Views.of(looks[used][:, :, y, x], pose - pose.new_tensor((x.start, y.start, 0)), sides))
    return shown


def chosen_frames(where: str, frames: Iterable[Tensor], track: Track) -> tuple[Tensor, Tensor]:
    """The numbers (K,) of MOST frames evenly spread over a ``track`` (F, R, ...), and the frames, grey: (K, 1, H, W).
    ValueError, which names ``where``, for frames that are not those of the track."""
    if track.pose.dim() != 3:
        raise ValueError(f"{where}: track must be (F, R, ...), got {tuple(track.pose.shape)}")
    count = len(track.pose)
    some = torch.linspace(0, count - 1, min(MOST, count), device=track.pose.device).round().long()
    wanted, kept, done = set(some.tolist()), [], 0
    for frame in frames:
        if done in wanted:
            kept.append(as_gray(where, f"frame {done}", frame))
            if kept[-1].shape != kept[0].shape or len(kept[0]) != 1:
                raise ValueError(f"{where}: frame {done} must be one of the first one's size")
        done += 1
    if done != count:
        raise ValueError(f"{where}: frames must be {count}, as many as the track has, got {done}")
    return some, torch.cat(kept).to(track.pose.device)


def _around(pose: Tensor, size: tuple[int, int]) -> tuple[slice, slice]:
    """Columns and rows that hold a template at poses (K, 3)."""
    reach = (size[0] ** 2 + size[1] ** 2) ** 0.5 / 2
    low = (pose[:, :2].amin(0) - reach).floor().clamp(min=0).long().tolist()
    high = (pose[:, :2].amax(0) + reach).ceil().long().tolist()
    return slice(low[0], high[0] + 1), slice(low[1], high[1] + 1)


def _shown(views: Views) -> Tensor:
    """Where the camera shows the scene, (H, W) bool."""
    image = views.image[:, 0]
    change = (image - image.median(0).values).abs().median(0).values
    noise = noise_level(views.image[:1], torch.ones_like(views.image[:1])).maximum(LEAST_NOISE * image.std())
    shown = torch.ones_like(change, dtype=torch.bool)
    patches = Sampler.of(views.image, "bspline3")(views.there, views.template)
    for k in range(ROUNDS):
        misfit, contrast = _misfit(views, patches, shown)
        usual = misfit[shown].nanmedian()
        if k == 0 and not bool(usual < WRONG * noise):
            crossed = views.crossed.sum(0) >= FEWEST
            changing = change[crossed].median() > CHANGE * noise
            return ~(crossed & changing & (change < noise))
        mark = misfit > torch.maximum(EXCESS * usual, CONTRAST * contrast)  # NaN is none
        shown &= ~(mark & (change < STILL * misfit)) if k < ROUNDS - 1 else ~mark
    return shown


def _misfit(views: Views, patches: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
    """The median (H, W) of what the scene leaves of the frames, NaN where few tell, and the scene's contrast ();
    the scene is made of those pixels of the ``patches`` (K, h w) that are ``shown`` (H, W)."""
    height, width = shown.shape
    x, y = (views.there @ views.template.to(views.there.dtype)).round().long().unbind(1)
    seen = shown[y.clamp(0, height - 1), x.clamp(0, width - 1)] & inside(views.there, views.template, shown.shape)
    scene = median(torch.where(seen, patches, torch.nan))
    expected = Sampler.of(scene.view(1, 1, *views.size))(views.back, views.frame).view(-1, height, width)
    expected = torch.where(views.crossed, expected, torch.nan)
    left = unexplained(views.image[:, 0], torch.where(shown, expected, torch.nan), expected)
    return median(left.abs()), scene[scene.isfinite()].std()


def unexplained(image: Tensor, known: Tensor, expected: Tensor) -> Tensor:
    """What is left of an ``image`` (K, H, W) that is ``expected`` to be something else, after each frame's gain and
    offset: those of most pixels where that is ``known``, by iteratively re-weighted least squares (Cauchy)."""
    e, g = known.flatten(1), image.flatten(1)
    left = g - e
    left = left - left.nanmedian(1, keepdim=True).values
    gain, e0, g0 = (torch.zeros_like(left[:, :1]) for _ in range(3))
    for _ in range(FITS):
        scale = 2 * left.abs().nanmedian(1, keepdim=True).values + LEAST
        weight = (1 + (left / scale).square()).reciprocal().nan_to_num(0.0)
        total = weight.sum(1, keepdim=True).clamp(min=LEAST)
        e0, g0 = ((weight * v.nan_to_num(0.0)).sum(1, keepdim=True) / total for v in (e, g))
        a, b = (e - e0).nan_to_num(0.0), g - g0
        gain = (weight * a * b).sum(1, keepdim=True) / (weight * a * a).sum(1, keepdim=True).clamp(min=LEAST)
        left = b - gain * (e - e0)
    return (g - g0 - gain * (expected.flatten(1) - e0)).view_as(image)


def median(values: Tensor) -> Tensor:
    """Over the frames (K, ...), NaN where too few tell: (...)."""
    return torch.where(values.isfinite().sum(0) >= FEWEST, values.nanmedian(0).values, torch.nan)


def _pixels(h: int, w: int, like: Tensor) -> Tensor:
    """Homogeneous, from the first one on: (3, h w)."""
    y, x = torch.meshgrid(*(torch.arange(n, device=like.device, dtype=torch.float32) for n in (h, w)), indexing="ij")
    return torch.stack((x.flatten(), y.flatten(), torch.ones(h * w, device=like.device)))
