"""What a batch leaves beside the recordings' own results: batch.csv, batch.png, poses.parquet, and what has failed."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from torch_ecc.commands.batch_unit import COLUMNS, TRACKED, Row, Work, inputs_of, read_json, same_versions
from torch_ecc.commands.jobs import BatchJob
from torch_ecc.commands.track import given_settings
from torch_ecc.io.output import append, create, part, publish
from torch_ecc.io.summary import versions, write_json

TABLE, PICTURE, POSES, FAILURES = "batch.csv", "batch.png", "poses.parquet", ".failed.json"
TYPES = {"frame": "int64", "template": "int32", "iterations": "int32"}
WORDS = ("file", "status", "reason", "origin", "damage")


def check_report(job: BatchJob) -> None:
    """ValueError if what is wanted cannot be written here."""
    if job.parquet and find_spec("pyarrow") is None:
        raise ValueError("parquet: pyarrow is not installed: pip install 'torch-ecc[parquet]'")


def write_report(folder: Path, rows: list[Row], job: BatchJob, *, anew: bool) -> None:
    """All of it; what takes time only if something has changed, or is not there."""
    with create(part(folder, TABLE)) as file:
        append(file, table_of(rows).encode())
    publish(folder, TABLE)
    tracked = [row for row in rows if row["status"] == TRACKED]
    if anew or not (folder / PICTURE).exists():
        _draw(folder, rows)
    if job.parquet and tracked and (anew or not (folder / POSES).exists()):
        _write_poses(folder, [row["folder"] for row in tracked])


def table_of(rows: Iterable[Row]) -> str:
    """The table as text: numbers with six digits, nothing where nothing is known."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_cell(row.get(name)) for name in COLUMNS] for row in rows)
    return text.getvalue()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    return "".join(c if c.isprintable() else "?" for c in str(value))


def _draw(folder: Path, rows: list[Row]) -> None:
    from torch_ecc.plots.batch import POINTS, Panel, plot_batch  # slow to import
    from torch_ecc.plots.blocks import blocks

    def panel(row: Row) -> Panel:
        if row["status"] != TRACKED:
            return Panel(row["folder"], None, row.get("words") or row["status"])
        every = max(row["frames"] // POINTS, 1)
        with np.load(folder / row["folder"] / "track.npz") as track:
            moved = np.concatenate([some["displacement"][:1] for some in blocks(track, ["displacement"], every)])
        return Panel(row["folder"], moved, f"{row['lost']} lost" if row["lost"] else "")

    plot_batch(map(panel, rows), folder / PICTURE)


def _write_poses(folder: Path, names: list[str]) -> None:
    """Every row of every track.csv, and whose it is; recordings one after the other, so that memory does not grow."""
    import pyarrow as pa
    from pyarrow import csv as tables
    from pyarrow import parquet

    headers = [(folder / name / "track.csv").open(encoding="utf-8").readline().strip().split(",") for name in names]
    columns = list(dict.fromkeys(column for header in headers for column in header))
    kinds = {
        column: pa.type_for_alias(TYPES.get(column, "string" if column in WORDS else "float64")) for column in columns
    }
    schema = pa.schema([("recording", pa.dictionary(pa.int32(), pa.string())), *kinds.items()])
    options = tables.ConvertOptions(column_types=kinds, include_columns=columns, include_missing_columns=True)
    with parquet.ParquetWriter(part(folder, POSES), schema, compression="zstd") as writer:
        for name in names:
            for block in tables.open_csv(folder / name / "track.csv", convert_options=options):
                whose = pa.DictionaryArray.from_arrays(pa.array([0] * len(block), pa.int32()), [name])
                writer.write_batch(pa.RecordBatch.from_arrays([whose, *block.columns], schema=schema))
    publish(folder, POSES)


class Failures:
    """What has failed in a way that it would again, and of which input and settings that was."""

    def __init__(self, folder: Path, known: dict[str, Any]) -> None:
        self.folder, self.known = folder, known

    @staticmethod
    def read(folder: Path) -> Failures:
        """As the last run has left them."""
        return Failures(folder, read_json(folder / FAILURES))

    def of(self, work: Work) -> Row | None:
        """The row of a recording that has failed and has not changed since."""
        told = self.known.get(work.name, {})
        same = (
            told.get("settings") == given_settings(work.job)
            and same_versions(told.get("versions", {}), work.versions)
            and told.get("row", {}).get("inputs") == inputs_of(work)
        )
        return told["row"] if same else None

    def write(self, failed: list[Row], works: list[Work]) -> None:
        """For the next run: what has failed of these works."""
        settings = {work.name: given_settings(work.job) for work in works}
        kept: dict[str, object] = {
            row["folder"]: {"settings": settings[row["folder"]], "versions": versions(), "row": row}
            for row in failed
            if row.get("lasting")
        }
        kept |= {name: told for name, told in self.known.items() if name not in settings}  # of other lists
        if kept or self.known:
            write_json(part(self.folder, FAILURES), kept)
            publish(self.folder, FAILURES)
