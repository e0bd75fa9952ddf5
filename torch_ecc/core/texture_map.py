"""How well each place of a frame can be tracked: ``patches.texture`` of windows everywhere, from sums over boxes.

Every column that a patch is fitted with is one of four images (slopes along x and y, grey level, one) times 1, x or y.
So all normal matrices follow from the products of two images, summed over every window with powers of x and y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.ambient import plain, threads_for
from torch_ecc.core.frame import as_gray, require_tensor
from torch_ecc.core.grid import Grid, Place
from torch_ecc.core.noise import DIM_BLURS, INSTRUMENT_BLUR, LEAST_NOISE, NOISE_SHARE, Noise, blurred
from torch_ecc.core.normal import Moments, Normal, normal_equations
from torch_ecc.core.patches import QUANTISATION, Size, as_size
from torch_ecc.core.reference import MARGIN, NARROW, Reference, chosen, each
from torch_ecc.core.sampling import clipped, gradients, noise_samples, pad
from torch_ecc.core.verdict import predicted_sigma

MOST_PLACES = 16_000  # of a map
FINENESS = 10  # steps per side of a window
LEVELS = 128  # of noise that are told apart, from squares of
SQUARE = 12  # px
BLURRED = 3  # images that instruments are made of, before all others

Products = dict[tuple[int, int], Tensor]  # of two images, their sums


class TextureMap(NamedTuple):
    """Predicted ``sigma`` (rows, columns, 3) px, px, rad of patches of ``size`` (h, w) with their centres at ``x``
    (columns,) and ``y`` (rows,) px; infinite where the texture does not fix the pose."""

    sigma: Tensor
    x: Tensor
    y: Tensor
    size: tuple[int, int]

    @property
    def worst(self) -> Tensor:
        """Sigma of the place of a patch's farthest pixel: (rows, columns) px."""
        h, w = self.size
        arm = math.hypot(h - 1, w - 1) / 2
        return (self.sigma * self.sigma.new_tensor((1.0, 1.0, arm))).square().sum(-1).sqrt()

    def best(self, count: int) -> Tensor:
        """Centres (n, 2) of up to ``count`` patches that do not overlap, the best one first."""
        (h, w), worst, found = self.size, self.worst.clone(), list[tuple[float, float]]()
        while len(found) < count and bool(worst.isfinite().any()):
            row, column = divmod(int(worst.argmin()), len(self.x))
            found.append((float(self.x[column]), float(self.y[row])))
            near = (self.y - self.y[row]).abs()[:, None].lt(h) & (self.x - self.x[column]).abs().lt(w)
            worst[near] = torch.inf
        return self.x.new_tensor(found).reshape(-1, 2)


class _Windows(NamedTuple):
    """Windows of ``size`` (h, w) px at every ``step`` px of a frame, as many as fit."""

    size: tuple[int, int]
    step: int

    def middles(self, shape: torch.Size) -> list[Tensor]:
        """Where the windows of a frame (..., H, W) have theirs: y (rows,) and x (columns,) px."""
        return [
            torch.arange(0, n - side + 1, self.step, dtype=torch.float64) + (side - 1) / 2
            for n, side in zip(shape[-2:], self.size, strict=True)
        ]

    def sums(self, image: Tensor) -> Tensor:
        """Of an ``image`` (H, W) times x^i y^j about each window's middle: (windows, i = 0 1 2, j = 0 1 2)."""
        along_x = _power_sums(image, self.size[1], self.step)  # (H, i, columns)
        both = _power_sums(along_x.permute(2, 1, 0), self.size[0], self.step)  # (columns, i, j, rows)
        return both.permute(3, 0, 1, 2).flatten(0, 1)

    def gram(self, images: Tensor, known: Products) -> Tensor:
        """Sums over each window of all products of ``images`` (n, H, W), each times 1, x and y: (windows, 3 n, 3 n);
        those that are ``known`` are not made again."""
        power = torch.tensor([[0, 0], [1, 0], [0, 1]])  # of x and y
        i, j = (power[:, None] + power).unbind(-1)
        n, blocks = len(images), dict(known)
        for a in range(n):
            for b in (b for b in range(a, n) if (a, b) not in known):
                blocks[a, b] = blocks[b, a] = self.sums(images[a] * images[b])[:, i, j]  # as symmetric as the product
        known |= {pair: block for pair, block in blocks.items() if min(pair) >= BLURRED}
        return torch.cat([torch.cat([blocks[a, b] for b in range(n)], 2) for a in range(n)], 1)


