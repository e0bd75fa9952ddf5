"""Fill a frozen dataclass of settings from a TOML file; what the file says wrongly is an error before any work."""

from __future__ import annotations

import dataclasses
import tomllib
import types
import typing
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file. FileNotFoundError if it is missing, ValueError with the line if it is malformed."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"config: no such file: {path}")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"config: {path} is not valid TOML: {error}") from error


def build(kind: type[T], values: dict[str, Any], where: str) -> T:
    """``kind(**values)`` with lists as tuples. ValueError for an unknown key or a value of another type."""
    hints = typing.get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for key in values:
        if key not in known:
            close = get_close_matches(key, known, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(known)}"
            raise ValueError(f"{where}: unknown key {key!r} ({hint})")
    return kind(**{key: _convert(value, hints[key], f"{where}: {key}") for key, value in values.items()})


def _convert(value: Any, hint: Any, where: str) -> Any:
    """``value`` as the type ``hint``: int to float, list to tuple. ValueError otherwise."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        for option in arguments:
            try:
                return _convert(value, option, where)
            except ValueError:
                continue
        raise ValueError(f"{where} must be {_name(hint)}, got {value!r}")
    if origin is tuple and isinstance(value, list | tuple):
        many = arguments[1:] == (...,)
        if not many and len(value) != len(arguments):
            raise ValueError(f"{where} must have {len(arguments)} values, got {value!r}")
        kinds = arguments[:1] * len(value) if many else arguments
        return tuple(_convert(v, kind, where) for v, kind in zip(value, kinds, strict=True))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if origin is None and isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
        return value
    raise ValueError(f"{where} must be {_name(hint)}, got {value!r}")


def _name(hint: Any) -> str:
    return getattr(hint, "__name__", str(hint)) if typing.get_origin(hint) is None else str(hint)
