"""Pixels of a template in a frame: where they lie, how much they count, the frame's values there, and their columns."""

from __future__ import annotations

import triton
import triton.language as tl

from torch_ecc.core.fused.records import FARTHEST, OF_NUMBERS, ROUNDING, SIDE, One, Warp


@triton.jit
def one_of(grids, trusted, k, b):
    """The template k, the b-th answer, of those on a grid."""
    size: tl.constexpr = grids.HEIGHT * grids.PITCH
    n, weight = grids.numbers + k * OF_NUMBERS, grids.weight
    if not grids.EVEN:
        weight += k * size
    by_u, by_v = (1 / tl.load(n + 2)).to(tl.float32), (1 / tl.load(n + 3)).to(tl.float32)
    trust = trusted.blocks + b * trusted.COUNT
    return One(grids.planes + k * 7 * size, weight, n, trust, tl.load(n), tl.load(n + 1), by_u, by_v, tl.load(n + 4))


@triton.jit
def warp_of(pose, bend):
    """R (I + D) x' + t, eq. (2), of a record with a pose."""
    c, s = tl.cos(pose.theta), tl.sin(pose.theta)
    xu, xv, yu, yv = 1 + tl.load(bend), tl.load(bend + 1), tl.load(bend + 2), 1 + tl.load(bend + 3)
    return Warp(c * xu + s * yu, c * xv + s * yv, c * yu - s * xu, c * yv - s * xv, pose.x, pose.y)


@triton.jit
def inside(frame, warp, x, y):
    """Whether the frame shows what lies at x', y', float64."""
    px, py = warp.xu * x + warp.xv * y + warp.x0, warp.yu * x + warp.yv * y + warp.y0
    right, bottom = frame.of.width - 1 + ROUNDING, frame.of.height - 1 + ROUNDING
    return (px >= -ROUNDING) & (px <= right) & (py >= -ROUNDING) & (py <= bottom)


@triton.jit
def in_sight(frame, pixels, warp):
    """Whether the frame shows all of a template."""
    left, top = pixels.of.left, pixels.of.top
    right, bottom = left + (pixels.grid.WIDTH - 1) * pixels.grid.STEP, top + (pixels.grid.HEIGHT - 1) * pixels.grid.STEP
    above = inside(frame, warp, left, top) & inside(frame, warp, right, top)
    return above & inside(frame, warp, left, bottom) & inside(frame, warp, right, bottom)


@triton.jit
def near(v, bound):
    """A coordinate, no farther out than by FARTHEST: there all is border."""
    return tl.minimum(tl.maximum(v, -FARTHEST), bound + FARTHEST)


@triton.jit
def level(frame, x, y):
    """Of grey around a place: sums of what is taken off it lose little."""
    ring: tl.constexpr = frame.of.DEGREE // 2
    column = tl.minimum(tl.maximum(near(x, frame.of.width).to(tl.int32), 0), frame.of.width - 1) + ring
    row = tl.minimum(tl.maximum(near(y, frame.of.height).to(tl.int32), 0), frame.of.height - 1) + ring
    return tl.load(frame.grey + row * (frame.of.width + 2 * ring) + column).to(tl.float32)


@triton.jit
def sampled(frame, warp, x, y):
    """The frame at x', y', float32; of no meaning where that is out of sight. Coordinates count from a whole pixel near
    the template's centre, and stay small."""
    left, top = tl.floor(near(warp.x0, frame.of.width)), tl.floor(near(warp.y0, frame.of.height))
    px = warp.xu.to(tl.float32) * x + warp.xv.to(tl.float32) * y + (warp.x0 - left).to(tl.float32)
    py = warp.yu.to(tl.float32) * x + warp.yv.to(tl.float32) * y + (warp.y0 - top).to(tl.float32)
    column, of_x = placed(px, left.to(tl.int32), frame.of.width, frame.of.DEGREE)
    row, of_y = placed(py, top.to(tl.int32), frame.of.height, frame.of.DEGREE)
    pitch = frame.of.width + frame.of.DEGREE // 2 * 2
    g, first = tl.zeros_like(x), frame.grey + (row * pitch + column)
    for j in tl.static_range(frame.of.DEGREE + 1):
        line = tl.zeros_like(x)
        for i in tl.static_range(frame.of.DEGREE + 1):
            line += of_x[i] * tl.load(first + i).to(tl.float32)
        g += of_y[j] * line
        first += pitch
    return g


