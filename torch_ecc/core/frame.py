"""The door for images: every frame, template and mask enters the package through these functions."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.pose import pose_dtype

KEPT = (torch.uint8, torch.uint16)  # as they are, if they are grey
EXACT = (torch.bool, torch.int8, torch.int16, torch.float16, torch.bfloat16, torch.float32, torch.float64)
WIDE = (torch.int32, torch.int64, torch.uint32, torch.uint64)  # may hold more than a float32 does
LUMA = (0.299, 0.587, 0.114)  # of red, green and blue, by ITU-R 601
PIXEL_DTYPES = KEPT + EXACT + WIDE


def require_tensor(where: str, name: str, value: object) -> Tensor:
    """``value`` itself if it is a tensor; a ValueError that says how to make one otherwise."""
    if not isinstance(value, Tensor):
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        raise ValueError(f"{where}: {name} must be a torch tensor, got {kind} (torch.from_numpy makes one)")
    return value


def as_device(where: str, device: torch.device | str | None) -> torch.device | None:
    """``device`` if this machine has it, None for None. ValueError otherwise."""
    if device is None:
        return None
    try:
        return torch.zeros(1, device=device).device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{where}: device must be one of this machine, got {str(device)!r} ({reason})") from error


def as_gray(where: str, name: str, image: object, device: torch.device | str | None = None) -> Tensor:
    """``as_image`` in float32."""
    return as_image(where, name, image, device).float()


def as_image(where: str, name: str, image: object, device: torch.device | str | None = None) -> Tensor:
    """One or many images as grey levels (B, 1, H, W) on ``device``: uint8 and uint16 stay what they are if they are
    grey already, all else becomes float32. No copy where none is needed; the numbers keep the frame's own scale, and
    False and True are 0 and 1.

    ``image``: (H, W), (C, H, W) or (B, C, H, W) of integers, float or bool, C = 1 (grey), 3 (RGB) or 4 (RGBA; the
    alpha is dropped). Raises ValueError for any other shape or dtype, for an empty image, for NaN or infinity and for
    integers that float32 does not hold.
    """
    image = require_tensor(where, name, image)
    shape, dtype = tuple(image.shape), image.dtype
    if len(shape) not in (2, 3, 4):
        raise ValueError(f"{where}: {name} must be (H, W), (C, H, W) or (B, C, H, W), got {shape}")
    if dtype not in PIXEL_DTYPES:
        raise ValueError(f"{where}: {name} must be of integers, float (16 to 64 bits) or bool, got {dtype}")
    if 0 in shape:
        raise ValueError(f"{where}: {name} must hold pixels, got the empty shape {shape}")
    channels = shape[-3] if len(shape) > 2 else 1
    if channels not in (1, 3, 4):
        hint = " (channels last? use permute(2, 0, 1))" if shape[-1] in (1, 3, 4) else ""
        raise ValueError(f"{where}: {name} must have 1, 3 or 4 channels, got {shape}{hint}")
    image = image.view(*(1,) * (4 - len(shape)), *shape)
    if channels == 1 and dtype in KEPT:
        return image if device is None or image.device == device else image.to(device=device)
    gray = image.to(device=device, dtype=torch.float32)
    if not torch.compiler.is_compiling():  # what it makes cannot look at values
        _require_values(where, name, image, gray)
    if gray.shape[1] == 1:
        return gray
    r, g, b = (gray[:, k : k + 1] * share for k, share in enumerate(LUMA))
    return r + g + b


def _require_values(where: str, name: str, image: Tensor, gray: Tensor) -> None:
    """A ValueError if an ``image`` holds what its ``gray`` float32 does not, or what is no number."""
    if image.dtype in WIDE and not _same(gray, image):
        raise ValueError(f"{where}: {name} must hold numbers that float32 holds exactly, got {image.dtype} beyond 2^24")
    # The sum is finite exactly when all pixels are (no frame is large enough to overflow a float32 sum of grey
    # levels), and costs a thirtieth of isfinite().all().
    if image.is_floating_point() and not gray.sum().isfinite():
        raise ValueError(f"{where}: {name} must be finite, got {_describe_nonfinite(gray)}")


def _same(gray: Tensor, image: Tensor) -> bool:
    """Whether float32 holds integers exactly, as far as the device has a dtype to tell it in."""
    wide = pose_dtype(gray.device)
    return bool((gray.to(wide) == image.to(gray.device, wide)).all())


def _describe_nonfinite(image: Tensor) -> str:
    bad = ~image.isfinite()
    if not bad.any():
        return "values so large that their sum overflows float32"
    *_, row, column = bad.nonzero()[0].tolist()
    return f"{int(bad.sum())} NaN or infinite values, the first at row {row}, column {column}"


def as_mask(where: str, mask: object, batch: int, size: tuple[int, int]) -> Tensor:
    """Weights (B, 1, h, w), float32, of a mask (h, w), (B, h, w) or (B, 1, h, w) of bool or numbers >= 0."""
    mask = require_tensor(where, "mask", mask)
    shape = tuple(mask.shape)
    if shape not in {size, (batch, *size), (batch, 1, *size)}:
        expected = f"{size}, {(batch, *size)} or {(batch, 1, *size)}"
        raise ValueError(f"{where}: mask must be {expected}, got {shape}")
    weight = mask.to(torch.float32).reshape(-1, 1, *size).expand(batch, 1, *size)
    if not (weight.isfinite() & (weight >= 0)).all():
        raise ValueError(f"{where}: mask must hold finite weights >= 0, got {_range(weight)}")
    empty = (weight.amax((1, 2, 3)) == 0).nonzero().flatten().tolist()
    if empty:
        raise ValueError(f"{where}: mask must keep at least one pixel of each template, got none for {empty}")
    return weight


def _range(values: Tensor) -> str:
    return f"values from {values.min():g} to {values.max():g}"


def require_as_first(where: str, image: Tensor, first: tuple[int, ...]) -> None:
    """ValueError for an ``image`` of another shape than that of the ``first`` one."""
    if image.shape != first:
        raise ValueError(f"{where}: frame must be {_in_words(first)} as the first, got {_in_words(image.shape)}")


def _in_words(shape: tuple[int, ...]) -> str:
    """What images (B, 1, H, W) are."""
    return f"{shape[0]} image{'s' if shape[0] > 1 else ''} of {shape[3]}x{shape[2]} px"
