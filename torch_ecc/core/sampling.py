"""Image values between pixels: B-spline and bilinear sampling, gradients, blur and pyramid.

The one place that knows the coordinates of ``grid_sample`` and of kornia. Everywhere else a point is (x, y) in px with
pixel centres at integers, and a warp is a 2x3 matrix that takes homogeneous template pixels (3, N) to such points.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, reduce
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from kornia.filters import gaussian_blur2d
from torch import Tensor

from torch_ecc.core.pose import alike, pose_dtype

# px around a patch: in which bilinear iterations may move it; and that its B-spline still feels, of degree 3 and 5:
REACH = {1: 16, 3: 7, 5: 10}  # 0.27 ** 7 and 0.43 ** 10 are 1e-4 and 2e-4 of the border's contrast
LOOKED_AT = {"cpu"}  # devices that let the host see a value without waiting for it
TAPS = {3: (4 / 6, 1 / 6), 5: (66 / 120, 26 / 120, 1 / 120)}  # centred B-splines at 0, 1, 2
SLOPE = {3: (0.0, 1 / 2), 5: (0.0, 10 / 24, 1 / 24)}  # minus their derivatives there
# Variance of white noise after sampling, mean over all sub-pixel phases: a sampler smooths what lies between pixels.
NOISE_GAIN = {"bilinear": 4 / 9, "bspline3": 0.7643, "bspline5": 0.8427}


class Sampler(NamedTuple):
    """Values of images between their pixels, bilinear (``degree`` 1) or by the interpolating B-spline (3, 5).

    ``values`` (I, 1, h, w), the image or the B-spline's coefficients, I = 1 (shared by all, not copied) or one per
    template. ``origin`` (I, 2, 3): what to subtract from a warp to count from value (0, 0), so that coordinates stay
    small and float32 holds 1e-5 px. ``edge``: the frame's size (h, w) if templates may reach beyond it.
    """

    values: Tensor
    degree: int = 1
    origin: Tensor | None = None
    edge: tuple[int, int] | None = None

    @staticmethod
    def of(image: Tensor, degree: int, corner: Tensor | None = None) -> Sampler:
        """Of an ``image`` (I, 1, h, w) whose pixel (0, 0) lies at ``corner`` (I, 2), by default the origin."""
        ring, corner = degree // 2, torch.zeros(1, 2, device=image.device) if corner is None else corner
        values = prefilter(image, degree, ring) if ring else image
        return Sampler(values, degree, F.pad((corner - ring).unsqueeze(-1), (2, 0)))

    def __call__(self, warp: Any, pixels: Tensor) -> Tensor:
        """Values at ``warp`` (B, 2, 3) of ``pixels`` (3, N): (B, N). Outside, its border repeats."""
        local, in_torch = self._local(warp), isinstance(warp, Tensor) or self.degree > 1
        scale, shift = _unit_square(*self.values.shape[-2:], self.values.device, in_torch)
        if self.degree == 1:
            return _lookup(self.values, _points(local * scale + shift, pixels))
        return self._spline(_points(local, pixels), scale.float())

    def _local(self, warp: Any) -> Any:
        """``warp`` (B, 2, 3) to coordinates that count from the origin."""
        return warp if self.origin is None else warp - alike(self.origin, warp)

    def _spline(self, points: Tensor, scale: Tensor) -> Tensor:
        """Values (B, N) at ``points`` (B, 2, N).

        A B-spline is non-negative, so each pair of neighbouring taps is one bilinear lookup at their centre of mass
        (Ruijters et al., 2008): (degree + 1)^2 / 4 lookups instead of (degree + 1)^2 gathers.
        """
        floor = points.floor()
        pairs = _pairs(points.sub_(floor), self.degree)
        n = len(pairs)
        at = points.new_empty(len(points), 2 * n, points.shape[-1])  # x of each pair of columns, then y of each of rows
        for k, (first, total, second) in enumerate(pairs):
            torch.mul(torch.addcdiv(floor, second, total).add_(first), scale, out=at[:, k::n])
        at.sub_(1)
        wx, wy = zip(*(total.unbind(1) for _, total, _ in pairs), strict=True)
        rows = [[_lookup(self.values, at[:, i : n + j + 1 : n + j - i]) for i in range(n)] for j in range(n)]
        return _sum([_sum(row, wx) for row in rows], wy)

    def covers(self, warp: Any, box: Any, margin: float) -> Any:
        """Whether ``box`` (3, 4) at ``warp`` (B, 2, 3) lies ``margin`` px inside of what was sampled, (B,) bool."""
        return inside(self._local(warp), box, self.values.shape[-2:], margin + self.degree // 2).all(-1)

    def select(self, index: Tensor) -> Sampler:
        """The sampler of some of the templates."""
        if len(self.values) in (1, len(index)):
            return self
        origin = self.origin[index] if self.origin is not None and len(self.origin) > 1 else self.origin
        return self._replace(values=self.values[index], origin=origin)


def host_looks(device: torch.device) -> bool:
    """Whether the host may look at values in the midst of a solve: that costs a CPU nothing and stops an accelerator.

    It decides nothing but what is left undone: iterations after convergence, pixels of the frame far from a template.
    """
    return device.type in LOOKED_AT


def on_host(tensor: Tensor) -> Any:
    """``tensor`` as numpy sees it, without a copy, where the host may look at it; itself elsewhere.

    A call of numpy on a few numbers takes a quarter of the time of torch's.
    """
    return tensor.numpy() if host_looks(tensor.device) else tensor


def make_sampler(interpolation: str, image: Tensor, warp: Any, box: Any) -> Sampler:
    """The sampler of ``image`` (I, 1, H, W) around the patches ``warp`` (B, 2, 3) of the template rectangle.

    ``box`` (3, 4): the rectangle's corners. Only the neighbourhoods of the patches are converted and prefiltered,
    unless so many share one image that all of it is less work; on an accelerator always all of it.
    """
    degree, (h, w) = 1 if interpolation == "bilinear" else int(interpolation[-1]), image.shape[-2:]
    if host_looks(image.device) and not (degree == 1 and image.dtype == torch.float32):
        corners, reach = np.asarray(warp) @ np.asarray(box), REACH[degree]
        low = np.floor(corners.min(-1)) - reach
        extent = int((np.ceil(corners.max(-1)) + reach - low).max()) + 1
        side = -(-extent // 8) * 8  # few different sizes, so that the prefilter matrices are reused
        part, whole = (side * side, h * w) if degree == 1 else (2 * side**3, h * w * (h + w))
        if side <= min(h, w) and (len(image) > 1 or len(warp) * part < whole):
            low = low.clip(0, (w - side, h - side)).astype(int)  # what lies beyond is not sampled
            return Sampler.of(_crop(image, low, side), degree, torch.from_numpy(low).double())
    return Sampler.of(image.float(), degree)


def inside(warp: Any, pixels: Any, size: Sequence[int], margin: float = 0.0) -> Any:
    """Which ``pixels`` (3, N) the ``warp`` (B, 2, 3) puts at least ``margin`` px inside a frame (h, w): bool (B, N)."""
    points = warp @ alike(pixels, warp)
    x, y = points[:, 0], points[:, 1]
    h, w = size
    return (x >= margin) & (x <= w - 1 - margin) & (y >= margin) & (y <= h - 1 - margin)


def _crop(image: Tensor, origin: Any, side: int) -> Tensor:
    """Squares (B, 1, side, side), float, of ``image`` (1 or B, 1, H, W) from ``origin`` (B, 2) = (x, y), all inside."""
    frames, side_by_side = image.detach().numpy()[:, 0], zip(cycle(range(len(image))), origin.tolist(), strict=False)
    crops = np.stack([frames[b, y : y + side, x : x + side] for b, (x, y) in side_by_side])
    return torch.from_numpy(crops.astype(np.float32))[:, None]


def _mirror(index: Tensor, size: int) -> Tensor:
    period = max(2 * size - 2, 1)
    index = index.remainder(period)
    return torch.minimum(index, period - index)


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _unit_square(h: int, w: int, device: torch.device, in_torch: bool) -> tuple[Any, Any]:
    """Scale (2, 1) and shift (2, 3) of warps from px to grid_sample's coordinates: -1 and 1 at the outer pixels."""
    both = [[2 / max(w - 1, 1)], [2 / max(h - 1, 1)]], [[0, 0, -1.0]] * 2
    scale, shift = (torch.tensor(rows, dtype=pose_dtype(device), device=device) for rows in both)
    return (scale, shift) if in_torch else (scale.numpy(), shift.numpy())


