"""Animated images (GIF, PNG, WebP), through Pillow: at the times that the delays before a frame add up to."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from torch_ecc.io.frames import FrameError, Medium, Pixels, Raw, brief, check_size

ANIMATIONS = frozenset({".gif", ".apng"})


def is_animated(path: Path) -> bool:
    """Whether an image file holds more than one frame."""
    try:
        with Image.open(path) as image:
            return bool(getattr(image, "is_animated", False))
    except Exception:  # whatever a parser stumbles on in a damaged file, which is then told of as an image
        return False


def open_animation(path: Path) -> Medium:
    """The frames of an animated image. ValueError if it is none."""
    try:
        with Image.open(path) as image:
            check_size(f"open_frames: {path}", *image.size)
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"open_frames: {path} cannot be read as an image ({brief(error)})") from error
    return Medium(lambda numbers: _read(path, numbers), _length(path))


def _length(path: Path) -> int | None:
    try:
        with Image.open(path) as image:
            return int(getattr(image, "n_frames", 1))
    except Exception:  # it is cut off or damaged: where, reading will tell
        return None


def _read(path: Path, numbers: range) -> Iterator[Raw]:
    with Image.open(path) as image:
        passed_ms = 0.0
        for number in itertools.count():
            shown = _show(image, path, number)
            if shown is None or number >= numbers.stop:
                return
            pixels, delay_ms = shown
            if number == 0:
                timed = delay_ms > 0
            if number in numbers:
                yield Raw(number, pixels, passed_ms / 1000 if timed else None)
            passed_ms += delay_ms


def _show(image: Image.Image, path: Path, number: int) -> tuple[Pixels, float] | None:
    """What is shown, grey as it is and all else in RGB, and for how many ms; None after the last frame."""
    try:
        image.seek(number)
        image.load()
        pixels = np.array(image if image.mode in ("L", "I;16") else image.convert("RGB"))
        return pixels, float(image.info.get("duration", 0))
    except EOFError:
        return None
    except Exception as error:  # whatever the parsers stumble on; what follows is drawn over this frame
        raise FrameError(number, f"{path.name} is damaged there ({brief(error)})") from error
