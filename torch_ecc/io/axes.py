"""Which axis of a stack is time: channels, slices and stage positions never are; of them one has to be chosen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple


class Choice(NamedTuple):
    """The channel, slice and stage position to read, each from 0; None where the source has one only."""

    channel: int | None = None
    slice: int | None = None
    position: int | None = None


CHOSEN: Final = {"C": "channel", "S": "channel", "Z": "slice", "P": "position", "R": "position"}
"""What a letter of axes means where it is not time."""
_SEQUENCES: Final = "IQ"  # of pages: what they follow each other in is not said


class Walk(NamedTuple):
    """The way through a stack: ``length`` frames, the k-th of which is ``start`` plus k ``steps`` planes from the first
    plane, the last axis being the fastest."""

    length: int
    start: int
    step: int

    @property
    def planes(self) -> list[int]:
        return [self.start + number * self.step for number in range(self.length)]


def walk(where: str, axes: str, sizes: Sequence[int], choice: Choice, *, loose: bool = False) -> Walk:
    """Through time, for the ``choice``, along the ``axes`` of the planes (T, C, Z, P ..., one letter each).

    Where there is no T, one sequence of unknown meaning is time, or, if ``loose``, slices that nothing stands beside.
    ValueError if an axis is neither time nor chosen, or if a choice is not there.
    """
    sizes = list(sizes)
    time = _time_axis(axes, sizes, loose)
    fixed = _fixed(where, axes, sizes, choice, time)
    strides = [math.prod(sizes[k + 1 :]) for k in range(len(sizes))]
    start = sum(index * strides[k] for k, index in fixed.items())
    return Walk(1 if time is None else sizes[time], start, 0 if time is None else strides[time])


def check_single(where: str, choice: Choice) -> None:
    """ValueError if a ``choice`` asks for what a source without such axes does not have."""
    walk(where, "", (), choice)


def _time_axis(axes: str, sizes: Sequence[int], loose: bool) -> int | None:
    long = [k for k, size in enumerate(sizes) if size > 1]
    if "T" in axes:
        return axes.index("T")
    sequences = [k for k in long if axes[k] in _SEQUENCES]
    if len(sequences) == 1:
        return sequences[0]
    return long[0] if loose and len(long) == 1 and axes[long[0]] == "Z" else None


def _fixed(where: str, axes: str, sizes: Sequence[int], choice: Choice, time: int | None) -> dict[int, int]:
    """By axis, the index that is read."""
    fixed, open_axes, wanted = {}, [], {name: value for name, value in choice._asdict().items() if value is not None}
    for k, (letter, size) in enumerate(zip(axes, sizes, strict=True)):
        if k == time:
            continue
        name = CHOSEN.get(letter, "")
        index = wanted.pop(name, None) if size > 1 else wanted.get(name)
        if index is None and size > 1:
            open_axes.append((name, size))
        elif index is not None and not 0 <= index < size:
            held = f"{size} {name}s, 0 to {size - 1}" if size > 1 else f"one {name}, 0"
            raise ValueError(f"{name}: {where} holds {held}, got {index}")
        fixed[k] = index or 0
    for name, index in wanted.items():
        if index != 0:
            raise ValueError(f"{name}: {where} holds one {name}, 0, got {index}")
    if open_axes:
        raise ValueError(_refusal(where, axes, sizes, open_axes))
    return fixed


def _refusal(where: str, axes: str, sizes: Sequence[int], open_axes: Sequence[tuple[str, int]]) -> str:
    layout = " x ".join(f"{letter} {size}" for letter, size in zip(axes, sizes, strict=True) if size > 1)
    unknown = [str(size) for name, size in open_axes if not name]
    if unknown:
        return f"open_frames: {where} has axes of unknown meaning ({layout}): name them, one of them T"
    found = " and ".join(f"{size} {name}s" for name, size in open_axes)
    how = " ".join(f"--{name} 0...{size - 1}" for name, size in open_axes)
    return f"open_frames: {where} holds {found}, which are not time ({layout}): choose with {how}"
