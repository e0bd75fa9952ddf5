"""Image values between pixels: B-spline and bilinear sampling, and gradients.

The one place that knows the coordinates of ``grid_sample``. Everywhere else a point is (x, y) in px with
pixel centres at integers, and a warp is a 2x3 matrix that takes homogeneous template pixels (3, N) to such points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from itertools import cycle
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.ambient import constant
from torch_ecc.core.pose import pose_dtype

MARGIN_KEPT = 3  # px: a window serves until a patch comes nearer to its border
ROUNDING = 1e-6  # px: a pixel on the frame's outermost row is in sight, however its place was rounded

Pairs = list[tuple[int, Tensor, Tensor]]  # of taps: the first one's offset, the sum of both weights, the second weight
Slopes = list[tuple[Tensor, Tensor]]  # of these two by f


def _linear(f: Tensor) -> Pairs:
    return [(0, torch.ones_like(f), f)]


def _cubic(f: Tensor) -> Pairs:
    r, square = 1 - f, f * f
    left, right = (r * r).mul_(r).mul_(1 / 6), (square * f).mul_(1 / 6)
    high = (square + f).mul_(0.5).sub_(right, alpha=2).add_(1 / 6)
    low = 1 - high
    return [(-1, low, low - left), (1, high, right)]


def _quintic(f: Tensor) -> Pairs:
    r = 1 - f
    w = [
        r**5 / 120,
        ((1 + r) ** 5 - 6 * r**5) / 120,
        ((2 + r) ** 5 - 6 * (1 + r) ** 5 + 15 * r**5) / 120,
        ((2 + f) ** 5 - 6 * (1 + f) ** 5 + 15 * f**5) / 120,
        ((1 + f) ** 5 - 6 * f**5) / 120,
        f**5 / 120,
    ]
    return [(k - 2, w[k] + w[k + 1], w[k + 1]) for k in (0, 2, 4)]


def _linear_slopes(f: Tensor) -> Slopes:
    return [(torch.zeros_like(f), torch.ones_like(f))]


def _cubic_slopes(f: Tensor) -> Slopes:
    r, square = 1 - f, f * f
    high = f - square + 0.5
    return [(-high, torch.addcmul(-high, r, r, value=0.5)), (high, square / 2)]


def _quintic_slopes(f: Tensor) -> Slopes:
    r = 1 - f
    w = [
        *(-(r**4) / 24, (6 * r**4 - (1 + r) ** 4) / 24),
        (6 * (1 + r) ** 4 - (2 + r) ** 4 - 15 * r**4) / 24,
        ((2 + f) ** 4 - 6 * (1 + f) ** 4 + 15 * f**4) / 24,
        *(((1 + f) ** 4 - 6 * f**4) / 24, f**4 / 24),
    ]
    return [(w[k] + w[k + 1], w[k + 1]) for k in (0, 2, 4)]


class Kernel(NamedTuple):
    """An interpolation: how neighbouring pixels make a value between them. To add one, add it to ``SAMPLERS``.

    ``pairs``: of its non-negative taps around a point with fractional part f, any shape; ``slopes``: by how much they
    change with f; ``taps``: the kernel at 0, 1, 2 ... px, if it is not the identity there and images are prefiltered;
    ``radius``: px beyond which pixels bear on a value by less than 2e-4 of their contrast; ``noise_gain``: variance of
    white noise after sampling, mean over all sub-pixel phases (a sampler smooths what lies between pixels);
    ``aliases``: whether its own error counts.
    """

    pairs: Callable[[Tensor], Pairs]
    slopes: Callable[[Tensor], Slopes]
    taps: tuple[float, ...] = (1.0,)
    radius: int = 1
    noise_gain: float = 1.0
    aliases: bool = True

    @property
    def ring(self) -> int:
        """Taps before the pixel that a point lies behind."""
        return len(self.taps) - 1


SAMPLERS = {
    "bilinear": Kernel(_linear, _linear_slopes, noise_gain=4 / 9),
    # 0.27^7 and 0.43^10: the inverse filters' decay
    "bspline3": Kernel(_cubic, _cubic_slopes, (4 / 6, 1 / 6), 7, 0.7643),
    "bspline5": Kernel(_quintic, _quintic_slopes, (66 / 120, 26 / 120, 1 / 120), 10, 0.8427, aliases=False),
}
BAND, REACH = 160, 16  # px: slopes are made of so many at once; what is farther off counts for less than 1e-9
NEXT_TO_NOTHING = 1e-20  # beside the 1 on the diagonal
SLOPE = (0.0, 1 / 2)  # of the cubic B-spline at 0 and 1 px, but for the sign


class Sampler(NamedTuple):
    """Values of images between their pixels.

    ``values`` (I, 1, h, w): the image or the coefficients of its B-spline, I = 1 (shared by all, not copied) or one
    per template. ``origin`` (I, 2), float64: the position of value (0, 0), so that coordinates count from there, stay
    small, and float32 holds 1e-5 px.
    """

    values: Tensor
    kernel: Kernel
    origin: Tensor

    @staticmethod
    def of(image: Tensor, interpolation: str = "bilinear", corner: Tensor | None = None) -> Sampler:
        """Of an ``image`` (I, 1, h, w) whose pixel (0, 0) lies at ``corner`` (I, 2), by default the origin."""
        kernel = SAMPLERS[interpolation]
        if corner is None:
            corner = torch.zeros(len(image), 2, dtype=pose_dtype(image.device), device=image.device)
        values = prefilter(image, interpolation, kernel.ring) if kernel.ring else image
        return Sampler(values, kernel, corner - kernel.ring)

    def __call__(self, warp: Tensor, pixels: Tensor) -> Tensor:
        """Values at ``warp`` (B, 2, 3) of ``pixels`` (3, N): (B, N). Outside, its border repeats."""
        return self._at(self.points(warp, pixels))

    def scale(self) -> Tensor:
        """What takes px from value (0, 0) to grid_sample's coordinates plus 1: (2, 1)."""
        h, w = self.values.shape[-2:]
        return _to_unit(h, w, self.values.device)

    def points(self, warp: Tensor, pixels: Tensor) -> Tensor:
        """Where (B, 2, N) the ``warp`` takes ``pixels``: px from value (0, 0); without prefilter, where no more is done
        with them, in grid_sample's coordinates at once."""
        turn, shift = warp[:, :, :2], warp[:, :, 2:] - self.origin[:, :, None]
        if self.kernel.ring == 0:
            scale = self.scale()
            turn, shift = turn * scale, shift * scale - 1
        held = shift.to(pixels.dtype)  # the rest is added first: else its rounding would move all pixels alike
        warp = torch.cat((turn, shift - held), 2).to(pixels.dtype)
        return torch.addmm(held.view(-1, 1), warp.view(-1, 3), pixels).view(len(warp), 2, -1)

    def _at(self, points: Tensor) -> Tensor:
        """Values (B, N) at ``points`` (B, 2, N).

        Taps are non-negative, so each pair of neighbouring ones is one bilinear lookup at their centre of mass
        (Ruijters et al., 2008): a quarter as many lookups as there are taps.
        """
        if self.kernel.ring == 0:
            return lookup(self.values, points)
        floor = points.floor()
        pairs = self.kernel.pairs(points - floor)
        wx, wy = zip(*(total.unbind(1) for _, total, _ in pairs), strict=True)
        return _sum([_sum([lookup(self.values, at) for at in row], wx) for row in self.middles(floor, pairs)], wy)

    def middles(self, floor: Tensor, pairs: Pairs) -> list[list[Tensor]]:
        """Where (B, 2, N) to look up each pair of rows, and in it each pair of columns, of points behind the pixels
        ``floor`` (B, 2, N): in grid_sample's coordinates."""
        n, scale = len(pairs), self.scale().to(floor.dtype)
        middles = [torch.addcdiv(floor, second, total).add_(first).mul_(scale) for first, total, second in pairs]
        at = torch.stack(middles, 2).sub_(1).flatten(1, 2)  # x of each pair of columns, then y of each pair of rows
        return [[at[:, i : n + j + 1 : n + j - i] for i in range(n)] for j in range(n)]

    def select(self, index: Tensor) -> Sampler:
        """The sampler of some of the templates."""
        if len(self.values) == 1:
            return self
        return self._replace(values=self.values[index], origin=self.origin[index])

    def covers(self, low: Tensor, high: Tensor) -> bool:
        """Whether what lies between ``low`` and ``high`` (B, 2), px of the frame, was prefiltered."""
        first = self.origin + self.kernel.ring
        last = torch.stack((first[:, 0] + self.values.shape[-1], first[:, 1] + self.values.shape[-2]), 1)
        return bool(((low >= first) & (high < last - 2 * self.kernel.ring)).all())


