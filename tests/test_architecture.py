"""The layout is the architecture: imports go one way, the core is light, files and functions stay small."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torch_ecc

PACKAGE = Path(torch_ecc.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))

# From the bottom up; a package may import what stands before it, not what stands beside or after it.
FLOORS = [{"core"}, {"search"}, {"track"}, {"servo", "body"}, {"commands"}, {"paper", "view"}, {"cli"}]
# Leaves import nothing of the package but pose; what may use them, beside the floors above ``track``.
LEAVES = {"io", "plots", "records", "config", "sim"}
LEAF_USERS = {"commands", "paper", "view", "cli"}
LEAVES_BELOW = {("servo", "records"), ("body", "records"), ("sim", "config"), ("sim", "records")}
ROOMS = {"sim": ["scene", "camera", "stage"]}  # the floors of a leaf, from the bottom up


def parts(path: Path) -> tuple[str, ...]:
    """The package and the room or module in it that a file belongs to."""
    return path.relative_to(PACKAGE).with_suffix("").parts[:2]


def imports(path: Path) -> set[tuple[str, ...]]:
    """What a file imports of torch_ecc, as the first two names below it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            pytest.fail(f"{path.name}: relative imports hide the direction")
        names = []
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "torch_ecc":
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        found |= {tuple(name.split(".")[1:3]) for name in names if name.startswith("torch_ecc.")}
    return found


def of_every(paths: list[Path]):
    """One test of them all: to report hundreds takes longer than to read the files."""

    def made(check):
        def test() -> None:
            for path in paths:
                check(path)

        test.__doc__ = check.__doc__
        return test

    return made


def rank(name: str) -> int:
    return next(k for k, floor in enumerate(FLOORS) if name in floor)


@of_every(FILES)
def test_imports_go_one_way(path):
    me, *_ = parts(path)
    if me in {"__init__", "__main__"}:
        return
    for other, *rest in imports(path):
        if other == me or (me in LEAVES and [other, *rest] == ["core", "pose"]):
            continue
        if other in LEAVES:
            assert me in LEAF_USERS or (me, other) in LEAVES_BELOW, f"{me} must not import the leaf {other}"
        else:
            assert me not in LEAVES, f"the leaf {me} must not import {other}"
            assert rank(other) < rank(me), f"{me} must not import {other}"


@of_every(FILES)
def test_rooms_stand_on_one_another(path):
    me, *room = parts(path)
    order = ROOMS.get(me, [])
    if not room or room[0] not in order:
        return
    used = {rest[0] for other, *rest in imports(path) if other == me and rest}
    assert used <= set(order[: order.index(room[0]) + 1]), f"{me}.{room[0]} must not import {used}"


def test_every_module_has_its_place():
    placed = set().union(*FLOORS) | LEAVES | {"__init__", "__main__"}
    assert {parts(path)[0] for path in FILES} <= placed


def test_import_is_light():
    """``import torch_ecc`` brings no plotting, no video, no command line, nothing for configurations."""
    heavy = ["cv2", "matplotlib", "PIL", "click", "rich", "pydantic"]
    code = f"import sys, torch_ecc; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_names_come_when_they_are_used():
    """Not even torch is there before; kornia and torch.compile, slower than the rest, not even when one tracks."""
    code = (
        "import sys, torch_ecc; before = 'torch' in sys.modules; [getattr(torch_ecc, n) for n in torch_ecc.__all__];"
        "import torch; f = torch.rand(3, 90, 90); torch_ecc.Tracker(f, [(45, 45)], 31, levels=2).track(f);"
        "print(before, 'torch' in sys.modules, 'kornia' in sys.modules, 'torch._dynamo' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["False", "True", "False", "False"]
    assert set(torch_ecc.__all__) <= set(dir(torch_ecc))
    with pytest.raises(AttributeError, match="module 'torch_ecc' has no attribute 'trakcer'"):
        _ = torch_ecc.trakcer


@of_every(FILES)
def test_files_and_functions_stay_small(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 400, path.name
    tree = ast.parse(text)
    assert ast.get_docstring(tree), path.name
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            lines = node.end_lineno - node.lineno + 1
            assert lines <= 45, f"{path.name}: {node.name} has {lines} lines"
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{path.name}: {node.name} has no docstring"


def test_the_public_names_exist():
    for name in torch_ecc.__all__:
        assert getattr(torch_ecc, name).__doc__, name


@of_every([path for path in FILES if parts(path)[0] == "core"])
def test_the_core_is_plain_torch(path):
    """Without numpy, and without types that say nothing."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        assert not {"numpy", "Any"} & set(names), path.name
