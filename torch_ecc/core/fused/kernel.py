"""The loop of ``solver`` as one Triton kernel: a program per template does the whole solve, and writes no pixel.

Each iteration reads a template once, in 16 bits (``packed``), samples the frame at its pixels, and adds up their
products in registers; the normal equations are solved where they are. Programs end when their template has converged,
each by itself. See ``solver`` for the reasons behind each step and constant. A scalar is float64, what belongs to
pixels float32. ``LINES`` columns are summed, of which the criterion solves for ``COLUMNS``.
"""

from __future__ import annotations

import triton
import triton.language as tl

from torch_ecc.core.fused.algebra import AT_ONCE, column_of, inverted, nothing, picked, placed_in, scaled, with_products
from torch_ecc.core.fused.patch import (
    columns,
    counted,
    in_sight,
    in_view,
    level,
    one_of,
    places,
    sampled,
    warp_of,
)
from torch_ecc.core.fused.records import (
    COARSE_TOLERANCE,
    INFINITE,
    LARGEST_SCALE,
    LONGEST_STEP,
    OF_LOOK,
    OF_MOMENTS,
    PAPER,
    PLACES,
    SECANT_RANGE,
    SMALL,
    Pixels,
    State,
    View,
    Weighted,
)


@triton.jit
def solve(frames, smooth, fine, coarse, trusted, start, bend, answers, way):
    """Program b: the template b, or the b-th of those that trust is about, if it is asked for. First without
    ``PARTIAL``, for those that stay in sight and are trusted, of whose moments the first is then -1; with it for the
    others.

    A record with constants is an argument, never the value of a variable: that would make numbers of them.
    """
    b = tl.program_id(0).to(tl.int64)
    k, left = b, tl.load(trusted.asked + b).to(tl.int32) != 0
    if trusted.SOME:
        k = tl.load(trusted.which + b)
    elif way.PARTIAL:
        left = left & (tl.load(answers.moments + b * OF_MOMENTS) >= 0)
    if left:
        first, last = one_of(coarse, trusted, k, b), one_of(fine, trusted, k, b)
        state, well, bend, look = beginning(start + 3 * k), b >= 0, bend + 4 * k, answers.looks + b * OF_LOOK
        enough, some = tl.maximum(way.tolerance, COARSE_TOLERANCE), tl.maximum(tl.floor(way.most * 2 / 3), 1)
        if (way.COARSER or smooth.DEGREE > 1) and way.most > 1:
            state, well = iterate(
                View(frames.grey + k * frames.next, frames),
                Pixels(first, coarse, trusted),
                state,
                well,
                bend,
                look,
                enough,
                some,
                way,
            )
        state, well = iterate(
            View(smooth.grey + k * smooth.next, smooth),
            Pixels(last, fine, trusted),
            state,
            well,
            bend,
            look,
            way.tolerance,
            way.most,
            way,
        )
        kept(answers, b, state)
        if not way.PARTIAL:
            tl.store(answers.moments + b * OF_MOMENTS, tl.where(well, -1.0, 0.0))


@triton.jit
def kept(answers, b, state):
    """Where the b-th has come to."""
    tl.store(answers.pose + 3 * b, state.x)
    tl.store(answers.pose + 3 * b + 1, state.y)
    tl.store(answers.pose + 3 * b + 2, state.theta)
    tl.store(answers.error + b, state.error)
    tl.store(answers.iterations + b, state.iterations)


@triton.jit
def beginning(start):
    """Before the first iteration."""
    zero = tl.full((), 0, tl.float64)
    x, y, theta = tl.load(start), tl.load(start + 1), tl.load(start + 2)
    return State(x, y, theta, zero, zero, zero, zero, zero + 1, zero + INFINITE, tl.full((), 0, tl.int64))


