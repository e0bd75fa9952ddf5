"""TIFF of every kind, through tifffile: its pages, or the planes of the axes that it describes, one at a time.

What tifffile cannot decode, for want of a codec or for its colours, is left to Pillow.
"""

from __future__ import annotations

import logging
import math
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from torch_ecc.io.axes import Choice, Walk, walk
from torch_ecc.io.frames import FrameError, Medium, Pixels, Raw, brief, check_dtype, check_size
from torch_ecc.io.tags import read_tags

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it finds wrong is said here, not on the screen

TIFF = frozenset({".tif", ".tiff", ".btf", ".tf8", ".lsm", ".stk"})
_DESCRIBED = ("shaped", "lsm", "mmstack", "ome", "imagej", "ndtiff", "fluoview", "stk", "scanimage", "nih")
_JPEGS = (6, 7, 34892, 33007)  # which decode YCbCr by themselves
_MOST_COPIES = 64  # pages of a file whose copies of a page are looked for: of pyramids and previews there are few
_MADE_RGB = ("SEPARATED", "CIELAB", "ICCLAB", "ITULAB")  # colours that tifffile leaves as they are


class _Planes(NamedTuple):
    """The planes of a file by number, the way through them, how many frames are promised, and the position read."""

    read: Callable[[int], Pixels]
    walk: Walk
    promised: int
    position: int = 0
    notes: tuple[str, ...] = ()


def open_tiff(path: Path, choice: Choice) -> Medium:
    """One frame per page, or per time where the file describes its axes. ValueError if it is no TIFF, or if it has
    channels, slices or positions and none is chosen."""
    import tifffile  # a tenth of a second, which a video need not wait for

    try:
        tif: Any = tifffile.TiffFile(path)
        page = tif.pages.first
    except Exception as error:  # whatever a parser stumbles on in what is no TIFF
        raise ValueError(f"open_frames: {path} cannot be read as TIFF ({brief(error)})") from error
    if page.dtype is not None:
        check_dtype(page.dtype, path.name)
    planes = _described(tif, path, choice) or _pages(tif, path, choice)
    tags, lock = read_tags(tif, planes.position, planes.walk.planes), threading.Lock()

    def read(numbers: range) -> Iterator[Raw]:
        length, start, step = planes.walk
        for number in range(numbers.start, min(numbers.stop, length), numbers.step):
            plane = start + number * step
            with lock:  # a file is read at one place at a time
                pixels, time_s = _attempt(planes.read, plane), tags.time_s(number, plane)
            yield Raw(number, pixels, time_s)
        if numbers.stop > length and planes.promised > length:
            raise FrameError(length, f"{path.name} ends here, but more was promised: it is cut off or damaged")

    length = None if planes.promised > planes.walk.length else planes.walk.length
    return Medium(read, length, tags.fps, tags.um_per_px, planes.notes)


def _attempt(read: Callable[[int], Pixels], plane: int) -> Pixels | str:
    try:
        return read(plane)
    except Exception as error:  # whatever decoders stumble on in damaged data
        return f"it cannot be read ({brief(error)})"


