"""One long recording in parts, tracked side by side and joined as if one run had tracked it.

Every part has the templates of the first frame. It begins some frames ahead of its own ones, with a search for the
templates, so that at its seam it has forgotten how it began. There its pose must be the one of the part before it;
where it is not (the place was ambiguous, or nothing was seen), the part is tracked from its neighbour's last pose.
What is joined are journals, as a run leaves them that was stopped; the run of the whole goes on with them, and has
nothing left to do but to write the results.
"""

from __future__ import annotations

import csv
import io
import math
import os
import shutil
import time
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_ecc.commands.batch_unit import (
    NOTE,
    Row,
    Watch,
    Work,
    finished_row,
    found,
    inputs_of,
    part_folder,
    publish_whole,
    read_json,
    row_of,
    same_versions,
    told,
)
from torch_ecc.commands.jobs import span
from torch_ecc.commands.run import restore, state_of
from torch_ecc.commands.track import Session, given_settings
from torch_ecc.core.estimate import Status
from torch_ecc.io import open_frames
from torch_ecc.io.journal import Journal, Unfinished, rows_file
from torch_ecc.io.summary import write_json

PIECES = ".parts"  # in the folder of all results: parts that are done, until they are joined
AHEAD = 64  # frames that a part tracks before its own
SEAM = (1e-4, 1e-4, 1e-6)  # px, px, rad: two parts agree so well, or one of them is tracked again


class Seam(NamedTuple):
    """Where a part begins: how far it was from the part before it, at most of all templates, whole turns left out, and
    whether it was ``tracked_through`` from there instead."""

    frame: int
    apart_px: float | None
    apart_rad: float | None
    tracked_through: bool


