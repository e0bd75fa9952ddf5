"""The fused engine gives what the torch page gives: here in Triton's interpreter, on a GPU as it is compiled."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from engines import CRITERIA, Problem
from test_engines import bent, differs, ill_posed, page, trusted

from torch_ecc import ECC, Status, align
from torch_ecc.core import fused
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Trust
from torch_ecc.core.verdict import judge

if not fused.installed():
    pytest.skip("no Triton that can do it", allow_module_level=True)
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:triton")  # 0 * inf, as numpy sees it
KERNELS = Path(__file__).with_name("kernels.py")
ON = torch.device("cuda" if torch.cuda.is_available() else "cpu")

# One of each kind: in sight and across the border, lost and flat, masks, coarser grids, centres, distortions, trust.
PROBLEMS = {
    "plain": (Problem((13, 17), 1), Settings(backend="fused"), False),
    "border": (Problem((17, 13), 1, place="border", mask="one", seed=30), Settings(max_iterations=6), False),
    "coarser": (Problem((24, 21), 1, enough=100, mask="one", dtype=torch.uint16, seed=3), Settings("bspline5"), True),
    "shared": (Problem((12, 20), 2, shared=True, centred=False, dtype=torch.float32), Settings("bilinear"), True),
    "lost": (Problem((15, 15), 1, shown="other", seed=1), Settings(max_iterations=3), False),
    "edge": (Problem((15, 15), 1, texture="edge", seed=5), Settings("bilinear", 4), False),
    "blank": (Problem((11, 13), 1, shown="blank"), Settings("bilinear"), False),
    "tilted": (Problem((16, 14), 1, shown="tilted", place="border", seed=7), Settings(max_iterations=5), True),
}


# All criteria on both sides of the border; of the rest, which depends on them little, each with another one.
CASES = [(kind, k) for kind in ("plain", "border") for k in range(len(CRITERIA))]
CASES += [(kind, k % len(CRITERIA)) for k, kind in enumerate(list(PROBLEMS)[2:])]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter prepares Triton's language at each call of each function in a kernel: once in each launch, for
    each of them, is enough."""
    interpreter, ready = pytest.importorskip("triton.runtime.interpreter"), set()
    function, prepare = interpreter.InterpretedFunction, interpreter._patch_lang
    launch = function.run

    def called(self, *args, **kwargs):
        if self.fn not in ready:
            prepare(self.fn)
            ready.add(self.fn)
        return self.rewrite()(*args, **kwargs)

    def launched(self, *args, **kwargs):
        ready.clear()
        return launch(self, *args, **kwargs)

    monkeypatch.setattr(function, "__call__", called)
    monkeypatch.setattr(function, "run", launched)


def on(reference: Reference, *tensors: torch.Tensor) -> tuple:
    """Where the kernels run."""
    return reference.map(lambda tensor: tensor.to(ON)), *(tensor.to(ON) for tensor in tensors)


@pytest.mark.parametrize(("kind", "which"), CASES)
def test_it_gives_what_the_page_gives(kind, which):
    """Poses to 1e-4 px, statuses and iterations; sums, normal equations and the verdict of what is found."""
    (problem, settings, trusts), criterion, seed = PROBLEMS[kind], CRITERIA[which], which
    problem = problem._replace(seed=problem.seed + seed)
    reference, image, start = on(*problem.made(criterion))
    reference = bent(reference, 3 * seed if kind == "plain" else 1)
    blocks = trusted(reference, seed) if trusts else None
    exact = page(reference, image, start, settings, blocks)
    trust = None if blocks is None else Trust(torch.arange(len(start), device=ON), blocks)
    found = fused.solve(reference, image, start, settings, trust)
    a, b = (judge(reference, s._replace(trust=blocks), start, settings) for s in (found, exact))
    good = Status.good(b.status)
    assert torch.equal(a.status, b.status)
    assert ((a.pose - b.pose).abs() < (1e-3 * b.sigma.where(good[:, None], 0.0)).clamp(min=1e-4)).all()
    torch.testing.assert_close(a.sigma[good], b.sigma[good], rtol=1e-3, atol=0)
    apart = differs(a, b) & (good | exact.normal.inverse.any(-1).any(-1))
    assert not (apart & (good | ~ill_posed(reference, image, start, settings, b, blocks))).any()
    for mine, theirs in ((found.sums, exact.sums), (found.normal.bread, exact.normal.bread)):
        size = theirs[good].abs().amax(-1, keepdim=True)
        assert ((mine[good] - theirs[good]).abs() <= 2e-3 * size + 1e-3).all()


