"""Templates looked for around where they are expected: every place within some px and a few small turns at once.

What brings a template back that is out of Gauss-Newton's reach, for a tenth of what a search of the whole frame costs
(``locate``). Weighted normalised correlation by FFT, as coarse as the texture allows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.align import solve
from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import compose, rotation
from torch_ecc.core.pyramid import as_images
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import Sampler, inside
from torch_ecc.core.settings import Settings
from torch_ecc.search.bank import SMALLEST_SEARCHED, fast_length

FARTHEST = 24  # px
WIDEST, TURN = math.radians(9), math.radians(1.5)  # the largest turn, and from one to the next
STEPS = (8, 4, 2, 1)  # px between the pixels that are compared
LEAST_DENSITY = 2.0  # texture that is left, over what white noise of the same contrast would leave
LARGEST = 49  # of them across: they tell enough
TRIED = 3  # places per template that are brought to the answer
HANDICAP = 0.25  # of correlation: what such a place may lack to the best one
CLEARLY = (0.9, 0.002)  # a farther place must lack less to a score of 1 than a times what a nearer one lacks, minus b


class Nearby(NamedTuple):
    """B templates at A small turns on pixels ``step`` px apart, for the surroundings of their poses.

    ``middle`` (B, 2): the template's point x' in the middle of what is compared. ``shape``: the surroundings'
    pixels. Spectra, conjugated: ``texture`` (B, A, H, W // 2 + 1) of unit norm off the plane of light, ``weight``
    (B, 1, H, W // 2 + 1) of unit sum.
    """

    step: int
    shape: tuple[int, int]
    middle: Tensor
    texture: Tensor
    weight: Tensor

    @staticmethod
    def of(reference: Reference) -> Nearby:
        """Of prepared templates."""
        template, weight, corner = as_images(reference)
        h, w = template.shape[-2:]
        middle = corner + corner.new_tensor((w - 1, h - 1)) / 2 - reference.place.centre
        weight = weight / weight.sum((2, 3), keepdim=True)
        template = template - (weight * template).sum((2, 3), keepdim=True)
        for step in STEPS:
            texture, weights = _coarser(template, weight, step)
            if step == 1 or _tells(texture, weights, template, weight, step):
                break
        texture, weights = _turned(texture, weights, _turns(reference.place.radius.to(template)))
        reach = 2 * math.ceil(FARTHEST / step) + 2
        shape = (texture.shape[-2] + reach, texture.shape[-1] + reach)
        size = [fast_length(n) for n in shape]
        spectra = (torch.fft.rfft2(kernel, s=size).conj_physical() for kernel in (texture, weights))
        return Nearby(step, shape, middle.to(reference.place.radius), *spectra)

    def find(self, reference: Reference, image: Tensor, pose: Tensor, settings: Settings) -> Estimate:
        """The templates in ``image`` (1 or B, 1, H, W) around ``pose`` (B, 3): the nearest of those places that are not
        clearly worse than another."""
        place, score = self.candidates(image, pose)
        step = place - pose[:, None]
        away = torch.cat((step[..., :2], step[..., 2:] * reference.place.radius[:, None, None]), -1).norm(dim=-1)
        order = torch.where(score >= score[:, :1] - HANDICAP, away, torch.inf).sort(-1)
        place = place.gather(1, order.indices[..., None].expand_as(place))
        best = solve(reference, image, place[:, 0], settings)
        for k in range(1, TRIED):
            some = order.values[:, k].isfinite().nonzero()[:, 0]
            if len(some):
                own = image if len(image) == 1 else image[some]
                found = solve(reference.select(some), own, place[some, k], settings)
                lack = torch.where(Status.good(best.status[some]), 1 - best.score[some], torch.inf)
                clearly = 1 - found.score < CLEARLY[0] * lack - CLEARLY[1]
                better = (clearly & (found.status == Status.CONVERGED)).nonzero()[:, 0]
                best = best.put(some[better], found.at(better))
        return best

    def candidates(self, image: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Where ``image`` (1 or B, 1, H, W) looks most like the templates around ``pose`` (B, 3): (B, TRIED, 3), the
        best first, and the correlations (B, TRIED)."""
        g = self._surroundings(image, pose)
        shape = [fast_length(n) for n in self.shape]
        spectra = torch.fft.rfft2(torch.stack((g, g * g), 1), s=shape)
        reach = 2 * math.ceil(FARTHEST / self.step) + 3
        match, average = (
            torch.fft.irfft2(product, s=shape)[..., :reach, :reach]
            for product in (spectra[:, :1] * self.texture, spectra * self.weight)
        )
        power = average[:, 1] - average[:, 0].square()
        floor = 1e-4 * power.amax((1, 2), keepdim=True).clamp(min=1e-12)
        place, score = _peaks(match * torch.maximum(power, floor).rsqrt()[:, None])
        place, middle = place.to(self.middle), self.middle[:, None].expand(-1, TRIED, -1)
        flat = torch.zeros_like(middle[..., :1])
        shift = place[..., :2] * self.step + middle
        turned = compose(torch.cat((shift, place[..., 2:] * TURN), -1), torch.cat((-middle, flat), -1))
        return compose(pose[:, None].expand_as(turned), turned), score

    def _surroundings(self, image: Tensor, pose: Tensor) -> Tensor:
        """Grey levels (B, H, W) about their mean, turned as the templates are at ``pose``."""
        sides = [(n - 1) * self.step + 1 for n in self.shape]
        y, x = torch.meshgrid(*(_span(n, image) for n in sides), indexing="ij")
        turn = rotation(pose[:, 2])
        warp = torch.cat((turn, pose[:, :2, None] + turn @ self.middle[:, :, None]), -1)
        pixels = torch.stack((x.flatten(), y.flatten(), torch.ones_like(x.flatten())))
        g = Sampler.of(image)(warp, pixels).view(-1, *sides)
        g = _rows(sides[0], self.shape[0], self.step, g) @ g @ _rows(sides[1], self.shape[1], self.step, g).mT
        return g - g.mean((1, 2), keepdim=True)


def _peaks(score: Tensor) -> tuple[Tensor, Tensor]:
    """The TRIED highest maxima of scores (B, A, h, w), between pixels and turns by parabolas, counted from the middle:
    x, y, turn (B, TRIED, 3), and their heights (B, TRIED). The outermost places and turns are only
    there to be compared with."""
    volume = score.flatten(1)
    inner = score[:, 1:-1, 1:-1, 1:-1]
    peak = torch.where(inner >= F.max_pool3d(score[:, None], 3, 1)[:, 0], inner, -1.0)
    height, index = peak.flatten(1).topk(TRIED)
    a, h, w = inner.shape[1:]
    cell = torch.stack((index % w, index // w % h, index // (w * h)), -1)
    stride = cell.new_tensor((1, w + 2, (w + 2) * (h + 2)))
    index = ((cell + 1) * stride).sum(-1, keepdim=True)
    before, top, after = (volume.gather(1, (index + k * stride).flatten(1)).view(cell.shape) for k in (-1, 0, 1))
    offset = (after - before) / 2 / (2 * top - before - after).clamp(min=1e-6)
    return cell - score.new_tensor((w - 1, h - 1, a - 1)) / 2 + offset.clamp(-0.5, 0.5), height


def _coarser(template: Tensor, weight: Tensor, step: int) -> tuple[Tensor, Tensor]:
    """Templates and weights (B, 1, h, w) on the LARGEST pixels in their middle that are ``step`` px apart."""
    size = [(n - 1) // step + 1 for n in template.shape[-2:]]
    size = [n - 2 * max(-(-(n - LARGEST) // 2), 0) for n in size]
    rows, columns = (_rows(n, m, step, template) for n, m in zip(template.shape[-2:], size, strict=True))
    weights = rows @ weight @ columns.mT
    return rows @ (template * weight) @ columns.mT / weights.clamp(min=1e-12), weights


def _rows(n: int, m: int, step: int, like: Tensor) -> Tensor:
    """What takes ``n`` samples to the ``m`` in their middle, ``step`` apart, blurred as by repeated halving: (m, n)."""
    variance = max((step**2 - 1) / 3, 1e-2)
    place, sample = (_span(k, like) for k in (m, n))
    return torch.softmax(-(sample - step * place[:, None]).square() / (2 * variance), -1)


def _span(n: int, like: Tensor) -> Tensor:
    """``n`` places (n,) one apart about 0."""
    return torch.arange(n, dtype=like.dtype, device=like.device) - (n - 1) / 2


def _tells(texture: Tensor, weights: Tensor, template: Tensor, weight: Tensor, step: int) -> bool:
    """Whether enough pixels are left ``step`` px apart, and of the texture what white texture would leave."""
    kept, full = ((w * t * t).sum((1, 2, 3)) / w.sum((1, 2, 3)) for t, w in ((texture, weights), (template, weight)))
    density = 4 * math.pi * (step**2 - 1) / 3 * kept / full.clamp(min=1e-12)
    count = (weight > 0).sum((1, 2, 3)) / step**2
    return bool((density >= LEAST_DENSITY).all() & (count >= SMALLEST_SEARCHED**2).all())


def _turns(like: Tensor) -> Tensor:
    n = math.ceil(WIDEST / TURN) + 1
    return TURN * torch.arange(-n, n + 1, device=like.device, dtype=like.dtype)


def _turned(texture: Tensor, weights: Tensor, turns: Tensor) -> tuple[Tensor, Tensor]:
    """Kernels (B, A, h, w) of the weighted ``texture`` (B, 1, h, w) off the plane 1, x, y, of unit norm, turned about
    their middle; and the weights (B, 1, h, w) of unit sum, as they are without a turn."""
    b, _, h, w = texture.shape
    y, x = torch.meshgrid(*(_span(n, turns) for n in (h, w)), indexing="ij")
    planes = torch.stack((x.flatten(), y.flatten(), torch.ones_like(x.flatten())))
    middle = turns.new_tensor(((w - 1) / 2, (h - 1) / 2))[None, :, None].expand(len(turns), 2, 1)
    warp = torch.cat((rotation(-turns), middle), -1).repeat(b, 1, 1)
    both = torch.stack((texture, weights)).repeat_interleave(len(turns), 1)
    t, weight = (Sampler.of(image)(warp, planes) for image in both)
    weight = weight * inside(warp, planes, (h, w))
    weighted = planes * weight[:, None]
    inverse, _ = safe_inverse(weighted @ planes.mT)
    kernel = weight * (t - (planes.mT @ (inverse @ (weighted @ t[..., None])))[..., 0])
    norm = (kernel * t).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp(min=1e-12)
    kernel = kernel / (norm.clamp(min=1e-12).sqrt() * weight.sum(-1, keepdim=True).clamp(min=1e-12))
    return kernel.view(b, -1, h, w), weights / weights.sum((2, 3), keepdim=True).clamp(min=1e-12)
