"""Call a constructor with the values of a configuration: its signature says which keys and types are right."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

WORDS: dict[Any, str] = {float: "a number", int: "a whole number", bool: "true or false", str: "text", Path: "a path"}


def fill(make: Callable[..., T], values: Any, where: str, *, folder: Path, **given: Any) -> T:
    """``make(**values, **given)`` with values converted to the types that ``make`` declares.

    Integers become floats, lists tuples, tables dataclasses, and relative paths start at ``folder``. ValueError, which
    names ``where`` and the key, for a key that ``make`` does not know, that is missing, or of another type.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{where} must be a table of settings, got {values!r}")
    parameters = {k: v for k, v in inspect.signature(make).parameters.items() if k not in given}
    hints = typing.get_type_hints(make)
    for key in values:
        if key not in parameters:
            raise ValueError(f"{where}: unknown key {key!r}, known are {', '.join(parameters) or 'none'}")
    for key, parameter in parameters.items():
        if parameter.default is parameter.empty and key not in values:
            raise ValueError(f"{where}: missing key {key!r}")
    return make(**{k: _convert(v, hints[k], f"{where}: {k}", folder) for k, v in values.items()}, **given)


def choose(kinds: Mapping[str, Callable[..., T]], values: Any, where: str, *, folder: Path) -> T:
    """``fill`` for the constructor that the key ``kind`` names. ValueError that lists the known ones otherwise."""
    if not isinstance(values, Mapping):
        raise ValueError(f"{where} must be a table of settings, got {values!r}")
    kind = str(values.get("kind"))
    if kind not in kinds:
        raise ValueError(f"{where}: kind must be one of {', '.join(kinds)}, got {values.get('kind')!r}")
    rest = {key: value for key, value in values.items() if key != "kind"}
    return fill(kinds[kind], rest, f"{where} {kind}", folder=folder)


def _convert(value: Any, hint: Any, where: str, folder: Path) -> Any:
    """``value`` as the declared type ``hint``. ValueError if it is none."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _first(value, arguments, where, folder)
    if _is_plain(value, hint):
        return value
    if hint is Path and isinstance(value, str):
        return folder / value
    if is_dataclass(hint) and isinstance(value, Mapping):
        return fill(typing.cast("Callable[..., Any]", hint), value, where, folder=folder)
    if origin in (tuple, Sequence) and isinstance(value, list | tuple):
        return _row(value, arguments, where, folder)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    raise ValueError(f"{where} must be {_name(hint)}, got {value!r}")


def _is_plain(value: Any, hint: Any) -> bool:
    """Is the value of the declared type as it stands? True and False are no numbers."""
    if typing.get_origin(hint) is typing.Literal:
        return value in typing.get_args(hint)
    if not isinstance(hint, type) or typing.get_origin(hint) is not None:
        return False
    return isinstance(value, hint) and not (hint in (int, float) and isinstance(value, bool))


def _first(value: Any, options: tuple[Any, ...], where: str, folder: Path) -> Any:
    """The first of a union's types that takes the value."""
    for option in options:
        try:
            return _convert(value, option, where, folder)
        except ValueError:
            if isinstance(value, Mapping):  # what is wrong inside a table says more than that the table is wrong
                raise
    names = " or ".join(_name(option) for option in options if option is not type(None))
    raise ValueError(f"{where} must be {names}, got {value!r}")


def _row(value: Any, arguments: tuple[Any, ...], where: str, folder: Path) -> tuple[Any, ...]:
    """A list as a tuple: of fixed length for tuple[a, b], of any for tuple[a, ...] and Sequence[a]."""
    many = len(arguments) == 1 or arguments[1:] == (...,)
    if not many and len(value) != len(arguments):
        raise ValueError(f"{where} must have {len(arguments)} values, got {value!r}")
    kinds = arguments[:1] * len(value) if many else arguments
    return tuple(_convert(v, kind, where, folder) for v, kind in zip(value, kinds, strict=True))


def _name(hint: Any) -> str:
    """A type in the words of someone who writes a configuration."""
    if hint in WORDS:
        return WORDS[hint]
    if typing.get_origin(hint) is typing.Literal:
        return "one of " + ", ".join(map(repr, typing.get_args(hint)))
    return getattr(hint, "__name__", str(hint)) if typing.get_origin(hint) is None else str(hint)
