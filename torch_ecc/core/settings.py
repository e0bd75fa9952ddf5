"""How to iterate, and when to believe the result: the one record of settings, from the command line to the engine."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cached_property
from math import inf
from typing import Self, TypeVar

from torch_ecc.core.sampling import SAMPLERS

BACKENDS = ("auto", "torch", "native", "fused")

T = TypeVar("T")


def described(default: T, words: str, known: Collection[str] = (), example: object = None) -> T:
    """A field with what a command line and a configuration file say of it: its ``words``, the values that are
    ``known`` if it takes no others, and an ``example`` if its default shows nothing."""
    return field(default=default, metadata={"words": words, "known": known, "example": example})


@dataclass(frozen=True)
class Settings:
    """How to iterate and when to believe the result.

    A ``backend`` of "auto" is the native engine on a CPU and the fused one on an NVIDIA GPU; "native" and "fused" are
    one of them, and "torch" is the page, which also serves what an engine does not take (and, with a word, where no
    native one is installed).
    """

    interpolation: str = described("bspline3", "how the frame is read between pixels; bilinear is fast", SAMPLERS)
    max_iterations: int = described(15, "iterations per frame at most")
    tolerance: float = described(1e-3, "remaining error at the template's farthest pixel, px")
    min_score: float = described(0.5, "below this correlation a template is lost")
    min_visible: float = described(0.25, "with less of its weight in sight a template is out of view")
    robust: bool = described(True, "blocks that do not fit, as of what covers a part of the template, count less")
    backend: str = described("auto", "auto: native on a CPU, fused on an NVIDIA GPU, else torch", BACKENDS)

    @classmethod
    def of(cls, where: str, options: dict[str, str | float]) -> Self:
        """The settings of a function's keyword arguments. ValueError, which names ``where``, for an unknown one."""
        known = [each.name for each in fields(cls)]
        for name in options:
            if name not in known:
                close = get_close_matches(name, known, 1)
                hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
                raise ValueError(f"{where}: unknown option {name!r} ({hint})")
        return cls(**options)  # type: ignore[arg-type]

    @cached_property
    def once(self) -> Self:
        """The same for a single iteration."""
        return replace(self, max_iterations=1)

    def __post_init__(self) -> None:
        for each in fields(self):
            known = each.metadata.get("known")
            if known and getattr(self, each.name) not in known:
                raise ValueError(f"{each.name}: expected one of {list(known)}, got {getattr(self, each.name)!r}")
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(f"max_iterations: expected a whole number of at least 1, got {self.max_iterations}")
        if not 0 < self.tolerance < inf:
            raise ValueError(f"tolerance: expected a length in px > 0, got {self.tolerance}")
        for name, value in (("min_score", self.min_score), ("min_visible", self.min_visible)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name}: expected a number from 0 to 1, got {value}")
