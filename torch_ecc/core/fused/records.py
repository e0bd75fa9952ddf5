"""What the fused kernel is told, and what it has in hand: records of pointers, of numbers, and of constants that it is
compiled for."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import triton.language as tl

from torch_ecc.core import sampling, solution, solver, step
from torch_ecc.core.columns import LEVELS
from torch_ecc.core.grid import BLOCK
from torch_ecc.core.native.packed import MOMENTS, MOST, NUMBERS
from torch_ecc.core.normal import LEAST

SIDE, PLACES = tl.constexpr(BLOCK), tl.constexpr(MOST)
SUMS, CLUSTERS = tl.constexpr(solution.SUMS), tl.constexpr(solution.CLUSTERS)
OF_NUMBERS, OF_MOMENTS, STEPS = tl.constexpr(NUMBERS), tl.constexpr(MOMENTS), tl.constexpr(LEVELS)
ROUNDING, FLAT, SMALL = tl.constexpr(sampling.ROUNDING), tl.constexpr(solution.FLAT), tl.constexpr(LEAST)
SECANT_RANGE, LARGEST_SCALE = tl.constexpr(step.SECANT_RANGE), tl.constexpr(step.LARGEST_SCALE)
LONGEST_STEP, COARSE_TOLERANCE = tl.constexpr(step.LONGEST_STEP), tl.constexpr(solver.COARSE_TOLERANCE)
INFINITE, FARTHEST = tl.constexpr(inf), tl.constexpr(2.0**24)  # px: beyond it nothing is in sight
PAPER = tl.constexpr(-2)  # a criterion in place of a number of light columns; SSD is -1
OF_LOOK = tl.constexpr(8 + 4 * 16)


class Frames(NamedTuple):
    """``grey`` values of frames (I, h, w): pixels, or coefficients of their spline of ``DEGREE`` with a ring around
    them; ``height`` and ``width`` of the frames, and the values from one template's to the next, 0 if all share one."""

    grey: tl.tensor
    height: tl.tensor
    width: tl.tensor
    next: tl.tensor
    DEGREE: tl.constexpr


class View(NamedTuple):
    """The frame that one template is looked for in, its ``grey`` values, and what all have in common."""

    grey: tl.tensor
    of: Frames


class Grids(NamedTuple):
    """``packed.Packed`` of templates, on one of their grids, see there. ``EVEN``: one row of weights serves all."""

    planes: tl.tensor
    weight: tl.tensor
    numbers: tl.tensor
    HEIGHT: tl.constexpr
    WIDTH: tl.constexpr
    PITCH: tl.constexpr
    STEP: tl.constexpr
    EVEN: tl.constexpr


class Trusted(NamedTuple):
    """``solution.Trust``: ``blocks`` (n, COUNT), ACROSS of them side by side, of the templates at ``which`` (n,) that
    are ``asked`` (n,) for."""

    which: tl.tensor
    blocks: tl.tensor
    asked: tl.tensor
    ACROSS: tl.constexpr
    COUNT: tl.constexpr
    LINES: tl.constexpr  # a power of two, no less than rows or columns of blocks
    SOME: tl.constexpr  # False: all templates are whole


class Answers(NamedTuple):
    """``entry.FIELDS``, all without gaps, and ``looks`` (n, OF_LOOK): the numbers of ``Look``, and, at 16 places each,
    the model's fit to the patch and the first three rows of the inverse of Z W R^T."""

    pose: tl.tensor
    error: tl.tensor
    iterations: tl.tensor
    gain: tl.tensor
    sums: tl.tensor
    total: tl.tensor
    moments: tl.tensor
    looks: tl.tensor


class Way(NamedTuple):
    """How to solve. ``PIXELS`` at a time are sampled; of the columns' products, and of blocks in the last look, one is
    each of so many ``THREADS``'. (The most iterations are no whole number: Triton would make one more kernel of 1.)"""

    tolerance: tl.tensor
    most: tl.tensor
    CRITERION: tl.constexpr
    LINES: tl.constexpr
    COLUMNS: tl.constexpr
    COARSER: tl.constexpr  # whether the first stage has a grid of its own
    PIXELS: tl.constexpr
    THREADS: tl.constexpr
    PARTIAL: tl.constexpr  # whether pixels may be out of sight or not trusted


class One(NamedTuple):
    """A template on a grid: where it lies, and some of its ``packed.Numbers``; 1 / half[0] and 1 / half[1]."""

    planes: tl.tensor
    weight: tl.tensor
    numbers: tl.tensor
    trust: tl.tensor
    left: tl.tensor
    top: tl.tensor
    by_u: tl.tensor
    by_v: tl.tensor
    radius: tl.tensor


class Pixels(NamedTuple):
    """Those of one template, and what all have in common."""

    of: One
    grid: Grids
    trusted: Trusted


class Warp(NamedTuple):
    """x = xu x' + xv y' + x0, y = yu x' + yv y' + y0."""

    xu: tl.tensor
    xv: tl.tensor
    yu: tl.tensor
    yv: tl.tensor
    x0: tl.tensor
    y0: tl.tensor


class State(NamedTuple):
    """``solver.State`` of one template."""

    x: tl.tensor
    y: tl.tensor
    theta: tl.tensor
    delta_x: tl.tensor
    delta_y: tl.tensor
    delta_theta: tl.tensor
    length: tl.tensor
    scale: tl.tensor
    error: tl.tensor
    iterations: tl.tensor


class Weighted(NamedTuple):
    """What depends on the pixels' weights: the sums of w and of w t, the weighted norm of t off its mean, Z W t and
    Z W 1 (16,), and the inverse (16, 16) of Z W R^T. t less its mean."""

    total: tl.tensor
    along: tl.tensor
    contrast: tl.tensor
    of_t: tl.tensor
    of_one: tl.tensor
    inverse: tl.tensor


class Look(NamedTuple):
    """At a patch g, all of it in sight if it is ``whole``: the pose, what g is taken off, ``base``, and the ``mean`` of
    the rest, the sum of weights, and the mean of t less its own."""

    x: tl.tensor
    y: tl.tensor
    theta: tl.tensor
    whole: tl.tensor
    base: tl.tensor
    mean: tl.tensor
    total: tl.tensor
    along: tl.tensor
