"""A tracking run from a video to its files: what ``torch-ecc track`` does."""

from __future__ import annotations

import dataclasses
import errno
import json
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.body.body import Body
from torch_ecc.commands.bodies import BODY_FILES, read_lens, told, write_bodies
from torch_ecc.commands.jobs import TrackJob, span
from torch_ecc.commands.live import Latency, Send, as_it_comes, sender
from torch_ecc.commands.run import Pictures, Run
from torch_ecc.commands.templates import Templates, choose_templates, read_frame_mask, read_templates, refuse_doubt
from torch_ecc.core.ambient import threads_for
from torch_ecc.core.estimate import Estimate, Origin, Reason, Status
from torch_ecc.io import Frame, OverlayWriter, TrackWriter, open_frames
from torch_ecc.io.beside import ahead
from torch_ecc.io.journal import Unfinished
from torch_ecc.io.output import check_folder, claim
from torch_ecc.io.stabilised import StabilisedWriter
from torch_ecc.io.stacks import Stack
from torch_ecc.io.summary import plain
from torch_ecc.io.track import FILES
from torch_ecc.track.tracker import Tracker

STATUS_NAMES = {int(code): code.name for code in Status}
REASON_NAMES = {int(code): code.word for code in Reason}
ORIGIN_NAMES = {int(code): code.name for code in Origin}
RESULTS = (*FILES, *BODY_FILES, "track.png", "overlay.mp4", "overlay", "stabilised.mp4")
MANY = 8  # templates that were lost: of more there is one line
NOT_OF_THE_RESULT = ("out", "force", "resume", "send")


class Finished(NamedTuple):
    """What became of a run: ``frames`` done, of which so many ``damaged``, the first as ``damage`` says ("" if it came
    before the run went on), how many each template was lost in of the others and what speaks against its last pose
    (R,), how many rows each reason stands in, in the order of Reason, the folder, whether it was stopped from the
    keyboard or by a signal, and how late poses of a camera's frames were."""

    frames: int
    damaged: int
    damage: str
    lost: NDArray[np.int64]
    last_reason: NDArray[np.int8]
    reasons: NDArray[np.int64]
    folder: Path
    interrupted: bool
    latency: Latency

    def words(self) -> list[str]:
        """The same in sentences."""
        said = self._losses()
        if self.damaged:
            example = f", as {self.damage}" if self.damage else ""
            said.append(f"{self.damaged} of {self.frames} frames are damaged{example}: track.csv says which and why")
        counts = sorted(zip(self.reasons.tolist(), Reason, strict=True), key=lambda each: -each[0])
        if reasons := [f"{n} {code.name.lower().replace('_', ' ')}" for n, code in counts if n and code]:
            rows, doubted = int(self.reasons.sum()), int(self.reasons[1:].sum())
            said.append(f"{doubted} of {rows} rows are not to be trusted: {', '.join(reasons)}")
        said += [*told(self.folder), *self._clock(), *self.latency.words()]
        whole = sorted(path.name for path in self.folder.iterdir() if path.suffix != ".part") if self.frames else []
        end, names = "Stopped after" if self.interrupted else "Tracked", ", ".join(whole) or "nothing"
        return [*said, f"{end} {self.frames} frames. In {self.folder}/: {names}"]

    def _clock(self) -> list[str]:
        """What is said of times that are none."""
        path = self.folder / "summary.json"
        back = json.loads(path.read_text(encoding="utf-8"))["times_that_do_not_go_on"] if path.is_file() else 0
        return [f"The time of {back} frames is not later than that of the frame before: --fps tells it"] if back else []

    def _losses(self) -> list[str]:
        """What is said of templates that were lost: a line of each, or one of all if they are many."""
        lost = {number: frames for number, frames in enumerate(self.lost.tolist()) if frames}
        if len(lost) > MANY:
            worst = sorted(lost, key=lambda number: -lost[number])[:MANY]
            most = ", ".join(f"{number} in {lost[number]}" for number in worst)
            of = f"{len(lost)} of {len(self.lost)} templates were not found in some of {self.frames} frames"
            return [f"{of}, most often {most}: track.csv says why"]
        there = "It is there in the last one."
        ends = [f"Last frame: {Reason.describe(int(code))}" if code else there for code in self.last_reason]
        return [f"Template {k} was not found in {n} of {self.frames} frames. {ends[k]}" for k, n in lost.items()]


