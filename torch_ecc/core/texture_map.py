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
from torch_ecc.core.filters import pad
from torch_ecc.core.frame import as_gray, require_tensor
from torch_ecc.core.grid import Grid, Place
from torch_ecc.core.noise import (
    DIM_BLURS,
    INSTRUMENT_BLUR,
    LEAST_NOISE,
    NOISE_SHARE,
    Noise,
    blurred,
    clipped,
    noise_samples,
)
from torch_ecc.core.normal import Moments, Normal, normal_equations
from torch_ecc.core.patches import QUANTISATION, Size, as_size
from torch_ecc.core.reference import MARGIN, NARROW, Reference, chosen, each
from torch_ecc.core.sampling import gradients
from torch_ecc.core.verdict import predicted_sigma

MOST_PLACES = 16_000  # of a map
FINENESS = 10  # steps per side of a window
LEVELS = 128  # of noise that are told apart, from squares of
SQUARE = 12  # px
BLURRED = 3  # images that instruments are made of, before all others: slopes along x and y, level; then these and one
SHARP = {(3, 6), (4, 6), (5, 5), (5, 6), (6, 6)}  # products of the others that are needed

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
        (h, w), step = self.size, self.step
        rows, columns = (_steps(n, side, step) for n, side in zip(image.shape, self.size, strict=True))
        whole = F.pad(image, (0, columns * step - image.shape[1], 0, rows * step - image.shape[0]))
        down = _powers(h, step, image) @ whole.unflatten(0, (rows, step))  # (rows, 6, W)
        both = (down.unflatten(2, (columns, step)) @ _powers(w, step, image).mT).double()  # (rows, 6, columns, 6)
        along_x = _joined(both, w, step).permute(2, 3, 0, 1)  # (i, windows across, rows, 6)
        return _joined(along_x, h, step).permute(3, 1, 0, 2).flatten(0, 1)

    def gram(self, images: Tensor, known: Products) -> Tensor:
        """Sums over each window of the products of two ``images`` (7, H, W), each times 1, x and y: (windows, 21, 21),
        0 for those that nothing needs. What is ``known`` of images that are not blurred is not made again."""
        power = torch.tensor([[0, 0], [1, 0], [0, 1]])  # of x and y
        i, j = (power[:, None] + power).unbind(-1)
        pairs = [(a, b) for a in range(7) for b in range(a, 7) if a < BLURRED or (a, b) in SHARP]
        for a, b in pairs:
            if a < BLURRED or (a, b) not in known:
                known[a, b] = self.sums(images[a] * images[b]).flatten(1)
        sums = [known[pair] for pair in pairs]
        order = {pair: 9 * number for number, pair in enumerate(pairs)}
        first = [[order.get((min(a, b), max(a, b)), 9 * len(pairs)) for b in range(7)] for a in range(7)]
        which = torch.tensor(first)[:, None, :, None] + (3 * i + j)[None, :, None, :]  # as symmetric as the products
        gram: Tensor = torch.cat([*sums, torch.zeros_like(sums[0])], 1)[:, which.flatten()].unflatten(1, (21, 21))
        return gram


@plain
@torch.no_grad()
def texture_map(frame: Tensor, size: Size, *, step: int | None = None) -> TextureMap:
    """``te.texture`` of patches of ``size`` with their centres everywhere in a ``frame``, on the CPU.

    Under the default criterion, and to 5 % for patches of 40 px and more (97 of 100 places). What is told from noise
    near the edge of a patch depends on its surroundings here, and counts for more in smaller ones: of 31 px nine in ten
    are right to 8 %, of 20 px to 20 %, half of them to 5 %. ``step``: px between places; by default a tenth of the
    smaller side, or more where that would make over 16,000 of them. Raises ValueError for what does not fit.
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


class _Frame(NamedTuple):
    """A frame (H, W) that is continued on every side, ``wide`` (1, 1, ...); what of it is not blurred, ``sharp`` (1, 4,
    H, W): slopes, level and one; and the sums of all products that were made last."""

    wide: Tensor
    sharp: Tensor
    products: Products


class _Judged(NamedTuple):
    """What the verdict's predictions read of a reference."""

    noise: Noise
    grid: Grid
    place: Place


