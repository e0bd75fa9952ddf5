"""The compiled engine's look at where poses were found, and the way back from it to the image (csrc/adjoint.h): what
``linearised`` does on the torch page."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from struct import Struct

import torch
from torch import Tensor

from torch_ecc.core.linearised import Look
from torch_ecc.core.native import engine
from torch_ecc.core.native.engine import DEGREE
from torch_ecc.core.native.entry import frames_of, threads_for
from torch_ecc.core.native.library import load
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings

VIEW = Struct("@17q")  # View


def takes(reference: Reference, image: Tensor, settings: Settings) -> bool:
    """Whether it does this: what the engine takes, in float32, not as a part of a graph."""
    single = reference.K.dtype == torch.float32 and not torch.compiler.is_compiling()
    return single and engine.takes(reference, image, settings)


def look(reference: Reference, image: Tensor, pose: Tensor, settings: Settings) -> Look:
    """``linearised.look``."""
    warp, grid, degree = reference.warps(pose), reference.grid, DEGREE[settings.interpolation]
    values = warp.new_empty((len(warp), 4, grid.pixels.shape[1]), dtype=torch.float32)
    frames, next_frame = frames_of(image)
    where = warp.contiguous(), pose.contiguous(), grid.pixels, grid.box
    _call("linearise", frames, next_frame, where, (values, None), degree)
    size = list(image.shape)
    return Look(values, partial(_spread, where=where, size=size, degree=degree))


def _spread(by_g: Tensor, where: Sequence[Tensor], size: list[int], degree: int) -> Tensor:
    by_image: Tensor = torch.ops.torch_ecc.spread(by_g, *where, size, degree)  # which is also asked for many at once
    return by_image


def spread(
    by_g: Tensor, warp: Tensor, pose: Tensor, pixels: Tensor, box: Tensor, size: Sequence[int], degree: int
) -> Tensor:
    """The gradient by an image of some ``size`` (I, 1, H, W) from that by patches (B, N). Raises ValueError."""
    (b, n), single, double = by_g.shape, torch.float32, torch.float64
    came = [(tensor.dtype, tuple(tensor.shape)) for tensor in (by_g, warp, pose, pixels, box)]
    wanted = [(single, (b, n)), (double, (b, 2, 3)), (double, (b, 3)), (single, (3, n)), (single, (3, 4))]
    if came != wanted:
        raise ValueError(f"torch_ecc.spread: expected by_g, warp, pose, pixels and box as {wanted}, got {came}")
    if not (len(size) == 4 and size[0] in {1, b} and size[1] == 1 and min(size) > 0 and degree in DEGREE.values()):
        raise ValueError(
            f"torch_ecc.spread: expected size (1 or {b}, 1, H, W) and degree 1, 3, 5, got {size}, {degree}"
        )
    by_image = by_g.new_zeros(list(size))
    where = [tensor.contiguous() for tensor in (warp, pose, pixels, box)]
    _call("spread", by_image, size[2] * size[3] if size[0] > 1 else 0, where, (by_g.contiguous(), by_image), degree)
    return by_image


def _call(
    name: str,
    frames: Tensor,
    next_frame: int,
    where: Sequence[Tensor],
    results: tuple[Tensor, Tensor | None],
    degree: int,
) -> None:
    """Raises MemoryError."""
    library, (warp, pose, pixels, box), (values, by_image) = load(), where, results
    if library is None:
        raise RuntimeError(f"torch_ecc.{name}: there is no native engine here")
    n, (_, _, height, width) = pixels.shape[1], frames.shape
    alone = by_image is not None and next_frame == 0  # all of them add to the same frame
    record = VIEW.pack(
        *(frames.data_ptr(), frames.element_size(), height, width, frames.stride(2), next_frame),
        *(warp.data_ptr(), pose.data_ptr(), pixels.data_ptr(), pixels.data_ptr() + 4 * n, box.data_ptr()),
        *(values.data_ptr(), 0 if by_image is None else by_image.data_ptr()),
        *(n, len(warp), 1 if alone else threads_for(len(warp) * n), degree),
    )
    if getattr(library, name)(record) < 0:
        raise MemoryError(f"{name}: there is not enough memory for the images around the templates")


_library = torch.library.Library("torch_ecc", "FRAGMENT")
_library.define(
    "spread(Tensor by_g, Tensor warp, Tensor pose, Tensor pixels, Tensor box, int[] size, int degree) -> Tensor"
)
_library.impl("spread", spread, "CPU")