class Session:
    """A checked run: the input is open, the templates are cut, and nothing is written yet.

    ``frames``: anything indexed like a stack of them, in place of a file; ``job.input`` is then only its name. Raises
    FileNotFoundError or ValueError for whatever in ``job`` does not fit.
    """

    def __init__(self, job: TrackJob, frames: Stack | None = None) -> None:
        self.job, self.folder = job, check_folder(job.folder(), "track")
        if not (job.force or (job.resume and Unfinished.of(self.folder))):
            refuse_overwriting(self.folder, RESULTS)
        crops = read_templates(job)
        choice = {name: getattr(job, name) for name in ("channel", "slice", "position")}
        self.source = open_frames(job.input if frames is None else frames, fps=job.fps, **choice)
        if job.frames is not None:
            self.source = self.source[span(job.frames)]
        first = self.source.first if job.reference is None else open_frames(job.reference).first
        if self.source.shape != first.shape[-2:]:
            (h, w), (h0, w0) = self.source.shape, first.shape[-2:]
            raise ValueError(f"reference: expected an image of the input's size {w}x{h} px, got {w0}x{h0} px")
        self.templates = choose_templates(job, first) if crops is None else Templates.of(crops)
        self.calibration, self.lens = job.calibration(self.source.um_per_px), read_lens(job, first)
        self.send: Send = sender(job.send, self._um_matrix()) if job.send is not None else lambda frame, estimate: None
        if self.source.live and job.resume:
            raise ValueError("resume: a camera does not go back to where it was")
        centers, size, mask = self.templates
        if job.stabilise is not None and not 0 <= job.stabilise < len(centers):
            raise ValueError(f"stabilise: expected a template from 0 to {len(centers) - 1}, got {job.stabilise}")
        options = job.options() | {"frame_mask": read_frame_mask(job), **job.rate(self.source.fps)}
        with threads_for(len(centers) * size[0] * size[1]):
            if crops is None:
                self.tracker = Tracker(first, centers, size, mask=mask, **options)
            else:
                near = torch.tensor(job.centers).double() if job.centers else None
                self.tracker, located = Tracker.find(crops, first, near=near, **options)
                refuse_doubt(located, near is not None)
        self.body = Body(self.tracker, lens=self.lens) if job.body else None
        if job.bodies is not None and len(centers) < 2:
            raise ValueError(f"bodies: expected two templates or more, got {len(centers)}")
        self.settings, self.first = settings_of(job, first), first

    def remarks(self) -> list[str]:
        """What people should know before: what was taken from the file, and what is strange about it."""
        remarks = list(self.source.notes)
        if self.job.fps is None and self.source.fps is not None:
            who = "camera" if self.source.live else "file"
            remarks.append(f"{self.source.fps:.6g} frames per second, as the {who} says")
        if self.job.um_per_px is None and self.calibration is not None:
            x, y = self.calibration.scales
            remarks.append(f"{x:.6g} um per px{'' if abs(y) == x else f' in x, {abs(y):.6g} in y'}, as the file says")
        if self.job.grid is not None:
            remarks.append(f"{len(self.templates.centers)} templates where there is texture enough")
        return remarks

    def run(
        self,
        progress: Callable[[int], None] = lambda done: None,
        watch: Callable[[Frame, Estimate], None] = lambda frame, estimate: None,
    ) -> Finished:
        """Track every frame and write track.csv, track.npz, track.png, summary.json and the videos.

        ``progress`` is told how many frames are done, ``watch`` is shown each with its poses. Ctrl-C, or a
        KeyboardInterrupt from one of them, ends the run and keeps what it had; so does an error, which is raised again
        once everything before it is written.
        """
        if self.source.live:
            self.tracker(self.first)  # a thread's first frame takes longer than all others, and a camera does not wait
        with claim(self.folder):
            films = [film for film in (self._overlay(), self._stabilised()) if film is not None]
            left = self._left(films)
            run = self._run(left, films)
            stopped: BaseException | None = None
            try:
                with run, as_it_comes() if self.source.live else nullcontext():
                    frames, live = self._frames(left, pictures=bool(films)), self.source.live
                    run.through(frames, progress, self.send, watch, live=live)
            except (KeyboardInterrupt, ValueError) as error:
                stopped = error
            except OSError as error:
                raise _told(error, run.done) from error
            if run.done:
                self._plot()
                self._write_bodies()
                self._remove_old({film.film.name for film in films})
            if isinstance(stopped, ValueError):
                raise stopped
        return Finished(*run.counts, self.folder, stopped is not None, run.latency)

    def run_part(self, first: int, last: int, progress: Callable[[int], None] = lambda done: None) -> None:
        """Track the frames from number ``first`` to ``last``, or those of them that the folder does not have yet, and
        leave them there as a run that was ended before its time: without results, to go on with."""
        with claim(self.folder):
            left = self._left([])
            run = self._run(left, [])
            if left is not None:
                first = _last(left, self.folder) + 1
            try:
                run.through(ahead(self.source.between(first, last)), progress)
            finally:
                run.track.leave()

    def _run(self, left: Unfinished | None, films: list[Pictures]) -> Run:
        """One that goes on where what is ``left`` ends."""
        run = Run(self.tracker, self.body, self._track_writer(left), films, self.job.stop_at_damage)
        if left is not None:
            run.go_on(left, self.folder)
        return run

    def _write_bodies(self) -> None:
        """body.csv, body.json and body.png, if there are bodies."""
        for name in BODY_FILES:
            (self.folder / name).unlink(missing_ok=True)
        if self.job.body or self.job.bodies is not None:
            seen = self.tracker, self.lens, self._um_matrix(), self.first
            write_bodies(self.folder, self.job.bodies, *seen)

    def _remove_old(self, films: set[str]) -> None:
        """What a result before had and this one does not."""
        for name in {"overlay", "stabilised"} - films:
            (self.folder / f"{name}.mp4").unlink(missing_ok=True)

    def _left(self, films: list[Pictures]) -> Unfinished | None:
        """What an unfinished run has left to go on with. ValueError if it was another one, or if nobody said so."""
        left = None if self.job.force else Unfinished.of(self.folder)
        if left is None:
            return None
        if not self.job.resume:
            raise ValueError(
                f"out: {self.folder} holds an unfinished run: --resume goes on with it, --force starts anew"
            )
        for name in left.settings | self.settings:
            before, now = left.settings.get(name), self.settings.get(name)
            if before != now:
                raise ValueError(f"resume: {name} was {before!r} in the run in {self.folder}, and is {now!r} now")
        # What templates have learned is in no journal: all of it has to be tracked again.
        whole = 0 if self.tracker.learns else min([left.frames, *(each.film.left for each in films)])
        return left._replace(frames=whole) if whole else None

    def _frames(self, left: Unfinished | None, *, pictures: bool) -> Iterator[Frame]:
        """Those that are not done yet, read ahead, with their pictures if there are films; a camera's as they come."""
        if self.source.live:
            return iter(self.source)
        frames = iter(self.source) if left is None else self.source.between(_last(left, self.folder) + 1)
        return ahead(map(with_picture, frames) if pictures else frames)

    def _track_writer(self, left: Unfinished | None) -> TrackWriter:
        """Of track.csv, track.npz and summary.json."""
        return TrackWriter(
            self.folder,
            status_names=STATUS_NAMES,
            reason_names=REASON_NAMES,
            origin_names=ORIGIN_NAMES,
            fps=self.source.fps,
            um_matrix=self._um_matrix(),
            settings=self.settings,
            unfinished=left,
        )

    def _overlay(self) -> OverlayWriter | None:
        """Of overlay.mp4, if that is wanted."""
        if not self.job.overlay:
            return None
        um, shapes, fps = self._um_matrix(), self.templates.shapes, self.source.fps
        if self.body is not None:
            shapes.append(self._body_size())
        return OverlayWriter(self.folder, shapes=shapes, status_names=STATUS_NAMES, fps=fps, um_matrix=um)

    def _body_size(self) -> tuple[int, int]:
        """Height and width that all templates take, px."""
        extent = (self.templates.centers.amax(0) - self.templates.centers.amin(0)).round().long().tolist()
        h, w = self.templates.size
        return extent[1] + h, extent[0] + w

    def _stabilised(self) -> StabilisedWriter | None:
        """Of stabilised.mp4, if that is wanted."""
        template = self.job.stabilise
        return None if template is None else StabilisedWriter(self.folder, template, fps=self.source.fps)

    def _um_matrix(self) -> Tensor | None:
        if self.calibration is None:
            return None
        return self.calibration.matrix(torch.zeros(1, dtype=torch.float64))[:2, :2]

    def _plot(self) -> None:
        from torch_ecc.plots import plot_track  # slow to import

        plot_track(self.folder / "track.npz", self.folder / "track.png", title=self.source.name)