def _predicted(gray: Tensor, windows: _Windows, rounding: float) -> Tensor:
    """Sigma (windows, 3) of a frame (1, 1, H, W), as ``texture`` has it, from each window's normal equations."""
    wide = pad(gray - gray.mean(), 2 * MARGIN)
    frame = _Frame(wide, _inner(torch.cat((gradients(wide), wide, torch.ones_like(wide)), 1)), {})
    level = torch.maximum(_noise(gray, windows), LEAST_NOISE * _contrast(_inner(wide)[0, 0], windows))
    noise, normal = _observed(frame, level, windows, INSTRUMENT_BLUR)
    for wider in (blur for blur in DIM_BLURS if NARROW * blur < min(windows.size)):
        share = normal.noise_share * noise.power
        if bool((share <= NOISE_SHARE).all()):
            break
        others = _observed(frame, level, windows, wider)
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


def _observed(frame: _Frame, level: Tensor, windows: _Windows, instrument_blur: float) -> tuple[Noise, Normal]:
    """Noise and normal equations of each window under instruments of some blur, see ``_moments``."""
    noise = Noise.of(level, instrument_blur)
    return noise, normal_equations(_moments(frame, level, windows, instrument_blur), noise.response)


def _moments(frame: _Frame, noise: Tensor, windows: _Windows, instrument_blur: float) -> Moments:
    """Of each window, with its ``noise`` (windows,)."""
    noise = _everywhere(noise, windows, frame.wide.shape)
    soft, slopes, texture = blurred(frame.wide, 2 * MARGIN, noise, instrument_blur)
    q = _inner(texture)
    gram = windows.gram(torch.cat((_inner(slopes) * q, _inner(soft), frame.sharp), 1)[0], frame.products)
    number = gram[:, 18, 18]
    Z, R = (_columns(k, windows.size, gram[:, 3 * k + 6, 18] / number) for k in (0, 3))
    arms = [windows.sums(each)[:, [0, 1, 0, 2, 0], [0, 0, 1, 0, 2]] for each in (q[0, 0], q[0, 0].square())]
    light = _light(windows.size, R)
    sums = Z @ gram
    return Moments(
        number,
        sums @ R.mT,
        sums @ Z.mT,
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
    level = torch.searchsorted((levels[1:] + levels[:-1]) / 2, samples, out_int32=True)
    level = torch.where(samples.isnan(), len(levels), level)  # where they are not counted
    bin = (level * 2 * steps[0] + row[: len(samples), None]) * 2 * steps[1] + column[: samples.shape[1]]
    shape = len(levels) + 1, 2 * steps[0], 2 * steps[1]
    counts = torch.bincount(bin.flatten(), minlength=math.prod(shape)).view(shape)[:-1]
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
    pixel = torch.arange(steps * step, dtype=torch.int32)
    return 2 * (pixel // step) + (pixel % step >= side % step)


def _over_windows(stretches: Tensor, side: int, step: int) -> Tensor:
    """Sums over windows (..., windows) from those over stretches (..., n)."""
    running, whole = F.pad(stretches.cumsum(-1), (1, 0)), side // step
    begin = torch.arange(0, stretches.shape[-1] - 2 * whole, 2)
    return running[..., begin + 2 * whole + 1] - running[..., begin]


def _powers(side: int, step: int, like: Tensor) -> Tensor:
    """1, x and x^2 of the pixels x of a step, those of its first stretch and those of its second: (6, step)."""
    x = torch.arange(step, dtype=like.dtype)
    powers, first = torch.stack((torch.ones_like(x), x, x * x)), x < side % step
    return torch.cat((powers * first, powers * ~first))


def _joined(stretches: Tensor, side: int, step: int) -> Tensor:
    """Sums times 1, x and x^2 over windows of ``side`` at every ``step``, x from the middle of each, from those of the
    stretches of each step, (..., steps, 6), x from where it begins: (..., 3, windows)."""
    start = torch.arange(stretches.shape[-2], dtype=stretches.dtype)[:, None] * step
    moved = _shifted(stretches.unflatten(-1, (2, 3)).unbind(-1), start)
    over = _over_windows(moved.flatten(-2), side, step)
    middle = torch.arange(over.shape[-1], dtype=stretches.dtype) * step + (side - 1) / 2
    return _shifted(over.unbind(-2), -middle)


def _shifted(sums: Sequence[Tensor], start: Tensor) -> Tensor:
    """Sums times 1, x and x^2, x counted from ``start`` before, now from 0: stacked before the axes of ``start``."""
    n, x, xx = sums
    return torch.stack((n, x + start * n, xx + start * (2 * x + start * n)), -1 - start.dim())
