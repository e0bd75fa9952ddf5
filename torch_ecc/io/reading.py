"""One door for every kind of input: ``open_frames``."""

from __future__ import annotations

import math
from glob import glob
from pathlib import Path

from torch_ecc.io.animation import ANIMATIONS, is_animated, open_animation
from torch_ecc.io.axes import Choice, check_single
from torch_ecc.io.cameras.newest import Camera
from torch_ecc.io.cine import open_cine
from torch_ecc.io.extras import open_extra
from torch_ecc.io.frames import FrameSource, Medium
from torch_ecc.io.images import IMAGES, open_images
from torch_ecc.io.live import PREFIX, medium_of, open_live
from torch_ecc.io.stacks import Stack, open_npy, open_npz, open_stack
from torch_ecc.io.tiff import TIFF, open_tiff
from torch_ecc.io.video import VIDEOS, open_video

_PLAIN = {
    ".npy": open_npy,
    ".npz": open_npz,
    ".cine": open_cine,
    **dict.fromkeys(VIDEOS, open_video),
    **dict.fromkeys(ANIMATIONS, open_animation),
}


def open_frames(
    source: str | Path | int | Stack | Camera,
    *,
    fps: float | None = None,
    channel: int | None = None,
    slice: int | None = None,
    position: int | None = None,
) -> FrameSource:
    """A stream of frames, each with its own time, from whatever ``source`` is.

    A video file; an animated GIF, PNG or WebP; an image; a folder or a glob (``"run3/*.png"``) of images in the order
    of the numbers in their names; a TIFF with one time axis; an .npy stack, (F, H, W) or with 1, 3 or 4 channels, first
    or last; an .npz with such an array named ``frames`` or alone; anything indexed like such an array (numpy, dask,
    zarr, h5py); a camera: ``camera:KIND:WHICH`` (see ``live.KINDS``), an index of OpenCV's, as a number or in digits
    ("0"), or any object with ``grab`` (see ``cameras.newest.Camera``). Frames are read when they are asked for; a
    camera does not wait, and what is lost is counted (see ``cameras.newest``).

    ``fps`` in Hz: the frames' times, instead of the source's own. ``channel``, ``slice``, ``position``, from 0: which
    of them to read where a source has several; they are never taken for time. Raises FileNotFoundError where nothing
    is there, and ValueError for what cannot be read, in words.
    """
    if fps is not None and not 0 < fps < math.inf:
        raise ValueError(f"open_frames: fps must be a rate > 0 in Hz, got {fps:g}")
    name, medium = _open(source, Choice(channel, slice, position))
    return FrameSource(name, medium, fps=fps)


def _open(source: str | Path | int | Stack | Camera, choice: Choice) -> tuple[str, Medium]:
    if isinstance(source, Camera):
        return "camera", medium_of(source, "camera")
    if not isinstance(source, str | Path | int):
        name = f"{type(source).__name__}"
        check_single(name, choice)
        return name, open_stack(source, name)
    text = str(source)
    text = text if Path(text).expanduser().exists() else text.strip()  # a name may begin or end with a space
    path = Path(text).expanduser()
    if not isinstance(source, int) and text and path.exists():  # a folder named by digits is no camera
        return path.name or str(path), _open_path(path, choice)
    if isinstance(source, int) or (text.isascii() and text.isdecimal()):
        text = f"{PREFIX}opencv:{int(text)}"
    if text.startswith(PREFIX):
        check_single(text, choice)
        return text.removeprefix(PREFIX).replace(":", " "), open_live(text)
    if any(wildcard in text for wildcard in "*?["):
        return _open_glob(path, choice)
    raise FileNotFoundError(f"open_frames: no such file, folder or camera: {text!r}")


def _open_path(path: Path, choice: Choice) -> Medium:
    suffix = path.suffix.lower()
    if path.is_dir() and suffix != ".zarr":
        return _open_folder(path, choice)
    if path.stat().st_size == 0:
        raise ValueError(f"open_frames: {path} is empty")
    extra = open_extra(path, choice)
    if extra is not None:
        return extra
    if suffix in TIFF:
        return open_tiff(path, choice)
    if suffix in IMAGES and not is_animated(path):
        return open_images([path], str(path), choice)
    opener = open_animation if suffix in IMAGES else _PLAIN.get(suffix)
    if opener is None:
        known = " ".join(sorted(IMAGES | _PLAIN.keys()))
        raise ValueError(f"open_frames: {path.name} has the extension {suffix!r}, which is not known (known: {known})")
    check_single(path.name, choice)
    return opener(path)


def _open_folder(folder: Path, choice: Choice) -> Medium:
    # Hidden files are left out: some systems put a "._f001.png" beside each f001.png.
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    if not files:
        raise ValueError(f"open_frames: the folder {folder} is empty")
    return open_images(files, f"the folder {folder}", choice)


def _open_glob(pattern: Path, choice: Choice) -> tuple[str, Medium]:
    files = [Path(match) for match in glob(str(pattern), recursive=True)]
    if not files:
        raise FileNotFoundError(f"open_frames: no file matches {str(pattern)!r}")
    if len(files) == 1:
        return files[0].name, _open_path(files[0], choice)
    return pattern.name, open_images(files, f"the {len(files)} files that match {str(pattern)!r}", choice)
