"""The report: one HTML file that holds everything, pictures too, and opens in any browser, on a phone and on paper."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from torch_ecc.paper.result import load_records


def write_report(path: Path, records: Iterable[Path]) -> None:
    """One page of the experiments whose records.json files are given, in that order; their pictures lie beside them."""
    template = files("torch_ecc.paper").joinpath("report.html").read_text(encoding="utf-8")
    page = Environment(autoescape=True, undefined=StrictUndefined).from_string(template)
    path.write_text(page.render(experiments=[_whole(file) for file in records]), encoding="utf-8")


def _whole(file: Path) -> dict[str, Any]:
    """What ``save_records`` wrote, with the pictures themselves; numbers with a limit or with a counterpart in the
    paper, which are ``compared`` in sight, and ``others``, which are folded away."""
    document = load_records(file)
    for picture in document["pictures"]:
        picture["data"] = base64.b64encode((file.parent / picture["file"]).read_bytes()).decode()
    compared = [record for record in document["records"] if "tolerance" in record or "paper" in record]
    others = [record for record in document["records"] if record not in compared]
    return document | {"compared": compared, "others": others}
