"""The native path on a CPU: the solve of ``align.solve`` as one C++ operator, compiled on first use and cached.

The torch path stays the reference; both give the same poses to 1e-4 px. Sources: ``csrc``. One compilation takes some
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
import weakref
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.criteria import ECC, ILLUMINATION, SSD, Criterion, PaperECC
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings

SOURCES = Path(__file__).parent / "csrc"
DEGREE = {"bilinear": 1, "bspline3": 3, "bspline5": 5}
CODE: dict[type[Criterion], int] = {SSD: -1, PaperECC: -2}  # beside ECC's number of light columns
DTYPES = (torch.uint8, torch.uint16, torch.float32)
_packed: dict[int, tuple[weakref.ref[Tensor], tuple[object, ...], Tensor]] = {}  # by the id of K
# Sums may be reordered and vectorised; NaN and infinity keep their meaning.
MATHS = ["-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math"]
INSTRUCTIONS = {
    "AVX2": ["-mavx2", "-mfma"],
    "AVX512": ["-mavx512f", "-mavx512vl", "-mavx512bw", "-mavx512dq", "-mfma"],
}


class Packed(NamedTuple):
    """What the operators are called with: the templates (B, bytes) as the C++ reads them, and the settings."""

    templates: Tensor
    degree: int
    max_iterations: int
    tolerance: float
    min_score: float


def takes(image: Tensor) -> bool:
    """Whether the operators read such an image."""
    return image.dtype in DTYPES and image.device.type == "cpu"


def packed(reference: Reference, settings: Settings) -> Packed | None:
    """Templates and settings for the operators; None if another path is asked for or needed."""
    serves = type(reference.criterion) in (ECC, SSD, PaperECC) and reference.K.device.type == "cpu"
    serves = serves and reference.radius.dtype == torch.float64  # float32 where it was prepared on Apple's MPS
    if settings.backend == "torch" or not serves or not load(settings.backend == "native"):
        return None
    degree = DEGREE[settings.interpolation]
    return Packed(_pack(reference), degree, settings.max_iterations, settings.tolerance, settings.min_score)


def solve(templates: Packed, image: Tensor, pose: Tensor) -> Estimate:
    """Estimate of B templates in (B or 1, 1, H, W) of one of DTYPES, from poses (B, 3); some are left out.

    Those have status -1: at the frame's border, where pixels drop out of sight, the torch path is needed.
    """
    return Estimate(*torch.ops.torch_ecc.solve.default(image, templates.templates, pose, *templates[1:]))


def track(
    templates: Packed, image: Tensor, state: list[Tensor], *, hold: bool, search: bool
) -> tuple[Estimate, list[Tensor]]:
    """One frame of a Tracker of one level: its estimate and the next ``state`` = [pose, velocity, start, score,
    tracked, doubted]. The state is empty and the estimate that of ``solve`` if there are some to ``search`` for, or
    some left out."""
    operator = torch.ops.torch_ecc.track.default
    fields = operator(image, templates.templates, state, *templates[1:], hold, search)
    count = len(Estimate._fields)
    return Estimate(*fields[:count]), fields[count:]


def _pack(reference: Reference) -> Tensor:
    """16-bit images (B, bytes) of the templates, made once for as long as the reference lives."""
    rest = tuple(v for v in reference if v is not reference.K)  # what holds K, as K_sparse too, would keep it alive
    key = id(reference.K)
    known = _packed.get(key)
    if known is not None and known[0]() is reference.K and [*map(id, known[1])] == [*map(id, rest)]:
        return known[2]
    criterion = reference.criterion
    code = ILLUMINATION[criterion.illumination] if isinstance(criterion, ECC) else CODE[type(criterion)]
    made: Tensor = torch.ops.torch_ecc.pack.default(list(reference[1:]), code)
    forget = _packed.pop  # a module's names are gone when the interpreter ends
    _packed[key] = weakref.ref(reference.K, lambda _: forget(key, None)), rest, made
    return made


@lru_cache(maxsize=2)
def load(wanted: bool) -> bool:
    """Whether the operator is there, compiled now if need be. ``wanted``: say so if there is no compiler."""
    compiler = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    try:
        if compiler is None:
            raise OSError("no C++ compiler is found; CXX names one")
        torch.ops.load_library(str(library(compiler)))
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        if wanted or compiler is not None:
            reason = str(getattr(error, "stderr", None) or error).strip().splitlines()[0]
            warnings.warn(f"torch_ecc: no native path, the slower torch path serves ({reason})", stacklevel=2)
        return False
    return True


def library(compiler: str) -> Path:
    """The compiled operator in the user's cache folder, made if it is not there. Raises OSError, SubprocessError."""
    sources = sorted(SOURCES.iterdir())
    instructions = INSTRUCTIONS.get(torch.backends.cpu.get_cpu_capability(), [])
    flags = ["-O3", "-std=c++20", "-shared", "-fPIC", *MATHS, *instructions]
    flags += ["-undefined", "dynamic_lookup"] if sys.platform == "darwin" else ["-fopenmp"]
    flags.append(f"-D_GLIBCXX_USE_CXX11_ABI={int(torch.compiled_with_cxx11_abi())}")
    parts = [torch.__version__, sys.platform, compiler, *flags, *(source.read_text() for source in sources)]
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torch_ecc"
    target = folder / f"native-{name}.so"
    if not target.is_file():
        print("torch_ecc: compiling the native CPU path, once (some 10 s) ...", file=sys.stderr, flush=True)
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