def is_cpu(device: torch.device) -> bool:
    """Whether the host may look at values in the midst of a solve: that costs a CPU nothing, stops an accelerator, and
    what torch.compile makes cannot.

    It decides nothing but what is left undone: iterations after convergence, pixels of the frame far from a template.
    """
    return device.type == "cpu" and not torch.compiler.is_compiling()


def make_sampler(interpolation: str, image: Tensor, warp: Tensor, box: Tensor, last: Sampler | None = None) -> Sampler:
    """The sampler of ``image`` (I, 1, H, W), float, around the patches ``warp`` (B, 2, 3) of the rectangle ``box``
    (3, 4): the ``last`` one if it still serves.

    Only the neighbourhoods of the patches are prefiltered, unless so many share one image that all of it is less work;
    on an accelerator always all of it.
    """
    kernel, (h, w) = SAMPLERS[interpolation], image.shape[-2:]
    if kernel.ring == 0 or not is_cpu(image.device):
        return last or Sampler.of(image, interpolation)
    most = torch.tensor((w - 1, h - 1), dtype=warp.dtype, device=warp.device)
    corners = warp @ box.to(warp.dtype)
    low, high = corners.amin(-1), corners.amax(-1)
    kept = [torch.minimum(v.clamp(min=0), most) for v in (low - MARGIN_KEPT, high + MARGIN_KEPT)]
    whole = h + 2 * kernel.ring, w + 2 * kernel.ring
    if last is not None and (last.values.shape[-2:] == whole or last.covers(*kept)):
        return last
    low, high = low.nan_to_num().floor() - kernel.radius, high.nan_to_num().ceil() + kernel.radius
    side = -(-(int((high - low).max()) + 1) // 8) * 8  # few different sizes, so that the prefilter matrices are reused
    if side > min(h, w) or (len(image) == 1 and len(warp) * 2 * side**3 >= h * w * (h + w)):
        return Sampler.of(image, interpolation)
    low = torch.minimum(low.clamp(min=0), most - (side - 1))  # what lies beyond is not sampled
    return Sampler.of(_crops(image, low.long(), side), interpolation, low)


def inside(warp: Tensor, pixels: Tensor, size: Sequence[int]) -> Tensor:
    """Which ``pixels`` (3, N) the ``warp`` (B, 2, 3) puts inside a frame (h, w): bool (B, N)."""
    x, y = (warp @ pixels.to(warp.dtype)).unbind(1)
    right, bottom = size[1] - 1 + ROUNDING, size[0] - 1 + ROUNDING
    return (x >= -ROUNDING) & (x <= right) & (y >= -ROUNDING) & (y <= bottom)


def _crops(image: Tensor, corner: Tensor, side: int) -> Tensor:
    """Squares (B, 1, side, side) of ``image`` (1 or B, 1, H, W) from ``corner`` (B, 2) = (x, y), all inside."""
    frames = zip(cycle(range(len(image))), corner.tolist(), strict=False)
    return torch.stack([image[b, :, y : y + side, x : x + side] for b, (x, y) in frames])


def _mirror(index: Tensor, size: int) -> Tensor:
    period = max(2 * size - 2, 1)
    index = index.remainder(period)
    return torch.minimum(index, period - index)


@constant
def _to_unit(h: int, w: int, device: torch.device) -> Tensor:
    """What takes px from the first pixel to grid_sample's coordinates plus 1, which end at 2: (2, 1)."""
    ends = (2 / max(w - 1, 1), 2 / max(h - 1, 1))
    return torch.cat([torch.full((1, 1), end, dtype=pose_dtype(device), device=device) for end in ends])


def lookup(image: Tensor, points: Tensor) -> Tensor:
    """Bilinear lookup of ``image`` (I, 1, H, W) at normalised points (B, 2, N): (B, N). Its border repeats."""
    image = image if len(image) == len(points) else image.expand(len(points), -1, -1, -1)
    grid = points.mT.unsqueeze(1)
    values = F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return values.view(len(points), -1)


def _sum(values: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    """Sum of values times weights, in place of the first value."""
    values[0].mul_(weights[0])
    return reduce(lambda total, pair: total.addcmul_(*pair), zip(values[1:], weights[1:], strict=True), values[0])


@constant
def _band(n: int, taps: tuple[float, ...], sign: int, device: torch.device) -> Tensor:
    """Filter with ``taps`` at 0, 1, 2 ... px, odd about 0 for a ``sign`` of -1, mirrored at the border: (n, n)."""
    index = torch.arange(n, device="cpu")
    band = torch.zeros(n, n, dtype=torch.float64, device="cpu")
    for offset in range(1 - len(taps), len(taps)):
        band[index, _mirror(index + offset, n)] += taps[abs(offset)] * (1 if offset >= 0 else sign)
    return band.to(device)


def prefilter(image: Tensor, interpolation: str, ring: int = 0) -> Tensor:
    """Coefficients of the interpolating B-spline of ``image`` (..., H, W), mirrored at its border (Unser, 1993), and
    ``ring`` more on every side, which repeat those inside: (..., H + 2 ring, W + 2 ring).

    Two products with a dense inverse: exact, and faster than a recursion, blocks or a 25-tap convolution in torch. To
    torch.compile it is one operator, so that the inverse is made once and no part of a graph.
    """
    if torch.compiler.is_compiling():
        compiled: Tensor = torch.ops.torch_ecc.prefilter(image, interpolation, ring)
        return compiled
    taps, like = SAMPLERS[interpolation].taps, (image.dtype, image.device)
    rows, columns = (prefilter_matrix(n, taps, ring, *like) for n in image.shape[-2:])
    return rows @ image @ columns.mT


_operators = torch.library.Library("torch_ecc", "FRAGMENT")
_operators.define("prefilter(Tensor image, str interpolation, int ring) -> Tensor")
_operators.impl("prefilter", prefilter, "CompositeExplicitAutograd")


def _prefilter_shape(image: Tensor, _: str, ring: int) -> Tensor:
    return image.new_empty((*image.shape[:-2], *(n + 2 * ring for n in image.shape[-2:])))


torch.library.register_fake("torch_ecc::prefilter", _prefilter_shape, lib=_operators)


@constant
def prefilter_matrix(n: int, taps: tuple[float, ...], ring: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """What ``prefilter`` does to columns of n values: (n + 2 ring, n)."""
    inverse = torch.linalg.inv(_band(n, taps, 1, torch.device("cpu")))
    extended = inverse[_mirror(torch.arange(-ring, n + ring, device="cpu"), n)]
    return _without_next_to_nothing(extended).to(device, dtype)


def _without_next_to_nothing(matrix: Tensor) -> Tensor:
    """0 far off the diagonal, where values fall to what float32 only holds as subnormal numbers: with these processors
    multiply twenty times as slowly."""
    return torch.where(matrix.abs() < NEXT_TO_NOTHING, 0.0, matrix)


@constant
def _slope_matrix(n: int, device: torch.device) -> Tensor:
    cpu = torch.device("cpu")
    slope = _band(n, SLOPE, -1, cpu) @ torch.linalg.inv(_band(n, SAMPLERS["bspline3"].taps, 1, cpu))
    return _without_next_to_nothing(slope).to(device, torch.float32)


def gradients(image: Tensor) -> Tensor:
    """d/dx and d/dy at the pixels, (B, 1, H, W) -> (B, 2, H, W): the slope of the interpolating cubic B-spline."""
    rows, columns = (_slope_matrix(n, image.device) for n in image.shape[-2:])
    along_x = [image[..., near] @ columns[some, near].mT for some, near in _bands(image.shape[-1])]
    along_y = [rows[some, near] @ image[..., near, :] for some, near in _bands(image.shape[-2])]
    return torch.cat((torch.cat(along_x, -1), torch.cat(along_y, -2)), 1)


def _bands(n: int) -> Iterator[tuple[slice, slice]]:
    """The pixels of an axis by bands, and those that are near enough to count for their slopes."""
    for first in range(0, n, BAND):
        yield slice(first, first + BAND), slice(max(first - REACH, 0), first + BAND + REACH)


def aliasing(image: Tensor, interpolation: str) -> Tensor:
    """What ``interpolation`` gets wrong when (B, 1, H, W) lies a quarter px off the grid in x, and in y: (B, 2, H, W).

    Grey levels, at a quarter px because there the shift that it feigns is largest; against the quintic spline.
    """
    rows, columns = (_alias(n, interpolation, image.device) for n in image.shape[-2:])
    return torch.cat((image @ columns.mT, rows @ image), 1)


@constant
def _alias(n: int, interpolation: str, device: torch.device) -> Tensor:
    """Samples of a signal to the error in them after it was sampled a quarter px off and interpolated back, (n, n)."""
    exact = _quarter(n, "bspline5")
    return _without_next_to_nothing((_quarter(n, interpolation) - exact) @ exact.flip(0, 1)).to(device)


def _quarter(n: int, interpolation: str) -> Tensor:
    """Samples to the values that an interpolation finds a quarter px after them, (n, n)."""
    cpu, kernel = torch.device("cpu"), SAMPLERS[interpolation]
    index, taps = torch.arange(n, device=cpu), torch.zeros(n, n, dtype=torch.float32, device=cpu)
    for first, total, second in kernel.pairs(torch.tensor(0.25, dtype=torch.float32, device=cpu)):
        taps[index, _mirror(index + first, n)] += total - second
        taps[index, _mirror(index + first + 1, n)] += second
    return taps @ prefilter_matrix(n, kernel.taps, 0, torch.float32, cpu) if kernel.ring else taps
