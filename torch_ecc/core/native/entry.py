"""The one entry of the compiled engine: tensors in, tensors out, by way of one record in memory (csrc/engine.cpp)."""

from __future__ import annotations

from struct import Struct

import torch
from torch import Tensor

from torch_ecc.core.ambient import threads_of_caller
from torch_ecc.core.native.library import Library
from torch_ecc.core.native.packed import Packed
from torch_ecc.core.solution import Trust

DTYPES = (torch.uint8, torch.uint16, torch.float32)  # of images
FIELDS = ("pose", "error", "iterations", "gain", "sums", "total", "moments")  # of answers
CALL = Struct("@21qdq")  # Call
PIXELS_PER_THREAD = 2**17  # half a millisecond of work or more

How = tuple[int, int, float, int]  # degree of the spline between pixels, max_iterations, tolerance, criterion


def call(
    library: Library,
    image: Tensor,
    start: Tensor,
    packed: Packed,
    how: How,
    trust: Trust | None = None,
    distortion: Tensor | None = None,
) -> tuple[int, list[Tensor]]:
    """Of the packed templates in (B or 1, 1, H, W) from ``start`` (B, 3), float64, on, or of those that ``trust`` is
    about, seen with a ``distortion`` (B, 2, 2), float64: how many are partial, because not all of their pixels count;
    and ``FIELDS``, see ``solution.Solution``. ``moments`` (n, MOMENTS) make the normal equations of those that are
    partial; of others the first is -1.

    Raises ValueError, MemoryError.
    """
    (many, channels, height, width), results, some = image.shape, packed.results, (0, 0)
    count = solved = results[0].shape[0]
    if start.shape != results[0].shape or channels != 1 or many not in {1, count}:
        raise ValueError(
            f"solve: expected start ({count}, 3), image (1 or {count}, 1, H, W), got {start.shape}, {image.shape}"
        )
    start = start if start.is_contiguous() else start.contiguous()
    image, next_frame = frames_of(image)
    if trust is None:
        results = [torch.empty_like(result) for result in results]  # the fastest way to a tensor
    else:
        some, solved = _places(trust, results[4]), len(trust.which)
        results = [result.new_empty((solved, *result.shape[1:])) for result in results]
    record = CALL.pack(
        *(image.data_ptr(), image.element_size(), height, width, image.stride(2), next_frame),
        *(start.data_ptr(), *some, _bent(distortion, count)),
        *[result.data_ptr() for result in results],
        *(solved, threads_for(solved * packed.pixels), *how),
    )
    partial = library.solve(record + packed.memory)
    if partial < 0:
        raise MemoryError("solve: there is not enough memory for the images around the templates")
    return partial, results


def frames_of(image: Tensor) -> tuple[Tensor, int]:
    """Frames (I, 1, H, W) of whole rows, and how many pixels it is from one to the next, 0 if there is one."""
    if image.stride(3) != 1 or image.is_neg():
        image = image.resolve_neg().contiguous()
    return image, image.stride(0) if image.shape[0] > 1 else 0


def threads_for(pixels: int) -> int:
    """For so many of templates. They sleep while there is nothing to do; but one that is interrupted in its last
    template has the others wait for a time slice, so that less work is not shared."""
    return 1 if pixels < PIXELS_PER_THREAD else min(1 + pixels // PIXELS_PER_THREAD, threads_of_caller())


def _bent(distortion: Tensor | None, count: int) -> int:
    """Where it lies. Raises ValueError if it is not one of so many templates."""
    if distortion is None:
        return 0
    if distortion.shape != (count, 2, 2) or distortion.dtype != torch.float64 or not distortion.is_contiguous():
        raise ValueError(f"distortion: expected float64 ({count}, 2, 2), got {distortion.dtype}, {distortion.shape}")
    return distortion.data_ptr()


def _places(trust: Trust, sums: Tensor) -> tuple[int, int]:
    """Where its tensors lie. Raises ValueError if they are not about the blocks of ``sums`` (B, ..., blocks)."""
    which, value, (count, _, blocks) = trust.which, trust.blocks, sums.shape
    if value is None:
        raise ValueError("trust: expected that of blocks, got None")
    if which.dtype != torch.int64 or value.dtype != torch.float32 or value.shape != (len(which), blocks):
        raise ValueError(
            f"trust: expected int64 (n,) and float32 (n, {blocks}), got {which.dtype}, {value.dtype} {value.shape}"
        )
    if not (which.is_contiguous() and value.is_contiguous()):
        raise ValueError("trust: expected tensors without gaps")
    if len(which) and not 0 <= int(which.min()) <= int(which.max()) < count:
        raise ValueError(f"trust: expected templates 0 to {count - 1}, got {which.tolist()}")
    return which.data_ptr(), value.data_ptr()
