#!/usr/bin/env python
"""The wheels for all systems, built from Linux by zig, each opened and checked: ``python .ci/wheels.py [TARGET ...]``.

Needs what pip gets from PyPI, and the package lief to read the libraries of all systems. Where wine or qemu-aarch64 are
there (and torch_ecc itself, to compare with), the foreign libraries solve a problem too: ``elsewhere.c``.
"""

from __future__ import annotations

import os
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import lief

sys.path.insert(0, str(Path(__file__).parents[1]))

from torch_ecc.core.native.build import TARGETS, Target, constants, digest, key
from torch_ecc.core.native.build import build as compiled

if TYPE_CHECKING:
    from torch_ecc.core.native.library import Library

HERE = Path(__file__).parent
ROOT = HERE.parent
LARGEST = 2**21  # bytes of a wheel
ENTRIES = {"torch_ecc_solve", "torch_ecc_linearise", "torch_ecc_spread"}
SYSTEM = {  # what a library may need beside itself
    ".so": {"libm.so.6", "libpthread.so.0", "libc.so.6", "libdl.so.2", "ld-linux-x86-64.so.2"},
    ".dll": {"KERNEL32.dll"},
    ".dylib": {"/usr/lib/libSystem.B.dylib"},
}
GLIBC = (2, 17)
ROUNDING = 1e-9  # px: nothing but the last digits of a system's sines
EMULATORS = {
    "windows-amd64": ["wine"],
    "linux-aarch64": ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"],
    f"linux-{platform.machine()}": ["env"],  # this machine itself
}
LEAST = {  # a processor that has nothing but what a library is named after, as of a virtual machine
    "baseline": ["qemu-x86_64", "-cpu", "qemu64,-sse3,-ssse3,-sse4.1,-sse4.2,-popcnt"],
    "AVX2": ["qemu-x86_64", "-cpu", "max,-bmi1,-bmi2,-abm,-movbe,-f16c,-adx,-rdrand"],
}


def build(name: str, folder: Path) -> Path:
    """The wheel of a target."""
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", scratch, str(ROOT)]
        subprocess.run(command, check=True, env=os.environ | {"TORCH_ECC_TARGET": name})
        (wheel,) = Path(scratch).iterdir()
        return Path(shutil.move(wheel, folder / wheel.name))


def unpacked(wheel: Path, target: Target, folder: Path) -> list[Path]:
    """The libraries of a wheel that is what it says."""
    assert wheel.stat().st_size < LARGEST, f"{wheel.name} has {wheel.stat().st_size} bytes"
    assert wheel.stem.endswith(f"-py3-none-{target.wheel}"), wheel.name
    with zipfile.ZipFile(wheel) as held:
        held.extractall(folder)
    (about,) = folder.glob("*.dist-info/WHEEL")
    assert f"Tag: py3-none-{target.wheel}" in about.read_text().splitlines()
    assert "Root-Is-Purelib: false" in about.read_text().splitlines()
    libraries = sorted((folder / "torch_ecc/core/native/libraries").iterdir())
    assert sorted(path.name.split("-")[0] for path in libraries) == sorted(target.instructions)
    for path in libraries:
        assert path.stem.split("-")[1:] == [key(constants()), digest(path)], path.name
    return libraries


def check(path: Path, target: Target) -> str:
    """In words what a library exports and needs. AssertionError for what it should not."""
    binary = lief.parse(str(path))
    exported = {each.name.removeprefix("_") for each in binary.exported_functions}
    assert exported >= ENTRIES, path.name
    needed = {getattr(each, "name", each) for each in (binary.imports if target.suffix == ".dll" else binary.libraries)}
    needed = {each for each in needed if not each.startswith(("api-ms-win-crt", "@rpath"))}
    assert needed <= SYSTEM[target.suffix], f"{path.name} needs {needed}"
    if target.suffix == ".so":
        assert exported == ENTRIES, f"{path.name} exports {exported}"
        versions = {str(each.symbol_version).split("(")[0] for each in binary.dynamic_symbols if each.symbol_version}
        newest = max(tuple(map(int, v[6:].split("."))) for v in versions if v.startswith("GLIBC_"))
        assert newest <= GLIBC, f"{path.name} needs glibc {newest}"
    if target.suffix == ".dylib":
        oldest = tuple(binary.build_version.minos[:2])
        assert f"macosx_{oldest[0]}_{oldest[1]}_arm64" == target.wheel, f"{path.name} needs macOS {oldest}"
        assert binary.header.cpu_type.name == "ARM64", path.name
        assert binary.has_code_signature, path.name  # without one the system ends the process
        # Zig's linker cannot hide operators new and delete, weak ones that give way to the system's.
        assert all(name.startswith(("_Z", "__Z")) for name in exported - ENTRIES), f"{path.name}: {exported}"
    return f"{path.name}: {path.stat().st_size} bytes, exports {len(exported)}, needs {', '.join(sorted(needed))}"


