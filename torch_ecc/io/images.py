"""Image files, one frame each, and the pages of a multi-page TIFF.

TIFF goes through Pillow, which walks the pages in one pass; the few kinds that Pillow cannot open, or would cut down to
8 bits, and all other formats go through OpenCV.
"""

from __future__ import annotations

import re
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from torch_ecc.io.frames import FrameError, Medium, Pixels, counted

TIFF = frozenset({".tif", ".tiff"})
IMAGES = TIFF | {".png", ".bmp", ".jpg", ".jpeg", ".jp2", ".webp", ".pgm", ".ppm", ".pnm"}
_SAME = {".tiff": ".tif", ".jpeg": ".jpg"}
_CHUNK_BYTES = 1 << 25


def natural_key(path: Path) -> list[str | int]:
    """Sorts f2 before f10."""
    return [int(part) if part.isdigit() else part.casefold() for part in re.split(r"([0-9]+)", path.as_posix())]


def open_images(paths: Sequence[Path], where: str) -> Medium:
    """One frame per file, in natural order; ValueError if none of the files is an image, or two formats are mixed."""
    images = sorted((path for path in paths if path.suffix.lower() in IMAGES), key=natural_key)
    if not images:
        raise ValueError(f"open_frames: no image in {where} (known: {' '.join(sorted(IMAGES))})")
    kinds = Counter(_SAME.get(path.suffix.lower(), path.suffix.lower()) for path in images)
    if len(kinds) > 1:
        found = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        raise ValueError(f"open_frames: several kinds of image in {where} ({found}); name one, as in '*{min(kinds)}'")
    return Medium(counted(lambda: _read_files(images)), len(images))


def _read_files(paths: Sequence[Path]) -> Iterator[Pixels]:
    for index, path in enumerate(paths):
        try:
            yield _read_file(path)
        except (ValueError, OSError) as error:
            raise FrameError(index, f"{path.name} cannot be read ({error})") from error


def _read_file(path: Path) -> Pixels:
    if path.suffix.lower() not in TIFF:
        return _to_rgb(cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED))
    pages = _read_pages(path)
    first = next(pages, None)
    if first is None:
        raise ValueError("it has no page")
    if next(pages, None) is not None:
        raise ValueError("it has several pages; give a multi-page TIFF as the source itself")
    return first


def open_tiff(path: Path) -> Medium:
    """One frame per page. ValueError if it is no TIFF, or an ImageJ stack beyond 4 GB, which hides its frames."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(path) as image:
                length, text = getattr(image, "n_frames", 1), str(image.getexif().get(270, ""))
        except UnidentifiedImageError:
            length, text = cv2.imcount(str(path), cv2.IMREAD_UNCHANGED), ""
        except Exception:  # a damaged page list: Pillow raises what its parser stumbles on; the frames before it count
            length, text = None, ""
    if length == 0:
        raise ValueError(f"open_frames: {path} cannot be read as TIFF")
    hidden = re.search(r"ImageJ=.*^images=([0-9]+)", text, re.DOTALL | re.MULTILINE)
    if hidden and length is not None and int(hidden[1]) > length:
        raise ValueError(
            f"open_frames: {path} is an ImageJ stack of {hidden[1]} images with {length} TIFF page(s): "
            "save it as an image sequence or in parts under 4 GB"
        )
    return Medium(counted(lambda: _read_pages(path)), length)


def _read_pages(path: Path) -> Iterator[Pixels]:
    try:
        image = Image.open(path)
    except UnidentifiedImageError:
        yield from _read_pages_opencv(path)
        return
    with image:
        for index in range(sys.maxsize):
            try:
                page = _read_page(image, index)
            except EOFError:
                return
            except Exception as error:  # whatever Pillow's parsers stumble on in a damaged page
                raise FrameError(index, f"{path.name} is damaged there ({error})") from error
            if page is None:
                yield from _read_pages_opencv(path)
                return
            yield page


def _read_page(image: Image.Image, index: int) -> Pixels | None:
    """One page as it is stored; None where Pillow would cut colours of 16 bits down to 8."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image.seek(index)
        bits = getattr(image, "tag_v2", {}).get(258, (8,))
        if len(image.getbands()) > 1 and max(bits) > 8:
            return None
        plain = image.mode in ("1", "L", "LA", "RGB", "RGBA", "I", "F") or image.mode.startswith("I;16")
        return np.array(image if plain else image.convert("RGB"))


def _read_pages_opencv(path: Path) -> Iterator[Pixels]:
    """OpenCV finds each page from the start of the file, so several are fetched at once, up to a fixed memory."""
    count, index, chunk = cv2.imcount(str(path), cv2.IMREAD_UNCHANGED), 0, 1
    while index < count:
        pages = cv2.imreadmulti(str(path), index, min(chunk, count - index), flags=cv2.IMREAD_UNCHANGED)[1]
        if not pages:
            raise FrameError(index, f"{path.name} is damaged there")
        yield from map(_to_rgb, pages)
        index += len(pages)
        chunk = max(1, _CHUNK_BYTES // pages[0].nbytes)


def _to_rgb(array: Pixels | None) -> Pixels:
    """OpenCV's (H, W), BGR or BGRA as (H, W) or RGB; None is what OpenCV returns for a file that it cannot decode."""
    if array is None:
        raise ValueError("it is damaged or not an image")
    return array if array.ndim == 2 or array.shape[2] < 3 else array[:, :, 2::-1]