@triton.jit
def placed(p, start, size, DEGREE: tl.constexpr):
    """The first tap around coordinates from ``start`` on, among values that go on for a ring beyond ``size``, and the
    weights of all: the first one is clamped once, so that the others lie beside it, on the last pixel too."""
    most = size + (DEGREE // 2) * 2 - 1 - DEGREE
    first = tl.minimum(tl.maximum(tl.floor(p).to(tl.int32) + start, 0), most)
    return first, taps(p - (first - start).to(tl.float32), DEGREE)


@triton.jit
def taps(f, DEGREE: tl.constexpr):
    """Weights of the neighbours of a point with the fractional part f."""
    r = 1 - f
    if DEGREE == 1:
        return r, f
    elif DEGREE == 3:
        return cubic(r), 2 / 3 - f * f * (1 - f / 2), 2 / 3 - r * r * (1 - r / 2), cubic(f)
    else:
        r1, r2, f1, f2 = fifth(1 + r), fifth(2 + r), fifth(1 + f), fifth(2 + f)
        r0, f0 = fifth(r), fifth(f)
        return r0, r1 - 6 * r0, r2 - 6 * r1 + 15 * r0, f2 - 6 * f1 + 15 * f0, f1 - 6 * f0, f0


@triton.jit
def cubic(v):
    """Of the B-spline's outermost piece."""
    return v * v * v / 6


@triton.jit
def fifth(v):
    """The same of the quintic one."""
    return v * v * v * v * v / 120


@triton.jit
def places(pixels, at):
    """x' and y' of pixels by their numbers, float32."""
    x = pixels.of.left.to(tl.float32) + (at % pixels.grid.PITCH * pixels.grid.STEP).to(tl.float32)
    y = pixels.of.top.to(tl.float32) + (at // pixels.grid.PITCH * pixels.grid.STEP).to(tl.float32)
    return x, y


@triton.jit
def in_view(frame, pixels, warp, whole, at, way):
    """The weights of pixels, as far as they are in sight."""
    place = at
    if pixels.grid.EVEN:
        place = at % pixels.grid.PITCH
    weight = tl.load(pixels.of.weight + place, mask=at < pixels.grid.HEIGHT * pixels.grid.PITCH, other=0.0)
    if way.PARTIAL:
        if not whole:
            x = pixels.of.left + (at % pixels.grid.PITCH * pixels.grid.STEP).to(tl.float64)
            y = pixels.of.top + (at // pixels.grid.PITCH * pixels.grid.STEP).to(tl.float64)
            weight = tl.where(inside(frame, warp, x, y), weight, 0.0)
    return weight


@triton.jit
def counted(pixels, seen, at):
    """The weights of pixels as their blocks are trusted."""
    weight = seen
    if pixels.trusted.SOME:
        row, column = (
            at // pixels.grid.PITCH * pixels.grid.STEP // SIDE,
            at % pixels.grid.PITCH * pixels.grid.STEP // SIDE,
        )
        weight *= tl.load(pixels.of.trust + row * pixels.trusted.ACROSS + column, mask=seen > 0, other=0.0)
    return weight


@triton.jit
def columns(pixels, R: tl.constexpr, at, x, y, way):
    """Those of Z, or of R if it is 1, at pixels: LINES of them, see criteria.ECC.columns."""
    size: tl.constexpr = pixels.grid.HEIGHT * pixels.grid.PITCH
    of, n, mask = pixels.of.planes + 3 * R * size, pixels.of.numbers + 2 * R, at < size
    slope, unit = tl.load(n + 5).to(tl.float32), tl.load(n + 6).to(tl.float32)
    base = tl.load(pixels.of.numbers + 9 + R)
    shift = (base - tl.load(pixels.of.numbers + 11 + R)).to(tl.float32)
    gx = slope * tl.load(of + at, mask=mask, other=0).to(tl.float32)
    gy = slope * tl.load(of + size + at, mask=mask, other=0).to(tl.float32)
    t = unit * tl.load(of + 2 * size + at, mask=mask, other=0).to(tl.float32)
    result = (gx, gy, gx * y - gy * x, t + shift, tl.full(t.shape, 1, tl.float32))
    t, u, v = t + base.to(tl.float32), x * pixels.of.by_u, y * pixels.of.by_v
    if way.LINES > 5:
        result = result + (t * u, t * v)
    if way.LINES > 7:
        result = result + (t * u * u, t * v * v, t * u * v)
    return result
