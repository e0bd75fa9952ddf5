"""Laws of the compiled engine's coming to be: what a compiler may do, and what is loaded of what lies there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from engines import compiled

from torch_ecc.core.native import build, library

posix = pytest.mark.skipif(os.name != "posix", reason="for systems with owners and modes")
TARGET = build.Target(build.X86, [], ".so")
COMPILER = f"""#!{sys.executable}
import os, sys
with open(sys.argv[sys.argv.index("-o") + 1], "wb") as made:
    made.write(os.urandom(100_000))
"""


@pytest.fixture
def compiler(tmp_path, monkeypatch):
    """A function that makes a program the compiler."""

    def made(text: str) -> None:
        path = tmp_path / "compiler"
        path.write_text(text)
        path.chmod(0o755)
        monkeypatch.setenv("CXX", str(path))

    return made


def test_constants_are_those_of_the_modules():
    """Where there is no torch they are read from the source."""
    assert build.constants() == library.constants()
    assert len(build.constants()) == sum(map(len, build.CONSTANTS.values()))


@posix
def test_a_library_is_named_after_what_it_holds(compiler, tmp_path):
    compiler(COMPILER)
    made = build.build(tmp_path / "there", TARGET)
    assert [path.name.split("-")[0] for path in made] == list(build.X86)
    for path in made:
        assert path.stem.split("-")[1:] == [build.key(library.constants()), build.digest(path)]


@posix
def test_a_library_replaces_the_one_before(compiler, tmp_path):
    compiler(COMPILER)
    folder, old = tmp_path / "there", time.time() - 100
    for path in build.build(folder, TARGET):
        os.utime(path, (old, old))
    new = build.build(folder, TARGET)
    assert sorted(folder.iterdir()) == sorted(new)


@posix
def test_two_builds_at_once(compiler, tmp_path):
    """Each library is there as a whole, of one or of the other, whenever one looks."""
    compiler(COMPILER)
    code = (
        "import sys; from pathlib import Path; from torch_ecc.core.native import build;"
        "[build.build(Path(sys.argv[1]), build.Target(build.X86, [], '.so')) for _ in range(4)]"
    )
    folder = tmp_path / "there"
    both = [subprocess.Popen([sys.executable, "-c", code, folder]) for _ in range(2)]
    while any(process.poll() is None for process in both):
        for path in folder.glob("*-*-*"):
            try:
                assert path.stem.rpartition("-")[2] == build.digest(path)
            except FileNotFoundError:  # the other's replaces it
                continue
    assert [process.returncode for process in both] == [0, 0]
    assert {path.name.split("-")[0] for path in folder.iterdir()} == set(build.X86)


def ended(process: int) -> bool:
    """Soon, as far as the system tells."""
    status = Path(f"/proc/{process}/status")
    for _ in range(100):
        try:
            if "zombie" in status.read_text():
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.1)
    return False


@posix
def test_a_compiler_that_hangs_is_ended_with_its_children(compiler, tmp_path, monkeypatch):
    compiler("#!/bin/sh\nsleep 1000 &\necho $! >> $0.children\nwait\n")
    monkeypatch.setattr(build, "SECONDS", 3)
    begun = time.monotonic()
    with pytest.raises(build.BuildError, match=r"compiler .* did not end within 3 s"):
        build.build(tmp_path / "there", TARGET)
    assert time.monotonic() - begun < 100  # of 1000
    assert not list((tmp_path / "there").iterdir())
    children = (tmp_path / "compiler.children").read_text().split()
    assert children
    for child in children:
        assert ended(int(child))


@posix
def test_what_a_killed_build_has_left_is_cleared(compiler, tmp_path):
    """Not what one that is still at work has."""
    compiler(COMPILER)
    folder = tmp_path / "there"
    for name in (".building-old", ".building-new"):
        (folder / name).mkdir(parents=True)
        (folder / name / "half.so").write_text("half")
    os.utime(folder / ".building-old", (0, 0))
    build.build(folder, TARGET)
    assert [path.name for path in folder.glob(".*")] == [".building-new"]


@posix
@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("false", "the C\\+\\+ compiler false failed: ended with status 1"),
        ("nosuchcompiler", "cannot be run: .*nosuchcompiler"),
        ("/", "cannot be run: "),
        ('g++ "', "CXX is no command: .*quotation"),
        ("sh -c 'echo error: a >&2; echo error: b >&2; exit 3' --", "the C\\+\\+ compiler sh failed: error: a"),
        ("true", "the C\\+\\+ compiler true has made nothing"),
    ],
)
def test_odd_words_for_a_compiler_are_refused_in_one_line(command, said, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", command)
    with pytest.raises(build.BuildError, match=said) as failure:
        build.build(tmp_path, TARGET)
    assert len(str(failure.value)) < 300
    assert "\n" not in str(failure.value)


def test_without_a_compiler_there_is_a_sentence(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("CXX", "  ")
    monkeypatch.setattr(build, "find_spec", lambda name: None)
    with pytest.raises(build.BuildError, match=r"there is no C\+\+ compiler.*`pip install ziglang`"):
        build.here()


@pytest.fixture
def there(tmp_path, monkeypatch):
    """Copies of this machine's libraries, which serve."""
    folder = tmp_path / "libraries"
    shutil.copytree(build.LIBRARIES, folder)
    monkeypatch.setattr(build, "LIBRARIES", folder)
    return folder


