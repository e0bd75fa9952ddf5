"""One door for every kind of input: ``open_frames``."""

from __future__ import annotations

from glob import glob
from pathlib import Path

from torch_ecc.io.frames import FrameSource, Medium
from torch_ecc.io.images import IMAGES, TIFF, open_images, open_tiff
from torch_ecc.io.stacks import open_npy, open_npz
from torch_ecc.io.video import VIDEOS, open_camera, open_video


def open_frames(source: str | Path | int, *, fps: float | None = None) -> FrameSource:
    """A stream of frames from whatever ``source`` is.

    A video file; an image; a folder or a glob (``"run3/*.png"``) of images in natural order; a multi-page TIFF of 8 or
    16 bits or float; an .npy stack, (F, H, W) or with 1, 3 or 4 channels, first or last; an .npz with such an array
    named ``frames`` or alone; a camera index, as a number or in digits ("0"). The first frame is read here, the others
    when they are asked for.

    Raises FileNotFoundError where nothing is there, and ValueError for what cannot be read, in words.
    """
    if isinstance(source, int):
        return FrameSource(f"camera {source}", open_camera(source), fps=fps)
    text = str(source).strip()
    if text.isdecimal():
        return FrameSource(f"camera {int(text)}", open_camera(int(text)), fps=fps)
    path = Path(text).expanduser()
    if text and path.exists():
        return FrameSource(path.name or str(path), _open_path(path), fps=fps)
    if any(wildcard in text for wildcard in "*?["):
        return _open_glob(path, fps)
    raise FileNotFoundError(f"open_frames: no such file, folder or camera: {text!r}")


def _open_path(path: Path) -> Medium:
    if path.is_dir():
        return _open_folder(path)
    suffix = path.suffix.lower()
    if suffix in TIFF:
        return open_tiff(path)
    if suffix in IMAGES:
        return open_images([path], str(path))
    if suffix in VIDEOS:
        return open_video(path)
    if suffix == ".npy":
        return open_npy(path)
    if suffix == ".npz":
        return open_npz(path)
    known = " ".join(sorted(IMAGES | VIDEOS | {".npy", ".npz"}))
    raise ValueError(f"open_frames: {path.name} has the extension {suffix!r}, which is not known (known: {known})")


def _open_folder(folder: Path) -> Medium:
    # Hidden files are left out: some systems put a "._f001.png" beside each f001.png.
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    if not files:
        raise ValueError(f"open_frames: the folder {folder} is empty")
    return open_images(files, f"the folder {folder}")


def _open_glob(pattern: Path, fps: float | None) -> FrameSource:
    files = [Path(match) for match in glob(str(pattern), recursive=True)]
    if not files:
        raise FileNotFoundError(f"open_frames: no file matches {str(pattern)!r}")
    if len(files) == 1:
        return FrameSource(files[0].name, _open_path(files[0]), fps=fps)
    return FrameSource(pattern.name, open_images(files, f"the {len(files)} files that match {str(pattern)!r}"), fps=fps)