def _pages(tif: Any, path: Path, choice: Choice) -> _Planes:
    """Every page is a frame, but for smaller copies of another page."""
    every: Sequence[int] = range(len(tif.pages))
    if len(every) <= _MOST_COPIES:
        every = [k for k in every if k == 0 or not _is_copy(tif, k)]
    samples = _samples(tif.pages.first)
    steps = walk(path.name, "IS", (len(every), samples), choice)

    def read(plane: int) -> Pixels:
        pixels = _page(tif.pages[every[plane // samples]], path)
        return pixels[..., plane % samples] if samples > 1 else pixels

    return _Planes(read, steps, steps.length + _goes_on(tif, len(tif.pages)))


def _is_copy(tif: Any, page: int) -> bool:
    try:
        return bool(tif.pages[page].is_reduced)
    except Exception:  # it is damaged, which its reading tells
        return False


def _goes_on(tif: Any, length: int) -> int:
    """1 if the last page that can be found tells of a next one, or the description of more, else 0."""
    told, size = tif.imagej_metadata or {}, tif.tiff.offsetsize
    tif.filehandle.seek(tif.pages.next_page_offset or 0)
    return int(tif.filehandle.read(size) != bytes(size) or told.get("images", 0) > length)


def _samples(page: Any) -> int:
    """How many channels stand beside each other in a page: 1 if they are colours, or grey and its opacity."""
    name, count = getattr(page.photometric, "name", ""), page.samplesperpixel
    opacity = any(int(each) in (1, 2) for each in page.extrasamples)
    return 1 if name not in ("MINISBLACK", "MINISWHITE") or (count == 2 and opacity) else count


def _described(tif: Any, path: Path, choice: Choice) -> _Planes | None:
    """The planes as the file describes them, None if it does not, or describes single pages only."""
    if not any(getattr(tif, f"is_{kind}", False) for kind in _DESCRIBED):
        return None
    try:
        every = [each for each in tif.series if each.kind in _DESCRIBED]
    except Exception as error:  # whatever the parsers stumble on in a damaged description
        raise ValueError(f"open_frames: {path} is damaged: its axes cannot be made out ({brief(error)})") from error
    if not every:
        return _cut_off(tif, path, choice)
    if all(set(each.axes) <= set("YXS") for each in every) and every[0].kind != "ome":
        return None
    positions = every if every[0].kind == "ome" else every[:1]
    position = min(max(choice.position or 0, 0), len(positions) - 1)
    series, samples = positions[position], _samples(tif.pages.first)
    outer = [(letter, size) for letter, size in zip(series.axes, series.shape, strict=True) if letter not in "YXS"]
    axes, sizes = "P" + "".join(letter for letter, _ in outer) + "S", [len(positions), *(n for _, n in outer), samples]
    told = [int(n) for n in re.findall(r'Size[TZ]="([0-9]+)"', tif.ome_metadata or "")[:2]]  # C may be colours
    if series.kind == "ome" and math.prod(sizes[1:]) < math.prod(told):
        raise ValueError(f"open_frames: {path} is cut off or damaged: it describes {math.prod(told)} planes at least")
    loose = series.kind == "imagej" and not (tif.imagej_metadata or {}).get("hyperstack")
    length, start, step = walk(path.name, axes, sizes, choice, loose=loose)
    start -= position * math.prod(sizes[1:])
    stacked = length > 1 and not set(series.axes) & set("TIQ")
    notes = (f"{path.name}: its {length} slices, as ImageJ calls them, are taken for times",) if stacked else ()
    steps = Walk(length, start, step)
    if series.dataoffset is not None and samples == 1 and position == 0 and len(series) < math.prod(sizes):
        return _one_after_the_other(tif, tif.pages.first, steps)._replace(notes=notes)
    return _Planes(_series_reader(series, path, samples), steps, length, position, notes)


def _cut_off(tif: Any, path: Path, choice: Choice) -> _Planes | None:
    """What is left of a file whose description does not fit what is there: the planes of ImageJ's stacks stand one
    after the other. None if the description tells of nothing but times; ValueError if it does, and they do not."""
    told, page = tif.imagej_metadata or {}, tif.pages.first
    sizes = [max(int(told.get(name, 1)), 1) for name in ("frames", "slices", "channels")]
    other = {*map(str, sizes[1:]), *re.findall(r'Size[CZ]="([0-9]+)"', tif.ome_metadata or "")}
    if told and page.is_final and math.prod(sizes) > 1:
        steps = walk(path.name, "TZC", sizes, choice, loose=not told.get("hyperstack"))
        return _one_after_the_other(tif, page, steps)
    if other == {"1"}:
        return None
    raise ValueError(f"open_frames: {path} is cut off or damaged: its axes cannot be made out")


def _one_after_the_other(tif: Any, page: Any, steps: Walk) -> _Planes:
    """Planes that follow the first one without a gap, as far as the file reaches."""
    dtype, count = np.dtype(page.dtype).newbyteorder(tif.byteorder), math.prod(page.shape)
    offset, size = page.dataoffsets[0], count * dtype.itemsize
    there = (tif.filehandle.size - offset) // max(size, 1)
    left = max(0, min(steps.length, -((steps.start - there) // max(steps.step, 1))))

    def read(plane: int) -> Pixels:
        tif.filehandle.seek(offset + plane * size)
        return _colours_last(tif.filehandle.read_array(dtype, count).reshape(page.shape), page.axes)

    return _Planes(read, steps._replace(length=left), steps.length)


def _series_reader(series: Any, path: Path, samples: int) -> Callable[[int], Pixels]:
    """Reads the planes of a series by number; ``samples`` of them share a page."""
    shape = [size for letter, size in zip(series.axes, series.shape, strict=True) if letter in "YXS"]
    depth = max(math.prod(series.shape) // max(math.prod(shape), 1) // len(series), 1)

    def read(plane: int) -> Pixels:
        page = series[plane // samples // depth]
        if page is None:
            raise ValueError("its plane is not in the file")
        pixels = _page(page, path)
        pixels = pixels[plane // samples % depth] if depth > 1 else pixels
        return pixels[..., plane % samples] if samples > 1 else pixels

    return read


def _colours_last(pixels: Pixels, axes: str) -> Pixels:
    return np.moveaxis(pixels, -3, -1) if "S" in axes and not axes.endswith("S") else pixels


def _page(page: Any, path: Path) -> Pixels:
    """The pixels of one page as they are stored, palettes and colours of print turned to RGB. Raises ValueError, or
    what a decoder stumbles on."""
    keyframe, file = page.keyframe, page.parent.filehandle
    check_size("it", keyframe.imagewidth, keyframe.imagelength * keyframe.imagedepth)
    ends = [start + size for start, size in zip(page.dataoffsets, page.databytecounts, strict=False)]
    if not ends or 0 in page.databytecounts or max(ends) > file.size:
        raise ValueError("parts of it are missing")
    colours = getattr(keyframe.photometric, "name", "")
    if colours in _MADE_RGB or (colours == "YCBCR" and keyframe.compression not in _JPEGS):
        return _by_pillow(path, page, f"its colours ({colours}) cannot be turned to RGB")
    try:
        pixels = _colours_last(page.asarray(maxworkers=1), keyframe.axes)
    except (NotImplementedError, ValueError) as error:
        if isinstance(error, ValueError) and "imagecodecs" not in str(error):
            raise  # it is damaged: who is less strict would make something up
        return _by_pillow(path, page, f"{brief(error)}: pip install 'torch-ecc[codecs]'")
    if colours != "PALETTE" or page.parent.is_imagej or page.parent.is_ome:  # to these two a palette is for the eye
        return pixels
    palette: Pixels = np.moveaxis(keyframe.colormap >> 8, 0, -1).astype(np.uint8)
    return palette[(pixels if keyframe.samplesperpixel == 1 else pixels[..., 0]).astype(np.uint16)]  # without opacity


def _by_pillow(path: Path, page: Any, reason: str) -> Pixels:
    """A page read by Pillow; ValueError with the ``reason`` why it came to that if it cannot either, or not as deep."""
    try:
        with warnings.catch_warnings(), Image.open(path) as image:
            warnings.simplefilter("ignore")
            image.seek(page.index)
            plain = image.mode in ("1", "L", "LA", "RGB", "RGBA", "I", "F") or image.mode.startswith("I;16")
            if page.keyframe.bitspersample > 8 and image.mode not in ("I", "F") and not image.mode.startswith("I;16"):
                raise ValueError("Pillow cuts colours down to eight bits")
            return np.array(image if plain else image.convert("RGB"))
    except Exception as error:  # whatever its parsers stumble on
        raise ValueError(reason) from error