@pytest.fixture
def found(monkeypatch):
    """What would be loaded in a new process."""
    return library.found.__wrapped__


@compiled
def test_a_library_that_is_whole_is_loaded(there, found):
    assert found().instructions == library.load().instructions


@compiled
@pytest.mark.parametrize(
    "change",
    [
        lambda held: b"",
        lambda held: held[:50_000],
        lambda held: held[:-1],
        lambda held: held[:999] + b"!" + held[1000:],
    ],
    ids=["empty", "truncated", "one byte short", "one byte other"],
)
def test_a_damaged_library_is_refused(change, there, found):
    """Before the system maps it, and dies of it."""
    for path in there.iterdir():
        path.write_bytes(change(path.read_bytes()))
    assert "is damaged or was changed" in found()


@compiled
@posix
def test_a_library_that_anyone_may_have_written_is_refused(there, found):
    for path in there.iterdir():
        path.chmod(0o777)
    assert "anyone may have written" in found()


@compiled
@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root gives files away")
def test_a_library_of_another_user_is_refused(there, found):
    for path in there.iterdir():
        os.chown(path, 54321, -1)
    assert "its owner is user 54321" in found()


@compiled
def test_a_library_of_other_sources_is_refused(there, found):
    """As after a change of the checkout."""
    for path in there.iterdir():
        path.rename(path.with_name(path.name.replace(build.key(library.constants()), "0123456789ab")))
    assert found() == f"the one in {there} is of other sources; `python -m torch_ecc.core.native.build` makes it"


@compiled
@pytest.mark.parametrize(
    ("capability", "instructions"),
    [("AVX512", "AVX512"), ("AVX2", "AVX2"), ("DEFAULT", "baseline"), ("SVE", "baseline")],
)
def test_the_processor_decides(capability, instructions, there, found, monkeypatch):
    """As torch sees it, which ATEN_CPU_CAPABILITY may hold back."""
    if not list(there.glob("AVX512*")):
        pytest.skip("libraries of another kind of processor")
    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: capability)
    assert library._find(there)[0] == instructions


@compiled
def test_a_lesser_library_serves_where_the_best_is_missing(there, found, monkeypatch):
    for path in there.glob("AVX*"):
        path.unlink()
    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: "AVX512")
    assert found().instructions == "baseline"


def test_without_a_library_torch_serves(tmp_path):
    """One clear line that says how to have one, and the same answer; none if the page is asked for."""
    code = """
import pathlib, sys, torch, torch_ecc as te, warnings
from torch_ecc.core.native import build, library
warnings.simplefilter("always")
build.LIBRARIES = pathlib.Path(sys.argv[1])
frame = torch.rand(60, 60)
for backend in ("torch", "native", "auto"):
    library.load.cache_clear()  # as in a new process
    tracker = te.Tracker(frame, [(30, 30)], 21, backend=backend)
    for _ in range(3):
        pose = tracker.track(frame).pose
    print(pose.round().abs().tolist())
    print("next", file=sys.stderr)
"""
    run = subprocess.run([sys.executable, "-c", code, tmp_path], check=True, capture_output=True, text=True)
    assert run.stdout.splitlines() == ["[[30.0, 30.0, 0.0]]"] * 3
    for told, count in zip(run.stderr.split("next")[:3], (0, 1, 1), strict=True):
        lines = [line for line in told.splitlines() if "torch page serves" in line]
        assert len(lines) == count
        assert all("python -m torch_ecc.core.native.build" in line for line in lines)
