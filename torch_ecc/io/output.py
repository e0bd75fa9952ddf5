"""The folder that results go to: everything is ``name.part`` until it is whole.

A file gets its final name in one step of the file system, so a final name never stands for half a file, not even after
a power cut or a kill.
"""

from __future__ import annotations

import os
from pathlib import Path


def check_folder(path: str | Path, who: str) -> Path:
    """``path`` as a Path; it need not exist yet. ValueError, as ``who``, if it is something else than a folder."""
    folder = Path(path).expanduser()
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{who}: out_dir must be a folder, {folder} is a file")
    return folder


def part(folder: Path, name: str) -> Path:
    """Where ``name`` is written until it is whole."""
    return folder / f"{name}.part"


def publish(folder: Path, *names: str) -> None:
    """Give each part its final name, in this order, in place of what bore it."""
    for name in names:
        os.replace(part(folder, name), folder / name)
