"""``torch-ecc reproduce``: run an experiment, keep what came out of it, and collect everything in one report.

The experiment NAME is ``run(quick, advance) -> Experiment`` of the module torch_ecc.paper.NAME, called in the pictures'
style.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from torch_ecc.io.output import check_folder, part, publish
from torch_ecc.paper.report import write_report
from torch_ecc.paper.result import Advance, Experiment, environment, load_records, save_records
from torch_ecc.plots.style import styled

NAMES = ("fig2", "fig3", "fig4", "table1", *(f"fig{n}" for n in range(6, 14)), "robustness", "body")
RECORDS = "records.json"
DPI = 130


def chosen(names: Sequence[str]) -> list[str]:
    """The experiments meant by ``names``, each once, in the paper's order; "all" means every one.

    ValueError, before any work, for a name that is not known and for none at all.
    """
    for name in names:
        if name not in (*NAMES, "all"):
            raise ValueError(f"reproduce: expected one of {', '.join(NAMES)} or all, got {name!r}")
    if not names:
        raise ValueError(f"reproduce: expected one or more of {', '.join(NAMES)} or all, got none")
    return [name for name in NAMES if name in names or "all" in names]


def run(name: str, out: str | Path, quick: bool, advance: Advance) -> Experiment:
    """Run the experiment ``name``; write out/name/*.png and records.json, and out/report.html anew.

    The report holds every experiment that was ever finished in ``out``. What is written is whole or not there at all:
    an interruption loses the experiment that was going on and nothing else. ValueError if ``out`` is a file.
    """
    folder = check_folder(out, "reproduce")
    chosen([name])
    started, worked = time.perf_counter(), time.process_time()
    with styled():
        experiment: Experiment = import_module(f"torch_ecc.paper.{name}").run(quick, advance)
    spent = {"seconds": time.perf_counter() - started, "cpu_seconds": time.process_time() - worked}
    save(experiment, folder / name, {"quick": quick} | {key: round(value, 1) for key, value in spent.items()})
    written = [path for each in NAMES if (path := folder / each / RECORDS).is_file()]
    write_report(part(folder, "report.html"), written)
    publish(folder, "report.html")
    return experiment


def save(experiment: Experiment, folder: Path, about: Mapping[str, Any]) -> None:
    """Pictures and records of an experiment, in place of those of an earlier run.

    ``about`` holds how it was run: "quick", "seconds" and "cpu_seconds".
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [f"{picture.name}.png" for picture in experiment.pictures]
    for picture, file in zip(experiment.pictures, files, strict=True):
        picture.figure.savefig(part(folder, file), dpi=DPI, format="png")
    date = datetime.now().astimezone().isoformat(timespec="seconds")
    save_records(experiment, part(folder, RECORDS), {**about, "date": date, "environment": environment()})
    earlier = load_records(folder / RECORDS)["pictures"] if (folder / RECORDS).is_file() else []
    publish(folder, *files, RECORDS)
    for old in {picture["file"] for picture in earlier} - set(files):
        (folder / old).unlink(missing_ok=True)