def _points(warp: Any, pixels: Tensor) -> Tensor:
    """Where the ``warp`` (B, 2, 3), a tensor or numpy array, takes ``pixels`` (3, N): (B, 2, N), float32."""
    rows = warp.reshape(-1, 3)
    rows = rows.to(pixels.dtype) if isinstance(rows, Tensor) else torch.from_numpy(rows.astype(np.float32))
    return torch.mm(rows, pixels).view(len(warp), 2, -1)


def _lookup(image: Tensor, points: Tensor) -> Tensor:
    """Bilinear lookup of ``image`` (I, 1, H, W) at normalised points (B, 2, N): (B, N). Its border repeats."""
    image = image if len(image) == len(points) else image.expand(len(points), -1, -1, -1)
    grid = points.mT.unsqueeze(1)
    values = F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return values.view(len(points), -1)


def _sum(values: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    """Sum of values times weights, in place of the first value."""
    values[0].mul_(weights[0])
    return reduce(lambda total, pair: total.addcmul_(*pair), zip(values[1:], weights[1:], strict=True), values[0])


def _pairs(f: Tensor, degree: int) -> list[tuple[int, Tensor, Tensor]]:
    """Pairs of neighbouring taps around a point with fractional part ``f``, any shape: the first one's offset, the
    sum of both weights and the second one's weight."""
    r = 1 - f
    if degree == 1:
        return [(0, torch.ones_like(f), f)]
    if degree == 3:
        square = f * f
        left, right = (r * r).mul_(r).mul_(1 / 6), (square * f).mul_(1 / 6)
        high = square.add_(f).mul_(0.5).sub_(right, alpha=2).add_(1 / 6)
        low = 1 - high
        return [(-1, low, low - left), (1, high, right)]
    w = [
        r**5 / 120,
        ((1 + r) ** 5 - 6 * r**5) / 120,
        ((2 + r) ** 5 - 6 * (1 + r) ** 5 + 15 * r**5) / 120,
        ((2 + f) ** 5 - 6 * (1 + f) ** 5 + 15 * f**5) / 120,
        ((1 + f) ** 5 - 6 * f**5) / 120,
        f**5 / 120,
    ]
    return [(k - 2, w[k] + w[k + 1], w[k + 1]) for k in (0, 2, 4)]


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _spline_matrices(n: int, degree: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Prefilter (n, n): samples to B-spline coefficients, mirrored at the border; and slope (n, n) at the samples."""
    index = torch.arange(n)
    taps, slope = torch.zeros(2, n, n, dtype=torch.float64)
    for offset in range(-(degree // 2), degree // 2 + 1):
        column = _mirror(index + offset, n)
        taps[index, column] += TAPS[degree][abs(offset)]
        slope[index, column] += SLOPE[degree][abs(offset)] * (1 if offset > 0 else -1)
    filter_ = torch.linalg.inv(taps)
    return filter_.float().to(device), (slope @ filter_).float().to(device)


def prefilter(image: Tensor, degree: int, ring: int = 0) -> Tensor:
    """Coefficients of the interpolating B-spline of ``image`` (..., H, W), mirrored at its border (Unser, 1993), and
    ``ring`` more on every side, which repeat those inside: (..., H + 2 ring, W + 2 ring).

    Two products with a dense inverse: exact, and faster than a recursion, blocks or a 25-tap convolution in torch.
    """
    rows, columns = (_prefilter_matrix(n, degree, ring, image.device) for n in image.shape[-2:])
    return rows @ image @ columns.mT


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _prefilter_matrix(n: int, degree: int, ring: int, device: torch.device) -> Tensor:
    index = _mirror(torch.arange(-ring, n + ring, device=device), n)
    return _spline_matrices(n, degree, device)[0][index]


def gradients(image: Tensor) -> Tensor:
    """d/dx and d/dy at the pixels, (B, 1, H, W) -> (B, 2, H, W): the slope of the interpolating cubic B-spline."""
    _, rows = _spline_matrices(image.shape[-2], 3, image.device)
    _, columns = _spline_matrices(image.shape[-1], 3, image.device)
    return torch.cat((image @ columns.mT, rows @ image), 1)


def aliasing(image: Tensor, interpolation: str) -> Tensor:
    """What ``interpolation`` gets wrong when (B, 1, H, W) lies a quarter px off the grid in x, and in y: (B, 2, H, W).

    Grey levels, at a quarter px because there the shift that it feigns is largest; against the quintic spline.
    """
    rows, columns = (_alias(n, interpolation, image.device) for n in image.shape[-2:])
    return torch.cat((image @ columns.mT, rows @ image), 1)


@lru_cache(maxsize=64)
def _alias(n: int, interpolation: str, device: torch.device) -> Tensor:
    """Samples of a signal to the error in them after it was sampled a quarter px off and interpolated back, (n, n)."""
    exact, degree = _quarter(n, 5), 1 if interpolation == "bilinear" else int(interpolation[-1])
    return ((_quarter(n, degree) - exact) @ exact.flip(0, 1)).to(device)


def _quarter(n: int, degree: int) -> Tensor:
    """Samples to the values that a spline of ``degree`` 1, 3 or 5 finds a quarter px after them, (n, n)."""
    index, f, taps = torch.arange(n), torch.tensor(0.25), torch.zeros(n, n)
    for first, total, second in _pairs(f, degree):
        taps[index, _mirror(index + first, n)] += total - second
        taps[index, _mirror(index + first + 1, n)] += second
    return taps if degree == 1 else taps @ _spline_matrices(n, degree, taps.device)[0]


def pad(image: Tensor, margin: int) -> Tensor:
    """``image`` (B, 1, H, W) continued by ``margin`` px, odd about its border pixels: slopes stay what they are.

    (A mirror image would put a kink at the border and halve the gradient there.)
    """
    for dim in (-1, -2):
        n = image.shape[dim]
        edges = image.narrow(dim, 0, 1), image.narrow(dim, n - 1, 1)
        run = torch.arange(1, margin + 1, device=image.device).clamp(max=n - 1)
        before = 2 * edges[0] - image.index_select(dim, run.flip(0))
        after = 2 * edges[1] - image.index_select(dim, n - 1 - run)
        image = torch.cat((before, image, after), dim)
    return image


def blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of (B, 1, H, W)."""
    size = 2 * int(4 * sigma + 0.5) + 1
    return gaussian_blur2d(image, (size, size), (sigma, sigma), border_type="reflect")


def halve(image: Tensor) -> Tensor:
    """Next pyramid level of (B, 1, H, W): blurred, and pixel (i, j) of it lies exactly at (2 i, 2 j) of ``image``."""
    return blur(image, 1.0)[:, :, ::2, ::2]


def noise_level(image: Tensor, kept: Tensor) -> Tensor:
    """Upper estimate of the white noise of (B, 1, H, W) where ``kept`` > 0, grey levels, (B,).

    Median response to the difference of two Laplacians (Immerkaer, 1996), which cancels flat areas, ramps and edges
    along rows or columns; what fine texture leaves in it counts as noise.
    """
    kernel = image.new_tensor([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])[None, None]
    response = F.conv2d(image, kernel).abs().flatten(1) / 6
    response = torch.where(kept[:, :, 1:-1, 1:-1].flatten(1) > 0, response, float("nan"))
    return response.nanmedian(-1).values.nan_to_num() / 0.6745
