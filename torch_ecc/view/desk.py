"""What lies on the desk: an input or a result, the marks in it, the settings, the run. Pages show it, and change it."""

from __future__ import annotations

import json
from base64 import b64decode
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from torch_ecc.commands.jobs import TrackJob, span
from torch_ecc.commands.options import track_command, track_toml
from torch_ecc.commands.templates import choose_templates
from torch_ecc.commands.track import RESULTS
from torch_ecc.config import fill
from torch_ecc.core.estimate import Reason
from torch_ecc.core.texture_map import TextureMap, texture_map
from torch_ecc.io import open_frames
from torch_ecc.io.canvas import Stretch
from torch_ecc.io.frames import Frame, FrameSource
from torch_ecc.io.journal import Unfinished
from torch_ecc.io.summary import plain
from torch_ecc.view.history import History
from torch_ecc.view.marks import Mark, Outlook, as_settings, boxes, outlook, read_outline
from torch_ecc.view.pictures import jpeg
from torch_ecc.view.rois import read_rois
from torch_ecc.view.run import Run, State

PLACED = ("centers", "size", "polygons", "grid", "template")
SETTINGS = ("frames", "fps", "um_per_px", "out", "force", "overlay")  # that a page may change
DEFAULTS = {name: each.default for name, each in TrackJob.__dataclass_fields__.items()}
MOST_STEPS = 99  # that can be taken back, and one
Placing: TypeAlias = tuple[dict[str, Any], list[Mark]]
FALLEN = (ValueError, OSError, MemoryError)


