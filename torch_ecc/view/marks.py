"""What is marked in a frame, as the settings of a tracking run know it, and how well each mark can be tracked.

A box is {"x", "y", "w", "h"}: its centre and its sides in px. An outline is {"points": [[x, y], ...]}.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

from torch import Tensor

from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.templates import choose_templates
from torch_ecc.core.estimate import Status
from torch_ecc.core.patches import texture

Mark: TypeAlias = dict[str, Any]


class Outlook(NamedTuple):
    """What is to be expected of a mark: ``sigma`` (3,) px, px, rad, None if x, y and theta are not fixed, and a
    sentence if something speaks against it."""

    sigma: list[float] | None
    words: str | None


def as_settings(marks: Sequence[Mark]) -> dict[str, Any]:
    """The keys of a ``TrackJob``: centres of boxes of one size, else outlines, for templates have one size."""
    if all("w" in mark for mark in marks) and len({(mark["h"], mark["w"]) for mark in marks}) == 1:
        h, w = marks[0]["h"], marks[0]["w"]
        return {"centers": [[mark["x"], mark["y"]] for mark in marks], "size": h if h == w else [h, w]}
    return {"polygons": [mark.get("points") or _corners(mark) for mark in marks]}


def _corners(box: Mark) -> list[list[float]]:
    """The middles of a box's outermost pixels."""
    x, y, right, down = box["x"], box["y"], (box["w"] - 1) / 2, (box["h"] - 1) / 2
    return [[x - right, y - down], [x + right, y - down], [x + right, y + down], [x - right, y + down]]


def boxes(centers: Tensor, size: tuple[int, int]) -> list[Mark]:
    """Those of templates of ``size`` (h, w) at ``centers`` (R, 2)."""
    return [{"x": x, "y": y, "w": size[1], "h": size[0]} for x, y in centers.tolist()]


def outlook(frame: Tensor, marks: Sequence[Mark], settings: Mapping[str, Any]) -> list[Outlook]:
    """What is to be expected of each mark in a ``frame`` (H, W) under the ``settings`` of a ``TrackJob``."""
    sizes = {(mark.get("h"), mark.get("w")) for mark in marks}
    try:
        together = [list(marks)] if len(sizes) == 1 and None not in sizes.copy().pop() else [[mark] for mark in marks]
        return [each for some in together for each in _predicted(frame, some, settings)]
    except ValueError as error:
        if len(marks) == 1:
            return [Outlook(None, _sentence(error))]
        return [each for mark in marks for each in outlook(frame, [mark], settings)]


def _predicted(frame: Tensor, marks: Sequence[Mark], settings: Mapping[str, Any]) -> list[Outlook]:
    job = TrackJob(input="", criterion=settings.get("criterion", "ecc"), **_tuples(as_settings(marks)))
    centers, size, mask = choose_templates(job, frame)
    found = texture(frame, centers, size, mask=mask, criterion=job.criterion)
    low = Outlook(None, Status.describe(Status.LOW_TEXTURE))
    return [Outlook(sigma.tolist(), None) if bool(sigma.isfinite().all()) else low for sigma in found]


def _tuples(value: Any) -> Any:
    """Lists as tuples, which is what a ``TrackJob`` has."""
    if isinstance(value, dict):
        return {name: _tuples(each) for name, each in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _sentence(error: ValueError) -> str:
    """An error's words without the name of the function that raised it."""
    words = re.sub(r"^\w+: ", "", str(error))
    return f"{words[:1].upper()}{words[1:]}."


def read_outline(text: str) -> Mark:
    """A mark from what ImageJ writes: the recorder's makeRectangle(...) or makePolygon(...), or a list of coordinates.

    ValueError if there is no outline in the text.
    """
    call = re.search(r"make(Rectangle|Polygon|Selection)\s*\(([^)]*)\)", text)
    if call and call[1] == "Rectangle":
        x, y, w, h = (float(number) for number in call[2].split(",")[:4])
        return {"x": x + (w - 1) / 2, "y": y + (h - 1) / 2, "w": round(w), "h": round(h)}
    number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
    if call:
        values = [float(each) for each in re.findall(number, call[2])]
        pairs = list(zip(values[::2], values[1::2], strict=False))
    else:
        rows = [re.findall(number, line) for line in text.replace(";", "\n").splitlines()]
        pairs = [(float(row[-2]), float(row[-1])) for row in rows if len(row) in (2, 3)]
    if len(pairs) < 3:
        raise ValueError(
            "outline: expected a line 'X Y' for each of three corners or more, as ImageJ saves XY coordinates, or "
            "makeRectangle(...) or makePolygon(...) as its recorder shows them"
        )
    return at_pixel_centres(pairs)


def at_pixel_centres(corners: Sequence[Sequence[float]]) -> Mark:
    """An outline with corners (x, y) as ImageJ counts them: from the outer corner of the first pixel."""
    return {"points": [[x - 0.5, y - 0.5] for x, y in corners]}
