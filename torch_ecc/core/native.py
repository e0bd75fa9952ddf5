"""The native engine on a CPU: the loop of ``solver`` as one C++ operator, compiled on first use and cached.

The torch page stays the reference; both give the same poses to 1e-4 px. Sources: ``csrc``. One compilation takes some
ten seconds, says so on stderr, and serves this version of torch and this kind of CPU from then on.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path

import torch
from torch import Tensor

from torch_ecc.core import packed, reference, sampling, solution, solver
from torch_ecc.core.criteria import ECC, SSD, Criterion, PaperECC
from torch_ecc.core.normal import Moments, Normal, normal_equations
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, Trust

SOURCES = Path(__file__).parent / "csrc"
DEGREE = {"bilinear": 1, "bspline3": 3, "bspline5": 5}
LIGHT = {"gain": 0, "linear": 2, "quadratic": 5}  # light columns of ECC
CODE: dict[type[Criterion], int] = {SSD: -1, PaperECC: -2}
DTYPES = (torch.uint8, torch.uint16, torch.float32)
CONSTANTS = {  # of the Python modules, for the C++
    "ECC_MOST": packed.MOST,
    "ECC_BLOCK": reference.BLOCK,
    "ECC_LEVELS": reference.LEVELS,
    "ECC_ROUNDING": sampling.ROUNDING,
    "ECC_FLAT": solution.FLAT,
    **{
        f"ECC_{name}": getattr(solver, name)
        for name in ("COARSE_TOLERANCE", "SECANT_RANGE", "LARGEST_SCALE", "LONGEST_STEP")
    },
}
# Sums may be reordered and vectorised; NaN and infinity keep their meaning.
MATHS = ["-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math"]
INSTRUCTIONS = {
    "AVX2": ["-mavx2", "-mfma"],
    "AVX512": ["-mavx512f", "-mavx512vl", "-mavx512bw", "-mavx512dq", "-mfma"],
}


def takes(reference: Reference, image: Tensor, settings: Settings) -> bool:
    """Whether the engine solves this: a built-in criterion and sampler, an image on the CPU in one of ``DTYPES``."""
    return (
        settings.backend != "torch"
        and image.dtype in DTYPES
        and image.device.type == "cpu"
        and reference.place.radius.dtype == torch.float64  # float32 where it was prepared on Apple's MPS
        and settings.interpolation in DEGREE
        and _code(reference.criterion) is not None
        and load(settings.backend == "native")
    )


def _code(criterion: Criterion) -> int | None:
    """What the C++ calls a criterion: the number of light columns, or one of ``CODE``; None if it does not know it."""
    return LIGHT.get(criterion.illumination) if type(criterion) is ECC else CODE.get(type(criterion))


def solve(
    reference: Reference, image: Tensor, start: Tensor, settings: Settings, trust: Trust | None = None
) -> Solution:
    """``solver.solve``: poses of B templates in (B or 1, 1, H, W) of one of ``DTYPES`` from ``start`` (B, 3) on, or of
    those that a ``trust`` is about."""
    code, degree = _code(reference.criterion), DEGREE[settings.interpolation]
    rest = (None, None) if trust is None else (trust.blocks, trust.which)
    *values, partial, moments = operator()(
        image, start, *reference.packed, code, degree, settings.max_iterations, settings.tolerance, *rest
    )
    pose, error, iterations, gain, sums, total = values
    normal = _counted(reference, partial, moments, trust) if len(partial) else reference.normal
    return Solution(pose, error, iterations, gain, sums, total, normal)


def _counted(reference: Reference, index: Tensor, moments: Tensor, trust: Trust | None) -> Normal:
    """The normal equations with those of the templates at ``index`` (n,) made anew from ``moments`` (n, ...); with
    ``trust`` of those that it is about."""
    most, columns = packed.MOST, reference.K.shape[1]
    number, *matrices, gram, noise = moments.split((1, most**2, most**2, 16, 8), 1)
    normal, power = (matrix.view(-1, most, most)[:, :columns, :columns] for matrix in matrices)
    anew = normal_equations(Moments(number[:, 0], normal, power, gram.view(-1, 4, 4), noise.view(-1, 2, 4)))
    if trust is not None or len(index) == len(reference.K):  # with trust all of them are
        return anew
    return each(lambda old, new: old.index_copy(0, index, new), reference.normal, anew)


@cache
def operator() -> Callable[..., list[Tensor]]:
    """The operator itself, looked up once: the lookup is slow."""
    solve: Callable[..., list[Tensor]] = torch.ops.torch_ecc.solve.default
    return solve


@lru_cache(maxsize=2)
def load(wanted: bool) -> bool:
    """Whether the operator is there, compiled now if need be. ``wanted``: say so if there is no compiler."""
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    try:
        if compiler is None:
            raise OSError("no C++ compiler is found; CXX names one")
        torch.ops.load_library(str(build(compiler)))
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        if wanted or compiler is not None:
            warnings.warn(f"torch_ecc: no native engine, the slower torch page serves ({_reason(error)})", stacklevel=2)
        return False
    return True


def _reason(error: Exception) -> str:
    """Why there is no operator, in one line: the compiler's first error if it has told one."""
    if not isinstance(error, subprocess.CalledProcessError):
        return str(error).strip().splitlines()[0]
    told = [line for line in error.stderr.splitlines() if "error" in line]
    return told[0] if told else f"the compiler {error.cmd[0]} ended with status {error.returncode}"


def build(compiler: str) -> Path:
    """The compiled operator in the user's cache folder, made if it is not there. Raises OSError, SubprocessError."""
    sources = sorted(SOURCES.iterdir())
    instructions = INSTRUCTIONS.get(torch.backends.cpu.get_cpu_capability(), [])
    flags = ["-O3", "-std=c++20", "-shared", "-fPIC", *MATHS, *instructions]
    flags += ["-undefined", "dynamic_lookup"] if sys.platform == "darwin" else ["-fopenmp"]
    flags.append(f"-D_GLIBCXX_USE_CXX11_ABI={int(torch.compiled_with_cxx11_abi())}")
    flags += [f"-D{name}={value!r}" for name, value in CONSTANTS.items()]
    parts = [torch.__version__, sys.platform, compiler, *flags, *(source.read_text() for source in sources)]
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torch_ecc"
    target = folder / f"native-{name}.so"
    if not target.is_file():
        print("torch_ecc: compiling the native engine, once (some 10 s) ...", file=sys.stderr, flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        home = Path(torch.__file__).parent
        include = [f"-I{home / 'include'}", f"-I{home / 'include' / 'torch' / 'csrc' / 'api' / 'include'}"]
        with tempfile.TemporaryDirectory(dir=folder) as scratch:  # renamed when finished: no process sees half of it
            made = Path(scratch) / target.name
            command = [*shlex.split(compiler), *flags, *include, str(SOURCES / "solve.cpp"), "-o", str(made)]
            command += [f"-L{home / 'lib'}", "-ltorch_cpu", "-lc10"]
            subprocess.run(command, check=True, capture_output=True, text=True)
            made.replace(target)
    return target
