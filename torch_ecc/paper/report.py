"""The report: one HTML file that holds everything, pictures too, and opens in any browser, on a phone and on paper."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from torch_ecc.paper.result import load_records

PAPER = (
    "An Improved Template-Matching-Based Pose Tracking Method for Planar Nanopositioning Stages Using Enhanced "
    "Correlation Coefficient (Li, Zhang, Yao, Zhu, Fatikow)"
)
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1b1b; max-width: 62rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.7rem; line-height: 1.2; }
h2 { font-size: 1.35rem; margin-top: 3rem; border-top: 2px solid; padding-top: .6rem; }
a { color: #0b5c8a; }
figure { margin: 1.5rem 0; }
img { width: 100%; min-width: 40rem; height: auto; }
h3 { font-size: 1rem; margin: 1.6rem 0 0; }
figcaption, .small { color: #555; font-size: .9rem; margin: .2rem 0; }
.wide { overflow-x: auto; margin: .6rem 0 1.2rem; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .9rem .25rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #ddd; }
th { border-bottom: 1px solid #1b1b1b; }
td { white-space: nowrap; }
td:first-child { white-space: normal; min-width: 11rem; }
.kept { color: #0b6e4f; }
.missed { color: #b3261e; font-weight: 600; }
summary { cursor: pointer; }
@media print {
  body { font-size: 10pt; max-width: none; padding: 0; }
  figure, tr { break-inside: avoid; }
  .wide { overflow: visible; }
  td { white-space: normal; }
  img { min-width: 0; }
}
"""


def write_report(path: Path, records: Iterable[Path]) -> None:
    """One page of the experiments whose records.json files are given, in that order; their pictures lie beside them."""
    documents = [(load_records(file), file.parent) for file in records]
    body = "".join(_section(document, folder) for document, folder in documents)
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>torch_ecc: the paper reproduced</title><style>{STYLE}</style></head><body>"
        f"<h1>The paper's figures and tables, reproduced</h1><p>{escape(PAPER)}. Our numbers beside the paper's.</p>"
        f"{_overview([document for document, _ in documents])}{body}</body></html>\n"
    )
    path.write_text(page, encoding="utf-8")


def _overview(documents: Sequence[dict[str, Any]]) -> str:
    rows = []
    for document in documents:
        limited = [record for record in document["records"] if "tolerance" in record]
        kept = sum(record["kept"] for record in limited)
        verdict = _mark(kept == len(limited), f"{kept} of {len(limited)}") if limited else ""
        link = f'<a href="#{escape(document["experiment"])}">{escape(document["title"])}</a>'
        length = "quick" if document["quick"] else "full"
        date = escape(document["date"][:16].replace("T", " "))
        rows.append((link, verdict, length, f"{document['seconds']:.0f} s", date))
    return _table(("experiment", "numbers within their limits", "run", "time", "date"), rows)


def _section(document: dict[str, Any], folder: Path) -> str:
    length = "Quick run" if document["quick"] else "Full run"
    spent = f"{document['seconds']:.1f} s, {document['cpu_seconds']:.1f} s of a processor"
    about = [f"{length}, {spent}, seed {document['seed']}"]
    about += [f"{name} {value}" for name, value in document["environment"].items()]
    parts = [
        f'<section id="{escape(document["experiment"])}"><h2>{escape(document["title"])}</h2>',
        *(_picture(folder / picture["file"], picture["caption"]) for picture in document["pictures"]),
        "<ul>" + "".join(f"<li>{escape(remark)}</li>" for remark in document["remarks"]) + "</ul>",
        *(_words(table) for table in document["tables"]),
        _numbers(document["records"]),
        f'<p class="small">{escape(", ".join(about))}</p></section>',
    ]
    return "\n".join(parts)


def _picture(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{escape(caption)}">'
    return f'<figure><div class="wide">{image}</div><figcaption>{escape(caption)}</figcaption></figure>'


def _words(table: dict[str, Any]) -> str:
    head = f'<h3>{escape(table["title"])}</h3><p class="small">{escape(table["note"])}</p>'
    return head + _table(map(escape, table["header"]), [map(escape, map(str, row)) for row in table["rows"]])


def _numbers(records: Sequence[dict[str, Any]]) -> str:
    """Numbers with a limit or with a counterpart in the paper in sight, the others folded away."""
    header = ("number", "ours", "paper", "limit", "")
    compared = [record for record in records if "tolerance" in record or "paper" in record]
    others = [record for record in records if record not in compared]
    shown = f"<h3>Our numbers beside the paper's</h3>{_table(header, map(_number, compared))}" if compared else ""
    if not others:
        return shown
    folded = _table(header[:2], [_number(record)[:2] for record in others])
    return f"{shown}<details><summary>{len(others)} more numbers</summary>{folded}</details>"


def _number(record: dict[str, Any]) -> tuple[str, ...]:
    unit = f" {escape(record['unit'])}" if record["unit"] not in ("", "1") else ""
    paper = f"{record['paper']:.4g}{unit}" if "paper" in record else ""
    limit = verdict = ""
    if "tolerance" in record:
        limit = f"{'≤' if record['better'] == 'lower' else '≥'} {record['tolerance']:.4g}{unit}"
        verdict = _mark(record["kept"], "kept" if record["kept"] else "not kept")
    value = "not finite" if record["value"] is None else f"{record['value']:.4g}{unit}"
    return escape(record["name"]), value, paper, limit, verdict


def _mark(kept: bool, text: str) -> str:
    return f'<span class="{"kept" if kept else "missed"}">{"✓" if kept else "✗"} {text}</span>'


def _table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Cells are HTML already."""
    head = "".join(f"<th>{name}</th>" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