def _last(left: Unfinished, folder: Path) -> int:
    """The number of the last frame that an unfinished run has done."""
    return int(left.records(folder)["frame"][-1])


def with_picture(frame: Frame) -> Frame:
    """A frame whose picture is made already: on the thread that reads ahead."""
    if frame.colours is None:
        return frame
    colours = frame.colours()
    return dataclasses.replace(frame, colours=lambda: colours)


def _told(error: OSError, done: int) -> OSError:
    """The same of a full disk, with what to do."""
    if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not done:
        return error
    words = f"{error.strerror}. {done} frames are done: with some room, the same command with --resume goes on"
    return OSError(error.errno, words)


def settings_of(job: TrackJob, first: Tensor) -> dict[str, Any]:
    """What a result depends on, as JSON knows it: the settings that were given, and the first frame by its checksum."""
    return given_settings(job) | {"first_frame_crc32": zlib.crc32(first.cpu().numpy().tobytes())}


def given_settings(job: TrackJob) -> dict[str, Any]:
    """The settings that were given, as JSON knows them, without those that change no result."""
    given = {k: v for k, v in dataclasses.asdict(job).items() if v not in (None, (), False)}
    found: dict[str, Any] = plain({k: v for k, v in given.items() if k not in NOT_OF_THE_RESULT})
    return found


def refuse_overwriting(folder: Path, names: Iterable[str]) -> None:
    """ValueError if ``folder`` holds a result."""
    there = [name for name in names if (folder / name).exists()]
    if there:
        raise ValueError(
            f"out: {folder} holds a result already ({there[0]}): --out names another folder, --force replaces it, and "
            "--resume goes on with one that is unfinished"
        )
