"""What a tracker reports per frame, as the writers take it, and the words that they put it in.

Anything with these attributes will do: the writers know no tracker.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

StatusNames: TypeAlias = Mapping[int, str]
"""The word for each status code, for example ``{0: "CONVERGED", 1: "MAX_ITERATIONS", 2: "LOST"}``."""
ReasonNames: TypeAlias = Mapping[int, str]
"""The word for each reason code, empty where a pose can be trusted, for example ``{0: "", 1: "COVERED"}``."""
OriginNames: TypeAlias = Mapping[int, str]
"""The word for how a pose was come by, for example ``{0: "TRACKED", 1: "NEARBY"}``."""

CONVERGED: Final = "CONVERGED"
DOUBTFUL: Final = "MAX_ITERATIONS"
"""The two words of a frame that carries a new pose. With every other word the template was lost in that frame and its
pose is the last good one."""
DAMAGED: Final = "DAMAGED"
"""The word of a frame that could not be looked at."""


class Record(Protocol):
    """R templates in one frame: px, px, rad; on any device. ``covariance`` may be infinite where the status is bad."""

    @property
    def pose(self) -> Tensor: ...  # (R, 3)
    @property
    def displacement(self) -> Tensor: ...  # (R, 3)
    @property
    def score(self) -> Tensor: ...  # (R,)
    @property
    def status(self) -> Tensor: ...  # (R,) integer
    @property
    def iterations(self) -> Tensor: ...  # (R,) integer
    @property
    def covariance(self) -> Tensor: ...  # (R, 3, 3)
    @property
    def residual_rms(self) -> Tensor: ...  # (R,)
    @property
    def coverage(self) -> Tensor: ...  # (R,)
    @property
    def reason(self) -> Tensor: ...  # (R,) integer
    @property
    def origin(self) -> Tensor: ...  # (R,) integer


FIELDS: Final[dict[str, tuple[str, tuple[int, ...]]]] = {
    "pose": ("f8", (3,)),
    "displacement": ("f8", (3,)),
    "score": ("f8", ()),
    "status": ("i1", ()),
    "iterations": ("i4", ()),
    "covariance": ("f8", (3, 3)),
    "residual_rms": ("f8", ()),
    "coverage": ("f8", ()),
    "reason": ("i1", ()),
    "origin": ("i1", ()),
}
"""dtype and shape of each field per template."""


def to_arrays(record: Record) -> dict[str, NDArray[Any]]:
    """The fields as arrays (R, ...). ValueError if their shapes do not agree on R or have other tails than Record's."""
    count = len(record.pose)
    arrays = {}
    for name, (dtype, tail) in FIELDS.items():
        value: Tensor = getattr(record, name)
        if value.shape != (count, *tail):
            raise ValueError(f"write: record.{name} must be {(count, *tail)}, got {tuple(value.shape)}")
        arrays[name] = value.numpy(force=True).astype(dtype)
    return arrays


def sigma(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations (..., n) of covariances (..., n, n)."""
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


def words(values: NDArray[np.int8], names: Mapping[int, str], field: str = "status") -> list[str]:
    """The word of each of (R,) codes of a ``field``. ValueError for a code that has none."""
    codes = values.tolist()
    unknown = sorted(set(codes) - set(names))
    if unknown:
        raise ValueError(f"write: record.{field} has the code {unknown[0]}, {field}_names has {sorted(names)}")
    return [names[code] for code in codes]
