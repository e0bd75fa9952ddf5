"""The moving picture of the README: a patch that is followed while something passes over it, and what is measured.

``python benchmarks/moving_picture.py [OUT.webp]``: left the frames as the overlay draws them, right x, y and theta as
they grow, with three sigma; where nothing is believed there is a gap.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

import torch_ecc as te
from torch_ecc.io.frames import Frame
from torch_ecc.io.overlay import OverlayWriter
from torch_ecc.sim import Camera, harmonic, micrograph, placed

FRAMES, FPS = 90, 15
SHAPE, CENTER, SIDE = (400, 480), (255.0, 190.0), 91
COVER = range(38, 62)  # frames in which a bar passes
STATUS = {int(status): status.name for status in te.Status}
Picture = NDArray[np.uint8]


def sequence() -> torch.Tensor:
    """(F, H, W) uint8: a micrograph under a microscope, and a bar that passes over it."""
    path = placed(harmonic((30.0, 25.0, 0.12), points=FRAMES), (SHAPE[1] / 2, SHAPE[0] / 2))
    frames = Camera(size=SHAPE, noise_sigma=3).capture(micrograph(), path)[:, 0]
    for number, left in zip(COVER, np.linspace(60, 420, len(COVER)).astype(int).tolist(), strict=True):
        frames[number, :, left : left + 26] = 40
    return frames


def overlays(frames: torch.Tensor, track: list[te.Estimate]) -> list[Picture]:
    """The frames (h, w, 3) as the overlay draws them."""
    with TemporaryDirectory() as folder:
        with OverlayWriter(folder, shapes=[(SIDE, SIDE)], status_names=STATUS, as_frames=True) as writer:
            for number, (frame, estimate) in enumerate(zip(frames, track, strict=True)):
                writer.write(Frame(number, frame), estimate)
        return [np.asarray(Image.open(path).convert("RGB")) for path in sorted(Path(folder, "overlay").iterdir())]


def curves(track: list[te.Estimate]) -> Iterator[Picture]:
    """The displacements so far, frame by frame."""
    figure = Figure(figsize=(3.8, 4), dpi=100)
    canvas = FigureCanvasAgg(figure)
    scale = np.array([1, 1, np.degrees(1)])
    moved = np.stack([estimate.displacement[0].numpy() for estimate in track]) * scale
    sigma = np.stack([estimate.sigma[0].numpy() for estimate in track]) * scale
    good = np.array([bool(estimate.ok[0]) for estimate in track])
    moved[~good] = np.nan
    axes = figure.subplots(3, 1, sharex=True)
    figure.subplots_adjust(left=0.19, right=0.97, top=0.97, bottom=0.12, hspace=0.18)
    lines = []
    for k, (axis, name) in enumerate(zip(axes, ("x (px)", "y (px)", "theta (deg)"), strict=True)):
        lines.append(axis.plot([], [], color="#0072b2", lw=1.4)[0])
        axis.set(xlim=(0, FRAMES), ylim=(np.nanmin(moved[:, k]) * 1.1, np.nanmax(moved[:, k]) * 1.1), ylabel=name)
        axis.spines[["top", "right"]].set_visible(False)
        axis.yaxis.set_label_coords(-0.14, 0.5)
        lines.append(axis.text(0.98, 0.04, "", transform=axis.transAxes, ha="right", fontsize=8, color="#555555"))
    axes[-1].set_xlabel("frame")
    for done in range(1, len(track) + 1):
        for k in range(3):
            lines[2 * k].set_data(np.arange(done), moved[:done, k])
            unit = ("px", "px", "deg")[k]
            lines[2 * k + 1].set_text(f"sigma {sigma[done - 1, k]:.4f} {unit}" if good[done - 1] else "not found")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def main() -> None:
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "moving_picture.webp")
    frames = sequence()
    tracker = te.Tracker(frames[0], [CENTER], SIDE)
    track = [tracker.track(frame) for frame in frames]
    joined = [np.hstack(pair) for pair in zip(overlays(frames, track), curves(track), strict=True)]
    first, *rest = (Image.fromarray(picture) for picture in joined)
    first.save(path, save_all=True, append_images=rest, duration=1000 // FPS, loop=0, quality=45, method=6)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, {len(joined)} frames")


if __name__ == "__main__":
    main()
