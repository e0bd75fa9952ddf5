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

# From the bottom up; a module may import what stands before it, not what stands beside or after it.
LAYERS = [
    {"pose"},
    {"frame", "sampling", "estimate", "calibration", "comparison", "config", "curves"},
    {"criteria", "synchrony"},
    {"noise"},
    {"reference"},
    {"solver", "pyramid"},
    {"judge", "bank", "native"},
    {"align", "patches"},
    {"locate", "nearby"},
    {"tracker"},
    {"compare", "session", "servo"},
    {"experiments"},
    {"cli"},
]
LEAVES = {"io", "plots", "sim"}  # they import nothing of the package but pose
LEAF_USERS = {"compare", "session", "servo", "experiments", "cli"}


def unit(path: Path) -> str:
    """The module or sub-package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            pytest.fail(f"{path.name}: relative imports hide the direction")
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{a.name}" if node.module == "torch_ecc" else node.module for a in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        found |= {name.split(".")[1] for name in names if name.startswith("torch_ecc.")}
    return found


def rank(name: str) -> int:
    return next(k for k, layer in enumerate(LAYERS) if name in layer)


def typing_only(path: Path) -> set[str]:
    """Imports under ``if TYPE_CHECKING``: annotations may name what is above."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            for child in ast.walk(node):
                if isinstance(child, ast.ImportFrom) and (child.module or "").startswith("torch_ecc."):
                    found.add(child.module.split(".")[1])
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    me = unit(path)
    if me in {"__init__", "__main__"}:
        return
    used = imports(path) - {me} - typing_only(path)
    if me in LEAVES:
        assert used <= {"pose"}
        return
    for other in used:
        if other in LEAVES:
            assert me in LEAF_USERS, f"{me} must not import the leaf {other}"
        else:
            assert rank(other) < rank(me), f"{me} must not import {other}"


def test_every_module_has_its_place():
    placed = set().union(*LAYERS) | LEAVES | {"__init__", "__main__"}
    assert {unit(path) for path in FILES} <= placed


def test_import_is_light():
    """``import torch_ecc`` brings no plotting, no video, no command line."""
    code = (
        "import sys, torch_ecc; print([m for m in ('cv2', 'matplotlib', 'PIL', 'click', 'rich') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_and_functions_stay_small(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 300
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
