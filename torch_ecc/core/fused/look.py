"""What a template leaves behind after its last look: sums per block of pixels, and the moments of those that count."""

from __future__ import annotations

import triton
import triton.language as tl

from torch_ecc.core.fused.algebra import finite, product, stacked
from torch_ecc.core.fused.patch import columns, counted, in_view, one_of, places, sampled, warp_of
from torch_ecc.core.fused.records import (
    CLUSTERS,
    FLAT,
    OF_LOOK,
    OF_MOMENTS,
    PLACES,
    SIDE,
    STEPS,
    SUMS,
    Look,
    Pixels,
    View,
)


@triton.jit
def answer(smooth, fine, trusted, bend, answers, way):
    """Program b: what is to be said of the b-th answer, after ``kernel.solve``."""
    b = tl.program_id(0).to(tl.int64)
    k = b
    if trusted.SOME:
        k = tl.load(trusted.which + b)
    n, one = answers.looks + b * OF_LOOK, one_of(fine, trusted, k, b)
    x, y, theta, whole = tl.load(n), tl.load(n + 1), tl.load(n + 2), tl.load(n + 3) > 0
    look = Look(x, y, theta, whole, tl.load(n + 4), tl.load(n + 5), tl.load(n + 6), tl.load(n + 7))
    tl.store(answers.gain + b, finite(tl.load(n + 11)))
    sums, total = answers.sums + b * SUMS * trusted.COUNT, answers.total + b * (SUMS + CLUSTERS)
    moments, bend = answers.moments + b * OF_MOMENTS, bend + 4 * k
    describe(
        View(smooth.grey + k * smooth.next, smooth),
        Pixels(one, fine, trusted),
        look,
        n,
        bend,
        sums,
        total,
        moments,
        way,
    )


@triton.jit
def describe(frame, pixels, look, n, bend, sums, total, moments, way):
    """A look and its numbers: sums, their total and, where not all pixels count, moments."""
    warp = warp_of(look, bend)
    summed(frame, pixels, look, warp, n + 8, sums, total, way)
    if look.whole and not pixels.trusted.SOME:
        tl.store(moments, -1.0)
    elif way.PARTIAL:
        completed(frame, pixels, look, warp, moments, way)


@triton.jit
def numbers_at(place, COUNT: tl.constexpr):
    """The first COUNT numbers there, float32."""
    numbers = ()
    for k in tl.static_range(COUNT):
        numbers = numbers + (tl.load(place + k).to(tl.float32),)
    return numbers


@triton.jit
def combined(columns, factors, COUNT: tl.constexpr):
    """The sum of columns times factors."""
    total = columns[0] * factors[0]
    for k in tl.static_range(1, COUNT):
        total += columns[k] * factors[k]
    return total


@triton.jit
def rows(frame, pixels, look, warp, model, at, way):
    """Of pixels what ``solution.summed`` adds up over their blocks, ten of them. ``model``: the fit, and the first
    three rows of K by Z."""
    seen = in_view(frame, pixels, warp, look.whole, at, way)
    x, y = places(pixels, at)
    Z, R, t = columns(pixels, 0, at, x, y, way), columns(pixels, 1, at, x, y, way), look.along.to(tl.float32)
    g = tl.where(seen > 0, sampled(frame, warp, x, y) - look.base.to(tl.float32), 0.0)
    e = tl.where(seen > 0, g - combined(R, model[0], way.LINES), 0.0)
    g0 = tl.where(seen > 0, g - look.mean.to(tl.float32), 0.0)
    wg, we = seen * g0, counted(pixels, seen, at) * e
    result = (seen, wg, wg * g0, wg * (R[3] - t), wg * x * pixels.of.by_u, wg * y * pixels.of.by_v)
    result = result + (seen * e * e,)
    for k in tl.static_range(1, 4):
        result = result + (we * combined(Z, model[k], way.COLUMNS),)
    return result


@triton.jit
def block_sums(frame, pixels, look, warp, model, block, way):
    """Sums over the pixels of blocks (BLOCKS,), ten of each: row by row, with eight lanes for six columns."""
    lane, sums = tl.arange(0, 8)[None, :], ()
    for _ in tl.static_range(SUMS):
        sums = sums + (tl.zeros((way.BLOCKS, 8), tl.float32),)
    for j in range(SIDE):
        row = block[:, None] // pixels.trusted.ACROSS * SIDE + j
        column = block[:, None] % pixels.trusted.ACROSS * SIDE + lane
        there = (lane < SIDE) & (row < pixels.grid.HEIGHT) & (column < pixels.grid.WIDTH)
        at = tl.where(there, row * pixels.grid.PITCH + column, pixels.grid.HEIGHT * pixels.grid.PITCH)
        more, of_row = (), rows(frame, pixels, look, warp, model, at, way)
        for k in tl.static_range(SUMS):
            more = more + (sums[k] + of_row[k],)
        sums = more
    result = ()
    for k in tl.static_range(SUMS):
        result = result + (tl.sum(sums[k], 1),)
    return result


