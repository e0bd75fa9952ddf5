"""Image files, one frame each, in the order of the numbers in their names, through Pillow (JPEG), tifffile
(TIFF) and OpenCV."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from torch_ecc.io.axes import Choice, check_single
from torch_ecc.io.frames import Medium, Pixels, Raw, brief, check_size
from torch_ecc.io.tiff import TIFF, open_tiff

IMAGES = TIFF | {".png", ".bmp", ".jpg", ".jpeg", ".jp2", ".webp", ".pgm", ".ppm", ".pnm"}
_SAME = {".tiff": ".tif", ".jpeg": ".jpg"}
# A number with a decimal point is one number; of more than two parts, as in dates and versions, each is its own.
_DECIMAL = r"(?<![0-9.])[0-9]+\.([0-9]+)(?![0-9]|\.[0-9])"
_NUMBER = re.compile(f"({_DECIMAL.replace('([0-9]+)', '[0-9]+')}|[0-9]+)")
_WHOLE = re.compile("([0-9]+)")
_TOLD_GAPS = 3


def in_order(paths: Iterable[Path]) -> list[Path]:
    """By the numbers in their names: f2 before f10, and t_0.5s before t_1s."""
    paths = list(paths)
    fractions = {each for path in paths for each in re.findall(_DECIMAL, path.stem)}
    # 1.9 and 1.10 are two numbers with a point between them: nobody writes the decimal 1.1 like this beside 1.9.
    counted = len({len(each) for each in fractions}) > 1 and any(each[1:].endswith("0") for each in fractions)
    number = _WHOLE if counted else _NUMBER

    def key(path: Path) -> list[str | Fraction]:
        parts = number.split(path.with_suffix("").as_posix().casefold())
        return [Fraction(part) if k % 2 else part for k, part in enumerate(parts)] + [path.suffix.casefold()]

    return sorted(paths, key=key)


def open_images(paths: Sequence[Path], where: str, choice: Choice) -> Medium:
    """One frame per file, in natural order; ValueError if none of the files is an image, or two formats are mixed."""
    images = in_order(path for path in paths if path.suffix.lower() in IMAGES)
    if not images:
        raise ValueError(f"open_frames: no image in {where} (known: {' '.join(sorted(IMAGES))})")
    kinds = Counter(_SAME.get(path.suffix.lower(), path.suffix.lower()) for path in images)
    if len(kinds) > 1:
        found = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        raise ValueError(f"open_frames: several kinds of image in {where} ({found}); name one, as in '*{min(kinds)}'")
    if not kinds.keys() & TIFF:
        check_single(where, choice)

    def read(numbers: range) -> Iterator[Raw]:
        for number in range(numbers.start, min(numbers.stop, len(images)), numbers.step):
            yield _read_file(images[number], number, choice)

    return Medium(read, len(images), notes=_gaps(images))


def _read_file(path: Path, number: int, choice: Choice) -> Raw:
    try:
        if path.stat().st_size == 0:
            raise ValueError("it is empty")
        if path.suffix.lower() in TIFF:
            return Raw(number, _read_tiff(path, choice), name=path.name)
        pixels, colours = _read_image(path)
        return Raw(number, pixels, name=path.name, colours=colours)
    except UnidentifiedImageError:
        return Raw(number, f"{path.name} cannot be read (it is damaged or not an image)", name=path.name)
    except (ValueError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        return Raw(number, f"{path.name} cannot be read ({brief(error)})", name=path.name)


def _read_tiff(path: Path, choice: Choice) -> Pixels:
    frames = open_tiff(path, choice).read(range(2))
    first, second = next(frames, None), next(frames, None)
    if first is None or isinstance(first.pixels, str):
        raise ValueError("it has no page" if first is None else first.pixels)
    if second is not None:
        raise ValueError("it has several pages; give a multi-page TIFF as the source itself")
    return first.pixels


def _read_image(path: Path) -> tuple[Pixels, Callable[[], Pixels] | None]:
    """As it is stored, whatever orientation it tells of, and how its colours are had if these are its grey levels."""
    with Image.open(path) as image:  # its header, and the checksums of PNG: OpenCV tells neither before it decodes
        check_size("it", *image.size)
        kind = image.format
        if kind != "JPEG":
            image.verify()
    if kind == "JPEG":
        return _by_pillow(path, "L"), lambda: _by_pillow(path, "RGB")
    pixels = _by_opencv(path)
    if kind == "JPEG2000" and pixels.dtype == np.uint8:
        return _by_pillow(path, None), None  # OpenCV passes over its palettes
    return pixels, None


def _by_pillow(path: Path, mode: str | None) -> Pixels:
    """In this mode, of which "L" is the luma of a JPEG as it was coded; without one, in L or RGB."""
    with Image.open(path) as image:
        if mode and image.mode in ("L", "RGB"):
            image.draft(mode, image.size)
        plain = mode or ("L" if image.mode in ("L", "LA") else "RGB")
        return np.array(image if image.mode == plain else image.convert("RGB").convert(plain))


def _by_opencv(path: Path) -> Pixels:
    logging: Any = getattr(cv2.utils, "logging", cv2)  # until OpenCV 4.10 it was there
    level = logging.getLogLevel()
    logging.setLogLevel(0)
    try:
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    finally:
        logging.setLogLevel(level)
    if pixels is None:
        raise ValueError("it is damaged or not an image")
    return pixels if pixels.ndim == 2 or pixels.shape[2] < 3 else np.ascontiguousarray(pixels[:, :, 2::-1])


def _gaps(images: Sequence[Path]) -> tuple[str, ...]:
    """A sentence on the numbers that are missing between files that differ in one whole number only."""
    names = [_NUMBER.split(path.stem) for path in images]
    places = [k for k in range(1, min(map(len, names)), 2) if len({name[k] for name in names}) > 1]
    if len(places) != 1 or len(images) < 3 or any("." in name[places[0]] for name in names):
        return ()
    k = places[0]
    if len({(*name[:k], *name[k + 1 :]) for name in names}) > 1:
        return ()
    numbers = [int(name[k]) for name in names]
    steps = Counter(b - a for a, b in pairwise(numbers))
    step = min(steps, key=lambda each: (-steps[each], each))
    gaps = [(name, a + step, b - step) for name, (a, b) in zip(names, pairwise(numbers), strict=False) if b - a > step]
    if not gaps or step < 1:
        return ()
    told = [_gap(name, k, first, last) for name, first, last in gaps[:_TOLD_GAPS]]
    told += [f"{len(gaps) - _TOLD_GAPS} more stretches"] if len(gaps) > _TOLD_GAPS else []
    return (f"missing in the numbering of the files: {', '.join(told)}",)


def _gap(name: list[str], k: int, first: int, last: int) -> str:
    ends = dict.fromkeys("".join([*name[:k], f"{n:0{len(name[k])}d}", *name[k + 1 :]]) for n in (first, last))
    return " to ".join(ends)