def test_some_of_many_are_solved_as_they_are_alone():
    """Those that trust is about, in its order, and that are asked for; each with its own mask."""
    reference, image, start = on(*Problem((13, 17), 4, mask="each", seed=4).made(CRITERIA[1]))
    few = Settings(max_iterations=3)
    index, asked = torch.tensor([3, 1, 0, 3], device=ON), torch.tensor([True, False, True, True], device=ON)
    blocks = trusted(reference, 1)[index]
    found = fused.solve(reference, image, start, few, Trust(index, blocks, asked))
    index, blocks = index[asked], blocks[asked]
    exact = page(reference.select(index), image[index], start[index], few, blocks)
    torch.testing.assert_close(found.pose[asked], exact.pose, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.sums[asked, 0], exact.sums[:, 0])


def test_who_is_pushed_is_whole():
    """Where nobody's trust is less, those that are asked for are solved as if there were none."""
    reference, image, start = on(*Problem((13, 17), 2, seed=5).made(CRITERIA[0]))
    asked, once = torch.tensor([False, True], device=ON), Settings(max_iterations=1)
    found = fused.solve(reference, image, start, once, Trust(torch.arange(2, device=ON), None, asked))
    exact = page(reference, image, start, once)
    torch.testing.assert_close(found.pose[1], exact.pose[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(found.normal.bread[1], exact.normal.bread[1])


def test_records_with_constants_are_arguments():
    """As the value of a variable they would hold numbers: slower, and an error before Triton 3.8."""
    for path in Path(fused.__file__).parent.glob("*.py"):
        assert not re.search(r"^ +\w+ = (Pixels|View|Grids|Frames|Way|Trusted)\(", path.read_text("utf-8"), re.M), (
            path.name
        )


def test_align_with_it():
    """By name: the record is the page's, of a robust solve too, and of a frame whose pixels lie column by column."""
    reference, image, start = on(*Problem((13, 17), 1).made(CRITERIA[1]))
    image = image.mT.contiguous().mT
    a, b = (align(reference, image, start, backend=name, max_iterations=5) for name in ("fused", "torch"))
    assert a.status == b.status == Status.CONVERGED
    for name in ("pose", "covariance", "score", "residual_rms"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-3, atol=1e-5)
    with pytest.raises(ValueError, match="backend: expected one of"):
        align(reference, image, start, backend="triton")


def test_what_it_takes(monkeypatch):
    """A built-in criterion and sampler, pixels of a camera, a GPU; a CPU only where Triton interprets and it is asked
    for."""

    class Own(ECC):
        """Another criterion."""

    reference, image, start = Problem((13, 17), 1).made(ECC())
    asked = Settings(backend="fused")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert fused.takes(reference, image, asked)
    assert not fused.takes(reference, image, Settings())
    assert not fused.takes(reference, image, Settings(backend="torch"))
    assert not fused.takes(reference, image.double(), asked)
    assert not fused.takes(reference._replace(criterion=Own()), image, asked)
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    assert not fused.takes(reference, image, asked)
    assert align(reference, image, start, backend="fused").status == Status.CONVERGED  # by the page


@pytest.mark.skipif(sys.platform != "linux" or platform.machine() != "x86_64", reason="compilers come for Linux")
def test_it_compiles_for_a_gpu(tmp_path):
    """What an interpreter lets pass a compiler may not: as far as machine code of a GPU, which need not be there."""
    here = {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(KERNELS.parents[1])}
    done = subprocess.run([sys.executable, KERNELS], env=os.environ | here, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["solve", "solve", "answer"], done.stderr
