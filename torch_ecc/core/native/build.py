"""Compile the native engine, ``csrc``.

``python -m torch_ecc.core.native.build`` does it for a checkout, ``csrc/hook.py`` for a wheel.

One library for each set of instructions that a processor of the target may have; which of them serves is chosen where
it is loaded (``library``). Any C++20 compiler with vector extensions will do; CXX names one. Needs no torch.
"""

from __future__ import annotations

import ast
import hashlib
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
SOURCES, LIBRARIES, CORE = HERE / "csrc", HERE / "libraries", HERE.parent
SECONDS = 600  # a compiler that takes longer is given up
CONSTANTS = {  # of the Python modules, for the C++
    "native.packed": ["MOST", "PLANES", "NUMBERS", "MOMENTS"],
    "columns": ["LEVELS"],
    "grid": ["BLOCK"],
    "sampling": ["ROUNDING"],
    "solution": ["CLUSTERS", "FLAT", "SUMS"],
    "solver": ["COARSE_TOLERANCE"],
    "step": ["SECANT_RANGE", "LARGEST_SCALE", "LONGEST_STEP"],
}
# Nothing that rounds may be reordered. Products are fused with sums where a processor can; zig (clang) does so as the
# source has them, so that all that can give the same poses. g++ knows but never, a tenth slower, and freely.
MATHS = ["-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros"]
AS_WRITTEN, FREELY = "-ffp-contract=on", "-ffp-contract=fast"
FLAGS = ["-O3", "-std=c++20", "-shared", "-fvisibility=hidden", "-Wno-psabi", *MATHS]
ZIG = "ziglang==0.13.0.post1"  # builds for all TARGETS
HINT = "an installed C++ compiler, or `pip install ziglang`, which is one"


class Target(NamedTuple):
    """A kind of machine: its sets of ``instructions`` and their flags, what its ``linking`` takes, the ``suffix`` of a
    library; what ``zig`` and a wheel's name call it, empty for this machine and its own compiler."""

    instructions: Mapping[str, list[str]]
    linking: list[str]
    suffix: str
    zig: str = ""
    wheel: str = ""


class BuildError(Exception):
    """Why there is no library, in one line."""


X86 = {  # no more than torch looks for where it speaks of AVX2 and AVX512: a virtual machine may lack the rest
    "baseline": [],
    "AVX2": ["-mavx2", "-mfma"],
    "AVX512": ["-mavx512f", "-mavx512vl", "-mavx512bw", "-mavx512dq", "-mavx2", "-mfma"],
}
ZIG_X86 = {
    "baseline": [],
    "AVX2": ["-mcpu=x86_64+avx2+fma"],
    "AVX512": ["-mcpu=x86_64+avx2+fma+avx512f+avx512vl+avx512bw+avx512dq+evex512", "-mprefer-vector-width=512"],
}
ARM: Mapping[str, list[str]] = {"baseline": []}  # NEON
ELF = ["-fPIC", "-pthread", "-Xlinker", "--version-script", "-Xlinker", str(SOURCES / "exports.map"), "-Wl,-s"]
TARGETS = {  # of wheels, built by zig; Linux as old as manylinux2014
    "linux-x86_64": Target(ZIG_X86, ELF, ".so", "x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64"),
    "linux-aarch64": Target(ARM, ELF, ".so", "aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64"),
    "windows-amd64": Target(ZIG_X86, ["-Wl,-s"], ".dll", "x86_64-windows-gnu", "win_amd64"),
    "macos-arm64": Target(
        ARM,
        ["-fPIC", "-Wl,-s", "-Wl,-install_name,@rpath/torch_ecc.dylib"],
        ".dylib",
        "aarch64-macos.11.0",
        "macosx_11_0_arm64",
    ),
}


def here() -> Target:
    """This machine, by the command of CXX, a compiler on the path or zig. Raises BuildError if there is none."""
    system = {"linux": "linux", "darwin": "macos", "win32": "windows"}.get(sys.platform, sys.platform)
    machine = platform.machine().lower()
    by_zig = TARGETS.get(f"{system}-{machine}")
    if not compiler() and by_zig and find_spec("ziglang"):
        return by_zig
    if not compiler():
        raise BuildError(f"there is no C++ compiler: it takes {HINT}")
    linking = {"macos": ["-fPIC"], "windows": []}.get(system, [*ELF, "-static-libstdc++", "-static-libgcc"])
    suffix = {"macos": ".dylib", "windows": ".dll"}.get(system, ".so")
    return Target(X86 if machine in {"x86_64", "amd64"} else ARM, linking, suffix)