@plain
@torch.no_grad()
def texture_map(frame: Tensor, size: Size, *, step: int | None = None) -> TextureMap:
    """``te.texture`` of patches of ``size`` with their centres everywhere in a ``frame``, on the CPU.

    Under the default criterion, and to 5 % for patches of 40 px and more: in smaller ones the noise changes too much
    from place to place (20 px: mostly to 15 %). ``step``: px between places; by default a tenth of the smaller side,
    or more where that would make over 16,000 of them. Raises ValueError for what does not fit.
    """
    gray = as_gray("texture_map", "frame", frame).cpu()
    (h, w), (height, width) = as_size("texture_map", size), gray.shape[-2:]
    if len(gray) != 1 or h > height or w > width:
        raise ValueError(f"texture_map: frame must be one image of {w}x{h} px or more, got {tuple(frame.shape)}")
    if step is not None and step < 1:
        raise ValueError(f"texture_map: step must be 1 px or more, got {step}")
    coarsest = math.isqrt((height - h + 1) * (width - w + 1) // MOST_PLACES) + 1
    windows = _Windows((h, w), step or max(min(h, w) // FINENESS, coarsest))
    rounding = 0.0 if require_tensor("texture_map", "frame", frame).is_floating_point() else QUANTISATION
    y, x = windows.middles(gray.shape)
    with threads_for(gray.numel()):
        sigma = _predicted(gray, windows, rounding)
    return TextureMap(sigma.view(len(y), len(x), 3), x, y, (h, w))


class _Judged(NamedTuple):
    """What the verdict's predictions read of a reference."""

    noise: Noise
    grid: Grid
    place: Place


def _predicted(gray: Tensor, windows: _Windows, rounding: float) -> Tensor:
    """Sigma (windows, 3) of a frame (1, 1, H, W), as ``texture`` has it, from each window's normal equations."""
    wide = pad(gray - gray.mean(), 2 * MARGIN)
    level = torch.maximum(_noise(gray, windows), LEAST_NOISE * _contrast(_inner(wide)[0, 0], windows))
    known: Products = {}
    noise, normal = _observed(wide, level, windows, INSTRUMENT_BLUR, known)
    for wider in (blur for blur in DIM_BLURS if NARROW * blur < min(windows.size)):
        share = normal.noise_share * noise.power
        if bool((share <= NOISE_SHARE).all()):
            break
        others = _observed(wide, level, windows, wider, known)
        better = (share > NOISE_SHARE) & (others[1].noise_share * noise.power < share)
        noise = each(partial(chosen, better), others[0], noise)
        normal = each(partial(chosen, better), others[1], normal)
    none, (h, w) = torch.zeros_like(level), windows.size
    lever2 = torch.stack((none + 1, none + 1, none + ((h - 1) ** 2 + (w - 1) ** 2) / 4), 1)
    grid = Grid(torch.empty(3, h * w), torch.empty(3, 4), torch.empty(2), torch.empty(0), (0, 0), 0)
    place = Place(torch.empty(0), torch.empty(0), lever2.sqrt(), lever2, torch.empty(0))
    reference = cast(Reference, _Judged(noise, grid, place))
    variance = level.square() + rounding
    return predicted_sigma(reference, normal, variance)


def _observed(
    wide: Tensor, level: Tensor, windows: _Windows, instrument_blur: float, known: Products
) -> tuple[Noise, Normal]:
    """Noise and normal equations of each window under instruments of some blur, see ``_moments``."""
    noise = Noise.of(level, instrument_blur)
    return noise, normal_equations(_moments(wide, level, windows, instrument_blur, known), noise.response)


def _moments(wide: Tensor, noise: Tensor, windows: _Windows, instrument_blur: float, known: Products) -> Moments:
    """Of each window, with its ``noise`` (windows,), in a frame (1, 1, ...) that is continued on every side; products
    of images that are not blurred are ``known`` afterwards."""
    soft, slopes, texture = blurred(wide, 2 * MARGIN, _everywhere(noise, windows, wide.shape), instrument_blur)
    q, one = _inner(texture), torch.ones_like(_inner(wide))
    images = _inner(slopes) * q, _inner(soft), _inner(gradients(wide)), _inner(wide), one
    gram = windows.gram(torch.cat(images, 1)[0], known)
    number = gram[:, 18, 18]
    Z, R = (_columns(k, windows.size, gram[:, 3 * k + 6, 18] / number) for k in (0, 3))
    arms = [windows.sums(each)[:, [0, 1, 0, 2, 0], [0, 0, 1, 0, 2]] for each in (q[0, 0], q[0, 0].square())]
    light = _light(windows.size, R)
    return Moments(
        number,
        Z @ gram @ R.mT,
        Z @ gram @ Z.mT,
        light @ gram @ light.mT,
        torch.stack([torch.cat((each[:, :3], each[:, 3:].sum(1, keepdim=True)), 1) for each in arms], 1),
    )


def _columns(first: int, size: tuple[int, int], mean: Tensor) -> Tensor:
    """``ECC.columns`` as combinations (B, 7, 21) of seven images, each times 1, x and y: from the ``first`` on slopes
    and level, which has the ``mean`` (B,) in each window; the last one is one."""
    h, w = ((side - 1) / 2 for side in size)
    columns, x, y, level = mean.new_zeros(len(mean), 7, 21), 3 * first, 3 * first + 3, 3 * first + 6
    columns[:, 0, x] = columns[:, 1, y] = columns[:, 3, level] = columns[:, 4, 18] = 1.0
    columns[:, 2, x + 2], columns[:, 2, y + 1] = 1.0, -1.0  # theta: slope x times y less slope y times x
    columns[:, 5, level + 1], columns[:, 6, level + 2] = 1 / w, 1 / h
    columns[:, 3, 18], columns[:, 5, 19], columns[:, 6, 20] = -mean, -mean / w, -mean / h
    return columns


def _light(size: tuple[int, int], columns: Tensor) -> Tensor:
    """1, u, v and the level less its mean, as ``columns`` has it: (B, 4, 21)."""
    h, w = ((side - 1) / 2 for side in size)
    light = columns[:, [4, 4, 4, 3]].clone()
    light[:, 1:3] = 0.0
    light[:, 1, 19], light[:, 2, 20] = 1 / w, 1 / h
    return light


def _contrast(level: Tensor, windows: _Windows) -> Tensor:
    """Standard deviation (windows,) of levels (H, W)."""
    h, w = windows.size
    mean, square = (windows.sums(each)[:, 0, 0] / (h * w) for each in (level, level.square()))
    return (square - mean.square()).clamp(min=0).sqrt()


def _inner(wide: Tensor) -> Tensor:
    """The frame (..., H, W) in what is continued by twice MARGIN px."""
    return wide[..., 2 * MARGIN : -2 * MARGIN, 2 * MARGIN : -2 * MARGIN]


def _noise(gray: Tensor, windows: _Windows) -> Tensor:
    """``noise_level`` of each window of a frame (1, 1, H, W), to the nearest of some levels: (windows,).

    The samples on each crossing of two stretches are counted by their level, and the counts summed over the windows.
    """
    sides, step = windows
    samples = torch.where(clipped(gray), torch.nan, noise_samples(pad(gray, 1)))[0, 0]
    levels = _levels(samples)
    steps = [_steps(n, side, step) for n, side in zip(samples.shape, sides, strict=True)]
    row, column = (_stretch(n, side, step) for n, side in zip(steps, sides, strict=True))
    samples = samples[: len(row), : len(column)].contiguous()
    level = torch.searchsorted((levels[1:] + levels[:-1]) / 2, samples)  # NaN is beyond all, and not counted
    bin = (level * 2 * steps[0] + row[: len(samples), None]) * 2 * steps[1] + column[: samples.shape[1]]
    shape = len(levels), 2 * steps[0], 2 * steps[1]
    counts = torch.bincount(bin[~samples.isnan()], minlength=math.prod(shape)).view(shape)
    counts = _over_windows(_over_windows(counts, sides[1], step).mT, sides[0], step).mT
    below = counts.cumsum(0)
    return levels[(2 * below >= below[-1:]).to(torch.int8).argmax(0)].flatten().double()


def _levels(samples: Tensor) -> Tensor:
    """The medians (n,) of small squares, of so many that all others are near to one: ascending."""
    side = min(SQUARE, *samples.shape)
    h, w = (n // side * side for n in samples.shape)
    squares = samples[:h, :w].unflatten(1, (-1, side)).unflatten(0, (-1, side)).movedim(1, 2).flatten(2)
    medians: Tensor = squares.nanmedian(-1).values.nan_to_num().unique()
    some = torch.linspace(0, len(medians) - 1, min(len(medians), LEVELS))
    return medians[some.round().long()]


def _everywhere(values: Tensor, windows: _Windows, shape: torch.Size) -> Tensor:
    """The values (windows,) of the nearest window for every pixel of what is continued: (1, 1, H, W)."""
    pixels = [torch.arange(n, dtype=torch.float64) - 2 * MARGIN for n in shape[-2:]]
    frame = torch.Size(n - 4 * MARGIN for n in shape[-2:])
    middles = windows.middles(frame)
    rows, columns = (
        ((p - m[0]) / windows.step).round().clamp(0, len(m) - 1).long() for p, m in zip(pixels, middles, strict=True)
    )
    return values.view(len(middles[0]), -1)[rows][:, columns][None, None]


def _steps(length: int, side: int, step: int) -> int:
    """How many steps the windows of ``side`` at every ``step`` of an axis reach over, those after the last included."""
    return (length - side) // step + 1 + side // step


def _stretch(steps: int, side: int, step: int) -> Tensor:
    """Which stretch each pixel of some steps is in: their windows' first and last pixels cut each step into two."""
    pixel = torch.arange(steps * step)
    return 2 * (pixel // step) + (pixel % step >= side % step)


def _over_windows(stretches: Tensor, side: int, step: int) -> Tensor:
    """Sums over windows (..., windows) from those over stretches (..., n)."""
    running, whole = F.pad(stretches.cumsum(-1), (1, 0)), side // step
    begin = torch.arange(0, stretches.shape[-1] - 2 * whole, 2)
    return running[..., begin + 2 * whole + 1] - running[..., begin]


def _power_sums(values: Tensor, side: int, step: int) -> Tensor:
    """Sums of ``values`` (..., n) times 1, x and x^2 over windows of ``side`` at every ``step``, x from the middle of
    each: (..., 3, windows), float64."""
    steps = _steps(values.shape[-1], side, step)
    x = torch.arange(step, dtype=values.dtype)
    powers, first = torch.stack((torch.ones_like(x), x, x * x)), x < side % step
    cut = F.pad(values, (0, steps * step - values.shape[-1])).unflatten(-1, (steps, step))
    sums = (cut @ torch.cat((powers * first, powers * ~first)).mT).double().unflatten(-1, (2, 3))
    stretches = _shifted(sums.unbind(-1), torch.arange(steps, dtype=torch.float64)[:, None] * step)
    over = _over_windows(stretches.flatten(-2), side, step)
    middle = torch.arange(over.shape[-1], dtype=torch.float64) * step + (side - 1) / 2
    return _shifted(over.unbind(-2), -middle)


def _shifted(sums: Sequence[Tensor], start: Tensor) -> Tensor:
    """Sums times 1, x and x^2, x counted from ``start`` before, now from 0: stacked before the axes of ``start``."""
    n, x, xx = sums
    return torch.stack((n, x + start * n, xx + start * (2 * x + start * n)), -1 - start.dim())
