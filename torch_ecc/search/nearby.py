"""Templates looked for around where they are expected: every place within some px and a few small angles at once.

What brings a template back that is out of Gauss-Newton's reach, for a tenth of what a search of the whole frame costs
(``locate``): ZNCC with pixels as far apart as the texture allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.align import solve
from torch_ecc.core.estimate import Estimate, Origin, Status
from torch_ecc.core.pose import compose, rotation
from torch_ecc.core.pyramid import as_images
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import Sampler
from torch_ecc.core.settings import Settings
from torch_ecc.search.bank import SMALLEST_SEARCHED
from torch_ecc.search.correlation import Correlator, Template, about_mean, detrended, peaks, rotated, span

HALF_WIDTH = 32  # px to each side that are searched
LARGEST_ANGLE, ANGLE_STEP = math.radians(9), math.radians(1.5)
SPACINGS = (8, 4, 2, 1)  # px between the pixels that are compared
LEAST_DENSITY = 2.0  # texture that is left, over what white noise of the same contrast would leave
LARGEST_KERNEL = 49  # pixels across: they tell enough
CANDIDATES = 5  # places per template that are brought to the answer: those with
SOLVED_AT_ONCE = 64  # of them
SCORE_MARGIN, LEAST_SCORE = 0.25, 0.2  # s >= max(s_best - margin, least), the nearest first
FARTHER_MARGIN = (0.9, 0.002)  # (a, b): a farther place of score s is better if 1 - s < a (1 - s_nearer) - b

Allowed = Callable[[Tensor], Tensor]  # which of places (..., 3) may be the template's, bool (...)


class Nearby(NamedTuple):
    """B templates at A small angles on pixels ``spacing`` px apart, for the surroundings of their poses.

    ``middle`` (B, 2): the template's point x' in the middle of what is compared. ``shape``: the surroundings' pixels.
    ``radius`` (B,): px from x' = 0 to the farthest pixel. The ``correlator`` takes the mean from the surroundings, but
    no planes, and leaves the weights as they are without a rotation: the angles are small.
    """

    spacing: int
    shape: tuple[int, int]
    middle: Tensor
    radius: Tensor
    correlator: Correlator

    @staticmethod
    def of(reference: Reference, half_width: int = HALF_WIDTH) -> Nearby:
        """Of prepared templates, to look ``half_width`` px to each side."""
        template, (image, weight, corner) = Template.of(reference), as_images(reference)
        h, w = image.shape[-2:]
        middle = corner + corner.new_tensor((w - 1, h - 1)) / 2 - template.centre
        weight = weight / weight.sum((2, 3), keepdim=True)
        image = about_mean(image, weight)
        for spacing in SPACINGS:
            texture, weights = _subsampled(image, weight, spacing)
            if spacing == 1 or _enough(texture, weights, image, weight, spacing):
                break
        places = 2 * math.ceil(half_width / spacing) + 3  # with those that are only there to be compared with
        shape = (texture.shape[-2] + places - 1, texture.shape[-1] + places - 1)
        correlator = _correlator(texture, weights, shape)
        return Nearby(spacing, shape, middle.to(template.radius), template.radius, correlator)

    def find(
        self, reference: Reference, image: Tensor, pose: Tensor, settings: Settings, allowed: Allowed | None = None
    ) -> Estimate:
        """The templates in ``image`` (1 or B, 1, H, W) around ``pose`` (B, 3): the nearest of those places that are not
        clearly worse than another, of those that are ``allowed``."""
        place, score = self.candidates(image, pose)
        if allowed is not None:
            score = torch.where(allowed(place), score, -1.0)
        step = place - pose[:, None]
        distance = torch.cat((step[..., :2], step[..., 2:] * self.radius[:, None, None]), -1).norm(dim=-1)
        least = (score.amax(-1, keepdim=True) - SCORE_MARGIN).clamp(min=LEAST_SCORE)
        distance = torch.where(score >= least, distance, torch.inf)
        distance, order = distance.sort(-1)
        place = place.gather(1, order[..., None].expand_as(place))
        wanted = distance.isfinite()
        wanted[:, 0] = True  # there is always an answer
        each = solved_at(reference, image, place, wanted, settings)
        best = Estimate(*(value[:, 0] for value in each))
        for k in range(1, CANDIDATES):
            farther = Estimate(*(value[:, k] for value in each))
            replaced = (wanted[:, k] & better(farther, best)).nonzero()[:, 0]
            best = best.put(replaced, farther.at(replaced))
        return best._replace(origin=torch.full_like(best.origin, int(Origin.NEARBY)))

    def candidates(self, image: Tensor, pose: Tensor, most: int = CANDIDATES) -> tuple[Tensor, Tensor]:
        """Where ``image`` (1 or B, 1, H, W) looks most like the templates around ``pose`` (B, 3): (B, ``most``, 3) and
        the scores (B, ``most``)."""
        surroundings = self._surroundings(image, pose)
        (score,) = self.correlator.scores(surroundings, self.correlator.texture.shape[1])
        peak = peaks(score, most)
        a, h, w = (n - 2 for n in score.shape[1:])
        cell = (peak.place - peak.place.new_tensor((w - 1, h - 1, a - 1)) / 2).to(self.middle)
        step = torch.cat((cell[..., :2] * self.spacing, cell[..., 2:] * ANGLE_STEP), -1)
        middle = F.pad(self.middle, (0, 1))[:, None].expand_as(step)
        moved = compose(middle + step, -middle)
        return compose(pose[:, None].expand_as(moved), moved), peak.score

    def _surroundings(self, image: Tensor, pose: Tensor) -> Tensor:
        """Grey levels (B, H, W), rotated as the templates are at ``pose``."""
        sides = [(n - 1) * self.spacing + 1 for n in self.shape]
        y, x = torch.meshgrid(*(span(n, image) for n in sides), indexing="ij")
        turn = rotation(pose[:, 2])
        warp = torch.cat((turn, pose[:, :2, None] + turn @ self.middle[:, :, None]), -1)
        pixels = torch.stack((x.flatten(), y.flatten(), torch.ones_like(x.flatten())))
        g = Sampler.of(image)(warp, pixels).view(-1, *sides)
        rows, columns = (_resampling(*n, self.spacing, g) for n in zip(sides, self.shape, strict=True))
        return rows @ g @ columns.mT


def solved_at(reference: Reference, image: Tensor, place: Tensor, wanted: Tensor, settings: Settings) -> Estimate:
    """B templates solved in an ``image`` (1 or B, 1, H, W) from the ``wanted`` (B, K) ones of their places (B, K, 3):
    Estimate (B, K, ...), in which the others have that of any."""
    pairs = wanted.nonzero().split(SOLVED_AT_ONCE)
    parts = []
    for which, k in (pair.T for pair in pairs):
        some = reference.copies(len(which)) if len(place) == 1 else reference.select(which)
        parts.append(solve(some, image if len(image) == 1 else image[which], place[which, k], settings))
    row = (wanted.flatten().cumsum(0) - 1).clamp(min=0).view_as(wanted)
    return Estimate(*(torch.cat(values)[row] for values in zip(*parts, strict=True)))


def better(farther: Estimate, nearer: Estimate) -> Tensor:
    """Whether the ``farther`` place (B, ...) explains the image clearly better than the ``nearer`` one: (B,) bool."""
    a, b = FARTHER_MARGIN
    lack = torch.where(Status.good(nearer.status), 1 - nearer.score, torch.inf)
    return (1 - farther.score < a * lack - b) & (farther.status == Status.CONVERGED)


def _correlator(texture: Tensor, weight: Tensor, shape: tuple[int, int]) -> Correlator:
    """Kernels of ``texture`` (B, 1, h, w) under ``weight`` at all angles, for surroundings of ``shape``."""
    count = math.ceil(LARGEST_ANGLE / ANGLE_STEP) + 1
    angles = ANGLE_STEP * torch.arange(-count, count + 1, device=texture.device, dtype=texture.dtype)
    h, w = texture.shape[-2:]
    middle = angles.new_tensor(((w - 1) / 2, (h - 1) / 2))
    textures, weights = (rotated(image, angles, middle=middle, size=(h, w)) for image in (texture, weight))
    weights = weights / weights.sum((2, 3), keepdim=True).clamp(min=1e-12)
    kernels, _ = detrended(textures, weights)
    weight = weight / weight.sum((2, 3), keepdim=True).clamp(min=1e-12)
    return Correlator.of(kernels, weight, planes=weight[:, :, None], size=shape)


def _subsampled(image: Tensor, weight: Tensor, spacing: int) -> tuple[Tensor, Tensor]:
    """Images and weights (B, 1, h, w) on the LARGEST_KERNEL pixels in their middle that are ``spacing`` px apart."""
    counts = [(n - 1) // spacing + 1 for n in image.shape[-2:]]
    counts = [n - 2 * max(-(-(n - LARGEST_KERNEL) // 2), 0) for n in counts]
    rows, columns = (_resampling(n, m, spacing, image) for n, m in zip(image.shape[-2:], counts, strict=True))
    weights = rows @ weight @ columns.mT
    return rows @ (image * weight) @ columns.mT / weights.clamp(min=1e-12), weights


def _resampling(n: int, m: int, spacing: int, like: Tensor) -> Tensor:
    """What takes ``n`` samples to the ``m`` in their middle, ``spacing`` apart, blurred as by a pyramid: (m, n)."""
    variance = max((spacing**2 - 1) / 3, 1e-2)
    place, sample = (span(k, like) for k in (m, n))
    return torch.softmax(-(sample - spacing * place[:, None]).square() / (2 * variance), -1)


def _enough(texture: Tensor, weights: Tensor, image: Tensor, weight: Tensor, spacing: int) -> bool:
    """Whether enough pixels are left ``spacing`` px apart, and of the texture what white texture would leave."""
    kept, full = ((w * t * t).sum((1, 2, 3)) / w.sum((1, 2, 3)) for t, w in ((texture, weights), (image, weight)))
    density = 4 * math.pi * (spacing**2 - 1) / 3 * kept / full.clamp(min=1e-12)
    count = (weight > 0).sum((1, 2, 3)) / spacing**2
    return bool((density >= LEAST_DENSITY).all() & (count >= SMALLEST_SEARCHED**2).all())