@triton.jit
def summed(frame, pixels, look, warp, model_at, sums, totals, way):
    """``solution.summed`` of the last look: sums (10, COUNT) over blocks, and their total."""
    COUNT: tl.constexpr = pixels.trusted.COUNT
    total, model = (), (numbers_at(model_at, way.LINES),)
    for _ in tl.static_range(SUMS):
        total = total + (tl.zeros((way.BLOCKS,), tl.float64),)
    for k in tl.static_range(1, 4):
        model = model + (numbers_at(model_at + 16 * k, way.COLUMNS),)
    for first in range(0, COUNT, way.BLOCKS):
        block, more = first + tl.arange(0, way.BLOCKS), ()
        trust = tl.full((way.BLOCKS,), 1, tl.float32)
        if pixels.trusted.SOME:
            trust = tl.load(pixels.of.trust + block, mask=block < COUNT, other=0.0)
        of_blocks = block_sums(frame, pixels, look, warp, model, block, way)
        for k in tl.static_range(SUMS):
            tl.store(sums + k * COUNT + block, of_blocks[k], mask=block < COUNT)
            if k < SUMS - 3:
                more = more + (total[k] + (of_blocks[k] * trust).to(tl.float64),)
            else:  # K is less where there is less trust
                more = more + (total[k] + of_blocks[k].to(tl.float64),)
        total = more
    tl.debug_barrier()  # what others have stored is read again
    concluded(look, total, sums, totals, COUNT)
    for k in tl.static_range(3):
        clustered(sums + (SUMS - 3 + k) * COUNT, totals + SUMS + k, pixels.trusted)


@triton.jit
def concluded(look, total, sums, totals, COUNT: tl.constexpr):
    """The total of the sums. Of a patch that is flat but for rounding g0 is 0."""
    level, power = look.mean + look.base, tl.sum(total[2])
    rough = power > FLAT * (power + level * level * look.total)
    for k in tl.static_range(SUMS):
        value = finite(tl.sum(total[k]))
        if (k >= 1) and (k <= 5):
            value = tl.where(rough, value, 0.0)
        tl.store(totals + k, value)
    if not rough:
        for first in range(COUNT, 6 * COUNT, 1024):
            at = first + tl.arange(0, 1024)
            tl.store(sums + at, 0.0, mask=at < 6 * COUNT)


@triton.jit
def clustered(effect, out, trusted):
    """``solution.clustered`` of one of three effects (COUNT,): square sums over blocks, rows and columns of them."""
    i, j = tl.arange(0, trusted.LINES)[:, None], tl.arange(0, trusted.LINES)[None, :]
    there = (j < trusted.ACROSS) & (i < trusted.COUNT // trusted.ACROSS)
    value = tl.load(effect + i * trusted.ACROSS + j, mask=there, other=0.0).to(tl.float64)
    in_row, in_column = tl.sum(value, 1), tl.sum(value, 0)
    tl.store(out, finite(tl.sum(value * value)))
    tl.store(out + 3, finite(tl.sum(in_row * in_row)))
    tl.store(out + 6, finite(tl.sum(in_column * in_column)))


@triton.jit
def completed(frame, pixels, look, warp, out, way):
    """normal.Moments of the pixels that count in the last look."""
    empty = tl.zeros((16, 16), tl.float32)
    number, normal, power, gram, noise = tl.zeros((way.SLICE,), tl.float32), empty, empty, empty, empty
    size: tl.constexpr = pixels.grid.HEIGHT * pixels.grid.PITCH
    for first in range(0, size, way.SLICE):
        at = first + tl.arange(0, way.SLICE)
        weight = counted(pixels, in_view(frame, pixels, warp, look.whole, at, way), at)
        x, y = places(pixels, at)
        R, wiener = (
            columns(pixels, 1, at, x, y, way),
            tl.load(pixels.of.planes + 6 * size + at, mask=at < size, other=0),
        )
        ZW = stacked(columns(pixels, 0, at, x, y, way), way.LINES, way.SLICE) * weight[None, :]
        normal += product(ZW, stacked(R, way.LINES, way.SLICE))
        power += product(ZW, ZW)
        shape = stacked((R[4], x * pixels.of.by_u, y * pixels.of.by_v, R[3]), 4, way.SLICE)
        gram += product(shape * weight[None, :], shape)
        q = weight * (wiener.to(tl.float32) / STEPS)
        noise += product(stacked((q, q * q), 2, way.SLICE), stacked((R[4], x, y, x * x + y * y), 4, way.SLICE))
        number += (weight > 0).to(tl.float32)
    tl.store(out, tl.sum(number).to(tl.float64))
    written(out + 1, normal, PLACES, PLACES)
    written(out + 1 + PLACES * PLACES, power, PLACES, PLACES)
    out += 1 + 2 * PLACES * PLACES
    written(out, gram, 4, 4)
    written(out + 16, noise, 2, 4)


@triton.jit
def written(out, matrix, HEIGHT: tl.constexpr, WIDTH: tl.constexpr):
    """The first rows and columns of a matrix (16, 16)."""
    i, j = tl.arange(0, 16)[:, None], tl.arange(0, 16)[None, :]
    tl.store(out + i * WIDTH + j, matrix.to(tl.float64), mask=(i < HEIGHT) & (j < WIDTH))