class Problem:
    """Templates within a frame, across its border and beyond, as ``elsewhere.c`` reads them, and their poses here."""

    def __init__(self) -> None:
        import torch

        from torch_ecc import prepare
        from torch_ecc.core.native import entry, library
        from torch_ecc.sim.scene.scene import PlaneWaves

        poses = torch.tensor([[60.0, 50.0, 0.5], [100.0, 20.0, -1.0], [3.0, 60.0, 2.0], [900.0, 0.0, 0.0]]).double()
        middle = torch.tensor([[30.0, 24.0, 0.0]], dtype=torch.float64)
        scene, records = PlaneWaves.random(seed=3), []
        reference = prepare(scene.render(middle, (49, 61)).expand(4, 1, 49, 61))
        image, start = scene.render(poses, (110, 130)).round().byte(), poses + torch.tensor([0.8, -0.6, 0.02])
        given = image, start, reference.packed, (3, 40, 1e-6, 2)
        self.solved = lambda library: entry.call(library, *given)[1][0]
        keep = library.Library("none", *[lambda record: records.append(record) or 0] * len(ENTRIES))
        _, results = entry.call(keep, *given)
        self.tensors = [*results, image, start, *reference.packed.tensors]
        self.words = [self._place(word) for word in struct.unpack(f"{len(records[0]) // 8}q", records[0])]

    def _place(self, word: int) -> tuple[int, int]:
        for k, tensor in enumerate(self.tensors):
            if tensor.data_ptr() <= word < tensor.data_ptr() + tensor.nbytes:
                return k, word - tensor.data_ptr()
        return -1, word

    def write(self, path: Path) -> None:
        """As a file."""
        numbers = [len(self.tensors), len(self.words), *(tensor.nbytes for tensor in self.tensors)]
        numbers += [number for word in self.words for number in word]
        blocks = [tensor.contiguous().numpy().tobytes() for tensor in self.tensors]
        path.write_bytes(b"".join([struct.pack(f"{len(numbers)}q", *numbers), *blocks]))

    def difference(self, answer: Path, *, fused: bool) -> float:
        """The largest between its poses and those of this machine's own wheel, px and rad, products fused or not."""
        import torch

        poses = self.solved(own()[fused])
        held = torch.frombuffer(bytearray(answer.read_bytes()[: poses.nbytes]), dtype=torch.float64)
        return float((held.view_as(poses) - poses).abs().max())


@cache
def own() -> dict[bool, Library]:
    """Of this machine's own wheel the best library that runs here with products fused, and without."""
    from torch.backends.cpu import get_cpu_capability

    from torch_ecc.core.native import library

    target = TARGETS[f"linux-{platform.machine()}"]
    with tempfile.TemporaryDirectory() as scratch:
        made = {path.name.split("-")[0]: path for path in compiled(Path(scratch), target)}
        kinds = reversed(library.SUITABLE.get(get_cpu_capability(), ["baseline"]))  # the best comes last
        return {fuses(target, kind): library._load(kind, made[kind]) for kind in kinds}


def fuses(target: Target, kind: str) -> bool:
    """Whether its processors multiply and add at once."""
    return kind != "baseline" or "aarch64" in target.zig


def run_elsewhere(name: str, libraries: list[Path], folder: Path) -> None:
    """Prints how far the poses of a foreign library are from those here."""
    emulator = EMULATORS.get(name, [])
    if not emulator or shutil.which(emulator[0]) is None:
        print(f"  not run: there is no {emulator[0] if emulator else 'emulator of it'}")
        return
    problem = Problem()
    program, target = folder / "elsewhere.exe", TARGETS[name]
    zig = [sys.executable, "-m", "ziglang", "cc", "-target", target.zig, "-O2", str(HERE / "elsewhere.c")]
    subprocess.run([*zig, "-o", str(program), *(["-ldl"] if target.suffix == ".so" else [])], check=True)
    problem.write(folder / "problem")
    for library in libraries:
        least = LEAST.get(library.name.split("-")[0], []) if name == "linux-x86_64" else []
        for emulated in filter(None, (emulator, least)):
            if shutil.which(emulated[0]) is None:
                continue
            command = [*emulated, str(program), str(library), str(folder / "problem"), str(folder / "answer")]
            subprocess.run(command, check=True, capture_output=True, env=os.environ | {"WINEDEBUG": "-all"})
            fused = fuses(target, library.name.split("-")[0])
            difference = problem.difference(folder / "answer", fused=fused)
            print(f"  {emulated[0]} {library.name}: poses within {difference:.1e} px and rad")
            assert difference < ROUNDING, library.name


def main() -> None:
    """All targets, or those that are named."""
    out = ROOT / "dist"
    out.mkdir(exist_ok=True)
    for name in sys.argv[1:] or TARGETS:
        wheel = build(name, out)
        print(f"{name}: {wheel.name}, {wheel.stat().st_size} bytes", flush=True)
        with tempfile.TemporaryDirectory() as scratch:
            libraries = unpacked(wheel, TARGETS[name], Path(scratch))
            for library in libraries:
                print(f"  {check(library, TARGETS[name])}")
            run_elsewhere(name, libraries, Path(scratch))


if __name__ == "__main__":
    main()