@triton.jit
def iterate(frame, pixels, state, well, bend, look, tolerance, most, way):
    """``solver.iterate``: the state, and whether all is ``well``: without ``PARTIAL`` no look may be out of sight. What
    is seen is noted in the ``look``."""
    x, y, theta, dx, dy, dtheta, length, scale, _, iterations = state
    state = State(x, y, theta, dx, dy, dtheta, length, scale, tl.full((), INFINITE, tl.float64), iterations)
    base = level(frame, x, y)
    while (state.error > tolerance) & (state.iterations < most) & well:
        warp = warp_of(state, bend)
        whole = in_sight(frame, pixels, warp)
        sums, square = added(frame, pixels, warp, whole, base, way)
        weighted = known(pixels)
        if way.PARTIAL:
            if pixels.trusted.SOME or not whole:
                weighted = weighed(frame, pixels, warp, whole, way)
        else:
            well = well & whole
        fit, step_x, step_y, step_theta = fitted(pixels, weighted, sums, square, base, way)
        noted(look, state, whole, base, picked(sums, 4) / tl.maximum(weighted.total, SMALL), weighted, fit)
        state = advance(state, step_x, step_y, step_theta, weighted.total > 0, pixels.of.radius)
    return state, well


@triton.jit
def noted(look, state, whole, base, mean, weighted, fit):
    """Written down for ``look.summed``."""
    i, whole = tl.arange(0, 16), tl.where(whole, 1.0, 0.0)
    along = weighted.along / tl.maximum(weighted.total, SMALL)
    tl.store(look, state.x)
    tl.store(look + 1, state.y)
    tl.store(look + 2, state.theta)
    tl.store(look + 3, whole)
    tl.store(look + 4, base)
    tl.store(look + 5, mean)
    tl.store(look + 6, weighted.total)
    tl.store(look + 7, along)
    tl.store(look + 8 + i, fit)
    rows = i[:, None] < 3
    tl.store(look + 24 + 16 * i[:, None] + i[None, :], weighted.inverse, mask=rows)


@triton.jit
def known(pixels):
    """``Weighted`` of all pixels, as it was prepared."""
    n, i = pixels.of.numbers + 13, tl.arange(0, 16)
    of_t, of_one = tl.load(n + 3 + i, mask=i < 3, other=0.0), tl.load(n + 6 + i, mask=i < 3, other=0.0)
    within = (i < PLACES)[:, None] & (i < PLACES)[None, :]
    inverse = tl.load(n + 9 + i[:, None] * PLACES + i[None, :], mask=within, other=0.0)
    return Weighted(tl.load(n), tl.load(n + 1), tl.load(n + 2), of_t, of_one, inverse)


@triton.jit
def weighed(frame, pixels, warp, whole, way):
    """``Weighted`` of the pixels that are in sight, as their blocks are trusted: reference.restrict."""
    zero, sums = tl.zeros((way.THREADS,), tl.float32), tl.zeros((16, 16), tl.float64)
    total, along, power = zero, zero, zero
    for k in tl.static_range(0, way.LINES, AT_ONCE):
        matrix = nothing(k, way.LINES, way.LINES, way.THREADS)
        for first in range(0, pixels.grid.HEIGHT * pixels.grid.PITCH, way.THREADS):
            at = first + tl.arange(0, way.THREADS)
            weight = counted(pixels, in_view(frame, pixels, warp, whole, at, way), at)
            x, y = places(pixels, at)
            R = columns(pixels, 1, at, x, y, way)
            ZW = scaled(columns(pixels, 0, at, x, y, way), weight, way.LINES)
            matrix = with_products(matrix, ZW, R, k, way.LINES, way.LINES)
            if k == 0:
                total += weight
                along += weight * R[3]
                power += weight * R[3] * R[3]
        sums = placed_in(sums, matrix, k, way.LINES, way.LINES)
    sum_w, sum_t, energy = tl.sum(total).to(tl.float64), tl.sum(along).to(tl.float64), tl.sum(power).to(tl.float64)
    contrast = tl.sqrt(tl.maximum(energy - sum_t * sum_t / tl.maximum(sum_w, SMALL), 0.0))
    solved = tl.arange(0, 16) < way.COLUMNS
    of_t = tl.where(solved, column_of(sums, 3), 0.0)
    of_one = tl.where(solved, column_of(sums, 4), 0.0)
    return Weighted(sum_w, sum_t, contrast, of_t, of_one, inverted(sums, way.COLUMNS))


