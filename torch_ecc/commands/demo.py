"""``torch-ecc demo``: a sequence with known motion under uneven light and noise, tracked with ECC and SSD."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table
from torch import Tensor

from torch_ecc.commands.track import ORIGIN_NAMES, REASON_NAMES, STATUS_NAMES
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.io import OverlayWriter, TrackWriter
from torch_ecc.plots import plot_track
from torch_ecc.records.calibration import Calibration
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.light import GradientLight
from torch_ecc.sim.camera.motion import harmonic, placed
from torch_ecc.sim.camera.sequence import Sequence
from torch_ecc.sim.scene.micrograph import micrograph
from torch_ecc.track.tracker import Tracker

SIZE = 121  # px, the paper's template
AMPLITUDES = (50.0, 50.0, math.radians(10.0))
NOISE = 2.0  # grey levels
UM_PER_PX = 0.275  # 5.5 um pixels behind a magnification of 20
PAPER = {"ecc": (0.05, 0.05), "ssd": (0.07, 0.35)}  # px and deg: largest errors of Fig. 3 under uneven light
COLOURS = {"ecc": "#0b6e4f", "ssd": "#c8553d"}


class DemoResult(NamedTuple):
    """Errors (F, 3) px, px, rad of each method, frame by frame, and frames that it lost."""

    errors: dict[str, Tensor]
    lost: dict[str, int]

    def table(self) -> Table:
        """Errors beside the paper's largest ones under uneven light (Fig. 3); 80 columns."""
        table = Table(title=f"Errors against the exact motion ({UM_PER_PX:g} um per px)", title_justify="left")
        for name in ("", "", "x px", "y px", "theta deg", "x nm", "y nm"):
            table.add_column(name, justify="right" if name else "left")
        for method, error in self.errors.items():
            px, deg = PAPER[method]
            lost = f"{self.lost[method]} lost" if self.lost[method] else ""
            table.add_row(method, "rms", *_cells(error.square().mean(0).sqrt()))
            table.add_row(lost, "largest", *_cells(error.abs().amax(0)))
            table.add_row("", "paper, largest", *_cells(torch.tensor((px, px, math.radians(deg)))), end_section=True)
        return table


def _cells(pose: Tensor) -> list[str]:
    """(3,) px, px, rad as px, px, deg, nm, nm."""
    x, y, theta = pose.tolist()
    nm = 1e3 * UM_PER_PX
    return [f"{x:.4f}", f"{y:.4f}", f"{math.degrees(theta):.4f}", f"{nm * x:.1f}", f"{nm * y:.1f}"]


def run_demo(out: Path, frames: int, advance: Callable[[int, int], None]) -> DemoResult:
    """Render, track with both methods at once and write their outputs; ``advance(done, total)`` tells how far it is."""
    camera = Camera(light=GradientLight(), noise_sigma=NOISE)
    h, w = camera.size
    path = placed(harmonic(AMPLITUDES, frames), (w / 2, h / 2))
    sequence = Sequence(micrograph(), path, camera)
    first, center = sequence.batch(0, 1)[0, 0], path[:1, :2]
    truth = sequence.truth(center)[:, 0]
    trackers = {name: Tracker(first, center, SIZE, criterion=name) for name in PAPER}
    poses: dict[str, list[Estimate]] = {name: [] for name in PAPER}
    with ExitStack() as stack:
        writers = {name: _open(stack, out / name, trackers[name]) for name in PAPER}
        for k, frame in enumerate(sequence):
            for name, tracker in trackers.items():
                estimate = tracker(frame)
                poses[name].append(estimate)
                writers[name][0].write(estimate)
                writers[name][1].write(frame, estimate)
            advance(k + 1, frames)
    for name in PAPER:
        plot_track(out / name / "track.npz", out / name / "track.png", title=f"demo, {name}")
    errors = {name: torch.cat([e.pose for e in found]) - truth for name, found in poses.items()}
    lost = {name: sum(int((~Status.good(e.status)).sum()) for e in found) for name, found in poses.items()}
    sigma = torch.cat([e.sigma for e in poses["ecc"]])
    draw(first, truth, errors, sigma).savefig(out / "demo.png", dpi=130)
    np.savetxt(out / "truth.csv", truth.numpy(), delimiter=",", header="x_px,y_px,theta_rad", comments="", fmt="%.9f")
    return DemoResult(errors, lost)


def _open(stack: ExitStack, folder: Path, tracker: Tracker) -> tuple[TrackWriter, OverlayWriter]:
    um = Calibration(UM_PER_PX).matrix(torch.zeros(1, dtype=torch.float64))[:2, :2]
    settings = {"criterion": str(tracker.criterion), "size": SIZE, "um_per_px": UM_PER_PX, **asdict(tracker.settings)}
    words: dict[str, Any] = {"status_names": STATUS_NAMES, "fps": 25.0, "um_matrix": um}
    names: dict[str, Any] = {"reason_names": REASON_NAMES, "origin_names": ORIGIN_NAMES}
    track = TrackWriter(folder, settings=settings, **names, **words)
    overlay = OverlayWriter(folder, shapes=[(SIZE, SIZE)], **words)
    return stack.enter_context(track), stack.enter_context(overlay)


def draw(first: Tensor, truth: Tensor, errors: dict[str, Tensor], sigma: Tensor) -> Figure:
    """The frame with the template's path, and the errors of x, y and theta of both methods."""
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(11, 5.2), layout="constrained")
        grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1.4))
        _draw_frame(figure.add_subplot(grid[:, 0]), first, truth)
        names = ("x error (px)", "y error (px)", "theta error (deg)")
        for k, name in enumerate(names):
            axes = figure.add_subplot(grid[k, 1])
            scale = math.degrees(1) if k == 2 else 1.0
            for method in ("ssd", "ecc"):
                axes.plot(scale * errors[method][:, k], color=COLOURS[method], lw=1.1, label=method.upper())
            band = 3 * scale * sigma[:, k]
            axes.fill_between(
                range(len(band)), -band, band, color=COLOURS["ecc"], alpha=0.15, lw=0, label="ECC's own 3 sigma"
            )
            limit = PAPER["ecc"][k == 2]
            for y in (-limit, limit):
                axes.axhline(y, color="0.5", lw=0.8, ls=":", label="paper, ECC: largest" if y > 0 else None)
            axes.set_ylabel(name)
            axes.tick_params(labelbottom=k == 2)
        axes.set_xlabel("frame")
        figure.axes[1].legend(ncols=4, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=8)
    return figure


def _draw_frame(axes: Axes, first: Tensor, truth: Tensor) -> None:
    axes.imshow(first.numpy(), cmap="gray", vmin=0, vmax=255)
    axes.plot(truth[:, 0], truth[:, 1], color="#f4d35e", lw=1.2)
    x, y = truth[0, :2].tolist()
    half = SIZE / 2
    axes.plot(
        [x - half, x + half, x + half, x - half, x - half],
        [y - half, y - half, y + half, y + half, y - half],
        color="#0bd18a",
    )
    axes.set_title("First frame, template and its path: eq. (11), 50 px and 10 deg", fontsize=9)
    axes.set_axis_off()
