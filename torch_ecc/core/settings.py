"""How to iterate, and when to believe the result: the one record of settings, from the command line to the engine."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf


@dataclass(frozen=True)
class Settings:
    """How to iterate and when to believe the result.

    ``tolerance``: remaining error in px at the template's farthest pixel. A template is lost below ``min_score`` and
    out of view when less than ``min_visible`` of its weight lies in the frame. ``backend``: "auto" is the native path
    on a CPU where it is there or can be compiled, "native" says so if it cannot, "torch" never is.
    """

    interpolation: str = "bspline3"
    max_iterations: int = 15
    tolerance: float = 1e-3
    min_score: float = 0.5
    min_visible: float = 0.25
    backend: str = "auto"

    def __post_init__(self) -> None:
        for name, known in (
            ("interpolation", ["bilinear", "bspline3", "bspline5"]),
            ("backend", ["auto", "torch", "native"]),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: expected one of {known}, got {getattr(self, name)!r}")
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(f"max_iterations: expected a whole number of at least 1, got {self.max_iterations}")
        if not 0 < self.tolerance < inf:
            raise ValueError(f"tolerance: expected a length in px > 0, got {self.tolerance}")
        for name, value in (("min_score", self.min_score), ("min_visible", self.min_visible)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name}: expected a number from 0 to 1, got {value}")
