"""The files of a run that is not finished: text rows, one binary record per frame with the run's state, and one record
for each time that what seldom changes of that state has done so.

All are appended to without a buffer, so that even a process that is killed leaves every frame but the one it was in.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import FileIO
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.frames import Frame
from torch_ecc.io.output import append, create, part, reopen
from torch_ecc.io.records import FIELDS
from torch_ecc.io.summary import plain
from torch_ecc.io.table import Table

_RECORDS, _CHANGES, _TABLE = "track.records", "track.changes", "track.csv"
_CHANGE = struct.Struct("<qq")  # of how many frames a change is the last, and of how many bytes
_HEADER = 8  # digits of the length of what the records begin with
_BLOCK = 1 << 22  # bytes of records that are read at once


class Form(NamedTuple):
    """What every frame of a run has: R ``templates``, times, names, micrometres, and a ``state`` of so many bytes."""

    templates: int
    timed: bool
    named: bool
    micrometres: bool
    state: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of one frame."""
        fields = FIELDS | ({"displacement_um": ("f8", (2,))} if self.micrometres else {})
        own: list[Any] = [("frame", "i8")] + ([("time_s", "f8")] if self.timed else [])
        own += [(name, dtype, (self.templates, *tail)) for name, (dtype, tail) in fields.items()]
        return np.dtype([*own, ("state", f"V{self.state}")] if self.state else own)

    @property
    def table(self) -> Table:
        """The text of one frame."""
        return Table(timed=self.timed, named=self.named, micrometres=self.micrometres)


