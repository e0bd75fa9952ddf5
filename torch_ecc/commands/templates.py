"""Which patches a tracking run follows: centres, polygons, a grid, or images of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.commands.jobs import TrackJob
from torch_ecc.core.estimate import Status
from torch_ecc.core.frame import as_gray
from torch_ecc.core.patches import texture
from torch_ecc.io import open_frames
from torch_ecc.search.locate import Located
from torch_ecc.track.sensor import FIND

LEAST_PRECISE = 0.05  # px: patches of a body that tell less of where they are only take time
MOST = 20_000  # patches of a grid
TRIED = 4  # places across, and down, of each field of a grid, for the best patch of a body


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


def read_templates(job: TrackJob) -> Tensor | None:
    """The images of ``job.template``, (R, 1, h, w) float, None if there are none. ValueError if they do not fit."""
    if not job.template:
        return None
    for name in ("reference", "size", "polygons", "grid"):
        if given := getattr(job, name):
            raise ValueError(f"{name}: not with template, whose image tells it all; got {given}")
    if job.centers and len(job.centers) != len(job.template):
        raise ValueError(f"centers: expected one per template ({len(job.template)}), got {len(job.centers)}")
    crops = [as_gray("template", name, open_frames(name).first) for name in job.template]
    sizes = {f"{crop.shape[-1]}x{crop.shape[-2]}" for crop in crops}
    if len(sizes) > 1:
        raise ValueError(f"template: expected images of one size, got {sorted(sizes)} px")
    return torch.cat(crops)


def read_frame_mask(job: TrackJob) -> Tensor | str | None:
    """Where the camera shows the scene, (H, W) bool: the brighter half of the grey levels in the image
    ``job.frame_mask``; FIND, or None if there is none."""
    if job.frame_mask is None:
        return FIND if job.find_marks else None
    image = as_gray("frame_mask", job.frame_mask, open_frames(job.frame_mask).first)[0, 0]
    return image > image.max() / 2


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


def choose_templates(job: TrackJob, frame: Tensor) -> Templates:
    """Centres, size and masks of a job in its first ``frame`` (H, W); polygons bring what is not given. ValueError if
    that leaves something open."""
    if job.grid is not None:
        return grid_templates(job, frame)
    if not job.centers and not job.polygons:
        raise ValueError("centers: expected at least one (x, y), or a polygon, got none")
    if job.centers and job.polygons and len(job.centers) != len(job.polygons):
        raise ValueError(f"polygons: expected one per center ({len(job.centers)}), got {len(job.polygons)}")
    polygons = [np.array(polygon, dtype=np.float64) for polygon in job.polygons]
    for number, polygon in enumerate(polygons):
        if len(polygon) < 3 or not np.isfinite(polygon).all():
            raise ValueError(f"polygons: polygon {number} needs three or more finite corners, got {polygon.tolist()}")
        if (np.ptp(polygon, 0) > frame.shape[:-3:-1]).any():
            raise ValueError(f"polygons: polygon {number} is larger than the frame, got {polygon.tolist()}")
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


def grid_templates(job: TrackJob, frame: Tensor) -> Templates:
    """``job.grid`` patches in a row, as many rows as fit evenly, without those whose texture does not fix a pose."""
    for name in ("centers", "polygons"):
        if given := getattr(job, name):
            raise ValueError(f"{name}: not with grid, which places the templates; got {given}")
    if job.size is None:
        raise ValueError("size: expected the side of the templates in px, got none")
    h, w = (job.size, job.size) if isinstance(job.size, int) else job.size
    height, width = frame.shape[-2:]
    most = math.isqrt(MOST * width // height)
    if job.grid is None or not 1 <= job.grid <= most or h > height or w > width:
        raise ValueError(
            f"grid: expected 1 to {most} templates in a row, {w}x{h} px each, in {width}x{height} px, got {job.grid}"
        )
    rows = max(round(job.grid * height / width), 1)
    # In the middles of equal fields, but for the templates' own halves at the border.
    x, y = (
        (torch.arange(n, dtype=torch.float64) + 0.5) * (whole / n) - 0.5
        for n, whole in ((job.grid, width), (rows, height))
    )
    x, y = x.clamp((w - 1) / 2, width - (w + 1) / 2), y.clamp((h - 1) / 2, height - (h + 1) / 2)
    centers = torch.cartesian_prod(y, x).flip(1).reshape(-1, 2)
    if job.body or job.bodies is not None:
        room = (width / job.grid - w, height / rows - h)
        return _best_in_fields(frame, centers, (h, w), room, job)
    kept = texture(frame, centers, (h, w), criterion=job.criterion).isfinite().all(1)
    _refuse_none(kept)
    return Templates(centers[kept], (h, w), None)


def _best_in_fields(
    frame: Tensor, middles: Tensor, size: tuple[int, int], room: tuple[float, float], job: TrackJob
) -> Templates:
    """The patch of each field around ``middles`` (N, 2) that tells most of x and y, ``room`` px wide and high for its
    centre to be in: they stay apart, and as far as the fields. Fields without much texture have none."""
    steps = torch.linspace(-0.5, 0.5, TRIED, dtype=torch.float64)
    offsets = torch.cartesian_prod(steps, steps).flip(1) * torch.tensor(room, dtype=torch.float64).clamp(min=0).floor()
    tried = (middles[:, None] + offsets).round()
    low = torch.tensor(((size[1] - 1) / 2, (size[0] - 1) / 2)).double()
    high = torch.tensor((frame.shape[-1], frame.shape[-2])).double() - 1 - low
    tried = tried.clamp(low.ceil(), high.floor())
    sigma = texture(frame, tried.flatten(0, 1), size, criterion=job.criterion).unflatten(0, tried.shape[:2])
    spread, best = sigma[..., :2].square().sum(-1).min(1)
    kept = spread < LEAST_PRECISE**2
    _refuse_none(kept)
    return Templates(tried[torch.arange(len(tried)), best][kept], size, None)


def _refuse_none(kept: Tensor) -> None:
    if not kept.any():
        raise ValueError(f"grid: none of the {len(kept)} patches has enough texture to fix x, y and theta")


def _rasterise(polygon: NDArray[np.float64], corner: NDArray[np.float64], size: tuple[int, int]) -> Tensor:
    """Mask (h, w) of the pixels inside a polygon (N, 2) and on its border, ``corner`` being pixel (0, 0)."""
    mask = np.zeros(size, dtype=np.uint8)
    fraction_bits = 4
    corners = np.round((polygon - corner) * 2**fraction_bits).astype(np.int32)
    cv2.fillPoly(mask, [corners], 1, shift=fraction_bits)
    return torch.from_numpy(mask) > 0