class Desk:
    """One input, looked at by any number of pages. ``values``: the keys of a ``TrackJob``, with ``input`` at least.

    What cannot be opened becomes the ``problem``, in words. Not for several threads at once, but for ``run``.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values, self.version = dict(values), 0
        self.marks, self.outlooks = list[Mark](), list[Outlook]()
        self.tracked: list[Mark] | None = None  # those that the rows are of
        self.history: History | None = None
        self.run: Run | None = None
        self.problem: str | None = None
        self._past, self._future = list[Placing](), list[Placing]()
        self._map: tuple[Tensor, TextureMap] | None = None
        self.looks = 0
        try:
            self._open_result()
            self.job = fill(TrackJob, self.values, "pick")
            self._look(self.job, _opened(self.job))
            self.stretch = Stretch.of(self.source.first)
            self._read_marks()
            self.tracked = self.marks if self.history is not None else None
        except FALLEN as error:
            self.problem = str(error).removeprefix("open_frames: ")

    def _open_result(self) -> None:
        """If the input is the folder of a result: its settings, its rows, and the input that it was made from."""
        folder = Path(self.values["input"]).expanduser()
        if not (folder / "summary.json").is_file() or not (folder / "track.npz").is_file():
            return
        settings = json.loads((folder / "summary.json").read_text(encoding="utf-8")).get("settings", {})
        known = {name: value for name, value in settings.items() if name in TrackJob.__dataclass_fields__}
        beside = folder.parent / str(known.get("input", ""))  # where it was when the run was begun
        if not Path(known.get("input", "")).exists() and beside.exists():
            known["input"] = str(beside)
        self.values = {"input": ""} | known | {"out": str(folder)}
        self.history = History.of(folder)

    def _look(self, job: TrackJob, source: FrameSource) -> None:
        """At a source, and at the frame in it that the job cuts its templates from."""
        first = span(job.frames).start or 0
        part = source if first == 0 else source[first:]
        frame = part.first if job.reference is None else open_frames(job.reference).first
        self.source, self.first, self.frame, self.looks = source, first, frame, self.looks + 1

    def _read_marks(self) -> None:
        """Those that the values bring."""
        marks = list[Mark]()
        if self.values.get("polygons"):
            marks = [{"points": [list(corner) for corner in polygon]} for polygon in self.values["polygons"]]
        elif self.values.get("centers") or self.values.get("grid"):
            templates = choose_templates(self.job, self.frame)
            marks = boxes(templates.centers, templates.size)
        self._place(self.values, marks)
        self._past = []

    def _change(self, values: Mapping[str, Any]) -> None:
        """Take these values, if they fit."""
        values = {name: value for name, value in values.items() if value not in (None, "", [], DEFAULTS.get(name))}
        job = self._job(values)
        self.job, self.values, self.calibration = job, values, job.calibration(self.source.um_per_px)
        self.version += 1

    def _job(self, values: Mapping[str, Any]) -> TrackJob:
        """What these values say. ValueError if they do not fit."""
        job = fill(TrackJob, values, "pick")
        job.calibration(self.source.um_per_px)
        return job

    def _place(self, values: Mapping[str, Any], marks: list[Mark]) -> None:
        """Take the values that say these marks, and what is to be expected of each, all at once."""
        outlooks = outlook(self.frame, marks, values) if marks else []
        before = self._placing()
        self._change(values)
        if marks != self.marks:
            self._past, self._future = [*self._past[-MOST_STEPS:], before], []
        self.marks, self.outlooks = marks, outlooks

    def _placing(self) -> Placing:
        """The marks, and the values that say them."""
        return {name: self.values[name] for name in PLACED if name in self.values}, self.marks

    def undo(self) -> None:
        """The marks as they were before their last change."""
        self._step(self._past, self._future)

    def redo(self) -> None:
        """The change that was taken back last, once more."""
        self._step(self._future, self._past)

    def _step(self, back: list[Placing], forth: list[Placing]) -> None:
        if not back or self.running:
            return
        (placed, marks), now, past, future = back[-1], self._placing(), self._past, self._future
        self._place(self._unplaced() | placed, marks)
        back.pop()
        forth.append(now)
        self._past, self._future = past, future  # a step is no change of its own

    def _unplaced(self) -> dict[str, Any]:
        """The values but for where the patches are."""
        return {name: value for name, value in self.values.items() if name not in PLACED}

    def told(self) -> dict[str, Any]:
        """All that a page shows, but for pictures and rows."""
        if self.problem is not None:
            return {"problem": self.problem, "input": self.values["input"], "version": self.version}
        source, folder = self.source, self.job.folder()
        state: dict[str, Any] = {
            "problem": None,
            "version": self.version,
            "input": self.values["input"],
            "name": source.name,
            "size": source.shape,
            "dtype": str(source.dtype).removeprefix("torch."),
            "length": source.length,
            "live": source.live,
            "looks": self.looks,
            "notes": source.notes,
            "own": {"fps": source.fps, "um_per_px": source.um_per_px},
            "settings": {name: self.values.get(name) for name in SETTINGS} | {"overlay": self.job.overlay},
            "first": self.first,
            "marks": self.marks,
            "undo": bool(self._past),
            "redo": bool(self._future),
            "outlooks": [each._asdict() for each in self.outlooks],
            "tracked": self.tracked,
            "ready": bool(self.marks or self.job.template),
            "command": track_command(self.values),
            "toml": track_toml(self.values, "pick"),
            "folder": str(folder),
            "there": self._there(folder),
            "run": None if self.run is None else self.run.told(),
            "files": [name for name in RESULTS if (folder / name).is_file()],
            "start": None if self.rows is None else self.rows.start.tolist(),
            "um_matrix": self._um_matrix(),
        }
        return state

    def _there(self, folder: Path) -> str:
        """What the folder of the results holds already."""
        if self.running or not folder.is_dir():
            return "nothing"
        try:
            left = Unfinished.of(folder)
        except ValueError:  # of another version
            left = None
        return "unfinished" if left else "result" if any((folder / name).exists() for name in RESULTS) else "nothing"

    def _um_matrix(self) -> list[list[float]] | None:
        if self.calibration is None:
            return None
        return self.calibration.matrix(torch.zeros(1, dtype=torch.float64))[:2, :2].tolist()

    @property
    def rows(self) -> History | None:
        """Those of the run, or of the result that was opened."""
        return self.history if self.run is None else self.run.history

    @property
    def running(self) -> bool:
        """Whether a run is going on."""
        return self.run is not None and self.run.state is State.RUNNING

    def mark(self, marks: list[Mark]) -> None:
        """These marks, instead of those before."""
        self._place(self._unplaced() | (as_settings(marks) if marks else {}), marks)

    def outline(self, text: str) -> None:
        """One mark more, from a text that ImageJ wrote."""
        self.mark([*self.marks, read_outline(text)])

    def rois(self, name: str, data: str) -> None:
        """Marks more, from a file of ImageJ's, its bytes in base 64."""
        self.mark([*self.marks, *read_rois(name, b64decode(data))])

    def grid(self, count: int, size: int) -> None:
        """``count`` patches of ``size`` px in a row, and rows to match, where there is texture enough."""
        values = self._unplaced() | {"grid": count, "size": size}
        templates = choose_templates(fill(TrackJob, values, "pick"), self.frame)
        self._place(values, boxes(templates.centers, templates.size))

    def best(self, count: int, size: int) -> None:
        """Up to ``count`` patches of ``size`` px that do not overlap, where they can be tracked best."""
        if count < 1:
            raise ValueError(f"best: expected 1 patch or more, got {count}")
        places = self.map(size).best(count)
        if not len(places):
            raise ValueError(f"best: no patch of {size} px has enough texture to fix x, y and theta")
        self.mark(boxes(places, (size, size)))

    def map(self, size: int) -> TextureMap:
        """How well patches of ``size`` px can be tracked, everywhere in the frame."""
        if self._map is None or self._map[0] is not self.frame or self._map[1].size != (size, size):
            self._map = self.frame, texture_map(self.frame, size)
        return self._map[1]

    def predict(self, mark: Mark) -> Outlook:
        """What is to be expected of one mark."""
        return outlook(self.frame, [mark], self.values)[0]

    def set(self, settings: Mapping[str, Any]) -> None:
        """Other settings, of ``SETTINGS``."""
        unknown = settings.keys() - set(SETTINGS)
        if unknown:
            raise ValueError(f"set: expected some of {', '.join(SETTINGS)}, got {', '.join(sorted(unknown))}")
        values = self.values | dict(settings)
        job = self._job(values)
        self._look(job, self.source if job.fps == self.job.fps else _opened(job))
        self._place(values, self.marks)

    def look(self) -> None:
        """Another picture of a live camera."""
        if self.running or not self.source.live:
            raise ValueError("look: only a camera that is not being tracked has another picture")
        self._look(self.job, _opened(self.job))
        self._place(self.values, self.marks)

    def track(self, *, resume: bool = False) -> None:
        """Begin the run that the settings tell, or go on with the one that was stopped."""
        if self.running:
            raise ValueError("track: a run is going on already")
        self.run = Run(fill(TrackJob, self.values | {"resume": resume}, "pick"))
        self.tracked = self.marks
        self.version += 1

    def stop(self) -> None:
        """Stop the run, and keep what it had."""
        if self.run is not None:
            self.run.stop()
        self.version += 1

    def picture(self, number: int) -> bytes:
        """A frame as JPEG. ValueError in words if it is damaged or there is none."""
        if self.source.live and number != self.first:
            raise ValueError("pictures of a camera are not kept; overlay.mp4 has them")
        if number == self.first and (self.source.live or self.job.reference):
            return jpeg(Frame(number, self.frame), self.stretch)
        try:
            frame = self.source[number]
        except IndexError as error:
            raise ValueError(str(error)) from error
        return jpeg(frame, self.stretch)

    def row(self, number: int) -> dict[str, Any]:
        """What was found in a frame, and why it is doubted."""
        found = None if self.rows is None else self.rows.at(number)
        if found is None:
            raise ValueError(f"row: frame {number} was not tracked")
        reasons = [Reason.describe(int(code)) for code in found[11::10]]
        return {"row": plain(found.tolist()), "reasons": reasons}


def _opened(job: TrackJob) -> FrameSource:
    """The input of a job."""
    return open_frames(job.input, fps=job.fps, channel=job.channel, slice=job.slice, position=job.position)