def constants() -> dict[str, float]:
    """Read from the modules' source: where an installation is built there is no torch to import them with."""
    found = {}
    for module, names in CONSTANTS.items():
        for node in ast.parse((CORE / f"{module.replace('.', '/')}.py").read_text()).body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id in names:
                found[f"ECC_{node.targets[0].id}"] = eval(compile(ast.Expression(node.value), module, "eval"))
    return found


def key(values: Mapping[str, float]) -> str:
    """What a library is made from."""
    sources = [path.read_bytes() for path in sorted(SOURCES.glob("*.[ch]*"))]
    return hashlib.sha256(b"\0".join([repr(sorted(values.items())).encode(), *sources])).hexdigest()[:12]


def digest(library: Path) -> str:
    """What it holds: a part of its name, so that one that is not whole or was changed is known."""
    return hashlib.sha256(library.read_bytes()).hexdigest()[:16]


def compiler() -> list[str]:
    """The command of CXX or of a compiler on the path, empty if there is none. Raises BuildError."""
    try:
        given = shlex.split(os.environ.get("CXX", ""))
    except ValueError as error:
        raise BuildError(f"CXX is no command: {os.environ['CXX']!r} ({error})") from error
    # What builds for Windows must align stacks for wide vectors, which MinGW's g++ does not.
    names = () if sys.platform == "win32" else ("c++", "g++", "clang++")
    return given or list(filter(None, map(shutil.which, names)))[:1]


def build(folder: Path, target: Target) -> list[Path]:
    """The libraries of a ``target`` in ``folder``, each there as a whole or not at all, whoever else builds, and those
    that they replace gone. Raises BuildError."""
    folder.mkdir(parents=True, exist_ok=True)
    for left in folder.glob(".building-*"):  # by what was killed
        with suppress(FileNotFoundError):  # whoever builds beside us has ended
            if time.time() - left.stat().st_mtime > SECONDS:
                shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".building-") as scratch, ThreadPoolExecutor() as pool:
        values = constants()  # once: what parses is not safe in threads
        return list(pool.map(lambda kind: _placed(target, kind, values, Path(scratch)), target.instructions))


def _placed(target: Target, kind: str, values: Mapping[str, float], scratch: Path) -> Path:
    """The library for one ``kind`` of instructions, in the folder above its ``scratch``."""
    made, folder = scratch / f"{kind}{target.suffix}", scratch.parent
    zig = [sys.executable, "-m", "ziglang", "c++", "-target", target.zig, "-Xclang", "-O3"]  # of itself it takes -O2
    command = [*zig, AS_WRITTEN] if target.zig else [*compiler(), FREELY]
    command += [*FLAGS, *(f"-D{name}={value!r}" for name, value in values.items()), *target.instructions[kind]]
    run([*command, str(SOURCES / "engine.cpp"), "-o", str(made), *target.linking], made)
    library = folder / f"{kind}-{key(values)}-{digest(made)}{target.suffix}"
    when = made.stat().st_mtime
    made.replace(library)
    for other in folder.glob(f"{kind}-*"):
        with suppress(FileNotFoundError):  # whoever builds beside us has removed it
            if other.stat().st_mtime < when:
                other.unlink()
    return library


def run(command: list[str], made: Path) -> None:
    """Raises BuildError if a compiler is not there, fails, takes too long or has not ``made`` what it should."""
    try:
        child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, errors="replace", start_new_session=True)
    except OSError as error:
        raise BuildError(f"the C++ compiler cannot be run: {error}") from error
    with child:
        try:
            told = child.communicate(timeout=SECONDS)[1]
        except BaseException as error:
            _end(child)
            if isinstance(error, subprocess.TimeoutExpired):
                raise BuildError(f"the C++ compiler {command[0]} did not end within {SECONDS} s") from error
            raise
    if child.returncode:
        lines = [line for line in told.splitlines() if "error" in line]
        words = lines[0] if lines else f"ended with status {child.returncode}"
        raise BuildError(f"the C++ compiler {command[0]} failed: {words[:200]}")
    if not made.is_file():
        raise BuildError(f"the C++ compiler {command[0]} has made nothing")


def _end(child: subprocess.Popen[str]) -> None:
    """With all that it has started."""
    if hasattr(os, "killpg"):
        os.killpg(child.pid, signal.SIGKILL)
    else:
        child.kill()


def main() -> None:
    """Build this checkout's engine."""
    try:
        for library in build(LIBRARIES, here()):
            print(library)
    except (BuildError, OSError) as failure:  # such as a folder that may not be written to
        sys.exit(f"torch_ecc: {failure}")


if __name__ == "__main__":
    main()
