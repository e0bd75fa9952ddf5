"""A tracking run from a video to its files: what ``torch-ecc track`` does."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.commands.jobs import TrackJob
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.frame import as_gray
from torch_ecc.io import OverlayWriter, TrackWriter, open_frames
from torch_ecc.plots import plot_track
from torch_ecc.search.locate import Located
from torch_ecc.track.tracker import Tracker

STATUS_NAMES = {int(code): code.name for code in Status}


class Templates(NamedTuple):
    """Centres (R, 2) px, common size (h, w) px and masks (R, h, w) or None."""

    centers: Tensor
    size: tuple[int, int]
    mask: Tensor | None

    @staticmethod
    def of(crops: Tensor) -> Templates:
        """The templates that images (R, 1, h, w) show, each in its own coordinates."""
        h, w = crops.shape[-2:]
        return Templates(torch.tensor([[(w - 1) / 2, (h - 1) / 2]]).repeat(len(crops), 1), (h, w), None)

    @property
    def shapes(self) -> list[tuple[int, int] | Tensor]:
        """What each template covers, for drawing."""
        return [self.size] * len(self.centers) if self.mask is None else list(self.mask)


class Finished(NamedTuple):
    """What became of a run: ``frames`` done, how many each template was lost in and its last status (R,), the folder,
    and whether it was stopped from the keyboard."""

    frames: int
    lost: Tensor
    last_status: Tensor
    folder: Path
    interrupted: bool


class Session:
    """A checked run: the input is open, the templates are cut, and nothing is written yet.

    Raises FileNotFoundError or ValueError for whatever in ``job`` does not fit.
    """

    def __init__(self, job: TrackJob) -> None:
        self.job, self.calibration = job, job.calibration()
        crops = read_templates(job)
        self.templates = choose_templates(job) if crops is None else Templates.of(crops)
        self.source = open_frames(job.input, fps=job.fps)
        first = self.source.first if job.reference is None else open_frames(job.reference).first
        centers, size, mask = self.templates
        if crops is None:
            self.tracker = Tracker(first, centers, size, mask=mask, **job.options())
        else:
            near = torch.tensor(job.centers).double() if job.centers else None
            self.tracker, located = Tracker.find(crops, first, near=near, **job.options())
            refuse_doubt(located, near is not None)
        if self.source.shape != first.shape[-2:]:
            (h, w), (h0, w0) = self.source.shape, first.shape[-2:]
            raise ValueError(f"reference: expected an image of the input's size {w}x{h} px, got {w0}x{h0} px")
        self.fps = self.source.fps

    def run(self, progress: Callable[[Estimate], None] = lambda estimate: None) -> Finished:
        """Track every frame and write DIR/track.csv, track.npz, track.png, summary.json and overlay.mp4.

        ``progress`` is told each frame's estimate. Ctrl-C ends the run and keeps what it had; so does a damaged frame,
        whose ValueError is raised again once everything before it is written.
        """
        folder, done = Path(self.job.out), 0
        stopped: BaseException | None = None
        lost = torch.zeros(len(self.templates.centers), dtype=torch.int64)
        last = torch.zeros_like(lost)
        writer, overlay = self._writers(folder)
        try:
            with writer, overlay:
                for frame in self.source:
                    if frame.pixels is None:
                        raise ValueError(f"frame {frame.number}: {frame.damage}")
                    estimate = self.tracker(frame.pixels)
                    writer.write(estimate)
                    overlay.write(frame.picture(), estimate)
                    last = estimate.status.cpu().long()
                    lost += ~Status.good(last)
                    done += 1
                    progress(estimate)
        except (KeyboardInterrupt, ValueError) as error:
            stopped = error
        if done:
            plot_track(folder / "track.npz", folder / "track.png", title=self.source.name)
        if isinstance(stopped, ValueError):
            raise stopped
        return Finished(done, lost, last, folder, stopped is not None)

    def _writers(self, folder: Path) -> tuple[TrackWriter, OverlayWriter | _NoOverlay]:
        matrix = None
        if self.calibration is not None:
            matrix = self.calibration.matrix(torch.zeros(1, dtype=torch.float64))[:2, :2]
        settings = {name: value for name, value in dataclasses.asdict(self.job).items() if value not in (None, ())}
        writer = TrackWriter(folder, status_names=STATUS_NAMES, fps=self.fps, um_matrix=matrix, settings=settings)
        if not self.job.overlay:
            return writer, _NoOverlay()
        shapes = self.templates.shapes
        return writer, OverlayWriter(folder, shapes=shapes, status_names=STATUS_NAMES, fps=self.fps)


class _NoOverlay(nullcontext[None]):
    def write(self, frame: Tensor, estimate: Estimate) -> None:
        """Nothing: the run goes without pictures."""


def read_templates(job: TrackJob) -> Tensor | None:
    """The images of ``job.template``, (R, 1, h, w) float, None if there are none. ValueError if they do not fit."""
    if not job.template:
        return None
    for name, given in (("reference", job.reference), ("size", job.size), ("polygons", job.polygons)):
        if given:
            raise ValueError(f"{name}: not with template, whose image tells it all; got {given}")
    if job.centers and len(job.centers) != len(job.template):
        raise ValueError(f"centers: expected one per template ({len(job.template)}), got {len(job.centers)}")
    crops = [as_gray("template", name, open_frames(name).first) for name in job.template]
    sizes = {f"{crop.shape[-1]}x{crop.shape[-2]}" for crop in crops}
    if len(sizes) > 1:
        raise ValueError(f"template: expected images of one size, got {sorted(sizes)} px")
    return torch.cat(crops)


def refuse_doubt(located: Located, placed: bool) -> None:
    """ValueError for the first template that the first frame does not show, or shows at several places unless it is
    known which one is meant."""
    for r, status in enumerate(located.status.tolist()):
        best, other = (_place(*p.tolist()) for p in (located.pose[r], located.runner_up.pose[r]))
        score, second = float(located.score[r]), float(located.runner_up_score[r])
        if not Status.good(located.status[r]):
            why = f". {Status.describe(status)}" if status == Status.LOW_TEXTURE else ""
            raise ValueError(f"template: number {r} is not in the first frame (best: {best}, score {score:.3f}){why}")
        if bool(located.ambiguous[r]) and not placed:
            raise ValueError(
                f"template: number {r} may be at {best} (score {score:.3f}) or at {other} (score {second:.3f}); "
                "a center tells which one is meant"
            )


def _place(x: float, y: float, theta: float) -> str:
    return f"x={x:.1f}, y={y:.1f}, theta={math.degrees(theta):.1f} deg"


def choose_templates(job: TrackJob) -> Templates:
    """Centres, size and masks of a job; polygons bring what is not given. ValueError if that leaves something open."""
    if not job.centers and not job.polygons:
        raise ValueError("centers: expected at least one (x, y), or a polygon, got none")
    if job.centers and job.polygons and len(job.centers) != len(job.polygons):
        raise ValueError(f"polygons: expected one per center ({len(job.centers)}), got {len(job.polygons)}")
    polygons = [np.array(polygon, dtype=np.float64) for polygon in job.polygons]
    for number, polygon in enumerate(polygons):
        if len(polygon) < 3 or not np.isfinite(polygon).all():
            raise ValueError(f"polygons: polygon {number} needs three or more finite corners, got {polygon.tolist()}")
    middles = [tuple(np.round((p.min(0) + p.max(0)) / 2)) for p in polygons]
    centers = np.array(job.centers or middles, dtype=np.float64)
    size = job.size
    if size is None:
        if not polygons:
            raise ValueError("size: expected the side of the templates in px, got none")
        size = 2 * math.ceil(max(np.abs(p - c).max() for p, c in zip(polygons, centers, strict=True))) + 1
    h, w = (size, size) if isinstance(size, int) else size
    if not polygons:
        return Templates(torch.from_numpy(centers), (h, w), None)
    masks = [
        _rasterise(p, np.round(c - (w / 2 - 0.5, h / 2 - 0.5)), (h, w)) for p, c in zip(polygons, centers, strict=True)
    ]
    return Templates(torch.from_numpy(centers), (h, w), torch.stack(masks))


def _rasterise(polygon: NDArray[np.float64], corner: NDArray[np.float64], size: tuple[int, int]) -> Tensor:
    """Mask (h, w) of the pixels inside a polygon (N, 2) and on its border, ``corner`` being pixel (0, 0)."""
    mask = np.zeros(size, dtype=np.uint8)
    fraction_bits = 4
    corners = np.round((polygon - corner) * 2**fraction_bits).astype(np.int32)
    cv2.fillPoly(mask, [corners], 1, shift=fraction_bits)
    return torch.from_numpy(mask) > 0
