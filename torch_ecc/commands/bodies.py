"""Rigid bodies of a track: body.csv, body.json and body.png beside track.csv."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_ecc.body.body import Body, BodyEstimate
from torch_ecc.body.centre import rotation_centre
from torch_ecc.body.grouping import rigid_groups
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.config import fill, read_toml
from torch_ecc.core.estimate import Estimate, Status, Track
from torch_ecc.io.output import append, create, part, publish
from torch_ecc.io.summary import write_json
from torch_ecc.records.lens import Lens
from torch_ecc.track.tracker import Tracker

BODY_FILES = ("body.csv", "body.json", "body.png")
POSE = ("x_px", "y_px", "theta_rad")
SELDOM = 0.5  # of the frames in which it was found: a patch that agrees in fewer is named


def read_lens(job: TrackJob, frame: Tensor) -> Lens | None:
    """The lens before each ``frame`` (..., h, w), None if ``job`` tells of none: a TOML file of what ``Lens`` takes, or
    k1,k2,p1,p2 about the middle of the frame in units of half its diagonal. ValueError for what is neither."""
    if job.lens is None:
        return None
    if not (job.body or job.bodies is not None):
        raise ValueError(f"lens: expected with body or bodies, whose poses it straightens; got {job.lens!r} alone")
    numbers = job.lens.split(",")
    try:
        terms = [float(number) for number in numbers]
    except ValueError:
        if len(numbers) > 1 or Path(job.lens).suffix != ".toml":
            raise ValueError(f"lens: expected a file.toml or k1,k2,p1,p2, got {job.lens!r}") from None
        return fill(Lens, read_toml(job.lens), job.lens)
    if len(terms) > 4:
        raise ValueError(f"lens: expected at most k1,k2,p1,p2, got {job.lens!r}")
    middle = (frame.shape[-1] - 1) / 2, (frame.shape[-2] - 1) / 2
    return Lens(middle, math.hypot(*middle), *terms)


def drawn_with(body: BodyEstimate, estimate: Estimate, lens: Lens | None = None) -> Estimate:
    """The ``estimate`` as the overlay draws it: patches that do not agree as doubtful, and their body one template
    more, where a ``lens`` shows it, whose score is the share that agrees."""
    apart = ~body.used & (estimate.status == Status.CONVERGED)
    status = torch.where(apart, int(Status.MAX_ITERATIONS), estimate.status).to(torch.int8)
    one = estimate.at(torch.zeros_like(body.status, dtype=torch.int64))
    pose = body.pose if lens is None else lens.distort_pose(body.pose)
    one = one._replace(pose=pose, displacement=body.displacement, covariance=body.covariance, status=body.status)
    one = one._replace(score=body.used.to(one.score.dtype).mean()[None])
    both = zip(estimate._replace(status=status), one, strict=True)
    return Estimate(*(torch.cat((a, b)) for a, b in both))


def write_bodies(
    folder: Path, bodies: int | None, tracker: Tracker, lens: Lens | None, um_matrix: Tensor | None, first: Tensor
) -> None:
    """The bodies of the track.npz in ``folder``: one of all its templates, or so many ``bodies`` by their motion; as
    without the ``lens``."""
    from torch_ecc.plots.body import plot_body

    with np.load(folder / "track.npz") as found:
        named = {name: torch.from_numpy(found[name]) for name in Estimate._fields if name in found}
        time = found.get("time_s")
        number = found["frame"]
    none = torch.zeros_like(named["score"], dtype=torch.int8)
    track = Track(**(dict.fromkeys(Estimate._fields, none) | named))
    groups, still = [list(range(track.pose.shape[1]))], False
    if bodies is not None:
        groups, still, _ = rigid_groups(track, bodies)
    found_bodies = Body(tracker, groups, lens)(track)
    rows = _rows(found_bodies, groups, (number, time), um_matrix)
    file = create(part(folder, "body.csv"))
    try:
        for text in rows:
            append(file, text.encode())
    finally:
        file.close()
    write_json(part(folder, "body.json"), {"bodies": _facts(found_bodies, track, groups, still)})
    publish(folder, *BODY_FILES[:2])
    plot_body(folder / "body.png", first, tracker.start[:, :2], groups, found_bodies, time)


def told(folder: Path) -> list[str]:
    """A line about each body of a result."""
    path = folder / "body.json"
    lines = []
    for g, fact in enumerate(json.loads(path.read_text(encoding="utf-8"))["bodies"] if path.is_file() else []):
        words = f"Body {g}{' (stands still)' if fact['stands_still'] else ''}: {len(fact['patches'])} patches"
        if "median_sigma_px_px_rad" in fact:
            x, y, theta = fact["median_sigma_px_px_rad"]
            words += f", sigma {x:.2g} px, {y:.2g} px, {1e6 * theta:.2g} urad"
        apart = ", ".join(map(str, fact["patches_that_disagree"]))
        lines.append(words + (f"; not like the others: {apart}" if apart else ""))
    return lines


def _rows(
    body: BodyEstimate, groups: list[list[int]], clock: tuple[Any, Any], um_matrix: Tensor | None
) -> Iterator[str]:
    """The table, the header first and then one frame after the other. Of several bodies each is also told as seen from
    the last one, which may stand still: what both have in common, as drift, is taken out."""
    number, time = clock
    moved = [f"d{name}" for name in POSE]
    header = ["frame", "body", *([] if time is None else ["time_s"]), *POSE, *moved]
    header += [] if um_matrix is None else ["dx_um", "dy_um"]
    header += [f"sigma_{name}" for name in POSE] + ["chi2", "freedom", "patches", "used", "status"]
    several, start = len(groups) > 1, body.pose[0] - body.displacement[0]
    if several:
        header += [f"relative_{name}" for name in moved] + [f"sigma_relative_{name}" for name in POSE]
        seen = [body.relative(g, len(groups) - 1) for g in range(len(groups) - 1)]
    yield ",".join(header) + "\n"
    for k in range(len(body.pose)):
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        for g, group in enumerate(groups):
            found = bool(body.ok[k, g])
            row: list[Any] = [int(number[k]), g] + ([] if time is None else [f"{time[k]:.9f}"])
            row += _numbers(body.pose[k, g], found) + _numbers(body.displacement[k, g], found)
            if um_matrix is not None:
                row += [f"{v:.6f}" if found else "" for v in (um_matrix @ body.displacement[k, g, :2]).tolist()]
            row += [f"{v:.4g}" if found else "" for v in body.sigma[k, g].tolist()]
            row += [f"{float(body.chi2[k, g]):.4g}" if found else "", max(round(float(body.freedom[k, g])), 0)]
            row += [len(group), int(body.used[k, group].sum()), Status(int(body.status[k, g])).name]
            if several and g < len(groups) - 1:
                pose, covariance = seen[g][0][k] - start[g], seen[g][1][k]
                row += _numbers(pose, found) + [
                    f"{v:.4g}" if found else "" for v in covariance.diagonal().sqrt().tolist()
                ]
            elif several:
                row += [""] * 6
            table.writerow(row)
        yield text.getvalue()


def _numbers(pose: Tensor, found: bool) -> list[str]:
    return [f"{v:.{n}f}" if found else "" for v, n in zip(pose.tolist(), (6, 6, 9), strict=True)]


def _facts(body: BodyEstimate, track: Track, groups: list[list[int]], still: bool) -> list[dict[str, Any]]:
    """What is said of each body as a whole."""
    facts: list[dict[str, Any]] = []
    for g, group in enumerate(groups):
        found = (track.status[:, group] == Status.CONVERGED).sum(0)
        agree = body.used[:, group].sum(0)
        named = [r for r, a, f in zip(group, agree.tolist(), found.tolist(), strict=True) if a <= SELDOM * f]
        ok = body.ok[:, g]
        fact: dict[str, Any] = {
            "patches": group,
            "stands_still": still and g == len(groups) - 1,
            "patches_that_disagree": named,
            "frames": int(ok.sum()),
            "reference_point_px": (body.pose[0] - body.displacement[0])[g, :2].tolist(),
        }
        if bool(ok.any()):
            fact["median_sigma_px_px_rad"] = body.sigma[ok, g].median(0).values.tolist()
            ratio = (body.chi2 / body.freedom)[ok, g]
            fact["median_chi2_per_freedom"] = float(ratio.median()) if len(group) > 1 else None
        facts.append(fact | _centre(body, g))
    return facts


def _centre(body: BodyEstimate, g: int) -> dict[str, Any]:
    """Where the body turns, if it does."""
    known = body.ok[:, g]
    try:
        centre = rotation_centre(body.pose[known, g], body.covariance[known, g])
    except ValueError:
        return {}
    told = {"px": centre.centre.tolist(), "sigma_px": centre.sigma.tolist(), "fixed": centre.fixed}
    return {"rotation_centre": told | {"wander_px": centre.wander_px}}
