"""Vectors and matrices with 16 places, of which the columns of a criterion take some, in a program's registers."""

from __future__ import annotations

import triton
import triton.language as tl

from torch_ecc.core.fused.records import INFINITE

AT_ONCE = tl.constexpr(4)  # rows of a matrix of sums


@triton.jit
def picked(vector, k):
    """One number of a vector (16,)."""
    return tl.sum(tl.where(tl.arange(0, 16) == k, vector, 0.0))


@triton.jit
def row_of(matrix, k):
    """One row (16,) of a matrix (16, 16)."""
    return tl.sum(tl.where(tl.arange(0, 16)[:, None] == k, matrix, 0.0), 0)


@triton.jit
def column_of(matrix, k):
    """One column (16,) of a matrix (16, 16)."""
    return tl.sum(tl.where(tl.arange(0, 16)[None, :] == k, matrix, 0.0), 1)


@triton.jit
def finite(v):
    """``v``, or 0."""
    return tl.where(tl.abs(v) < INFINITE, v, 0.0)


@triton.jit
def scaled(columns, weight, COUNT: tl.constexpr):
    """Columns (PIXELS,) times a weight."""
    result = ()
    for k in tl.static_range(COUNT):
        result = result + (columns[k] * weight,)
    return result


@triton.jit
def nothing(FIRST: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr, PIXELS: tl.constexpr):
    """No products yet, see there."""
    sums = ()
    for i in tl.static_range(AT_ONCE):
        if FIRST + i < HEIGHT:
            for _ in tl.static_range(WIDTH):
                sums = sums + (tl.zeros((PIXELS,), tl.float32),)
    return sums


@triton.jit
def with_products(sums, left, right, FIRST: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr):
    """The ``sums`` and, pixel by pixel, the products of AT_ONCE of HEIGHT columns on the left, from FIRST on, with
    WIDTH on the right: those rows of a matrix, of which all are more than registers hold."""
    result = ()
    for i in tl.static_range(AT_ONCE):
        if FIRST + i < HEIGHT:
            for j in tl.static_range(WIDTH):
                result = result + (sums[i * WIDTH + j] + left[FIRST + i] * right[j],)
    return result


@triton.jit
def placed_in(matrix, sums, FIRST: tl.constexpr, HEIGHT: tl.constexpr, WIDTH: tl.constexpr):
    """A matrix (16, 16), float64, with those rows, added up."""
    row, column = tl.arange(0, 16)[:, None], tl.arange(0, 16)[None, :]
    for i in tl.static_range(AT_ONCE):
        if FIRST + i < HEIGHT:
            for j in tl.static_range(WIDTH):
                value = tl.sum(sums[i * WIDTH + j]).to(tl.float64)
                matrix = tl.where((row == FIRST + i) & (column == j), value, matrix)
    return matrix


@triton.jit
def inverted(matrix, COLUMNS: tl.constexpr):
    """criteria.safe_inverse of the first COLUMNS of a matrix (16, 16), by Gauss and Jordan; elsewhere 0."""
    i, j, k = tl.arange(0, 16)[:, None], tl.arange(0, 16)[None, :], tl.arange(0, 16)
    one, within = i == j, (i < COLUMNS) & (j < COLUMNS)
    diagonal = tl.sum(tl.where(one, matrix, 0.0), 1)
    scale = 1 / tl.sqrt(tl.maximum(tl.abs(diagonal), 1e-30))
    regular = tl.min(tl.where(k < COLUMNS, diagonal, 1.0)) > 0
    scale = scale[:, None] * scale[None, :]
    left, right = tl.where(within, matrix * scale, one.to(tl.float64)), one.to(tl.float64)
    for n in range(COLUMNS):
        size = tl.where(k >= n, tl.abs(column_of(left, n)), -1.0)
        p = tl.argmax(size, 0)
        left, right = exchanged(left, n, p), exchanged(right, n, p)
        row, other = row_of(left, n), row_of(right, n)
        pivot = picked(row, n)
        regular = regular & (tl.abs(pivot) > 0)
        pivot = tl.where(tl.abs(pivot) > 0, pivot, 1.0)
        row, other, factor = row / pivot, other / pivot, column_of(left, n)[:, None]
        left = tl.where(i == n, row[None, :], left - factor * row[None, :])
        right = tl.where(i == n, other[None, :], right - factor * other[None, :])
    regular = regular & (tl.sum(tl.where(within, tl.abs(right), 0.0)) < 1e6)  # NaN and infinity are singular
    return tl.where(within, tl.where(regular, right * scale, 0.0), 0.0)


@triton.jit
def exchanged(matrix, n, p):
    """With rows n and p in each other's place."""
    i = tl.arange(0, 16)[:, None]
    swapped = tl.where(i == p, row_of(matrix, n)[None, :], matrix)
    return tl.where(i == n, row_of(matrix, p)[None, :], swapped)
