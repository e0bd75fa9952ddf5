"""Which columns of a log are time, x, y and theta, and in which units: by their names, or as the user says."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_ecc.io.logs import MISSING, Log

ROLES = ("time", "x", "y", "theta")
_TIME = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_LENGTH = {"um": 1.0, "micron": 1.0, "microns": 1.0, "nm": 1e-3, "pm": 1e-6, "mm": 1e3, "cm": 1e4, "m": 1e6}
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "nrad": 1e-9, "deg": math.pi / 180, "mdeg": math.pi / 180e3}
_ANGLE |= {"arcsec": math.pi / 648e3, "arcmin": math.pi / 10800}
UNITS = {"time": _TIME, "x": _LENGTH, "y": _LENGTH, "theta": _ANGLE}  # to s, um, rad
NAMES = {
    "time": {"time", "t", "timestamp", "timestamps", "elapsed", "zeit", "datetime", "dateandtime", "epoch", "clock"},
    "x": {"x"},
    "y": {"y"},
    "theta": {"theta", "thetaz", "rz", "rotz", "phi", "angle", "yaw", "rotation"}
    | {f"{letter}{axis}" for letter in "θϑφϕ" for axis in ("", "z")},
}
FILLERS = {"pos", "position", "positions", "stage", "sensor", "axis", "cds", "value", "actual", "measured", "elapsed"}
EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))  # a number so large counts these since 1970
ABSCISSA = {"x_value", "x-value"}  # what LabVIEW calls the time
DAY = 86400.0
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d*)?))?\s*([ap])?\.?m?\.?$", re.IGNORECASE)
_MINUTES = re.compile(r"(\d{1,2}):(\d{2}[.,]\d+)$")  # as spreadsheets show times with fractions
_ISO = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{1,2}:")


class Column(NamedTuple):
    """A column by its ``name`` in the log, and its ``unit``; "" for times in words."""

    name: str
    unit: str


def choose(log: Log, wanted: str | None = None) -> dict[str, Column]:
    """The column of each of time, x, y and theta that there is.

    ``wanted``: as ``"time=Stamp:ms, x=CH 1:um, theta="``: a column's name or number, its unit after a colon unless the
    header has it, nothing for a column that is not to be taken; what is not mentioned is found by its name. ValueError,
    which lists the columns, for what is not there, may be several, or has no unit.
    """
    told = _told(wanted)
    found = {}
    for role in ROLES:
        if role in told:
            if told[role]:
                found[role] = _named(log, role, told[role])
        elif (column := _guessed(log, role)) is not None:
            found[role] = column
    return found


def values(log: Log, role: str, column: Column) -> NDArray[np.float64]:
    """What a column holds, in s, um or rad; NaN where a cell is missing."""
    if not column.unit:
        return _instants(log, column.name)
    return UNITS[role][column.unit] * log.numbers(column.name)


def _told(wanted: str | None) -> dict[str, str]:
    """The parts of ``--columns`` by role."""
    if wanted is None:
        return {}
    parts = re.split(r"(?:^|[,;]|\s)\s*(\w+)\s*=", wanted)
    told = dict(zip(parts[1::2], (part.strip(" ,;") for part in parts[2::2]), strict=True))
    if parts[0].strip() or not told or not set(told) <= set(ROLES):
        raise ValueError(f"columns: expected 'time=NAME, x=NAME:UNIT, ...' with {', '.join(ROLES)}, got {wanted!r}")
    return told


def _named(log: Log, role: str, text: str) -> Column:
    """The column that was asked for, by name or number, with its unit."""
    name, _, unit = text.rpartition(":")
    known = _unit(unit, role)
    if not name or known is None:
        name, known = text, None
    if name not in log.names and name.isdecimal() and 1 <= int(name) <= len(log.names):
        name = log.names[int(name) - 1]
    if name not in log.names:
        raise ValueError(f"columns: {log.path} has no column {name!r} for {role}; columns found: {_listed(log)}")
    return Column(name, known if known is not None else _unit_of(log, role, name))


def _guessed(log: Log, role: str) -> Column | None:
    """The one column whose name says that it is this."""
    fitting = [name for name in log.names if _says(name, role)]
    fitting = [name for name in fitting if _unit(_parts(name)[1], role) is not None] or fitting
    if len(fitting) > 1:
        raise ValueError(f"{log.path}: {role} may be any of {', '.join(fitting)}: choose one, --columns '{role}=NAME'")
    return Column(fitting[0], _unit_of(log, role, fitting[0])) if fitting else None


def _says(name: str, role: str) -> bool:
    """Does a name, without its unit and words that say nothing, mean this?"""
    if name.lower() in ABSCISSA:
        return role == "time"
    bare, _ = _parts(name)
    words = [word for word in re.split(r"[\W_]+|(?<=[a-z])(?=[A-Z])", bare) if word]
    words = [word.lower() for word in words]
    rest = [word for word in words if word not in FILLERS] or words
    return "".join(rest) in NAMES[role]


def _parts(name: str) -> tuple[str, str]:
    """Name and unit of "x [um]", "x (um)", "x / um", "x in um", "x, um" and "x_um"; no unit in other names."""
    match = re.fullmatch(r"(.*?)\s*(?:\[(.*)\]|\((.*)\)|\s/\s*(.*)|/(.*)|\sin\s(.*)|,\s*(.*)|[_ ]([a-zA-Zµμ°]+))", name)
    if not match:
        return name, ""
    unit = next(group for group in match.groups()[1:] if group is not None)
    if match[8] is not None and all(_unit(unit, role) is None for role in ROLES):
        return name, ""
    return match[1], unit.strip()


def _unit(text: str, role: str) -> str | None:
    """The unit of that role that a text is, None if it is none."""
    plain = text.strip().replace("µ", "u").replace("μ", "u").replace("°", "deg").replace("degrees", "deg")
    plain = plain if plain in UNITS[role] else plain.lower()
    return plain if plain in UNITS[role] else None


def _unit_of(log: Log, role: str, name: str) -> str:
    """The unit of a column by its name; of times without one by their looks."""
    unit = _parts(name)[1]
    known = _unit(unit, role)
    if role == "time":
        return _unit_of_time(log, name, known)
    if known is None:
        said, example = f"is in {unit!r}" if unit else "has no unit", "deg" if role == "theta" else "um"
        known_ones = ", ".join(UNITS[role])
        raise ValueError(
            f"{log.path}: column {name} {said}: expected {known_ones}, as in --columns '{role}={name}:{example}'"
        )
    return known


def _unit_of_time(log: Log, name: str, known: str | None) -> str:
    """The unit of the header, "" for times in words, that of a number since 1970 by its size, else s."""
    cells = [cell for cell in log.column(name)[:100].tolist() if cell.lower() not in MISSING]
    if cells and any(form.search(cells[0]) for form in (_ISO, _CLOCK, _MINUTES)):
        return ""
    if known is not None:
        return known
    largest = float(np.nanmax(np.abs(log.numbers(name)), initial=0.0))
    return next((unit for size, unit in EPOCHS if largest > size), "s")


def _instants(log: Log, name: str) -> NDArray[np.float64]:
    """Dates with times, or times of the day, in s; a clock that starts again at midnight goes on."""
    cells = log.column(name).tolist()
    read = _since_1970 if cells and _ISO.match(cells[0]) else _of_day
    seconds = np.full(len(cells), math.nan)
    for k, cell in enumerate(cells):
        if cell.lower() not in MISSING:
            try:
                seconds[k] = read(cell)
            except ValueError:
                place = f"{log.path}: line {log.lines[k]}, column {name}"
                raise ValueError(f"{place}: expected a time such as {cells[0]!r}, got {cell!r}") from None
    if read is _of_day:
        seconds += DAY * np.concatenate(([0.0], np.cumsum(np.diff(seconds) < -DAY / 2)))
    return seconds


def _since_1970(cell: str) -> float:
    when = datetime.fromisoformat(cell.replace(",", "."))
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


def _of_day(cell: str) -> float:
    short = _MINUTES.match(cell)
    if short:
        return 60.0 * int(short[1]) + float(short[2].replace(",", "."))
    match = _CLOCK.search(cell)
    if not match:
        raise ValueError(cell)
    hours, minutes, seconds, half = match.groups()
    noon = {None: 0, "a": 0 if hours != "12" else -12, "p": 12 if hours != "12" else 0}[half and half.lower()]
    return 3600.0 * (int(hours) + noon) + 60.0 * int(minutes) + float((seconds or "0").replace(",", "."))


def _listed(log: Log) -> str:
    return ", ".join(log.names)
