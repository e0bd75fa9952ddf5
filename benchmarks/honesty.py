"""Is CONVERGED true? Trackers run over films, and what is counted of their frames."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from adapters import Start
from films.shot import Film
from torch import Tensor

from torch_ecc import Estimate, Origin, Status, Track, Tracker
from torch_ecc.paper.errors import in_degrees
from torch_ecc.paper.result import Number

WRONG = 0.1  # px, deg
SIGMAS = 5.0
FAR = 2.0  # px
VISIBLE = 0.5  # least share of a template to be seen that it should not be lost with

ROBUST = "robust" in inspect.signature(Tracker).parameters
BY: dict[str, dict[str, Any]] = {
    "default": {},
    "ecc_paper": {"criterion": "ecc_paper"},
    "ssd": {"criterion": "ssd"},
    "gain": {"illumination": "gain"},
    "quadratic": {"illumination": "quadratic"},
    **({"plain": {"robust": False}} if ROBUST else {}),
}


class Run(NamedTuple):
    """One tracker on one film: ``error`` and ``sigma`` (F, R, 3) px, px, deg, ``seconds`` (F,), all else (F, R)."""

    film: Film
    error: Tensor
    sigma: Tensor
    status: Tensor
    score: Tensor
    origin: Tensor
    coverage: Tensor
    seconds: Tensor

    @staticmethod
    def of(film: Film, told: Estimate, seconds: Tensor) -> Run:
        """What a tracker ``told`` of the frames of a film, (F, R, ...)."""
        error, sigma = in_degrees(told.pose - film.truth), in_degrees(told.sigma)
        return Run(film, error, sigma, told.status, told.score, told.origin, told.coverage, seconds)

    @property
    def believed(self) -> Tensor:
        """(F, R)."""
        return self.status == Status.CONVERGED

    @property
    def off(self) -> Tensor:
        """Over 0.1 px or 0.1 deg, (F, R)."""
        return (self.error.abs() > WRONG).any(-1)

    @property
    def wrong(self) -> Tensor:
        """Off in a component by 5 of its sigma too, (F, R)."""
        return ((self.error.abs() > WRONG) & ~(self.error.abs() <= SIGMAS * self.sigma)).any(-1)


def follow(film: Film, **options: Any) -> Run:
    """The Tracker with ``options`` on a film."""
    tracker = Tracker(film.frames[0], film.centers, film.size, **(options | film.options))
    estimates, seconds = [], []
    for frame in film.frames[1:]:
        begun = time.perf_counter()
        estimates.append(tracker(frame))
        seconds.append(time.perf_counter() - begun)
    return Run.of(film, Track.stack(estimates), torch.tensor(seconds))


def follow_peer(film: Film, start: Start) -> Run:
    """A peer on the first patch of a film; it has no sigma, and what it returns is taken as believed."""
    x, y = film.centers[0].tolist()
    follow, last = start(film.frames[0], (x, y), film.size), (x, y, 0.0)
    poses, status, seconds = [], [], []
    for frame in film.frames[1:]:
        begun = time.perf_counter()
        found = follow(frame)
        seconds.append(time.perf_counter() - begun)
        last = found or last
        poses.append(last)
        status.append(Status.CONVERGED if found else Status.LOST)
    error = in_degrees(torch.tensor(poses, dtype=torch.float64)[:, None] - film.truth)
    none, nothing = torch.full_like(error, math.nan), torch.zeros_like(error[..., 0])
    origin, codes = nothing.to(torch.int8), torch.tensor(status)[:, None]
    return Run(film, error, none, codes, nothing, origin, none[..., 0], torch.tensor(seconds))


def recovery(run: Run) -> float:
    """Frames after a disturbance has gone until the last patch is believed and right again; infinite if never, NaN if
    it never goes."""
    right = (run.believed & ~run.off)[run.film.clear :].all(1)
    if len(right) == 0:
        return math.nan
    return float(right.nonzero()[0]) if bool(right.any()) else math.inf


def joined(runs: Sequence[Run], part: Callable[[Run], Tensor]) -> Tensor:
    """A part (F, R, ...) of every run, one after the other: (n, ...)."""
    return torch.cat([part(run).flatten(0, 1) for run in runs])


def root_mean_square(ratio: Tensor) -> float:
    """Of each component (n, 3), the worst; NaN of none."""
    ratio = ratio[ratio.isfinite().all(1)]
    return float(ratio.square().mean(0).sqrt().max()) if len(ratio) else math.nan


def worst(runs: Sequence[Run], count: int) -> list[tuple[str, ...]]:
    """The ``count`` frames that are wrong and believed by most sigma, where they are and what was told of them."""
    found = []
    for number, run in enumerate(runs):
        for k, r in (run.wrong & run.believed).nonzero().tolist():
            error, sigma = run.error[k, r].tolist(), run.sigma[k, r].tolist()
            most = max(abs(e) / s for e, s in zip(error, sigma, strict=True)) if min(sigma) > 0 else math.inf
            told = f"{float(run.score[k, r]):.3f}", Origin(int(run.origin[k, r])).name
            seen = f"{float(run.film.seen[k, r]):.2f} {float(run.coverage[k, r]):.2f}"
            place = f"film {number}, frame {k + 1}, patch {r}", seen
            found.append((most, (*place, _triple(error), _triple(sigma), *told)))
    return [cells for _, cells in sorted(found, reverse=True)[:count]]


def _triple(values: Sequence[float]) -> str:
    return " ".join(f"{value:.4f}" for value in values)


def after(runs: Sequence[Run]) -> int:
    """Frames wrong and believed when nothing disturbs any more."""
    return sum(int((run.wrong & run.believed)[run.film.clear :].sum()) for run in runs)


def figures(runs: Sequence[Run]) -> dict[str, float]:
    """What is counted over all frames and patches of ``runs``."""
    believed, off, wrong = (joined(runs, part) for part in (lambda r: r.believed, lambda r: r.off, lambda r: r.wrong))
    error, sigma, status = (joined(runs, part) for part in (lambda r: r.error, lambda r: r.sigma, lambda r: r.status))
    bound, seen = joined(runs, lambda r: in_degrees(r.film.bound)), joined(runs, lambda r: r.film.seen)
    coverage = joined(runs, lambda r: r.coverage)[believed] - seen[believed]
    far = torch.hypot(error[:, 0], error[:, 1]) > FAR
    visible = seen >= VISIBLE
    times = 1e3 * torch.cat([run.seconds for run in runs])
    back = [r for r in map(recovery, runs) if not math.isnan(r)]
    count = {
        "frames": torch.ones_like(believed),
        "converged": believed,
        "right": believed & ~off,
        "wrong": believed & wrong,
        "off": believed & off,
        "far": believed & far,
        "disbelieved": ~believed & ~off,
        "lost": visible & (status > Status.MAX_ITERATIONS),
    }
    fair = believed & ~wrong
    return {name: int(which.sum()) for name, which in count.items()} | {
        "after": after(runs),
        "recovery": max(back, default=math.nan),
        "bound": root_mean_square((error / bound)[fair]),
        "sigma": root_mean_square((error / sigma)[believed]),
        "coverage": float(coverage.square().mean().sqrt()),
        "median": float(times.median()),
        "longest": float(times.max()),
    }


UNITS = {"bound": "x", "sigma": "x", "median": "ms", "longest": "ms", "recovery": "frames", "coverage": ""}
BETTER = {"converged": "higher", "right": "higher"}
TOLERANCE = {"wrong": 0.0, "after": 0.0, "far": 0.0, "right": 0.02, "lost": 0.0, "bound": 0.1, "sigma": 0.1}


def numbers(title: str, found: dict[str, float]) -> list[Number]:
    """The figures of a row as records."""
    return [
        Number(f"{title} / {n}", v, UNITS.get(n, "frames"), BETTER.get(n, "lower"), TOLERANCE.get(n))
        for n, v in found.items()
    ]
