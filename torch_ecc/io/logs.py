"""Text tables as instruments write them: any encoding and separator, comments before the header, decimal commas.

What separates the columns, how many there are and which of them hold values is read off the rows at the end of the
file, where no preamble is; the table begins at the first row like those, and its names stand right above.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SAMPLE = 200  # rows from which the layout is read
SEPARATORS = ("\t", ";", ",", "|", None)  # None: any white space
UNITS = {"s", "sec", "ms", "us", "µs", "μs", "ns", "min", "h", "m", "mm", "um", "µm", "μm", "nm", "pm"}
UNITS |= {"rad", "mrad", "urad", "µrad", "μrad", "deg", "°", "V", "mV", "A", "K", "°C", "N", "Hz", "%", "-"}
COMMENT = ("#", "%", "//", "!")
MISSING = {
    "",
    "nan",
    "na",
    "n/a",
    "#n/a",
    "null",
    "none",
    "-",
    "--",
    "---",
    "nan(ind)",
    "-nan(ind)",
    "1.#qnan",
    "-1.#ind",
}
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)*|[.,]\d+)(e[+-]?\d+)?|[+-]?inf(inity)?", re.IGNORECASE)
_INSTANT = re.compile(
    r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}.*|\d{1,2}:\d{2}(:\d{2}.*|[.,]\d+)?"
)  # a date or a time of the day
BINARY = {b"PK\x03\x04": "a workbook", b"TDSm": "a TDMS file", b"\x89HDF": "an HDF5 file", b"MATLAB 5": "a MAT file"}


class Log(NamedTuple):
    """``names`` of the columns, or their numbers from 1 if there is no header; ``cells`` of each, text (S,); ``lines``
    of the file (S,) that the rows stand in."""

    path: Path
    names: tuple[str, ...]
    cells: tuple[NDArray[np.str_], ...]
    lines: NDArray[np.int64]

    def column(self, name: str) -> NDArray[np.str_]:
        """The cells of a column as text. ValueError, which lists the columns, if there is none of that name."""
        if name not in self.names:
            raise ValueError(f"{self.path}: column {name} is missing; columns found: {', '.join(self.names)}")
        return self.cells[self.names.index(name)]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The cells of a column as numbers, NaN where one is missing. ValueError with the line for another word."""
        cells = self.column(name)
        plain = np.char.lower(cells)
        empty = np.isin(plain, list(MISSING))
        try:
            return np.where(empty, "nan", _points(plain)).astype(np.float64)
        except ValueError:
            wrong = next(k for k, cell in enumerate(cells) if not empty[k] and not _NUMBER.fullmatch(cell))
            place = f"{self.path}: line {self.lines[wrong]}, column {name}"
            raise ValueError(f"{place}: expected a number, got {str(cells[wrong])!r}") from None

    def take(self, rows: NDArray[np.bool_]) -> Log:
        """The same columns with some of the rows."""
        return Log(self.path, self.names, tuple(column[rows] for column in self.cells), self.lines[rows])


class _Layout(NamedTuple):
    """What stands between cells, how many there are in a row, and which of them are ``values``."""

    separator: str | None
    width: int
    values: frozenset[int]

    def is_data(self, row: Sequence[str]) -> bool:
        """Is this one of the rows?"""
        fits = len(row) == self.width and any(_is_value(row[k]) for k in self.values)
        return fits and all(_is_value(row[k]) or row[k].lower() in MISSING for k in self.values)


def read_log(path: str | Path) -> Log:
    """The table in a text file. FileNotFoundError; ValueError if there is none, or for a row of another length."""
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"no such file: {path}")
    data = path.read_bytes()
    for start, kind in BINARY.items():
        if data.startswith(start):
            raise ValueError(f"{path}: expected a table in text, this is {kind}: save it as CSV first")
    text = _decode(data)
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    layout = _layout([line for _, line in lines[-SAMPLE:]])
    rows = [(number, _fitted(row, layout.width)) for number, row in _split(lines, layout.separator)]
    first = next((k for k, (_, row) in enumerate(rows) if layout.is_data(row)), None)
    if first is None:
        raise ValueError(f"{path}: expected a header and rows of numbers, found no two columns of numbers")
    names = _names(lines[:first], layout)
    body = [(number, row) for number, row in rows[first:] if any(row) and not row[0].startswith(COMMENT)]
    while not any(map(_is_value, body[-1][1])):
        body.pop()  # a line at the end that is no row
    if body[-1][0] == lines[-1][0] and not text.endswith(("\n", "\r")) and len(body[-1][1]) < layout.width:
        body.pop()  # a row whose writing was broken off
    for number, row in body:
        if len(row) != layout.width:
            raise ValueError(f"{path}: line {number} must have {layout.width} cells, got {len(row)}")
    cells = tuple(np.array(column) for column in zip(*(row for _, row in body), strict=True))
    return Log(path, names, cells, np.array([number for number, _ in body]))


