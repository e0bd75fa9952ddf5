"""The fused engine on a GPU: the loop of ``solver`` as one Triton kernel (``kernel``), and nothing of the host in it.

The torch page stays the reference; both give the same poses to 1e-4 px. Triton's interpreter (``TRITON_INTERPRET=1``
before the start) runs the same kernel on tensors of the CPU.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from os import environ

import torch
from torch import Tensor

from torch_ecc.core.native import operator
from torch_ecc.core.native.engine import DEGREE, code_of, moments_of
from torch_ecc.core.native.entry import DTYPES
from torch_ecc.core.normal import Normal, normal_equations
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, Trust

LEAST_TRITON = (3, 4)


def takes(reference: Reference, image: Tensor, settings: Settings) -> bool:
    """Whether the engine solves this: a built-in criterion and sampler, an image in one of ``DTYPES`` on an NVIDIA GPU;
    on a CPU if that is asked for and Triton interprets."""
    return (
        settings.backend in {"auto", "fused"}
        and image.dtype in DTYPES
        and _runs_on(image.device.type, settings.backend == "fused")
        and settings.interpolation in DEGREE
        and code_of(reference.criterion) is not None
        and (reference.distortion is None or not torch.compiler.is_compiling())
    )


def _runs_on(kind: str, asked: bool) -> bool:
    if kind == "cpu":
        return asked and environ.get("TRITON_INTERPRET") == "1" and installed()
    return kind == "cuda" and torch.version.hip is None and installed()


@cache
def installed() -> bool:
    """Whether there is a Triton that can do it: records as arguments and in loops came with its version 3.4."""
    if find_spec("triton") is None:
        return False
    return tuple(int(n) for n in version("triton").split(".")[:2]) >= LEAST_TRITON


def solve(
    reference: Reference, image: Tensor, start: Tensor, settings: Settings, trust: Trust | None = None
) -> Solution:
    """``solver.solve``: poses of B templates in (B or 1, 1, H, W) of one of ``DTYPES`` from ``start`` (B, 3) on, or of
    those that a ``trust`` is about."""
    from torch_ecc.core.fused.launch import call  # which imports Triton

    code = code_of(reference.criterion)
    if code is None:
        raise ValueError("fused: expected what it takes")
    how = DEGREE[settings.interpolation], settings.max_iterations, settings.tolerance, code
    if torch.compiler.is_compiling():
        _, found = operator.traced(image, start, reference.packed, how, trust)
    else:
        found = call(image, start, reference.packed, how, trust, reference.distortion)
    pose, error, iterations, gain, sums, total, moments = found
    partial = None if Trust.whole(trust) else trust
    return Solution(pose, error, iterations, gain, sums, total, _counted(reference, moments, partial))


def _counted(reference: Reference, moments: Tensor, trust: Trust | None) -> Normal:
    """The normal equations with those of the partial templates made anew from ``moments`` (n, ...); the host does not
    ask which they are."""
    partial = moments[:, 0] >= 0
    response = reference.noise.response if trust is None else reference.noise.response[trust.which]
    anew = normal_equations(moments_of(moments, reference.K.shape[1]), response)
    if trust is not None:  # with it all of them are
        return anew
    return each(
        lambda new, old: torch.where(partial.view(-1, *[1] * (old.dim() - 1)), new, old), anew, reference.normal
    )
