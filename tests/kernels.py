"""The fused engine's kernels as machine code of a GPU that need not be there."""

from __future__ import annotations

from collections.abc import Iterator

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from torch_ecc.core.fused import kernel, look
from torch_ecc.core.fused.records import Answers, Frames, Grids, Trusted, Way

HOPPER = GPUTarget("cuda", 90, 32)
CONSTANT = "constexpr"
# Of each argument the types, and the values of its constants: a frame, cubic splines, templates of 31 px.
FRAMES = Frames("*fp32", "i32", "i32", "i32", CONSTANT), [1]
SMOOTH = Frames("*fp32", "i32", "i32", "i32", CONSTANT), [3]
GRIDS = Grids("*i16", "*fp32", "*fp64", *5 * (CONSTANT,)), [31, 31, 32, 1, True]
TRUSTED = Trusted("*i64", "*fp32", "*i1", *4 * (CONSTANT,)), [6, 36, 8, False]
ANSWERS = Answers("*fp64", "*fp64", "*i64", "*fp64", "*fp32", "*fp64", "*fp64", "*fp64"), []


def way(partial: bool) -> tuple[Way, list[int | bool]]:
    """Of the default criterion; of the one with the fewest columns, which are unrolled, where the code is longest."""
    light = 0 if partial else 2
    return Way("fp32", "fp32", *7 * (CONSTANT,)), [light, 5 + light, 5 + light, False, 256, 128, partial]


def compiled() -> Iterator[str]:
    """The names of the kernels, each after it was compiled."""
    for partial in (False, True):
        every = {"frames": FRAMES, "smooth": SMOOTH, "fine": GRIDS, "coarse": GRIDS, "trusted": TRUSTED}
        every |= {"start": ("*fp64", []), "bend": ("*fp64", []), "answers": ANSWERS, "way": way(partial)}
        yield _compiled(kernel.solve, every)
    some = {name: every[name] for name in ("smooth", "fine", "trusted", "bend", "answers", "way")}
    yield _compiled(look.answer, some)


def _compiled(function, arguments) -> str:
    types = {name: kinds for name, (kinds, _) in arguments.items()}
    constants = {}
    for k, (kinds, given) in enumerate(arguments.values()):
        places = [(k, j) for j, kind in enumerate(kinds) if kind == CONSTANT] if given else []
        constants |= dict(zip(places, given, strict=True))
    done = triton.compile(ASTSource(function, types, constants), target=HOPPER, options={"num_warps": 4})
    return done.metadata.name


if __name__ == "__main__":
    print(*compiled())