class Unfinished(NamedTuple):
    """What a run has left: its ``settings``, the ``form`` of its records, where they begin, and how many ``frames``
    both files have whole."""

    settings: dict[str, Any]
    form: Form
    start: int
    frames: int

    @staticmethod
    def of(folder: Path) -> Unfinished | None:
        """What is left in ``folder``; None if nothing is that one could go on with. ValueError if its records are not
        laid out as ours."""
        path = part(folder, _RECORDS)
        if not path.is_file() or path.is_symlink():
            return None
        with path.open("rb") as file:
            try:
                length = int(file.read(_HEADER))
                told = json.loads(file.read(length))
                form, settings, layout = Form(*told["form"]), dict(told["settings"]), told.get("layout")
            except (ValueError, TypeError, KeyError):  # killed before the first frame
                return None
        if layout != str(form.dtype):
            raise ValueError(f"resume: {path} was written by another version of torch_ecc; --force starts anew")
        start = _HEADER + length
        whole = (path.stat().st_size - start) // form.dtype.itemsize
        frames = min(whole, (_lines(rows_file(folder)) - 1) // form.templates)
        return Unfinished(settings, form, start, frames) if frames > 0 else None

    def records(self, folder: Path) -> NDArray[Any]:
        """(F,) records, mapped from the file."""
        return np.memmap(part(folder, _RECORDS), self.form.dtype, "r", self.start, shape=(self.frames,))

    def blocks(self, folder: Path, first: int = 0) -> Iterator[NDArray[Any]]:
        """The records from index ``first`` on, some at a time: read, since all that is mapped counts as memory."""
        dtype = self.form.dtype
        most = max(_BLOCK // dtype.itemsize, 1)
        with part(folder, _RECORDS).open("rb") as file:
            file.seek(self.start + first * dtype.itemsize)
            for index in range(first, self.frames, most):
                yield np.fromfile(file, dtype, min(most, self.frames - index))

    def change(self, folder: Path) -> bytes | None:
        """What seldom changes, as it was last; None if it never has. One that was cut off is of no whole frame."""
        path, last = part(folder, _CHANGES), None
        if not path.is_file() or path.is_symlink():
            return None
        with path.open("rb") as file:
            while len(head := file.read(_CHANGE.size)) == _CHANGE.size:
                frames, size = _CHANGE.unpack(head)
                change = file.read(size)
                last = change if frames <= self.frames else last
        return last


@dataclass
class Journal:
    """Both files, open, with so many ``frames`` in them; the table has ``table_bytes``."""

    folder: Path
    form: Form
    start: int
    table_file: FileIO
    records_file: FileIO
    table_bytes: int
    frames: int = 0

    def __post_init__(self) -> None:
        self._dtype, self._table = self.form.dtype, self.form.table
        self.fields = [name for name in self._dtype.names or () if name != "state"]
        self._of_record = [name for name in self.fields if name not in {"frame", "time_s"}]

    @staticmethod
    def begin(folder: Path, form: Form, settings: Mapping[str, Any]) -> Journal:
        """New files."""
        told = json.dumps({"form": form, "layout": str(form.dtype), "settings": plain(settings)}).encode()
        header, title = b"%0*d" % (_HEADER, len(told)) + told, form.table.header.encode()
        table, records = create(part(folder, _TABLE)), create(part(folder, _RECORDS))
        part(folder, _CHANGES).unlink(missing_ok=True)
        append(records, header)
        append(table, title)
        return Journal(folder, form, len(header), table, records, len(title))

    @staticmethod
    def go_on(folder: Path, left: Unfinished) -> Journal:
        """With the files of a run before, after the frames that are ``left``."""
        path = part(folder, _TABLE)
        if (
            rows_file(folder) != path
        ):  # it was ended in order: its table has its name already, and keeps it until the end
            path.unlink(missing_ok=True)
            shutil.copyfile(rows_file(folder), path)
        with path.open("rb") as file:
            size = sum(map(len, islice(file, 1 + left.frames * left.form.templates)))
        whole = left.start + left.frames * left.form.dtype.itemsize
        table, records = reopen(path, size), reopen(part(folder, _RECORDS), whole)
        return Journal(folder, left.form, left.start, table, records, size, left.frames)

    def append(
        self, arrays: Mapping[str, NDArray[Any]], said: tuple[list[str], ...], frame: Frame, state: bytes
    ) -> None:
        """One frame more, with what is ``said`` of it in words. ValueError if it is not like the first one."""
        if (count := len(arrays["pose"])) != self.form.templates:
            raise ValueError(f"write: record must have {self.form.templates} templates as before, got {count}")
        row = np.zeros((), self._dtype)
        for name in self._of_record:
            row[name] = arrays[name]
        row["frame"] = frame.number
        if self.form.timed:
            row["time_s"] = np.nan if frame.time_s is None else frame.time_s
        if self.form.state:
            row["state"] = np.void(state)
        text = self._table.rows(frame, arrays, *said).encode()
        append(self.records_file, row.tobytes())
        append(self.table_file, text)
        # A frame counts from here on: what an interrupt leaves half-written behind these marks is cut off by close().
        self.frames, self.table_bytes = self.frames + 1, self.table_bytes + len(text)

    def keep(self, change: bytes) -> None:
        """What seldom changes, as it is from the next frame on."""
        path = part(self.folder, _CHANGES)
        with reopen(path, path.stat().st_size) if path.exists() else create(path) as file:
            append(file, _CHANGE.pack(self.frames + 1, len(change)) + change)

    def extend(self, records: NDArray[Any], rows: bytes) -> None:
        """Frames more, as another journal of this form has them."""
        append(self.records_file, records.tobytes())
        append(self.table_file, rows)
        self.frames, self.table_bytes = self.frames + len(records), self.table_bytes + len(rows)

    def close(self) -> bool:
        """Cut both files after the last whole frame; False, and no files, if there is none."""
        size = self.start + self.frames * self._dtype.itemsize
        for file, whole in ((self.table_file, self.table_bytes), (self.records_file, size)):
            file.truncate(whole)
            file.close()
            if not self.frames:
                os.unlink(file.name)
        return self.frames > 0

    def blocks(self) -> Iterator[NDArray[Any]]:
        """All records, some at a time."""
        return Unfinished({}, self.form, self.start, self.frames).blocks(self.folder)

    def remove(self) -> None:
        """The results are whole: nobody needs to go on."""
        part(self.folder, _RECORDS).unlink()
        part(self.folder, _CHANGES).unlink(missing_ok=True)


def rows_file(folder: Path) -> Path:
    """The table of an unfinished run: with its final name if it was ended in order."""
    path = part(folder, _TABLE)
    return path if path.exists() else folder / _TABLE


def _lines(path: Path) -> int:
    """Whole ones."""
    if not path.is_file():
        return 0
    with path.open("rb") as file:
        return sum(line.endswith(b"\n") for line in file)
