"""Real sequences with known motion: python benchmarks/real.py DATA_FOLDER (or TORCH_ECC_DATA).

Prints the largest errors on mechanism_video, pixel_shift, pyvale_rigid and rotation_full at default settings, how far a
jump may go with and without pyramid and search, and of 1,000 frames of each, there and back over and over: how many are
found, by how much what is CONVERGED differs from one visit of a frame to the next, and the median and longest time of
a frame, of some runs the shortest.
"""

from __future__ import annotations

import json
import math
import sys
import time
from itertools import cycle, islice
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from work import data_folder

from torch_ecc import Status, Tracker
from torch_ecc.commands.track import TrackJob, choose_templates
from torch_ecc.io import open_frames

console = Console(width=120)
VISITS = 1000  # frames, there and back
RUNS = 3  # of the same frames: the shortest time of each is its own, and not that of what else the machine did


def facts(folder: Path) -> dict:
    return json.loads((folder / "truth.json").read_text())


def frames(folder: Path) -> list[torch.Tensor]:
    return [frame.pixels for frame in open_frames(str(folder / "f*.png"))]


def reference(folder: Path) -> torch.Tensor:
    return open_frames(folder / "ref.png").first


def middle(hint: list[int]) -> tuple[float, float]:
    x, y, w, h = hint
    return (x + (w - 1) / 2, y + (h - 1) / 2)


def mechanism(folder: Path) -> list[tuple[str, ...]]:
    truth = facts(folder)
    bodies = truth["bodies"].values()
    outlines = tuple(tuple(map(tuple, body["mask_polygon"])) for body in bodies)
    video = frames(folder)
    job = TrackJob(input="", centers=tuple(tuple(body["centre_px"]) for body in bodies), polygons=outlines)
    centers, size, mask, *_ = choose_templates(job, video[0])
    track = Tracker(video[0], centers, size, mask=mask).track_sequence(video[1:])
    rows = []
    for b, name in enumerate(truth["bodies"]):
        moves = [[f["bodies"][name][k] for k in ("tx", "ty", "theta_deg")] for f in truth["frames"][-55:]]
        error = track.displacement[:, b] - torch.tensor(moves) * torch.tensor([1, 1, -math.pi / 180])
        rows.append(row(f"mechanism_video, body {name}", error, track.status[:, b]))
    return rows


def row(name: str, error: torch.Tensor, status: torch.Tensor) -> tuple[str, ...]:
    largest = error.abs().amax(0)
    converged = int((status == Status.CONVERGED).sum())
    px, deg = f"{float(largest[:2].max()):.5f}", f"{math.degrees(float(largest[2])):.5f}"
    return name, px, deg, f"{converged} of {len(status)}"


def shifts(folder: Path) -> tuple[str, ...]:
    truth = facts(folder)
    track = Tracker(reference(folder), [middle(truth["template_hint"])], 121).track_sequence(frames(folder))
    expected = torch.tensor([[f["tx"], f["ty"], 0.0] for f in truth["frames"]])
    return row(folder.name, track.displacement[:, 0] - expected, track.status[:, 0])


def rotation(folder: Path, center: tuple[float, float], size: int) -> tuple[str, ...]:
    truth = facts(folder)
    track = Tracker(reference(folder), [center], size).track_sequence(frames(folder))
    c, p = torch.tensor(truth["centre_px"]), torch.tensor(center)
    expected = []
    for f in truth["frames"]:
        a = math.radians(f["theta_deg"])
        turn = torch.tensor([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
        expected.append([*(c + turn @ (p - c)).tolist(), -a])
    return row(f"{folder.name}, {size} px at {center}", track.pose[:, 0] - torch.tensor(expected), track.status[:, 0])


def basin(folder: Path, levels: int, search: bool) -> tuple[str, str]:
    """Largest whole-px jump in x and y at once from the first frame that is found, all smaller ones too."""
    truth, still = facts(folder), reference(folder)
    reached = 0
    for f, frame in zip(truth["frames"], frames(folder), strict=True):
        estimate = Tracker(still, [middle(truth["template_hint"])], 121, levels=levels, search=search)(frame)
        good = bool(Status.good(estimate.status)) and abs(float(estimate.displacement[0, 0]) - f["tx"]) < 0.002
        if not good:
            break
        reached = int(f["tx"])
    return f"levels={levels}" + (", search" if search else ""), f"{reached} of {len(truth['frames'])} px"


def there_and_back(folder: Path, center: tuple[float, float] | None, size: int) -> tuple[str, ...]:
    still = folder / "ref.png"
    shown = ([reference(folder)] if still.exists() else []) + frames(folder)
    h, w = shown[0].shape[-2:]
    order = list(islice(cycle([*range(1, len(shown)), *range(len(shown) - 2, -1, -1)]), VISITS))
    shortest = [math.inf] * VISITS
    for _ in range(RUNS):
        tracker = Tracker(shown[0], [center or (w / 2, h / 2)], size)
        visits: dict[int, list[torch.Tensor]] = {}
        found = 0
        for n, k in enumerate(order):
            begin = time.process_time()
            estimate = tracker(shown[k])
            shortest[n] = min(shortest[n], 1e3 * (time.process_time() - begin))
            found += bool(estimate.ok)
            if estimate.status == Status.CONVERGED:
                visits.setdefault(k, []).append(estimate.pose[0, :2])
    apart = max(float((torch.stack(v).amax(0) - torch.stack(v).amin(0)).amax()) for v in visits.values())
    median, longest = sorted(shortest)[VISITS // 2], max(shortest)
    figures = f"{apart:.3f}", f"{median:.2f}", f"{longest:.0f}", f"{longest / median:.0f}"
    return f"{folder.name}, {size} px", f"{found} of {VISITS}", *figures


def main() -> None:
    data = data_folder(sys.argv[1] if len(sys.argv) > 1 else None)
    table = Table("sequence", "largest px", "largest deg", "converged", title="Real sequences, default settings")
    for cells in mechanism(data / "mechanism_video"):
        table.add_row(*cells)
    for name in ("pixel_shift", "pyvale_rigid"):
        table.add_row(*shifts(data / name))
    table.add_row(*rotation(data / "rotation_full", (70.0, 52.0), 49))
    table.add_row(*rotation(data / "rotation_full", (126.0, 126.0), 201))
    console.print(table)
    jumps = Table("settings", "largest jump in x and y", title="pixel_shift, each frame from the first one's pose")
    for levels, search in ((1, False), (2, False), (3, False), (1, True)):
        jumps.add_row(*basin(data / "pixel_shift", levels, search))
    console.print(jumps)
    title = f"There and back, {VISITS} frames, processor time, of {RUNS} runs the shortest of each frame"
    visits = Table("sequence", "found", "px between visits", "median, ms", "longest, ms", "ratio", title=title)
    for name, center, size in (
        ("mechanism_video", (320.0, 240.0), 51),
        ("pixel_shift", None, 61),
        ("pyvale_rigid", None, 61),
        ("rotation_full", (70.0, 52.0), 49),
        ("rotation_full", (126.0, 126.0), 201),
    ):
        visits.add_row(*there_and_back(data / name, center, size))
    console.print(visits)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
