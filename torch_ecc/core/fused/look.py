"""What a template leaves behind after its last look: sums per block of pixels, and the moments of those that count."""

from __future__ import annotations

import triton
import triton.language as tl

from torch_ecc.core.fused.algebra import AT_ONCE, finite, nothing, scaled, with_products
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
    if tl.load(trusted.asked + b).to(tl.int32) != 0:
        n, one = answers.looks + b * OF_LOOK, one_of(fine, trusted, k, b)
        x, y, theta, whole = tl.load(n), tl.load(n + 1), tl.load(n + 2), tl.load(n + 3) > 0
        look = Look(x, y, theta, whole, tl.load(n + 4), tl.load(n + 5), tl.load(n + 6), tl.load(n + 7))
        tl.store(answers.gain + b, finite(tl.load(n + 11)))
        describe(
            View(smooth.grey + k * smooth.next, smooth),
            Pixels(one, fine, trusted),
            look,
            n,
            bend + 4 * k,
            answers.sums + b * SUMS * trusted.COUNT,
            answers.total + b * (SUMS + CLUSTERS),
            answers.moments + b * OF_MOMENTS,
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
    """Sums over the pixels of blocks (THREADS,), ten of each."""
    sums = ()
    for _ in tl.static_range(SUMS):
        sums = sums + (tl.zeros((way.THREADS,), tl.float32),)
    for j in range(SIDE):
        row = block // pixels.trusted.ACROSS * SIDE + j
        for i in range(SIDE):
            column = block % pixels.trusted.ACROSS * SIDE + i
            there = (row < pixels.grid.HEIGHT) & (column < pixels.grid.WIDTH)
            at = tl.where(there, row * pixels.grid.PITCH + column, pixels.grid.HEIGHT * pixels.grid.PITCH)
            more, of_pixels = (), rows(frame, pixels, look, warp, model, at, way)
            for k in tl.static_range(SUMS):
                more = more + (sums[k] + of_pixels[k],)
            sums = more
    return sums


@triton.jit
def summed(frame, pixels, look, warp, model_at, sums, totals, way):
    """``solution.summed`` of the last look: sums (10, COUNT) over blocks, and their total."""
    COUNT: tl.constexpr = pixels.trusted.COUNT
    model = (numbers_at(model_at, way.LINES),)
    for k in tl.static_range(1, 4):
        model = model + (numbers_at(model_at + 16 * k, way.COLUMNS),)
    for first in range(0, COUNT, way.THREADS):
        block = first + tl.arange(0, way.THREADS)
        of_blocks = block_sums(frame, pixels, look, warp, model, block, way)
        for k in tl.static_range(SUMS):
            tl.store(sums + k * COUNT + block, of_blocks[k], mask=block < COUNT)
    tl.debug_barrier()  # what others have stored is read again
    concluded(pixels, look, sums, totals)
    for k in tl.static_range(3):
        clustered(sums + (SUMS - 3 + k) * COUNT, totals + SUMS + k, pixels.trusted)


@triton.jit
def concluded(pixels, look, sums, totals):
    """The total of the sums, the first seven as blocks are trusted; K is less where there is less trust. Of a patch
    that is flat but for rounding g0 is 0."""
    COUNT: tl.constexpr = pixels.trusted.COUNT
    trust, total = tl.full((pixels.trusted.LINES, pixels.trusted.LINES), 1, tl.float64), ()
    if pixels.trusted.SOME:
        trust = of_blocks(pixels.of.trust, pixels.trusted)
    for k in tl.static_range(SUMS):
        value = of_blocks(sums + k * COUNT, pixels.trusted)
        if k < SUMS - 3:
            value *= trust
        total = total + (tl.sum(value),)
    level = look.mean + look.base
    rough = total[2] > FLAT * (total[2] + level * level * look.total)
    for k in tl.static_range(SUMS):
        value = finite(total[k])
        if (k >= 1) and (k <= 5):
            value = tl.where(rough, value, 0.0)
        tl.store(totals + k, value)
    if not rough:
        for first in range(COUNT, 6 * COUNT, 1024):
            at = first + tl.arange(0, 1024)
            tl.store(sums + at, 0.0, mask=at < 6 * COUNT)


@triton.jit
def of_blocks(values, trusted):
    """Of (COUNT,) as rows and columns of blocks (LINES, LINES), float64, 0 where there is none."""
    i, j = tl.arange(0, trusted.LINES)[:, None], tl.arange(0, trusted.LINES)[None, :]
    there = (j < trusted.ACROSS) & (i < trusted.COUNT // trusted.ACROSS)
    return tl.load(values + i * trusted.ACROSS + j, mask=there, other=0.0).to(tl.float64)


@triton.jit
def clustered(effect, out, trusted):
    """``solution.clustered`` of one of three effects (COUNT,): square sums over blocks, rows and columns of them."""
    value = of_blocks(effect, trusted)
    in_row, in_column = tl.sum(value, 1), tl.sum(value, 0)
    tl.store(out, finite(tl.sum(value * value)))
    tl.store(out + 3, finite(tl.sum(in_row * in_row)))
    tl.store(out + 6, finite(tl.sum(in_column * in_column)))


@triton.jit
def completed(frame, pixels, look, warp, out, way):
    """normal.Moments of the pixels that count in the last look."""
    size: tl.constexpr = pixels.grid.HEIGHT * pixels.grid.PITCH
    for k in tl.static_range(0, way.LINES, AT_ONCE):
        normal, power = nothing(k, way.LINES, way.LINES, way.THREADS), nothing(k, way.LINES, way.LINES, way.THREADS)
        for first in range(0, size, way.THREADS):
            at = first + tl.arange(0, way.THREADS)
            weight = counted(pixels, in_view(frame, pixels, warp, look.whole, at, way), at)
            x, y = places(pixels, at)
            ZW = scaled(columns(pixels, 0, at, x, y, way), weight, way.LINES)
            normal = with_products(normal, ZW, columns(pixels, 1, at, x, y, way), k, way.LINES, way.LINES)
            power = with_products(power, ZW, ZW, k, way.LINES, way.LINES)
        written(out + 1, normal, k, way.LINES, way.LINES, PLACES)
        written(out + 1 + PLACES * PLACES, power, k, way.LINES, way.LINES, PLACES)
    completed_shapes(frame, pixels, look, warp, out, way)


@triton.jit
def completed_shapes(frame, pixels, look, warp, out, way):
    """Of them the number, what the shapes 1, u, v and t have in common, and the Wiener weights q and q^2 by 1, x', y'
    and r'^2."""
    size: tl.constexpr = pixels.grid.HEIGHT * pixels.grid.PITCH
    number, gram = tl.zeros((way.THREADS,), tl.float32), nothing(0, 4, 4, way.THREADS)
    noise = nothing(0, 2, 4, way.THREADS)
    for first in range(0, size, way.THREADS):
        at = first + tl.arange(0, way.THREADS)
        weight = counted(pixels, in_view(frame, pixels, warp, look.whole, at, way), at)
        x, y = places(pixels, at)
        one, t = columns(pixels, 1, at, x, y, way)[4], columns(pixels, 1, at, x, y, way)[3]
        shape = (one, x * pixels.of.by_u, y * pixels.of.by_v, t)
        gram = with_products(gram, scaled(shape, weight, 4), shape, 0, 4, 4)
        q = weight * tl.load(pixels.of.planes + 6 * size + at, mask=at < size, other=0).to(tl.float32) / STEPS
        noise = with_products(noise, (q, q * q), (one, x, y, x * x + y * y), 0, 2, 4)
        number += (weight > 0).to(tl.float32)
    tl.store(out, tl.sum(number).to(tl.float64))
    out += 1 + 2 * PLACES * PLACES
    written(out, gram, 0, 4, 4, 4)
    written(out + 16, noise, 0, 2, 4, 4)


@triton.jit
def written(out, sums, FIRST: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PITCH: tl.constexpr):
    """The rows from FIRST on of a matrix of ``with_products``, added up."""
    for i in tl.static_range(AT_ONCE):
        if FIRST + i < HEIGHT:
            for j in tl.static_range(WIDTH):
                tl.store(out + (FIRST + i) * PITCH + j, tl.sum(sums[i * WIDTH + j]).to(tl.float64))