def _decode(data: bytes) -> str:
    """Text of any of the encodings that instruments use."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    if data[1:200:2].count(0) > 50:
        return data.decode("utf-16-le", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")  # Windows of Western Europe


def _split(lines: Sequence[tuple[int, str]], separator: str | None) -> Iterator[tuple[int, list[str]]]:
    """Every line with its cells, without the space around them."""
    if separator is None:
        yield from ((number, line.split()) for number, line in lines)
        return
    reader = csv.reader((line for _, line in lines), delimiter=separator, skipinitialspace=True)
    yield from ((number, [cell.strip() for cell in row]) for (number, _), row in zip(lines, reader, strict=False))


def _fitted(row: list[str], width: int) -> list[str]:
    """A row without the empty cells and the words beyond ``width``."""
    while len(row) > width and not _is_value(row[-1]):
        row = row[:-1]
    return row


def _layout(sample: Sequence[str]) -> _Layout:
    """The separator under which most cells are values and fewest are not; the most common length of a row."""
    tables = {}
    for separator in SEPARATORS:
        split = (row for _, row in _split(list(enumerate(sample)), separator))
        tables[separator] = [row for row in split if len(row) > 1 and any(map(_is_value, row))]

    def score(separator: str | None) -> int:
        return sum((1 if _is_value(cell) else -1) for row in tables[separator] for cell in row if cell)

    separator = max(SEPARATORS, key=score)
    rows = tables[separator]
    width = Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
    whole = [row for row in rows if len(row) == width]
    columns = [[_is_value(row[k]) for row in whole if row[k]] for k in range(width)]
    return _Layout(separator, width, frozenset(k for k, column in enumerate(columns) if 2 * sum(column) > len(column)))


def _names(preamble: Sequence[tuple[int, str]], layout: _Layout) -> tuple[str, ...]:
    """The names right above the table, with the units of a second row if there is one; else numbers from 1."""
    above = [_head(line, layout) for _, line in preamble[-2:]]
    numbers = tuple(str(k + 1) for k in range(layout.width))
    if not above or above[-1] is None:
        return numbers
    names = list(above[-1])
    if len(above) == 2 and above[0] is not None and any(names) and all(map(_is_unit, names)):
        names = [f"{name} [{unit.strip('[]()')}]" if unit else name for name, unit in zip(above[0], names, strict=True)]
    names = [name or number for name, number in zip(names, numbers, strict=True)]
    return tuple(name if name not in names[:k] else f"{name} ({k + 1})" for k, name in enumerate(names))


def _head(line: str, layout: _Layout) -> list[str] | None:
    """The names in a line, None if it has not one for each column."""
    text = line.strip().lstrip("#%!/").strip() if line.lstrip().startswith(COMMENT) else line
    for cells in (next(_split([(0, text)], layout.separator))[1], re.split(r"\s{2,}|[\t,;]\s*", text), text.split()):
        own, more = cells[: layout.width], cells[layout.width :]
        if len(own) == layout.width - 1 > 1:
            own.append("")  # every row may end with a separator
        if len(own) == layout.width and all(not cell or cell.lower() == "comment" for cell in more):
            return [cell.strip().strip('"') for cell in own]
    return None


def _is_unit(cell: str) -> bool:
    """Is this a unit, in brackets or one that is known?"""
    return not cell or bool(re.fullmatch(r"[\[(][^\])]*[\])]", cell)) or cell in UNITS


def _is_value(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _INSTANT.fullmatch(cell)) or (bool(cell) and cell.lower() in MISSING)


def _points(cells: NDArray[np.str_]) -> NDArray[np.str_]:
    """Numbers with a decimal point: commas are that, unless the points are, and then they part thousands."""
    comma, point = np.char.find(cells, ","), np.char.find(cells, ".")
    if not (comma >= 0).any():
        return cells
    if ((comma >= 0) & (point > comma)).any():
        return np.char.replace(cells, ",", "")
    if ((point >= 0) & (comma > point)).any():
        cells = np.char.replace(cells, ".", "")
    return np.char.replace(cells, ",", ".")
