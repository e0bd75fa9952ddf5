"""The rows of a run, for curves: as they come, and as a finished result has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.io.frames import Frame
from torch_ecc.io.journal import Unfinished

COLUMNS = ("x", "y", "theta", "sigma_x", "sigma_y", "sigma_theta", "score", "coverage", "status", "reason")
MOST = 4000  # rows that a page is sent of a long run, and as many of those that are doubted
Rows = NDArray[np.float64]


class History:
    """(F, 2 + 10 R) numbers: a frame's number and its time in s, then the ``COLUMNS`` of each of R templates. x, y and
    theta are displacements in px, px, rad from the ``start`` (R, 3); NaN where a template was not found."""

    def __init__(self, start: Rows) -> None:
        self.start, self._count = start, 0
        self._rows = np.empty((64, 2 + len(COLUMNS) * len(start)))

    @property
    def templates(self) -> int:
        """R."""
        return len(self.start)

    @staticmethod
    def of(folder: Path) -> History:
        """The rows of a result, or of a run that was ended. ValueError if there are none in ``folder``."""
        left = Unfinished.of(folder)
        if left is not None:
            records = left.records(folder)
            return History._of({name: np.array(records[name]) for name in records.dtype.names or () if name != "state"})
        try:
            with np.load(folder / "track.npz") as track:
                return History._of(dict(track))
        except (OSError, KeyError, ValueError, EOFError) as error:
            raise ValueError(f"{folder}: its track.npz cannot be read ({error})") from error

    @staticmethod
    def _of(track: dict[str, NDArray[Any]]) -> History:
        pose, moved = track["pose"], track["displacement"]
        seen = np.isfinite(pose).all(2)
        first = seen.argmax(0), np.arange(pose.shape[1])
        history = History(np.where(seen.any(0)[:, None], pose[first] - moved[first], np.nan))
        sigma = np.sqrt(np.diagonal(track["covariance"], axis1=2, axis2=3))
        each = (track[name][..., None] for name in ("score", "coverage", "status", "reason"))
        columns = np.concatenate((moved, sigma, *each), 2)
        columns[columns[..., 8] > Status.MAX_ITERATIONS, :6] = np.nan
        times = track.get("time_s", np.full(len(pose), np.nan))
        history._rows = np.column_stack((track["frame"], times, columns.reshape(len(pose), -1)))
        history._count = len(pose)
        return history

    def add(self, frame: Frame, estimate: Estimate) -> None:
        """One frame more."""
        found, codes = np.zeros((self.templates, len(COLUMNS))), (estimate.status, estimate.reason)
        found[:, :3], found[:, 3:6] = estimate.displacement.cpu(), estimate.sigma.cpu()
        found[:, 6], found[:, 7] = estimate.score.cpu(), estimate.coverage.cpu()
        found[:, 8], found[:, 9] = (code.cpu() for code in codes)
        found[found[:, 8] > Status.MAX_ITERATIONS, :6] = np.nan
        time_s = np.nan if frame.time_s is None else frame.time_s
        while self._count and self._rows[self._count - 1, 0] >= frame.number:  # a run that goes on does it once more
            self._count -= 1
        if self._count == len(self._rows):
            self._rows = np.concatenate((self._rows, np.empty_like(self._rows)))
        self._rows[self._count] = (frame.number, time_s, *found.ravel())
        self._count += 1  # counts from here on: another thread may be reading

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Rows:
        """All of them."""
        return self._rows[: self._count]

    def since(self, first: int) -> Rows:
        """The rows from ``first`` on: all if they are few, else evenly chosen ones and those that are doubted."""
        rows = self.rows[first:]
        if len(rows) <= MOST:
            return rows
        doubted = np.flatnonzero((rows[:, 11 :: len(COLUMNS)] > 0).any(1))
        some = (np.linspace(0, len(which) - 1, min(len(which), MOST)).round() for which in (rows, doubted))
        even, odd = (chosen.astype(int) for chosen in some)
        return np.asarray(rows[np.union1d(even, doubted[odd])])

    def at(self, number: int) -> Rows | None:
        """The row of the frame with this number, None if there is none."""
        rows = self.rows
        index = int(np.searchsorted(rows[:, 0], number))
        return rows[index] if index < len(rows) and rows[index, 0] == number else None
