"""Settings from TOML: a table fills the constructor whose parameters it names, and what does not fit has words.

Types are checked by pydantic, strictly: a number is no text and true is no number, but an integer serves as a float.
"""

from __future__ import annotations

import json
import tomllib
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, fields, is_dataclass
from difflib import get_close_matches
from inspect import Parameter, get_annotations, signature
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from pydantic import ConfigDict, ValidationError, create_model
from pydantic_core import ErrorDetails

T = TypeVar("T")

STRICT = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)
UNKNOWN = {"extra_forbidden", "unexpected_keyword_argument"}  # pydantic's names of one error


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file. FileNotFoundError if it is missing, ValueError with the line if it is malformed."""
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"config: no such file: {path}")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError(f"config: {path} is not valid TOML: it is nested too deeply") from error
    except ValueError as error:  # also for bytes that are no text, and numbers of thousands of digits
        raise ValueError(f"config: {path} is not valid TOML: {error}") from error


def fill(make: Callable[..., T], values: Any, where: str, *, folder: Path | str = ".", **given: Any) -> T:
    """``make(**values, **given)`` with the values as the types that ``make`` declares.

    Integers become floats, lists tuples, tables dataclasses, and relative paths start at ``folder``. ValueError, which
    names ``where`` and the key, for a key that ``make`` does not know, that is missing, or of another type.
    """
    hints, parameters = typing.get_type_hints(make), signature(make).parameters
    wanted: dict[str, Any] = {
        name: (hints[name], ... if parameter.default is Parameter.empty else parameter.default)
        for name, parameter in parameters.items()
        if name not in given
    }
    refuse_unknown(as_table(values, where), list(wanted), where)
    try:
        # By way of JSON, because a list there is what a tuple is made from even where types are strict.
        form = create_model("Form", __config__=STRICT, **wanted).model_validate_json(json.dumps(values, default=str))
    except ValidationError as error:
        _refuse(make, values, error.errors(), where)
    found = {name: getattr(form, name) for name in values}
    return make(**{k: Path(folder) / v if isinstance(v, Path) else v for k, v in found.items()}, **given)


def choose(kinds: Mapping[str, Callable[..., T]], values: Any, where: str, *, folder: Path | str = ".") -> T:
    """``fill`` for the constructor that the key ``kind`` names. ValueError that lists the known ones otherwise."""
    kind = as_table(values, where).get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"{where}: kind must be one of {', '.join(kinds)}, got {kind!r}")
    return fill(kinds[kind], {k: v for k, v in values.items() if k != "kind"}, f"{where} {kind}", folder=folder)


def as_table(values: Any, where: str) -> Mapping[str, Any]:
    """The values if they are a table. ValueError otherwise."""
    if not isinstance(values, Mapping):
        raise ValueError(f"{where} must be a table of settings, got {values!r}")
    return values


def refuse_unknown(keys: Iterable[str], known: Sequence[str], where: str) -> None:
    """ValueError for the first of ``keys`` that is not ``known``, with the one that it may have been meant to be."""
    for key in keys:
        if key not in known:
            close = get_close_matches(key, known, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(known) or 'none'}"
            raise ValueError(f"{where}: unknown key {key!r} ({hint})")


def _refuse(make: Callable[..., Any], values: Any, errors: list[ErrorDetails], where: str) -> NoReturn:
    """ValueError for the error that says most: a misspelt key before one missing for it, an item before its list."""
    error = max(errors, key=lambda e: (e["type"] in UNKNOWN, len(_place(values, e["loc"]))))
    place, name = _place(values, error["loc"]), str(error["loc"][-1])
    if error["type"] in UNKNOWN:
        refuse_unknown([name], _known(make, place[:-1]), _path(where, place[:-1]))
    if error["type"] == "missing" and name.isidentifier():
        raise ValueError(f"{_path(where, place)}: missing key {name!r}")
    if error["type"] == "value_error":
        raise ValueError(f"{_path(where, place)}: {error['ctx']['error']}")
    # A value that is none of several types has an error for each.
    wanted = dict.fromkeys(_wanted(e) for e in errors if _place(values, e["loc"]) == place)
    raise ValueError(
        f"{_path(where, place)} must {' or '.join(wanted).replace(' or be ', ' or ')}, got {error['input']!r}"
    )


def _wanted(error: ErrorDetails) -> str:
    """What a value must be or have."""
    if error["type"] in ("missing", "too_long"):  # of a list of fixed length
        return "have more values" if error["type"] == "missing" else f"have {error['ctx']['max_length']} values"
    return error["msg"].removeprefix("Input should ").replace("valid array", "list")


def _place(values: Any, steps: Iterable[int | str]) -> list[int | str]:
    """The keys and indices that lead to what is wrong, without pydantic's own names of a union's types."""
    place = []
    for step in steps:
        with suppress(LookupError, TypeError):
            values = values[step]
            place.append(step)
    return place


def _path(where: str, place: Iterable[int | str]) -> str:
    """[camera] and ["occluders", 0, "center"] as ``[camera]: occluders[0].center``."""
    keys = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in place)
    return f"{where}: {keys[1:]}" if keys else where


def _known(make: Any, place: Iterable[int | str]) -> list[str]:
    """The keys of a table of tables: of Occluder if the hint is tuple[Occluder, ...] or Occluder | None."""
    for key in place:
        if isinstance(key, str):
            make = typing.get_type_hints(make)[key]
            while not is_dataclass(make):
                make = typing.get_args(make)[0]
    return list(signature(make).parameters)


def paragraphs(kind: type[Any]) -> list[list[Field[Any]]]:
    """The settings of a dataclass: its own, then those of each class that it derives from."""
    settings = {each.name: each for each in fields(kind) if each.init}
    return [[settings[name] for name in get_annotations(each) if name in settings] for each in kind.__mro__[:-1]]


def write_toml(kind: type[Any], values: Mapping[str, Any]) -> str:
    """Every setting of a dataclass as a line of TOML with its ``words``: the ``values``, and commented out what is left
    at its default, or an example where there is none."""
    return "\n".join("".join(_line(setting, values) for setting in own) for own in paragraphs(kind))


def _line(setting: Field[Any], values: Mapping[str, Any]) -> str:
    example = setting.metadata["example"]
    value = values.get(setting.name, setting.default if example is None else example)
    # JSON's way to write text, numbers, true and lists is TOML's, but for one character.
    text = json.dumps(value, ensure_ascii=False, allow_nan=False).replace("\x7f", "\\u007f")
    pair = f"{'' if setting.name in values else '#'}{setting.name} = {text}"
    known = " | ".join(map(json.dumps, setting.metadata.get("known", ())))
    return f"{pair:<31} # {known}{known and ': '}{setting.metadata['words']}\n"
