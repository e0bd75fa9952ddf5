"""Files of microscopes and high-speed cameras, and arrays in HDF5 and Zarr, for which another library is needed; where
there is none here, a sentence that names it."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from torch_ecc.io.axes import Choice, check_single, walk
from torch_ecc.io.frames import Medium, Pixels, Raw, brief
from torch_ecc.io.stacks import open_stack

CONVERTERS: Final[Mapping[str, str]] = MappingProxyType(
    {
        ".czi": "pylibCZIrw or czifile",
        ".dm3": "ncempy",
        ".dm4": "ncempy",
        ".ims": "imaris-ims-file-reader",
        ".oib": "oiffile",
        ".oif": "oiffile",
        ".seq": "pims",
        ".sif": "sif-parser",
        ".spe": "spe2py",
        ".vsi": "Bio-Formats",
    }
)
"""What reads the formats that are not read here."""

_UNITS = {"second": 1.0, "millisecond": 1e-3, "microsecond": 1e-6, "minute": 60.0, "hour": 3600.0}
_UNITS |= {"micrometer": 1.0, "nanometer": 1e-3, "millimeter": 1e3, "meter": 1e6}
_LETTERS = {"λ": "C", "Λ": "C"}  # of axes that a format calls by another one


def open_extra(path: Path, choice: Choice) -> Medium | None:
    """A file of one of these formats, None if it is of none. ValueError if the library is missing or cannot read it."""
    suffix = path.suffix.lower()
    if suffix in CONVERTERS:
        raise ValueError(f"open_frames: {path.name}: {CONVERTERS[suffix]} reads this format: save its frames as TIFF")
    if suffix not in _OPENERS:
        return None
    library, extra, opener = _OPENERS[suffix]
    try:
        module = import_module(library)
    except ImportError as error:
        how = f"pip install 'torch-ecc[{extra}]'"
        raise ValueError(f"open_frames: {path.name} needs the library {library} to be read: {how}") from error
    try:
        return opener(module, path, choice)
    except (OSError, RuntimeError, KeyError, IndexError, TypeError) as error:
        raise ValueError(f"open_frames: {path} cannot be read by {library} ({brief(error)})") from error


def _medium(
    where: str, axes: str, sizes: Sequence[int], choice: Choice, read: Callable[[int], tuple[Pixels, float | None]]
) -> Medium:
    """Of planes along ``axes``; ``read`` gives one by its number, and its time."""
    length, start, step = walk(where, axes, sizes, choice)

    def frames(numbers: range) -> Iterator[Raw]:
        for number in range(numbers.start, min(numbers.stop, length), numbers.step):
            try:
                yield Raw(number, *read(start + number * step))
            except Exception as error:  # whatever a library stumbles on in damaged data
                yield Raw(number, f"it cannot be read ({brief(error)})")

    return Medium(frames, length)


def _open_nd2(nd2: Any, path: Path, choice: Choice) -> Medium:
    """Nikon: every coordinate of its loops is a block of channels."""
    file = nd2.ND2File(path)
    outer = {name: size for name, size in file.sizes.items() if name not in "CYXS"}
    channels = file.sizes.get("C", 1)

    def read(plane: int) -> tuple[Pixels, float | None]:
        block, channel = divmod(plane, channels)
        pixels = np.array(file.read_frame(block))
        told = file.frame_metadata(block)
        milliseconds = getattr(told, "channels", [None])[0]
        time_s = None if milliseconds is None else milliseconds.time.relativeTimeMs / 1000
        return (pixels[channel] if channels > 1 else pixels), time_s

    weakref.finalize(read, file.close)
    size = file.voxel_size()
    medium = _medium(path.name, "".join(outer) + "C", [*outer.values(), channels], choice, read)
    return medium._replace(um_per_px=(size.x, size.y) if size.x > 0 and size.y > 0 else None)


def _open_lif(liffile: Any, path: Path, choice: Choice) -> Medium:
    """Leica: its images are positions, each with axes of its own."""
    images = liffile.LifFile(path).images
    which = choice.position if choice.position in range(len(images)) else 0
    start = walk(path.name, "P", [len(images)], Choice(position=choice.position)).start
    image = images[start]
    outer = [_LETTERS.get(name, name) for name in image.dims[:-2]]
    stack = image.asarray(out="memmap")
    planes = stack.reshape(-1, *stack.shape[-2:])
    inner = choice._replace(position=None if which == start else choice.position)
    return _medium(path.name, "".join(outer), image.shape[:-2], inner, lambda plane: (planes[plane].copy(), None))


def _open_photron(pymraw: Any, path: Path, choice: Choice) -> Medium:
    """Photron: a description and the levels in a file beside it."""
    check_single(path.name, choice)
    told = next((path.with_suffix(kind) for kind in (".cihx", ".cih") if path.with_suffix(kind).exists()), path)
    frames, values = pymraw.load_video(str(told))
    rate, medium = float(values.get("Record Rate(fps)", 0)), open_stack(frames, path.name)
    if not rate > 0:
        return medium

    def read(numbers: range) -> Iterator[Raw]:
        for raw in medium.read(numbers):
            yield raw._replace(time_s=raw.number / rate)

    return medium._replace(read=read, fps=rate)


def _open_hdf5(h5py: Any, path: Path, choice: Choice) -> Medium:
    """The dataset ``frames``, or the only one that is a stack."""
    check_single(path.name, choice)
    file, stacks = h5py.File(path, "r"), {}
    file.visititems(lambda name, item: stacks.update({name: item}) if len(getattr(item, "shape", ())) > 2 else None)
    return open_stack(_only(stacks, path.name), path.name)


def _open_zarr(zarr: Any, path: Path, choice: Choice) -> Medium:
    """An array, the only one of a group, or the finest one of an OME-Zarr image, along its axes."""
    root = zarr.open(path, mode="r")
    if hasattr(root, "shape"):
        check_single(path.name, choice)
        return open_stack(root, path.name)
    told = root.attrs.get("ome", root.attrs).get("multiscales")
    if not told:
        check_single(path.name, choice)
        return open_stack(_only({name: array for name, array in root.arrays() if array.ndim > 2}, path.name), path.name)
    array = root[told[0]["datasets"][0]["path"]]
    axes = "".join(str(each["name"] if isinstance(each, dict) else each)[0].upper() for each in told[0]["axes"])
    outer, steps = array.shape[:-2], _steps(told[0])

    def read(plane: int) -> tuple[Pixels, float | None]:
        at = np.unravel_index(plane, outer)
        time_s = float(at[axes.index("T")]) * steps["T"] if "T" in steps else None
        return np.asarray(array[at] if outer else array[:]).copy(), time_s

    medium = _medium(path.name, axes[:-2], outer, choice, read)
    rate = 1 / steps["T"] if "T" in steps else None
    return medium._replace(fps=rate, um_per_px=(steps["X"], steps["Y"]) if {"X", "Y"} <= steps.keys() else None)


def _steps(image: Mapping[str, Any]) -> dict[str, float]:
    """How far the planes and pixels of an OME-Zarr image are apart in s and um, by letters of axes, where it tells.
    What is there and makes no sense is passed over."""
    axes, steps = image["axes"], np.ones(len(image["axes"]))
    try:
        for owner in (image, image["datasets"][0]):
            for change in owner.get("coordinateTransformations", ()):
                if change["type"] == "scale":
                    steps *= np.array([float(step) for _, step in zip(axes, change["scale"], strict=True)])
        units = [_UNITS.get(axis.get("unit"), 0.0) for axis in axes]
        told = zip(axes, (steps * units).tolist(), strict=True)
        return {str(axis["name"])[0].upper(): step for axis, step in told if 0 < step < math.inf}
    except (AttributeError, LookupError, TypeError, ValueError):
        return {}


def _only(stacks: Mapping[str, Any], where: str) -> Any:
    if "frames" not in stacks and len(stacks) != 1:
        raise ValueError(f"open_frames: {where} must hold one stack, or one named 'frames'; it holds {sorted(stacks)}")
    return stacks.get("frames", next(iter(stacks.values())))


_OPENERS: Final[Mapping[str, tuple[str, str, Callable[[Any, Path, Choice], Medium]]]] = MappingProxyType(
    {
        ".nd2": ("nd2", "microscopes", _open_nd2),
        ".lif": ("liffile", "microscopes", _open_lif),
        **dict.fromkeys((".mraw", ".cih", ".cihx"), ("pyMRAW", "photron", _open_photron)),
        **dict.fromkeys((".h5", ".hdf5", ".hdf"), ("h5py", "arrays", _open_hdf5)),
        ".zarr": ("zarr", "arrays", _open_zarr),
    }
)
