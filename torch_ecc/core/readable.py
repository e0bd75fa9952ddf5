"""Estimates and tracks as people and tables read them: px, degrees, standard deviations and words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from importlib import import_module
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Origin, Reason, Status, Track

if TYPE_CHECKING:
    from pandas import DataFrame

ROWS = 20  # templates that are listed; of more the first and last half of that
WORDS: dict[str, type[IntEnum]] = {"status": Status, "origin": Origin, "reason": Reason}
POSE = ("x_px", "y_px", "theta_rad")  # as in track.csv
_DEG = torch.tensor([1.0, 1.0, 180 / math.pi], dtype=torch.float64)


def estimate_text(estimate: Estimate) -> str:
    """One line per template: x and y in px, theta in degrees, each with its sigma, the score and the status."""
    e = on_host(estimate)
    head = ("template", "x (px)", "", "y (px)", "", "theta (deg)", "", "score", "status")
    rows = []
    pose, sigma = e.pose * _DEG, e.sigma * _DEG
    for k in listed(len(pose)):
        values = zip(pose[k].tolist(), sigma[k].tolist(), strict=True)
        numbers = [cell for value, spread in values for cell in measured(value, spread)]
        rows.append([str(k), *numbers, f"{float(e.score[k]):.4f}", _word(e, k)])
    count = len(pose)
    return f"Estimate of {count} template{'s' * (count != 1)}\n{aligned(head, rows, count)}"


def track_text(track: Track) -> str:
    """One line per template: in how many frames it was found, how far it moved, its median sigma, why it was lost."""
    t = on_host(track)
    frames, count = t.status.shape
    head = ("template", "found", "x (px)", "y (px)", "theta (deg)", "sigma x, y (px), theta (deg)", "frames lost")
    rows = []
    for k in listed(count):
        good = t.ok[:, k]
        found = f"{int(good.sum())}/{frames}"
        if not bool(good.any()):
            rows.append([str(k), found, "", "", "", "", _losses(t.status[:, k])])
            continue
        moved, sigma = t.displacement[good, k] * _DEG, (t.sigma[good, k] * _DEG).median(0).values
        spans = [span(values, float(spread)) for values, spread in zip(moved.T, sigma, strict=True)]
        spreads = ", ".join(f"{value:.2g}" for value in sigma.tolist())
        rows.append([str(k), found, *spans, spreads, _losses(t.status[:, k])])
    words = f"Track of {frames} frame{'s' * (frames != 1)}, {count} template{'s' * (count != 1)}; displacements"
    return f"{words}\n{aligned(head, rows, count)}"


def to_frame(estimate: Estimate) -> DataFrame:
    """A pandas.DataFrame of one row per template (and frame), by the columns of track.csv and every other field. As
    there, nothing that draws it takes an old pose for one: it is NaN.

    ModuleNotFoundError, in words, where there is no pandas.
    """
    try:
        pandas = import_module("pandas")
    except ModuleNotFoundError:
        raise ModuleNotFoundError("to_pandas: pandas is not installed; pip install pandas") from None
    e = on_host(estimate)
    shape = e.status.shape
    index = torch.meshgrid(*(torch.arange(n) for n in shape), indexing="ij")
    columns = dict(zip(("frame", "template")[-len(shape) :], (i.flatten() for i in index), strict=True))
    for prefix, values in (("", e.pose), ("d", e.displacement), ("sigma_", e.sigma)):
        new = torch.where(e.ok[..., None], values, math.nan)
        columns |= {f"{prefix}{name}": new[..., k].flatten() for k, name in enumerate(POSE)}
    for name, value in e._asdict().items():
        if value.shape == shape:
            columns[name] = value.flatten()
    table = {name: value.numpy() for name, value in columns.items()}
    for name, kind in WORDS.items():
        table[name] = pandas.Categorical.from_codes(table[name], [word.name for word in kind])
    return pandas.DataFrame(table)


def readable(estimate: Estimate) -> bool:
    """Are these fields of the shapes that a record has? Maps over records put other things in their place."""
    dims = 3 if isinstance(estimate, Track) else 2
    plain = all(type(value) is Tensor and not value.is_meta for value in estimate)
    return plain and estimate.pose.dim() == dims and estimate.status.shape == estimate.pose.shape[:-1]


def on_host(estimate: Estimate) -> Estimate:
    """The same record on the CPU, apart from any graph, in float64."""
    values = (value.detach().cpu() for value in estimate)
    return type(estimate)(*(value.double() if value.is_floating_point() else value for value in values))


def listed(count: int) -> Sequence[int]:
    """Which of ``count`` templates are listed."""
    return range(count) if count <= ROWS else [*range(ROWS // 2), *range(count - ROWS // 2, count)]


def measured(value: float, sigma: float) -> tuple[str, str]:
    """A value and its sigma to the digits that the sigma leaves."""
    digits = decimals(sigma)
    return f"{value:.{digits}f}", f"+- {sigma:.{digits}f}" if math.isfinite(sigma) else "+- ?"


def span(values: Tensor, sigma: float) -> str:
    """From the least to the largest of values (F,)."""
    digits = decimals(sigma)
    return f"{float(values.min()):.{digits}f} to {float(values.max()):.{digits}f}"


def decimals(sigma: float) -> int:
    """Digits after the point that show two of a sigma."""
    return min(max(1 - math.floor(math.log10(sigma)), 0), 9) if 0 < sigma < math.inf else 4


def aligned(head: Sequence[str], rows: list[list[str]], count: int) -> str:
    """A table whose columns are as wide as they need to be, with a line for the templates that are not listed."""
    table = [list(head), *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    last = len(widths) - 1
    lines = ["  ".join(map(str.rjust, row[:last], widths)) + f"  {row[last]}" for row in table]
    if count > len(rows):
        lines.insert(1 + len(rows) // 2, f"... and {count - len(rows)} more".center(len(lines[0])).rstrip())
    return "\n".join(line.rstrip() for line in lines)


def _word(estimate: Estimate, k: int) -> str:
    """The status of one template, where it was found if not by tracking alone, and what an old pose is and why."""
    status, reason = Status(int(estimate.status[k])), Reason(int(estimate.reason[k]))
    origin = Origin(int(estimate.origin[k]))
    if not bool(estimate.ok[k]):
        why = f" ({reason.name})" if reason and reason.name != status.name else ""
        return f"{status.name}{why}, the last good pose"
    return status.name if origin is Origin.TRACKED else f"{status.name}, found {origin.name}"


def _losses(status: Tensor) -> str:
    """How many frames (F,) were lost, by their status."""
    lost = status[~Status.good(status)]
    codes, counts = lost.unique(return_counts=True)
    return ", ".join(
        f"{count} {Status(code).name}" for code, count in zip(codes.tolist(), counts.tolist(), strict=True)
    )
