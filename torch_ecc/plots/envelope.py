"""A track as it is drawn: in units for people, and a long one thinned, while it is read, to what its curves pass
through."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torch_ecc.plots.blocks import Arrays, blocks, shape_of

_Array: TypeAlias = NDArray[np.float64]

BINS = 1500  # more points than this per curve would only be drawn on top of each other
_FOUND = ("CONVERGED", "MAX_ITERATIONS")  # with every other status the pose is an old one, and is not drawn
_NEEDED = ("displacement", "covariance", "score", "status", "residual_rms", "status_codes", "status_names")
_BLOCK = 1 << 14  # templates times frames that are in memory at once
_SAMPLE = 1 << 17  # of them tell what is usual


class Envelope(NamedTuple):
    """The lowest and the highest value in each of N bins, (N, R) or (N, R, 3), without those that are NaN."""

    low: _Array
    high: _Array


class Drawn(NamedTuple):
    """``frames`` frames of R templates in N bins, of one frame each if they are few: the first ``time`` (N,) in each;
    displacement, what lies within 3 sigma of it, and sigma, in (um or px, um or px, deg), NaN where a template was
    lost; the worst status (N, R), as an index into ``words``. ``usual`` (3,) is what sigma seldom exceeds, ``span``
    where the first frame's time begins and the last one's ends."""

    frames: int
    time: _Array
    displacement: Envelope
    band: Envelope
    sigma: Envelope
    score: Envelope
    residual: Envelope
    status: NDArray[np.int64]
    usual: _Array
    span: tuple[float, float]
    words: list[str]
    time_label: str
    unit: str


def thinned(arrays: Arrays) -> Drawn:
    """The track in ``arrays``, as ``plot_track`` takes them. ValueError if some are missing or there is no frame."""
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise ValueError(f"plot_track: track must have {', '.join(_NEEDED)}; missing: {', '.join(missing)}")
    frames, templates = shape_of(arrays, "score")
    if not frames * templates:
        raise ValueError("plot_track: track must have at least one frame and template")
    width = 1 if frames <= 2 * BINS else -(-frames // BINS)
    order = np.argsort(arrays["status_codes"])  # as indices, statuses keep the order of their codes
    codes, words = (np.asarray(arrays[name])[order] for name in ("status_codes", "status_names"))
    every, parts, sample, ends = max(frames * templates // _SAMPLE, 1), [], [], []
    for values in _in_units(arrays, codes, words, width * max(_BLOCK // templates // width, 1)):
        parts.append(_binned(values, np.arange(0, len(values["time"]), width)))
        sample.append(values["sigma"][::every])
        ends += [values["time"][0], values["time"][-1]]
    half = (ends[-1] - ends[0]) / (frames - 1) / 2 if frames > 1 else 0.5
    return Drawn(
        frames=frames,
        usual=_usual(np.concatenate(sample)),
        span=(ends[0] - half, ends[-1] + half),
        words=[str(word) for word in words],
        time_label="time (s)" if "time_s" in arrays else "frame",
        unit="µm" if "um_matrix" in arrays else "px",
        **_joined(parts),
    )


def _in_units(arrays: Arrays, codes: NDArray[Any], words: NDArray[Any], most: int) -> Iterator[dict[str, NDArray[Any]]]:
    """So many frames at a time: what is drawn of them."""
    units = np.eye(3)
    units[:2, :2] = np.asarray(arrays["um_matrix"]) if "um_matrix" in arrays else np.eye(2)
    units[2, 2] = np.degrees(1.0)
    timed, done = "time_s" in arrays, 0
    names = ["displacement", "covariance", "score", "status", "residual_rms", *(["time_s"] if timed else [])]
    for some in blocks(arrays, names, most):
        status = np.searchsorted(codes, some["status"])
        lost = ~np.isin(words, _FOUND)[status][..., None]
        moved = np.where(lost, np.nan, some["displacement"] @ units.T)
        covariance = np.where(np.isfinite(some["covariance"]), some["covariance"], np.nan)
        variance = np.einsum("ij,frjk,ik->fri", units, covariance, units)
        yield {
            "time": some["time_s"] if timed else np.arange(done, done + len(status), dtype=np.float64),
            "displacement": moved,
            "sigma": np.where(lost, np.nan, np.sqrt(variance)),
            "score": some["score"],
            "residual": some["residual_rms"],
            "status": status,
        }
        done += len(status)


def _binned(values: dict[str, NDArray[Any]], starts: NDArray[np.int64]) -> dict[str, Any]:
    """What is drawn of frames that fall into bins which begin at ``starts``."""
    moved, band = values["displacement"], 3 * values["sigma"]
    low_high = {name: (values[name], values[name]) for name in ("displacement", "sigma", "score", "residual")}
    low_high["band"] = (moved - band, moved + band)
    return {
        "time": values["time"][starts],
        "status": np.maximum.reduceat(values["status"], starts),
    } | {
        name: Envelope(np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts))
        for name, (low, high) in low_high.items()
    }


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """One after the other."""
    return {
        name: Envelope(*(np.concatenate(side) for side in zip(*(part[name] for part in parts), strict=True)))
        if isinstance(first, Envelope)
        else np.concatenate([part[name] for part in parts])
        for name, first in parts[0].items()
    }


def _usual(sigma: _Array) -> _Array:
    """(3,) the 99th percentile of (F, R, 3); NaN of what is never known."""
    flat = sigma.reshape(-1, 3)
    columns = [column[np.isfinite(column)] for column in flat.T]
    return np.array([np.percentile(column, 99) if len(column) else np.nan for column in columns])
