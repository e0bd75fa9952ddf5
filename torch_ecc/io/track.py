"""track.csv, track.npz and summary.json, written while the frames come.

Every file is written under a name that ends in ``.part`` and gets its own name when the run ends, by itself, by an
exception or by Ctrl-C: whatever bears a final name is whole. Memory does not grow with the number of frames.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self
from zipfile import ZipFile

import numpy as np
from numpy.lib.format import dtype_to_descr, write_array, write_array_header_1_0
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.io.frames import Frame
from torch_ecc.io.journal import Form, Journal, Unfinished
from torch_ecc.io.output import check_folder, create, part, publish
from torch_ecc.io.records import (
    CONVERGED,
    DOUBTFUL,
    OriginNames,
    ReasonNames,
    Record,
    StatusNames,
    to_arrays,
    words,
)
from torch_ecc.io.summary import Tally, write_json

FILES = ("track.csv", "track.npz", "summary.json")
NO_REASON, NO_ORIGIN = {0: ""}, {0: ""}


class TrackWriter:
    """Context manager: ``write`` each frame's record, and find track.csv, track.npz and summary.json in ``out_dir``.

    ``status_names`` is the word for each status code, ``reason_names`` that for each reason, ``origin_names`` that
    for how a pose was come by; ``fps`` in Hz is the time of frames that bring none of their own; ``um_matrix`` (2, 2),
    which takes a displacement (dx, dy) in px to micrometres, adds the columns dx_um and dy_um; ``settings`` goes into
    summary.json. ``unfinished``: what a run before has left, to go on with.

    Where a template was lost its pose and displacement are NaN, empty in the table: an old pose would look like a stop.

    A run that ends by an exception keeps the frames that it had: summary.json says ``"complete": false`` and why, and,
    where there is a state, a ``.part`` file stays that a later run can go on with. So do those of a process that is
    killed, or whose disk is full; they have every frame that was written. Nothing is created before the first record.
    Results of an earlier run in the same folder stay until then and are replaced at the end.
    """

    def __init__(
        self,
        out_dir: str | Path,
        *,
        status_names: StatusNames,
        reason_names: ReasonNames = NO_REASON,
        origin_names: OriginNames = NO_ORIGIN,
        fps: float | None = None,
        um_matrix: Tensor | None = None,
        settings: Mapping[str, object] | None = None,
        unfinished: Unfinished | None = None,
    ) -> None:
        self.out_dir = check_folder(out_dir, "TrackWriter")
        if fps is not None and not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"TrackWriter: fps must be a positive number, got {fps}")
        if um_matrix is not None and tuple(um_matrix.shape) != (2, 2):
            raise ValueError(f"TrackWriter: um_matrix must be (2, 2), got {tuple(um_matrix.shape)}")
        self.names = {"status": dict(status_names), "reason": dict(reason_names), "origin": dict(origin_names)}
        self.fps, self.settings = fps, dict(settings or {})
        self.um_matrix = None if um_matrix is None else um_matrix.detach().cpu().numpy().astype("f8")
        self._journal = None if unfinished is None else Journal.go_on(self.out_dir, unfinished)
        self._started, self._before = time.perf_counter(), self.frames

    @property
    def frames(self) -> int:
        """How many frames have been written."""
        return self._journal.frames if self._journal else 0

    def write(self, record: Record, frame: Frame | None = None, state: bytes = b"", change: bytes = b"") -> None:
        """Append one frame of R templates, the same R each time. ``frame`` brings its number, time, name and damage;
        ``state``, of one length, is what a run needs to go on from here, with the ``change`` of what seldom changes,
        empty where it has not. ValueError for what does not fit."""
        if frame is None:
            frame = Frame(self.frames, None, None if self.fps is None else self.frames / self.fps)
        arrays = to_arrays(record)
        status, reason, origin = (words(arrays[field], names, field) for field, names in self.names.items())
        lost = [word not in (CONVERGED, DOUBTFUL) for word in status]
        if any(lost):
            arrays["pose"][lost] = arrays["displacement"][lost] = np.nan
            origin = ["" if without else word for without, word in zip(lost, origin, strict=True)]
        if self.um_matrix is not None:
            arrays["displacement_um"] = arrays["displacement"][:, :2] @ self.um_matrix.T
        if self._journal is None:
            timed, micrometres = frame.time_s is not None, "displacement_um" in arrays
            form = Form(len(status), timed, bool(frame.name), micrometres, len(state))
            self._journal = Journal.begin(self.out_dir, form, self.settings)
        if change:
            self._journal.keep(change)
        self._journal.append(arrays, (status, reason, origin), frame, state)

    def __enter__(self) -> Self:
        self._started, self._before = time.perf_counter(), self.frames
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        journal, self._journal = self._journal, None
        if journal is None or not journal.close():
            return
        try:
            self._finish(journal, error)
        except OSError:  # no room for the results: what they are made from is there
            for name in FILES[1:]:
                with suppress(OSError):
                    part(self.out_dir, name).unlink(missing_ok=True)
            raise

    def leave(self) -> None:
        """End without results: what a later run can go on with stays."""
        journal, self._journal = self._journal, None
        if journal is not None:
            journal.close()

    def _finish(self, journal: Journal, error: BaseException | None) -> None:
        seconds = time.perf_counter() - self._started
        with BufferedWriter(create(part(self.out_dir, "track.npz"))) as file:
            _write_npz(file, journal, self._constants())
        tally = Tally(journal.form.templates, journal.frames, self.names)
        for records in journal.blocks():
            tally.add(records)
        summary = tally.summary(error)
        rate = (journal.frames - self._before) / seconds
        summary |= {"frames_per_s": rate, "fps": self.fps, "settings": self.settings}
        if self.um_matrix is not None:
            summary["um_per_px"] = np.linalg.norm(self.um_matrix, axis=0).tolist()
        write_json(part(self.out_dir, "summary.json"), summary)
        # The old summary goes first and the new one comes last: a summary always belongs to the files beside it.
        (self.out_dir / "summary.json").unlink(missing_ok=True)
        publish(self.out_dir, *FILES)
        if error is None or not journal.form.state:
            journal.remove()

    def _constants(self) -> dict[str, NDArray[Any]]:
        constants: dict[str, NDArray[Any]] = {}
        for field, names in self.names.items():
            constants[f"{field}_codes"] = np.array(list(names), np.int8)
            constants[f"{field}_names"] = np.array(list(names.values()))
        return constants if self.um_matrix is None else constants | {"um_matrix": self.um_matrix}


def _write_npz(file: IO[bytes], journal: Journal, constants: Mapping[str, NDArray[Any]]) -> None:
    """What numpy.savez writes of a journal's fields and of ``constants``, of which it would want all at once."""
    with ZipFile(file, "w") as archive:
        for name in journal.fields:
            kind = journal.form.dtype[name]
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                shape = (journal.frames, *kind.shape)
                header = {"descr": dtype_to_descr(kind.base), "fortran_order": False, "shape": shape}
                write_array_header_1_0(member, header)
                for records in journal.blocks():
                    member.write(records[name].tobytes())
        for name, values in constants.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                write_array(member, values)
