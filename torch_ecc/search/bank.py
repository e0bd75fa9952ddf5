"""One template rotated through the whole circle: its correlation with every place of a frame, at a coarse level."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.noise import INSTRUMENT_BLUR
from torch_ecc.core.pose import compose
from torch_ecc.core.pyramid import as_images
from torch_ecc.core.reference import Reference
from torch_ecc.search.correlation import CHUNK, Correlator, Template, about_mean, detrended, peaks, rotated, span

SMALLEST_SEARCHED = 24  # px: root of the area that a template keeps at the level at which it is searched for
LEAST_DENSITY = 0.25  # of a level's pixels: texture per bandwidth, over that of white texture of the same contrast
ANGLE_LOSS = 0.1  # of the smoothed texture's score, half way between two angles
COARSEST_STEP, FINEST_STEP = math.radians(6), math.radians(1.5)  # from one angle to the next
SMALLEST_DISC, LARGEST_DISC = 5, 24  # px: angles get closer with the radius, and this many pixels tell enough
DISC_SHARE = 0.5  # of the texture must lie in a disc for the disc alone to be searched for
TILE = 320  # px of a level that are transformed at once


class Bank(NamedTuple):
    """One template at ``angles`` (A,) rad as kernels of ``radius`` px around its point ``middle`` (2,), counted from
    the point that poses speak of; ``corners`` (x, y) of the tiles in which images are looked at one after the other, so
    that kernels take no more memory for a larger frame (the overlap-save method)."""

    radius: int
    middle: Tensor
    angles: Tensor
    correlator: Correlator
    corners: tuple[tuple[int, int], ...]

    @staticmethod
    def of(reference: Reference, size: tuple[int, int]) -> Bank:
        """Of one template (B = 1) at the level of images of ``size`` (h, w)."""
        template, (image, kept, corner) = Template.of(reference), as_images(reference)
        middle, extent, disc = _support(template, kept[0, 0], corner=corner)
        angles = _angles(template, middle, radius=extent)
        radius, about = math.ceil(extent), middle - corner
        side = (2 * radius + 1, 2 * radius + 1)
        texture = rotated(about_mean(image, kept), angles, middle=about, size=side, spline=True)
        if disc:
            across = span(side[0], texture)
            weight = (across[:, None] ** 2 + across**2 <= extent**2).to(texture)[None, None]
        else:
            weight = rotated(kept, angles, middle=about, size=side)
        texture, planes = detrended(texture, weight)
        (h, rows), (w, columns) = (_tiles(n, max(TILE, 2 * radius)) for n in size)
        corners = tuple((x, y) for y in rows for x in columns)
        correlator = Correlator.of(texture, weight, planes=planes, size=(h + 2 * radius, w + 2 * radius))
        return Bank(radius, (middle - template.centre[0]).to(template.radius.dtype), angles, correlator, corners)

    def candidates(self, image: Tensor, most: int) -> tuple[Tensor, Tensor]:
        """Where ``image`` (h, w) looks most like the template: at most ``most`` poses (K, 3) per tile and CHUNK of
        angles, and their scores (K,). They are local maxima over the places, each at the best angle of the chunk."""
        padded = F.pad(image[None, None], (self.radius,) * 4, mode="replicate")[0]
        variance = image.var(unbiased=False)[None]
        poses, scores = [], []
        h, w = (n + 2 * self.radius for n in self.correlator.places)
        for x, y in self.corners:
            chunks = self.correlator.scores(padded[:, y : y + h, x : x + w], CHUNK, variance)
            for score, angles in zip(chunks, self.angles.split(CHUNK), strict=True):
                peak = peaks(F.pad(score.amax(1), (1, 1, 1, 1), value=-math.inf), most)
                angle = angles[score[0].flatten(1)[:, peak.cell[0]].argmax(0)]
                poses.append(torch.cat((peak.place[0] + peak.place.new_tensor((x, y)), angle[:, None]), -1))
                scores.append(peak.score[0])
        pose = torch.cat(poses).to(self.middle.dtype)
        back = F.pad(-self.middle, (0, 1))
        return compose(pose, back.expand_as(pose)), torch.cat(scores)


def _tiles(n: int, most: int) -> tuple[int, list[int]]:
    """Length of as few equal tiles of at most so many px as cover ``n``, and where each begins."""
    count = -(-n // most)
    length = -(-n // count)
    return length, [k * (n - length) // max(count - 1, 1) for k in range(count)]


def most_levels(reference: Reference) -> int:
    """How many levels of a pyramid there are at which enough of a template may be left, itself the first."""
    level, (w, h) = 1, reference.grid.sides.tolist()
    while math.ceil(w / 2**level) * math.ceil(h / 2**level) >= SMALLEST_SEARCHED**2:
        level += 1
    return level


def search_level(references: list[Reference]) -> int:
    """The coarsest level of a pyramid of one template at which its texture is still there.

    Blurred by s px, white texture keeps 1 / (4 pi s^2) of its power; texture that keeps much less of it lives in what
    the blur has taken.
    """
    first, *coarser = map(Template.of, references)
    level, full = 0, _variance(first.t, first.w)
    for k, template in enumerate(coarser, 1):
        variance = (4**k - 1) / 3 + INSTRUMENT_BLUR**2 * 4**k  # of all blurs up to here, px^2
        density = 4 * math.pi * variance * _variance(template.smooth[:, 3], template.w) / full
        if float(template.w.count_nonzero()) >= SMALLEST_SEARCHED**2 and float(density) >= LEAST_DENSITY:
            level = k
    return level


def _variance(t: Tensor, w: Tensor) -> Tensor:
    """Of grey levels (B, N) under weights (B, N): (B,)."""
    w = w / w.sum(-1, keepdim=True)
    mean = (w * t).sum(-1, keepdim=True)
    return (w * (t - mean).square()).sum(-1)


def _support(template: Template, kept: Tensor, *, corner: Tensor) -> tuple[Tensor, float, bool]:
    """Middle (2,) of the weights and the radius of what is searched for around it: that of a disc wholly inside the
    template if enough of the texture lies in it (True), else of all of it. ``kept`` (h, w): the weights as an image
    whose pixel (0, 0) is at ``corner`` (2,)."""
    w, t = template.w[0], template.t[0]
    middle = (w * template.place).sum(-1) / w.sum()
    distance = (template.place - middle[:, None]).norm(dim=0)
    border, hole = _clearance(kept, middle - corner)
    largest = min(border, hole, LARGEST_DISC)
    energy = w * (t - (w * t).sum() / w.sum()).square()
    share = float((energy * (distance <= largest)).sum() / energy.sum())
    if largest >= SMALLEST_DISC and share >= DISC_SHARE * min(1.0, (LARGEST_DISC / max(border, 1)) ** 2):
        return middle, largest, True
    return middle, float(distance[w > 0].max()), False


def _clearance(weight: Tensor, point: Tensor) -> tuple[float, float]:
    """Px from a ``point`` (2,) of an image of weights (h, w) to its border, and to a pixel before the nearest zero."""
    h, w = weight.shape
    y, x = torch.meshgrid(*(torch.arange(n, dtype=weight.dtype, device=weight.device) for n in (h, w)), indexing="ij")
    cx, cy = point.tolist()
    zeros = torch.hypot(x - cx, y - cy)[weight <= 0]
    return min(cx, cy, w - 1 - cx, h - 1 - cy), float(zeros.min()) - 1 if len(zeros) else math.inf


def _angles(template: Template, middle: Tensor, *, radius: float) -> Tensor:
    """Angles (A,) of the whole circle, so close that the score falls by ANGLE_LOSS at most half way between.

    Rotated by a, the smoothed texture's score is 1 - c a^2 with c = <w, (dt/da)^2> / (2 <w, (t - mean)^2>).
    """
    x, y = template.place - middle[:, None]
    w = template.w * (x.square() + y.square() <= radius**2)
    gx, gy, _, t = template.smooth[0]
    by_angle = gx * y - gy * x
    loss = (w * by_angle.square()).sum() / (w.sum() * _variance(t[None], w)) / 2
    step = 2 * math.sqrt(ANGLE_LOSS / max(float(loss), 1e-6))
    count = math.ceil(2 * math.pi / min(max(step, FINEST_STEP), COARSEST_STEP))
    step = 2 * math.pi / count
    return torch.arange(count, device=t.device, dtype=t.dtype) * step - math.pi + step
