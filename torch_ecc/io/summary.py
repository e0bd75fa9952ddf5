"""summary.json: how a run went, for people and for scripts."""

from __future__ import annotations

import json
import math
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ecc.io.output import append, create
from torch_ecc.io.records import CONVERGED, DAMAGED, DOUBTFUL, ReasonNames, StatusNames


def summarise(
    records: NDArray[Any], names: StatusNames, reasons: ReasonNames, error: BaseException | None
) -> dict[str, object]:
    """What (F,) records of R templates say; ``error`` is what ended the run before its time, if anything did."""
    templates, damaged = records["score"].shape[1], [code for code, word in names.items() if word == DAMAGED]
    return {
        "complete": error is None,
        "reason": _describe(error),
        "frames": len(records),
        "damaged_frames": int(np.isin(records["status"][:, 0], damaged).sum()),
        "templates": templates,
        "rows": records["score"].size,
        "reasons": _counted(records["reason"], reasons),
        "per_template": [_summarise_template(records, names, reasons, index) for index in range(templates)],
        "versions": versions(),
    }


def write_json(path: Path, summary: dict[str, object]) -> None:
    """Strict JSON: what is not finite becomes null, what JSON does not know becomes its text."""
    with create(path) as file:
        append(file, (json.dumps(plain(summary), indent=2, allow_nan=False) + "\n").encode())


def _counted(values: NDArray[np.int8], names: StatusNames | ReasonNames) -> dict[str, int]:
    """How many of the codes each word stands for, without those that have none."""
    codes, counts = np.unique(values, return_counts=True)
    return {names[code]: count for code, count in zip(codes.tolist(), counts.tolist(), strict=True) if names[code]}


def _summarise_template(
    records: NDArray[Any], names: StatusNames, reasons: ReasonNames, index: int
) -> dict[str, object]:
    status = np.asarray(records["status"][:, index])
    found = np.isin(status, [code for code, word in names.items() if word in (CONVERGED, DOUBTFUL)])
    lost, coverage = np.flatnonzero(~found), np.asarray(records["coverage"][:, index])[found]
    variance = (records["covariance"][:, index, axis, axis] for axis in range(3))
    return {
        "status": _counted(status, names),
        "reasons": _counted(records["reason"][:, index], reasons),
        "lost_frames": len(lost),
        "first_lost_frame": int(lost[0]) if len(lost) else None,
        "last_lost_frame": int(lost[-1]) if len(lost) else None,
        "mean_score": float(np.mean(records["score"][:, index])),
        "mean_coverage": float(coverage.mean()) if len(coverage) else None,
        "least_coverage": float(coverage.min()) if len(coverage) else None,
        "median_sigma": {
            name: math.sqrt(np.median(values))
            for name, values in zip(("x_px", "y_px", "theta_rad"), variance, strict=True)
        },
    }


def _describe(error: BaseException | None) -> str | None:
    if error is None:
        return None
    if isinstance(error, KeyboardInterrupt):
        return "interrupted by the user"
    return f"{type(error).__name__}: {error}"


def versions() -> dict[str, str]:
    """Of what a result depends on."""
    try:
        package = version("torch-ecc")
    except PackageNotFoundError:
        package = "not installed"
    return {"torch_ecc": package, "torch": torch.__version__, "python": platform.python_version()}


def plain(value: Any) -> Any:
    """A value as JSON knows it: what is not finite is None, what is of another kind is its text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
