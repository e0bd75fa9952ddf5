"""A record of settings as options of the command line: names, types, words and defaults are those of its fields."""

from __future__ import annotations

import shlex
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field, fields
from itertools import chain
from pathlib import Path
from typing import Any

import click

from torch_ecc.commands.jobs import TrackJob
from torch_ecc.config import fill, paragraphs, write_toml

Command = Callable[..., Any]
HEAD = """\
# torch-ecc track --config FILE        (options on the command line win over this file)
# Every setting is here. What stands behind a "#" is off, or has the value shown by default.

"""


def options_of(
    kind: type[Any], *, without: Iterable[str] = (), **forms: Mapping[str, Any]
) -> Callable[[Command], Command]:
    """An option for every setting of a dataclass, unless it is ``without`` one; not given, it is None or empty.

    ``forms``: by name, what click is told of a setting beside what its field says, and its ``flag`` if it is another.
    """
    hints = typing.get_type_hints(kind)
    wanted = [each for each in chain(*paragraphs(kind)) if each.name not in without]

    def decorate(command: Command) -> Command:
        for each in reversed(wanted):
            command = _option(each, hints[each.name], dict(forms.get(each.name, {})))(command)
        return command

    return decorate


def _option(each: Field[Any], hint: Any, form: dict[str, Any]) -> Callable[[Command], Command]:
    types = [hint, *typing.get_args(hint)]
    known, dashed = each.metadata.get("known", ()), each.name.replace("_", "-")
    flag = form.pop("flag", f"--{dashed}/--no-{dashed}" if each.default is True else f"--{dashed}")
    settings = {
        "default": None,
        "type": next((plain for plain in (bool, int, float, str) if plain in types), None),
        "is_flag": bool in types,
        "multiple": typing.get_origin(hint) is tuple,
        "metavar": "|".join(known) or None,
        "help": _help(each),
    }
    return click.option(flag, each.name, **settings | form)


def _help(each: Field[Any]) -> str:
    words, default = each.metadata["words"], each.default
    off = default is MISSING or default is None or default is False or default == ()
    shown = "" if off else f" [default: {'yes' if default is True else default}]"
    return f"{words[0].upper()}{words[1:]}{shown}."


def given(options: Mapping[str, Any]) -> dict[str, Any]:
    """What was given of the options."""
    return {name: value for name, value in options.items() if value not in (None, (), [])}


def read_size(context: click.Context, option: click.Parameter, text: str | None) -> int | list[int] | None:
    """N or H,W as a number or [h, w]: heights come first wherever sizes are given."""
    if text is None:
        return None
    parts = text.split(",")
    if not (1 <= len(parts) <= 2 and all(part.strip().isdecimal() for part in parts)):
        raise ValueError(f"size: expected a number of px or HEIGHT,WIDTH, got {text!r}")
    numbers = [int(part) for part in parts]
    return numbers[0] if len(numbers) == 1 else numbers


def read_scale(context: click.Context, option: click.Parameter, text: str | None) -> float | list[float] | None:
    """S or SX,SY as a number or [x, y]."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 2:
        raise ValueError(f"um_per_px: expected one number or two as SX,SY, got {text!r}")
    return numbers[0] if len(numbers) == 1 else numbers


def read_polygons(context: click.Context, option: click.Parameter, texts: tuple[str, ...]) -> list[list[list[float]]]:
    """Each 'X,Y X,Y ...' as its corners."""
    return [_polygon(text) for text in texts]


def _polygon(text: str) -> list[list[float]]:
    try:
        corners = [[float(number) for number in corner.split(",")] for corner in text.split()]
    except ValueError:
        corners = []
    if not corners or any(len(corner) != 2 for corner in corners):
        raise ValueError(f"polygon: expected corners as 'X,Y X,Y ...' in px, got {text!r}")
    return corners


def track_toml(values: Mapping[str, Any], where: str = "track") -> str:
    """All settings of a tracking run as a commented file with these ``values``, which are checked, and with an example
    of what there must be."""
    placed = values.keys() & {"centers", "polygons", "grid", "template"}
    examples = {each.name: each.metadata.get("example") for each in fields(TrackJob)}
    needed = ("input",) if placed else ("input", "centers", "size")
    values = {name: examples[name] for name in needed} | dict(values)
    fill(TrackJob, values, where)
    return HEAD + write_toml(TrackJob, values)


def track_command(values: Mapping[str, Any]) -> str:
    """The command that runs a job with these ``values``, as a shell reads it."""
    words = ["torch-ecc", "track", str(values["input"])]
    for each in chain(*paragraphs(TrackJob)):
        value, flag = values.get(each.name, each.default), f"--{each.name.replace('_', '-')}"
        if each.name == "input" or value in (None, each.default) or not (value or each.default):
            continue
        if isinstance(value, bool):
            words.append(flag if value else flag.replace("--", "--no-", 1))
        elif each.name in _REPEATED:
            flag, form = _REPEATED[each.name]
            words += chain(*([flag, *form(item)] for item in value))
        else:
            words += [flag, _plain(value)]
    return shlex.join(words)


def _plain(value: Any) -> str:
    """A number, a text, or numbers with commas between."""
    if isinstance(value, list | tuple):
        return ",".join(map(_plain, value))
    return f"{value:.15g}" if isinstance(value, float) else str(value)


_REPEATED: dict[str, tuple[str, Callable[[Any], list[str]]]] = {
    "centers": ("--center", lambda center: [_plain(number) for number in center]),
    "polygons": ("--polygon", lambda corners: [" ".join(map(_plain, corners))]),
    "template": ("--template", lambda name: [name]),
}


def write_new(text: str, file: str) -> None:
    """Write a text into a new file, or on the screen if that is "-". ValueError if there is such a file."""
    path = Path(file).expanduser()
    if file == "-":
        click.echo(text, nl=False)
    elif path.exists():
        raise ValueError(f"write-config: {file} is already there and was left as it is")
    else:
        path.write_text(text, encoding="utf-8")