@triton.jit
def added(frame, pixels, warp, whole, base, way):
    """Z W (g - base), (16,), and (g - base) W (g - base) of the patch in a warp."""
    sums = ()
    for _ in tl.static_range(way.LINES + 1):
        sums = sums + (tl.zeros((way.PIXELS,), tl.float32),)
    for first in range(0, pixels.grid.HEIGHT * pixels.grid.PITCH, way.PIXELS):
        at = first + tl.arange(0, way.PIXELS)
        weight = counted(pixels, in_view(frame, pixels, warp, whole, at, way), at)
        x, y = places(pixels, at)
        e = tl.where(weight > 0, sampled(frame, warp, x, y) - base, 0.0)
        Z, we, more = columns(pixels, 0, at, x, y, way), weight * e, ()
        for k in tl.static_range(way.LINES):
            more = more + (sums[k] + Z[k] * we,)
        sums = more + (sums[way.LINES] + we * e,)
    result, index = tl.zeros((16,), tl.float64), tl.arange(0, 16)
    for k in tl.static_range(way.LINES):
        result = tl.where(index == k, tl.sum(sums[k]).to(tl.float64), result)
    return result, tl.sum(sums[way.LINES]).to(tl.float64)


@triton.jit
def fitted(pixels, weighted, sums, square, base, way):
    """Criterion.fit, (16,), and Criterion.step: of sums over a patch less its ``base``."""
    i = tl.arange(0, 16)
    if way.CRITERION >= 0:
        fit = tl.sum(weighted.inverse * sums[None, :], 1)
        gain = picked(fit, 3)
        step, sure = fit, gain > 0
    else:
        gain, offset = tl.full((), 1, tl.float64), tl.load(pixels.of.numbers + 12) - base  # g = t
        if way.CRITERION == PAPER:  # g less its mean, over t less its mean
            total = tl.maximum(weighted.total, SMALL)
            mean = picked(sums, 4) / total
            power = tl.maximum(square - mean * picked(sums, 4), 0.0)
            gain = tl.sqrt(power) / tl.maximum(weighted.contrast, SMALL)
            offset = mean - gain * weighted.along / total
        left = sums - gain * weighted.of_t - offset * weighted.of_one
        step, sure = tl.sum(weighted.inverse * left[None, :], 1), gain > 0
        fit = tl.where(i == 3, gain, tl.where(i == 4, offset, 0.0))
    step = tl.where(sure, step / tl.where(sure, gain, 1.0), INFINITE)
    return fit, picked(step, 0), picked(step, 1), picked(step, 2)


@triton.jit
def advance(state, step_x, step_y, step_theta, seen, radius):
    """``step.advance``."""
    delta_theta, last = step_theta * radius, state.length
    length = tl.sqrt(step_x * step_x + step_y * step_y + delta_theta * delta_theta)
    moving = seen & (length < INFINITE)
    along = state.delta_x * step_x + state.delta_y * step_y + state.delta_theta * delta_theta
    along /= tl.where(last > 0, last * last, 1.0)
    began = state.error < INFINITE
    rate = tl.where(last > 0, length / tl.where(last > 0, last, 1.0), 0.5)
    rate = tl.where((not began) & (state.scale > 1), 1 - 1 / state.scale, rate)
    rate = tl.minimum(tl.maximum(rate, 0.05), 0.95)
    usable = began & (last > 0) & (last < SECANT_RANGE) & (along < 0.9)
    scale = tl.minimum(tl.maximum(state.scale / tl.where(usable, 1 - along, 1.0), 1.0), LARGEST_SCALE)
    scale = tl.where(usable, scale, 1.0)
    scale = tl.where(length > 0, tl.minimum(scale, LONGEST_STEP * radius / tl.where(length > 0, length, 1.0)), scale)
    theta = state.theta - step_theta * scale
    c, s = tl.cos(theta), tl.sin(theta)
    x, y = state.x - (c * step_x + s * step_y) * scale, state.y - (c * step_y - s * step_x) * scale
    return State(
        tl.where(moving, x, state.x),
        tl.where(moving, y, state.y),
        tl.where(moving, theta, state.theta),
        tl.where(moving, step_x, state.delta_x),
        tl.where(moving, step_y, state.delta_y),
        tl.where(moving, delta_theta, state.delta_theta),
        tl.where(moving, length, state.length),
        tl.where(moving, scale, state.scale),
        tl.where(moving, length * scale * rate / (1 - rate), 0.0),
        state.iterations + moving.to(tl.int64),
    )
