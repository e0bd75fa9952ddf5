"""track.csv, track.npz and summary.json, written while the frames come.

Every file is written under a name that ends in ``.part`` and gets its own name when the run ends, by itself, by an
exception or by Ctrl-C: whatever bears a final name is whole. Memory does not grow with the number of frames.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.io.output import check_folder, part, publish
from torch_ecc.io.records import FIELDS, Record, StatusNames, to_arrays, words
from torch_ecc.io.summary import summarise, write_json
from torch_ecc.io.table import Table


class TrackWriter:
    """Context manager: ``write`` each frame's record, and find track.csv, track.npz and summary.json in ``out_dir``.

    ``status_names`` is the word for each status code; ``fps`` in Hz adds the time; ``um_matrix`` (2, 2), which takes a
    displacement (dx, dy) in px to micrometres, adds the columns dx_um and dy_um; ``settings`` goes into summary.json.

    A run that ends by an exception keeps the frames that it had, and summary.json says ``"complete": false`` and why.
    A process that is killed leaves ``.part`` files only. Nothing is created before the first record. Results of an
    earlier run in the same folder stay until then and are replaced at the end.
    """

    def __init__(
        self,
        out_dir: str | Path,
        *,
        status_names: StatusNames,
        fps: float | None = None,
        um_matrix: Tensor | None = None,
        settings: Mapping[str, object] | None = None,
    ) -> None:
        self.out_dir = check_folder(out_dir, "TrackWriter")
        if fps is not None and not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"TrackWriter: fps must be a positive number, got {fps}")
        if um_matrix is not None and tuple(um_matrix.shape) != (2, 2):
            raise ValueError(f"TrackWriter: um_matrix must be (2, 2), got {tuple(um_matrix.shape)}")
        self.fps, self.status_names, self.settings = fps, dict(status_names), dict(settings or {})
        self.um_matrix = None if um_matrix is None else um_matrix.detach().cpu().numpy().astype("f8")
        self._files: _PartFiles | None = None
        self._started = time.perf_counter()

    @property
    def frames(self) -> int:
        """How many frames have been written."""
        return self._files.frames if self._files else 0

    def write(self, record: Record) -> None:
        """Append one frame of R templates, the same R each time. ValueError for shapes or codes that do not fit."""
        arrays = to_arrays(record)
        status = words(arrays["status"], self.status_names)
        if self.um_matrix is not None:
            arrays["displacement_um"] = arrays["displacement"][:, :2] @ self.um_matrix.T
        if self._files is None:
            self._files = _PartFiles(self.out_dir, arrays, timed=self.fps is not None)
        time_s = None if self.fps is None else self.frames / self.fps
        self._files.append(arrays, status, time_s)

    def __enter__(self) -> Self:
        self._started = time.perf_counter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        files, self._files = self._files, None
        if files is not None and files.close():
            self._finish(files, error)

    def _finish(self, files: _PartFiles, error: BaseException | None) -> None:
        seconds = time.perf_counter() - self._started
        records = files.records()
        files.write_npz(records, self._constants(files.frames))
        summary = summarise(records, self.status_names, error)
        summary |= {"frames_per_s": files.frames / seconds, "fps": self.fps, "settings": self.settings}
        if self.um_matrix is not None:
            summary["um_per_px"] = np.linalg.norm(self.um_matrix, axis=0).tolist()
        write_json(part(self.out_dir, "summary.json"), summary)
        del records  # the memory map, which would keep the file busy on some systems
        files.publish()

    def _constants(self, frames: int) -> dict[str, NDArray[Any]]:
        constants = {
            "status_codes": np.array(list(self.status_names), np.int8),
            "status_names": np.array(list(self.status_names.values())),
        }
        if self.fps is not None:
            constants["time_s"] = np.arange(frames) / self.fps
        if self.um_matrix is not None:
            constants["um_matrix"] = self.um_matrix
        return constants


class _PartFiles:
    """The files of a run that is not finished: text rows and one binary record per frame, appended."""

    def __init__(self, folder: Path, arrays: Mapping[str, NDArray[Any]], *, timed: bool) -> None:
        count, fields, micrometres = len(arrays["pose"]), dict(FIELDS), "displacement_um" in arrays
        if micrometres:
            fields["displacement_um"] = ("f8", (2,))
        self._dtype = np.dtype([(name, dtype, (count, *tail)) for name, (dtype, tail) in fields.items()])
        self._table = Table(timed=timed, micrometres=micrometres)
        self._folder, self.frames = folder, 0
        folder.mkdir(parents=True, exist_ok=True)
        self._csv, self._records = part(folder, "track.csv").open("wb"), part(folder, "track.records").open("wb")
        self._csv_bytes = self._csv.write(self._table.header.encode())

    def append(self, arrays: Mapping[str, NDArray[Any]], status: list[str], time_s: float | None) -> None:
        row = np.zeros((), self._dtype)
        for name in row.dtype.names or ():
            if arrays[name].shape != row[name].shape:
                raise ValueError(
                    f"write: record must have {len(row[name])} templates as before, got {len(arrays[name])}"
                )
            row[name] = arrays[name]
        text = self._table.rows(self.frames, time_s, arrays, status).encode()
        self._records.write(row.tobytes())
        self._csv.write(text)
        # A frame counts from here on: what an interrupt leaves half-written behind these marks is cut off by close().
        self.frames, self._csv_bytes = self.frames + 1, self._csv_bytes + len(text)

    def close(self) -> bool:
        """Cut both files after the last whole frame; False, and no files, if there is none."""
        for file, size in ((self._csv, self._csv_bytes), (self._records, self.frames * self._dtype.itemsize)):
            file.truncate(size)
            file.close()
            if not self.frames:
                Path(file.name).unlink()
        return self.frames > 0

    def records(self) -> NDArray[Any]:
        """(F,) records, mapped from the file."""
        return np.memmap(part(self._folder, "track.records"), self._dtype, "r", shape=(self.frames,))

    def write_npz(self, records: NDArray[Any], constants: Mapping[str, NDArray[Any]]) -> None:
        """Each field of the records as an array (F, R, ...), copied through a small buffer, and the constants."""
        fields: dict[str, Any] = {name: records[name] for name in records.dtype.names or ()} | dict(constants)
        with part(self._folder, "track.npz").open("wb") as file:
            np.savez(file, **fields)

    def publish(self) -> None:
        # The old summary goes first and the new one comes last: a summary always belongs to the files beside it.
        (self._folder / "summary.json").unlink(missing_ok=True)
        publish(self._folder, "track.csv", "track.npz", "summary.json")
        part(self._folder, "track.records").unlink()
