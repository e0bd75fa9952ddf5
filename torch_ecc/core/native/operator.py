"""``torch.ops.torch_ecc.solve``: the compiled engines as an operator that torch.compile and torch.export see.

Eager calls go to ``entry.call`` and ``fused.launch.call`` directly. Here nothing is known of the arguments: each is
checked before a pointer is made of it, and refused with a sentence. The results are ``entry.FIELDS``.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.native.entry import DTYPES, FIELDS, How, call
from torch_ecc.core.native.library import load
from torch_ecc.core.native.packed import LANES, NUMBERS, PLANES, Packed
from torch_ecc.core.solution import Trust

SCHEMA = (
    "solve(Tensor image, Tensor pose, Tensor[] grids, int[] widths, int[] steps, int degree, int max_iterations, "
    "float tolerance, int criterion, Tensor? trust=None, Tensor? which=None) -> "
    f"({', '.join(f'Tensor {name}' for name in FIELDS)})"
)
CRITERIA, DEGREES = (-2, -1, 0, 2, 5), (1, 3, 5)
LARGEST_STEP = 64  # px between the pixels of a grid


class Arguments(NamedTuple):
    """Of the operator."""

    image: Tensor
    pose: Tensor
    grids: list[Tensor]
    widths: list[int]
    steps: list[int]
    degree: int
    max_iterations: int
    tolerance: float
    criterion: int
    trust: Tensor | None = None
    which: Tensor | None = None

    @property
    def packed(self) -> Packed:
        """The templates."""
        return Packed(self.grids, self.widths, self.steps)

    @property
    def trusted(self) -> Trust | None:
        """In some of them."""
        return None if self.which is None or self.trust is None else Trust(self.which, self.trust)


def traced(
    image: Tensor, start: Tensor, packed: Packed, how: How, trust: Trust | None = None
) -> tuple[int, list[Tensor]]:
    """``entry.call`` by way of the operator; how many templates are partial is not known before it runs."""
    rest = (None, None) if trust is None else (trust.blocks, trust.which)
    return len(start), list(torch.ops.torch_ecc.solve(image, start, *packed, *how, *rest))


def on_a_cpu(*arguments: object) -> tuple[Tensor, ...]:
    """The operator's kernel."""
    given, library = check(Arguments(*arguments)), load()  # type: ignore[arg-type]
    _require(given.image.device.type == "cpu", "tensors must be on the CPU", given.image)
    if library is None:
        raise RuntimeError("torch_ecc.solve: there is no native engine here")
    return tuple(call(library, given.image, given.pose, given.packed, given[5:9], given.trusted)[1])


def on_a_gpu(*arguments: object) -> tuple[Tensor, ...]:
    """The same by the fused engine."""
    from torch_ecc.core.fused.launch import call as launched  # which imports Triton

    given = check(Arguments(*arguments))  # type: ignore[arg-type]
    return tuple(launched(given.image, given.pose, given.packed, given[5:9], given.trusted))


def without_values(*arguments: object) -> tuple[Tensor, ...]:
    """What tracing needs: shapes and dtypes."""
    given = check(Arguments(*arguments))  # type: ignore[arg-type]
    n = len(given.pose if given.which is None else given.which)
    return tuple(result.new_empty((n, *result.shape[1:])) for result in given.packed.results)


def check(given: Arguments) -> Arguments:
    """Raises ValueError for arguments that no memory may be read of."""
    image, pose, n = given.image, given.pose, len(given.widths)
    count = len(pose) if pose.dim() else 0
    _require(pose.dtype == torch.float64 and pose.shape == (count, 3), "pose must be float64 (B, 3)", pose)
    fits = image.dtype in DTYPES and image.dim() == 4 and image.shape[0] in {1, count} and image.shape[1] == 1
    _require(fits and image.numel() > 0, f"image must be uint8, uint16 or float32 (1 or {count}, 1, H, W)", image)
    _require(given.criterion in CRITERIA, f"criterion must be one of {CRITERIA}", given.criterion)
    _require(given.degree in DEGREES, f"degree must be one of {DEGREES}", given.degree)
    _require(given.max_iterations >= 1, "max_iterations must be at least 1", given.max_iterations)
    _require(0 < given.tolerance < inf, "tolerance must be a length in px > 0", given.tolerance)
    _require(n in {1, 2} and len(given.grids) == 3 * n, "grids must be one or two of three tensors", len(given.grids))
    _require(len(given.steps) == n, "steps must be as many as widths", given.steps)
    (height, width), *last = (_size(given, count, k) for k in range(n))
    h, w = last[0] if last else (height, width)
    pitches = given.grids[0].shape[3], given.grids[-3].shape[3]
    reaches = ((h - 1) * given.steps[-1], (w - 1) * given.steps[-1])
    within = h <= height and pitches[1] <= pitches[0] and reaches[0] < height and reaches[1] < width
    _require(within, f"the last grid must not reach beyond the first, {height} x {width} px", reaches)
    _require((given.trust is None) == (given.which is None), "trust and which must come together", given.which)
    _require(given.trust is None or given.steps[0] == 1, "trust needs a first grid of all pixels", given.steps)
    devices = {tensor.device for tensor in (image, pose, *given.grids)}
    _require(len(devices) == 1, "tensors must be on one device", devices)
    return given


def _size(given: Arguments, count: int, k: int) -> tuple[int, int]:
    """Height and width of the grid ``k``, which is checked."""
    (planes, weight, numbers), width, step = given.grids[3 * k : 3 * k + 3], given.widths[k], given.steps[k]
    height, pitch = planes.shape[2:] if planes.dim() == 4 else (0, 0)
    words = f"({count}, {PLANES}, h, pitch)"
    _check_tensor(planes, torch.int16, (count, PLANES, height, pitch), f"planes must be int16 {words}")
    _require(height > 0 and pitch % LANES == 0, f"planes must have rows, of a multiple of {LANES} pixels", planes)
    _require(0 < width <= pitch, f"a width must be 1 to {pitch}", width)
    _require(0 < step <= LARGEST_STEP, f"a step must be 1 to {LARGEST_STEP} px", step)
    even = weight.dim() == 3 and weight.shape[:2] == (1, 1)
    shape = (1, 1, pitch) if even else (count, height, pitch)
    _check_tensor(weight, torch.float32, shape, f"a weight must be float32 (1, 1, {pitch}) or {shape}")
    _check_tensor(numbers, torch.float64, (count, NUMBERS), f"numbers must be float64 ({count}, {NUMBERS})")
    return height, width


def _check_tensor(tensor: Tensor, dtype: torch.dtype, shape: tuple[int, ...], words: str) -> None:
    right = tensor.dtype == dtype and tensor.shape == shape and tensor.is_contiguous()
    _require(right, f"{words}, without gaps", tensor)


def _require(right: bool, words: str, got: object) -> None:
    """Raises ValueError if it is not ``right``."""
    if not right:
        kind = f"{got.dtype} {tuple(got.shape)} on {got.device}" if isinstance(got, Tensor) else got
        raise ValueError(f"torch_ecc.solve: {words}, got {kind}")


_library = torch.library.Library("torch_ecc", "DEF")
_library.define(SCHEMA)
_library.impl("solve", on_a_cpu, "CPU")
_library.impl("solve", on_a_gpu, "CUDA")
_library.impl("solve", torch.library.fallthrough_kernel, "Autograd")  # nothing here has a gradient
torch.library.register_fake("torch_ecc::solve", without_values, lib=_library)
