"""The folder that results go to: one run at a time, and everything is ``name.part`` until it is whole.

A file gets its final name in one step of the file system, so a final name never stands for half a file, not even after
a power cut or a kill. Parts are new files of their own: a link that bears their name is removed, not followed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path

from filelock import FileLock, Timeout


def check_folder(path: str | Path, who: str) -> Path:
    """``path`` as a Path; it need not exist yet. ValueError, as ``who``, if it is something else than a folder."""
    folder = Path(path).expanduser()
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{who}: out_dir must be a folder, {folder} is a file")
    return folder


def printable(text: str) -> str:
    """Line ends and control codes, which names of files may hold, as escapes."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def part(folder: Path, name: str) -> Path:
    """Where ``name`` is written until it is whole."""
    return folder / f"{name}.part"


def create(path: Path) -> FileIO:
    """A new empty file without a buffer, in place of whatever bore its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    return FileIO(path, "x+")


def reopen(path: Path, size: int) -> FileIO:
    """A file that a run has left, cut after ``size`` bytes, to go on with. ValueError if it is a link."""
    if path.is_symlink():
        raise ValueError(f"resume: {path} is a link and was not written by a run")
    file = FileIO(path, "r+")
    file.truncate(size)
    file.seek(size)
    return file


def append(file: FileIO, data: bytes) -> None:
    """All of ``data``, at once in the file: a process that is killed later has written it. OSError on a full disk."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]


def publish(folder: Path, *names: str) -> None:
    """Give each part its final name, in this order, in place of what bore it."""
    for name in names:
        os.replace(part(folder, name), folder / name)


@contextmanager
def claim(folder: Path) -> Iterator[None]:
    """The folder for one run alone, made if need be and removed if nothing was written. ValueError if another run, of
    any process, has it."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(part(folder, "lock"), timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise ValueError(f"out: another run is writing into {folder}") from None
    try:
        yield
    finally:
        with suppress(OSError):  # a system that cannot remove what is open
            part(folder, "lock").unlink()
        lock.release()
        with suppress(OSError):
            folder.rmdir()
