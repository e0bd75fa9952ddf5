"""The native engine's library for this processor: found beside its sources, checked, loaded.

A wheel brings one for each set of instructions, ``build`` makes them elsewhere. A library's name tells what it was made
from and what it holds: neither one of other sources, nor one that is damaged or was changed is ever loaded.
"""

from __future__ import annotations

import ctypes
import os
import warnings
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import torch

from torch_ecc.core.native import build

# What torch itself says of the processor; another one takes the first.
SUITABLE = {"AVX2": ["AVX2", "baseline"], "AVX512": ["AVX512", "AVX2", "baseline"]}
WRITABLE = 0o002  # by anyone


class Library(NamedTuple):
    """The set of ``instructions`` it is made of, and its entries, see csrc/engine.cpp."""

    instructions: str
    solve: Callable[[bytes], int]
    linearise: Callable[[bytes], int]
    spread: Callable[[bytes], int]


class UnfitError(Exception):
    """Why a library is not loaded, in one line."""


@cache
def load() -> Library | None:
    """The one for this processor; None if there is none, which is said once."""
    library = found()
    if isinstance(library, Library):
        return library
    warnings.warn(f"torch_ecc: no native engine, the slower torch page serves ({library})", stacklevel=2)
    return None


@cache
def found() -> Library | str:
    """The one for this processor, or why there is none."""
    try:
        return _load(*_find(build.LIBRARIES))
    except (UnfitError, OSError) as reason:
        return str(reason)


def _find(folder: Path) -> tuple[str, Path]:
    """The best set of instructions that there is a library for, and the newest such. Raises UnfitError."""
    there = list(folder.glob("*-*-*"))
    key = build.key(constants())
    for kind in SUITABLE.get(torch.backends.cpu.get_cpu_capability(), ["baseline"]):
        fit = [path for path in there if path.name.startswith(f"{kind}-{key}-")]
        if fit:
            return kind, max(fit, key=lambda path: path.stat().st_mtime)
    again = "`python -m torch_ecc.core.native.build` makes it"
    if there:
        raise UnfitError(f"the one in {folder} is of other sources; {again}")
    raise UnfitError(f"none was installed; {again}, with {build.HINT}")


def _load(kind: str, path: Path) -> Library:
    """Raises UnfitError, OSError."""
    about, package = path.stat(), Path(__file__).stat()  # whoever may write this file needs no library
    by_anyone = about.st_mode & ~package.st_mode & WRITABLE
    if os.name == "posix" and (by_anyone or about.st_uid not in {0, os.geteuid(), package.st_uid}):
        raise UnfitError(
            f"anyone may have written {path}: its owner is user {about.st_uid}, its mode {about.st_mode:o}"
        )
    if path.stem.rpartition("-")[2] != build.digest(path):
        raise UnfitError(f"{path} is damaged or was changed; install again")
    library = ctypes.CDLL(str(path))  # the interpreter goes on with other threads while it runs
    entries = [getattr(library, f"torch_ecc_{name}") for name in Library._fields[1:]]
    for entry in entries:
        entry.argtypes, entry.restype = [ctypes.c_char_p], ctypes.c_int64
    return Library(kind, *entries)


def constants() -> dict[str, float]:
    """As the modules have them."""
    modules = {name: import_module(f"torch_ecc.core.{name}") for name in build.CONSTANTS}
    return {
        f"ECC_{name}": getattr(modules[module], name) for module, names in build.CONSTANTS.items() for name in names
    }


def describe() -> str:
    """Which engine serves on this CPU, for people."""
    library = found()
    if isinstance(library, Library):
        return f"native, {library.instructions} instructions"
    return f"the torch page; no native engine: {library}"
