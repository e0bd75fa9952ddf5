"""What a template leaves behind after its last look: sums per block of pixels, and the moments of those that count."""

from __future__ import annotations

import triton
import triton.language as tl

from torch_ecc.core.fused.algebra import finite, numbers_of, product, row_of, stacked
from torch_ecc.core.fused.patch import columns, counted, in_view, places, sampled
from torch_ecc.core.fused.records import FLAT, PLACES, SIDE, SLICE, SMALL, STEPS, SUMS



@triton.jit
def combined(columns, factors, COUNT: tl.constexpr):
    """The sum of columns times factors."""
    total = columns[0] * factors[0]
    for k in tl.static_range(1, COUNT):
        total += columns[k] * factors[k]
    return total


@triton.jit
def rows(frame, pixels, look, model, at, way):
    """Of pixels what ``solution.summed`` adds up over their blocks, ten of them. ``model``: the fit, and the first
    three rows of K by Z."""
    seen = in_view(frame, pixels, look.warp, look.whole, at)
    x, y = places(pixels, at)
    x, y = x.to(tl.float32), y.to(tl.float32)
    Z, R, off = columns(pixels, 0, at, x, y, way), columns(pixels, 1, at, x, y, way), look.along / tl.maximum(look.total, SMALL)
    g = tl.where(seen > 0, sampled(frame, look.warp, x, y) - look.base, 0.0)
    e = tl.where(seen > 0, g - combined(R, model[0], way.LINES), 0.0)
    g0 = tl.where(seen > 0, g - look.mean.to(tl.float32), 0.0)
    wg, we = seen * g0, counted(pixels, seen, at) * e
    result = (seen, wg, wg * g0, wg * (R[3] - off.to(tl.float32)), wg * x * pixels.of.by_u, wg * y * pixels.of.by_v)
    result = result + (seen * e * e,)
    for k in tl.static_range(1, 4):
        result = result + (we * combined(Z, model[k], way.COLUMNS),)
    return result


@triton.jit
def summed(frame, pixels, look, sums, totals, way):
    """``solution.summed`` of the last look: sums (10, COUNT) over blocks, and their total."""
    COUNT: tl.constexpr = pixels.trusted.COUNT
    total = ()
    for _ in tl.static_range(SUMS + 3):
        total = total + (tl.zeros((way.BLOCKS,), tl.float64),)
    lane, model = tl.arange(0, 8)[None, :], (numbers_of(look.fit, way.LINES),)
    for k in tl.static_range(3):
        model = model + (numbers_of(row_of(look.inverse, k), way.COLUMNS),)
    for first in range(0, COUNT, way.BLOCKS):
        block, added_up = first + tl.arange(0, way.BLOCKS), ()
        trust = tl.full((way.BLOCKS,), 1, tl.float32)
        if pixels.trusted.SOME:
            trust = tl.load(pixels.of.trust + block, mask=block < COUNT, other=0.0)
        for _ in tl.static_range(SUMS):
            added_up = added_up + (tl.zeros((way.BLOCKS, 8), tl.float32),)
        for j in range(SIDE):
            row, column = block[:, None] // pixels.trusted.ACROSS * SIDE + j, block[:, None] % pixels.trusted.ACROSS * SIDE + lane
            there = (lane < SIDE) & (row < pixels.grid.HEIGHT) & (column < pixels.grid.WIDTH)
            at = tl.where(there, row * pixels.grid.PITCH + column, pixels.grid.HEIGHT * pixels.grid.PITCH)
            more, of_row = (), rows(frame, pixels, look, model, at, way)
            for k in tl.static_range(SUMS):
                more = more + (added_up[k] + of_row[k],)
            added_up = more
        more, squares = (), ()
        for k in tl.static_range(SUMS):
            of_block = tl.sum(added_up[k], 1)
            tl.store(sums + k * COUNT + block, of_block, mask=block < COUNT)
            if k < SUMS - 3:
                more = more + (total[k] + (of_block * trust).to(tl.float64),)
            else:
                more = more + (total[k] + of_block.to(tl.float64),)
                squares = squares + (total[k + 3] + of_block.to(tl.float64) * of_block.to(tl.float64),)
        total = more + squares
    level, power = look.mean + look.base, tl.sum(total[2])
    rough = power > FLAT * (power + level * level * look.total)  # of a patch that is flat but for rounding g0 is 0
    for k in tl.static_range(SUMS + 3):
        value = finite(tl.sum(total[k]))
        if (k >= 1) and (k <= 5):
            value = tl.where(rough, value, 0.0)
        tl.store(totals + k, value)
    if not rough:
        tl.debug_barrier()
        for first in range(COUNT, 6 * COUNT, 1024):
            at = first + tl.arange(0, 1024)
            tl.store(sums + at, 0.0, mask=at < 6 * COUNT)


@triton.jit
def completed(frame, pixels, look, out, way):
    """normal.Moments of the pixels that count in the last look."""
    whole, empty = look.whole, tl.zeros((16, 16), tl.float32)
    number, normal, power, gram, noise = tl.zeros((SLICE,), tl.float32), empty, empty, empty, empty
    size: tl.constexpr = pixels.grid.HEIGHT * pixels.grid.PITCH
    for first in range(0, size, SLICE):
        at = first + tl.arange(0, SLICE)
        weight = counted(pixels, in_view(frame, pixels, look.warp, whole, at), at)
        x, y = places(pixels, at)
        x, y = x.to(tl.float32), y.to(tl.float32)
        R, wiener = columns(pixels, 1, at, x, y, way), tl.load(pixels.of.planes + 6 * size + at, mask=at < size, other=0)
        ZW = stacked(columns(pixels, 0, at, x, y, way), way.LINES) * weight[None, :]
        normal += product(ZW, stacked(R, way.LINES))
        power += product(ZW, ZW)
        shape = stacked((R[4], x * pixels.of.by_u, y * pixels.of.by_v, R[3]), 4)
        gram += product(shape * weight[None, :], shape)
        q = weight * (wiener.to(tl.float32) / STEPS)
        noise += product(stacked((q, q * q), 2), stacked((R[4], x, y, x * x + y * y), 4))
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
