"""The native engine on a CPU: the loop of ``solver`` as compiled C++ (``csrc``), see ``library``.

The torch page stays the reference; both give the same poses to 1e-4 px.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.criteria import ECC, SSD, Criterion, PaperECC
from torch_ecc.core.native import operator
from torch_ecc.core.native.entry import DTYPES, call
from torch_ecc.core.native.library import load
from torch_ecc.core.native.packed import MOST
from torch_ecc.core.normal import Moments, Normal, normal_equations
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, Trust

DEGREE = {"bilinear": 1, "bspline3": 3, "bspline5": 5}
LIGHT = {"gain": 0, "linear": 2, "quadratic": 5}  # light columns of ECC
CODE: dict[type[Criterion], int] = {SSD: -1, PaperECC: -2}


def takes(reference: Reference, image: Tensor, settings: Settings) -> bool:
    """Whether the engine solves this: a built-in criterion and sampler, an image on the CPU in one of ``DTYPES``."""
    return (
        settings.backend in {"auto", "native"}
        and image.dtype in DTYPES
        and image.device.type == "cpu"
        and reference.place.radius.dtype == torch.float64  # float32 where it was prepared on Apple's MPS
        and settings.interpolation in DEGREE
        and code_of(reference.criterion) is not None
        and (reference.distortion is None or not torch.compiler.is_compiling())
        and load() is not None
    )


def code_of(criterion: Criterion) -> int | None:
    """What the C++ calls a criterion: the number of light columns, or one of ``CODE``; None if it does not know it."""
    return LIGHT.get(criterion.illumination) if type(criterion) is ECC else CODE.get(type(criterion))


def solve(
    reference: Reference, image: Tensor, start: Tensor, settings: Settings, trust: Trust | None = None
) -> Solution:
    """``solver.solve``: poses of B templates in (B or 1, 1, H, W) of one of ``DTYPES`` from ``start`` (B, 3) on, or of
    those that a ``trust`` is about."""
    library, code, trust = load(), code_of(reference.criterion), None if Trust.whole(trust) else trust
    if library is None or code is None:
        raise ValueError("native: expected what it takes")
    how = DEGREE[settings.interpolation], settings.max_iterations, settings.tolerance, code
    if torch.compiler.is_compiling():
        partial, found = operator.traced(image, start, reference.packed, how, trust)
    else:
        partial, found = call(library, image, start, reference.packed, how, trust, reference.distortion)
    pose, error, iterations, gain, sums, total, moments = found
    judged = partial and (trust is None or trust.judged)
    normal = _counted(reference, moments, trust) if judged else reference.normal
    return Solution(pose, error, iterations, gain, sums, total, normal)


def _counted(reference: Reference, moments: Tensor, trust: Trust | None) -> Normal:
    """The normal equations with those of the partial templates made anew from ``moments`` (n, ...); with ``trust`` of
    those that it is about."""
    index = (moments[:, 0] >= 0).nonzero()[:, 0]
    response = reference.noise.response[index if trust is None else trust.which[index]]
    anew = normal_equations(moments_of(moments[index], reference.K.shape[1]), response)
    if trust is not None or len(index) == len(reference.K):  # with trust all of them are
        return anew
    return each(lambda old, new: old.index_copy(0, index, new), reference.normal, anew)


def moments_of(numbers: Tensor, columns: int) -> Moments:
    """Of the first ``columns``, from the ``numbers`` (n, MOMENTS) that a compiled engine writes."""
    number, *matrices, gram, noise = numbers.split((1, MOST**2, MOST**2, 16, 8), 1)
    normal, power = (matrix.view(-1, MOST, MOST)[:, :columns, :columns] for matrix in matrices)
    return Moments(number[:, 0], normal, power, gram.view(-1, 4, 4), noise.view(-1, 2, 4))