def cut(work: Work, parts: int) -> list[range]:
    """The numbers of the frames of each part, of ``parts`` at most; none if the recording cannot be gone into at any
    frame, or is so short that parts would mostly track what others track, too."""
    job = work.job
    choice = {name: getattr(job, name) for name in ("channel", "slice", "position")}
    source = open_frames(job.input if work.frames is None else work.frames, **choice)
    if job.frames is not None:
        source = source[span(job.frames)]
    numbers = source.numbers
    if numbers is None:
        return []
    parts = min(parts, len(numbers) // (4 * AHEAD))
    ends = [len(numbers) * k // parts for k in range(parts + 1)] if parts > 1 else []
    return [numbers[a:b] for a, b in pairwise(ends)]


def piece_of(work: Work, number: int) -> Path:
    """Where a part stands once it is whole."""
    return work.out / PIECES / work.name / str(number)


def do_part(work: Work, number: int, own: range) -> Row:
    """Track the part of that ``number`` with its ``own`` frames, unless that is done already."""
    return told(work, lambda: _part_found(work, number, own) or _track_part(work, number, own))


def do_join(work: Work, parts: Sequence[range]) -> Row:
    """Join the parts, which are done."""
    return told(work, lambda: found(work) or _join(work, parts))


def _part_found(work: Work, number: int, own: range) -> Row | None:
    told_of = read_json(piece_of(work, number) / NOTE)
    same = same_versions(told_of.get("versions", {}), work.versions)
    return told_of["row"] if same and told_of.get("of") == _described(work, own) else None


def _described(work: Work, own: range) -> dict[str, Any]:
    """What a part is of, as JSON knows it."""
    return {"settings": given_settings(work.job), "inputs": inputs_of(work), "frames": [own[0], own[-1], own.step]}


def _track_part(work: Work, number: int, own: range) -> Row:
    described, started = _described(work, own), time.perf_counter()
    with part_folder(work.out, f"{work.name}-{number}") as folder:
        session = work.session(folder, force=True)
        begin = own[0] if number == 0 else max(own[0] - own.step * AHEAD, (session.source.numbers or own)[0])
        session.run_part(begin, own[-1], Watch(work, len(own), f"{work.name}/{number}"))
        row = row_of(work, "part", frames=len(own), wall_s=time.perf_counter() - started)
        write_json(folder / NOTE, {"row": row, "of": described, "versions": work.versions})
        piece = piece_of(work, number)
        shutil.rmtree(piece, ignore_errors=True)
        piece.parent.mkdir(parents=True, exist_ok=True)
        os.rename(folder, piece)
    return row


def _join(work: Work, parts: Sequence[range]) -> Row:
    with part_folder(work.out, work.name) as folder:
        inputs, started = inputs_of(work), time.perf_counter()
        session = work.session(folder, resume=True)
        watch = Watch(work, sum(map(len, parts)))
        folder.mkdir(parents=True)
        seams = [_append(session, piece_of(work, k), own, watch) for k, own in enumerate(parts)]
        finished = session.run(watch)
        row = finished_row(work, finished, folder, remarks=session.remarks())
        tracking = sum(read_json(piece_of(work, k) / NOTE)["row"]["wall_s"] for k in range(len(parts)))
        row |= {"wall_s": tracking + time.perf_counter() - started}
        publish_whole(work, folder, row, {"inputs": inputs, "seams": [seam._asdict() for seam in seams[1:]]})
    forget_parts(work.out, {each.name for each in (work.out / PIECES).iterdir()} - {work.name})
    return row


def forget_parts(out: Path, kept: set[str]) -> None:
    """Remove the parts of all other recordings than those ``kept``."""
    for folder in (out / PIECES).glob("*/"):
        if folder.name not in kept:
            shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        (out / PIECES).rmdir()


# ---- seams -----------------------------------------------------------------------------------------------------------


def _append(session: Session, piece: Path, own: range, watch: Watch) -> Seam:
    """Add the frames of a part to what is joined, or track them from its end."""
    watch.check()
    part, joined = Unfinished.of(piece), Unfinished.of(session.folder)
    if part is None:
        raise ValueError(f"batch: the part in {piece} holds no frames")
    records = part.records(piece)
    begin = bisect_left(records["frame"], own[0])  # without reading all of them
    if joined is None:
        _copy(session, (piece, part), begin, np.zeros(part.form.templates, np.int64))
        return Seam(own[0], 0.0, 0.0, tracked_through=False)
    before, after = joined.records(session.folder)[-1], records[begin - 1]
    apart = np.array(after["pose"] - before["pose"])
    turns = np.nan_to_num(np.round(apart[:, 2] / (2 * math.pi)))
    apart[:, 2] -= 2 * math.pi * turns
    sure = all((each["status"] == Status.CONVERGED).all() for each in (before, after))
    through = not (sure and (np.abs(apart) <= SEAM).all())
    if through:
        session.run_part(own[0], own[-1], watch)
    else:
        _copy(session, (piece, part), begin, -turns.astype(np.int64))
    px, rad = (float(np.abs(apart[:, which]).max()) for which in (slice(2), 2))
    return Seam(own[0], px if math.isfinite(px) else None, rad if math.isfinite(rad) else None, through)


def _copy(session: Session, part: tuple[Path, Unfinished], begin: int, turns: NDArray[np.int64]) -> None:
    """Append a part's frames from index ``begin`` on, each template turned by so many whole ``turns`` (R,)."""
    piece, left = part
    joined = Unfinished.of(session.folder)
    if joined is None:
        journal = Journal.begin(session.folder, left.form, session.settings)
    else:
        journal = Journal.go_on(session.folder, joined)
    try:
        with rows_file(piece).open("rb") as file:
            header = next(file)
            lines = islice(file, begin * left.form.templates, None)
            for some in left.blocks(piece, begin):
                rows: Iterator[bytes] = islice(lines, len(some) * left.form.templates)
                if turns.any():
                    rows = _turned(session, some, turns, (header, rows))
                journal.extend(some, b"".join(rows))
    finally:
        journal.close()


def _turned(
    session: Session, records: NDArray[Any], turns: NDArray[np.int64], table: tuple[bytes, Iterator[bytes]]
) -> Iterator[bytes]:
    """Turn ``records`` (F,), in place, and their rows in the ``table``, a header and lines."""
    angle = 2 * math.pi * turns
    for name in ("pose", "displacement"):
        records[name][..., 2] += angle
    restore(state_of(session.tracker), records["state"][-1].tobytes())
    session.tracker.pose[:, 2] += session.tracker.pose.new_tensor(angle)
    state = b"".join(part.cpu().numpy().tobytes() for part in state_of(session.tracker))
    records["state"][-1] = np.void(state)  # only what is last is gone on from
    header, lines = table
    names = header.decode().strip().split(",")
    columns = [(names.index(name), field) for name, field in (("theta_rad", "pose"), ("dtheta_rad", "displacement"))]
    for index, cells in enumerate(csv.reader(line.decode() for line in lines)):
        for column, field in columns:
            if cells[column]:
                cells[column] = f"{records[field].reshape(-1, 3)[index, 2]:.9f}"
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(cells)
        yield text.getvalue().encode()
