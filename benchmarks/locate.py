"""Global search: hit rate and time, beside cv2.matchTemplate: python benchmarks/locate.py [DATA] [poses] [threads].

A hit is within 1 px and 1 deg before the last refinement. The 121 x 121 templates and the frames have noise of 5 grey
levels of their own; frames are 640 x 480 px in uneven light, poses anywhere at any angle. OpenCV turns the same template
by the same turns of the same level and takes the best TM_CCOEFF_NORMED; "fine" is the same at full resolution in steps of
2 deg, every tenth pose. Both run alternately in one process, on as many threads; times are median and quartiles.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torch_ecc import Locator, Status, align, prepare, texture
from torch_ecc.io import open_frames
from torch_ecc.locate import halvings
from torch_ecc.pose import compose, inverse, to_opencv
from torch_ecc.sim import Camera, GradientLight, Pads, PlaneWaves, Scene, Speckle, micrograph
from torch_ecc.sim.still import image_scene

SIZE, SIDE = (480, 640), 121
console = Console(width=150)


class Trial(NamedTuple):
    """A template (1, 1, h, w), a frame (1, 1, H, W) and where the template is in it, (1, 3)."""

    template: Tensor
    frame: Tensor
    truth: Tensor


def simulated(
    scene: Scene, count: int, spread: tuple[float, float] = (0.0, 0.0), noise: float = 5.0
) -> Iterator[Trial]:
    """Patches of a scene, the middle one or anywhere within ``spread`` px of it, each in a frame at a random pose."""
    u = torch.rand(8 * count, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x, y = SIDE * 0.71 + u[:, 0] * (SIZE[1] - SIDE * 1.42), SIDE * 0.71 + u[:, 1] * (SIZE[0] - SIDE * 1.42)
    truth = torch.stack((x, y, (u[:, 2] - 0.5) * math.tau), -1)
    place = torch.cat(((u[:, 3:] - 0.5) * torch.tensor(spread), torch.zeros(len(u), 1)), -1)
    camera = Camera(size=SIZE, noise_sigma=noise, light=GradientLight())
    small, half = Camera(size=(SIDE, SIDE), noise_sigma=noise), torch.tensor([(SIDE - 1) / 2] * 2 + [0.0]).double()
    made = 0
    for k in range(len(u)):
        template = small.capture(scene, compose(half, inverse(place[k]))[None], seed=2 * k)
        if made < count and bool(texture(template, half[None, :2], SIDE, noise=noise).isfinite().all()):
            made += 1
            frame = camera.capture(scene, compose(truth[k], inverse(place[k]))[None], seed=2 * k + 1)
            yield Trial(template, frame, truth[k : k + 1])


def parts(folder: Path) -> Iterator[Trial]:
    """Each part of rotation_full, and all of it, in every frame."""
    facts, still = json.loads((folder / "truth.json").read_text()), next(iter(open_frames(str(folder / "ref.png"))))
    c = torch.tensor([*facts["centre_px"], 0.0]).double()
    for x, y, half in ((70, 52, 24), (205, 138, 30), (70, 190, 40), (98, 52, 30), (126, 126, 100)):
        local = torch.tensor([x, y, 0.0]).double() - c
        for fact, frame in zip(facts["frames"], open_frames(str(folder / "f*.png")), strict=True):
            turn = torch.tensor([0.0, 0.0, -math.radians(fact["theta_deg"])]).double()
            truth = compose(c, compose(turn, local))[None]
            yield Trial(
                still.reshape(1, 1, *still.shape[-2:])[..., y - half : y + half + 1, x - half : x + half + 1],
                frame,
                truth,
            )


def error(pose: Tensor, truth: Tensor) -> tuple[float, float]:
    step = (pose - truth)[0]
    return float(step[:2].norm()), abs(math.degrees(math.remainder(float(step[2]), math.tau)))


def hit(pose: Tensor, truth: Tensor) -> bool:
    px, deg = error(pose, truth)
    return px < 1 and deg < 1


class TurnedBank:
    """cv2.matchTemplate with a template (h, w) turned by ``turns`` (A,) rad, over the disc that fits into it."""

    def __init__(self, template: Tensor, turns: Tensor) -> None:
        size = h, w = template.shape
        self.turns, self.size, side = turns, size, int(min(h, w) / math.sqrt(2)) - 1  # what every turn fills
        self.side = side - 1 + side % 2
        pixels = template.numpy().astype("float32")
        for_all = torch.stack((torch.full_like(turns, (self.side - 1) / 2),) * 2 + (turns,), -1).double()
        warp = to_opencv(for_all, size)
        area = (self.side, self.side)
        self.templates = [cv2.warpAffine(pixels, m.numpy(), area, flags=cv2.INTER_LINEAR) for m in warp]

    def __call__(self, image: Tensor) -> Tensor:
        """The best pose (1, 3) in ``image`` (h, w)."""
        best = max(
            (
                cv2.minMaxLoc(cv2.matchTemplate(image.numpy(), t, cv2.TM_CCOEFF_NORMED)) + (k,)
                for k, t in enumerate(self.templates)
            ),
            key=lambda found: found[1],
        )
        (x, y), middle = best[3], (self.side - 1) / 2
        return torch.tensor([[x + middle, y + middle, float(self.turns[best[4]])]], dtype=torch.float64)


def measure(trials: Iterator[Trial]) -> tuple[str, ...]:
    """One line of the table."""
    hits, told, alarms, worse, cv_hits, fine = 0, 0, 0, 0, 0, []
    times: dict[str, list[float]] = {"locate": [], "cv2": [], "fine": []}
    count, locator, last = 0, None, None
    for count, (template, frame, truth) in enumerate(trials, 1):
        frame = frame.reshape(1, 1, *frame.shape[-2:])
        if last is None or not torch.equal(template, last):
            last, reference = template, prepare(template)
            locator = Locator(reference, (frame.shape[-2], frame.shape[-1]))
            level = locator.levels - 1
            bank = TurnedBank(halvings(template.float(), level + 1)[-1][0, 0], locator.banks[0].turns)
        begun = time.perf_counter()
        found = locator(frame)
        times["locate"].append(time.perf_counter() - begun)
        images = halvings(frame.float(), locator.levels)
        good = hit(locator.coarse(images, 0)[:1], truth)
        hits += good
        alarms += good and bool(found.ambiguous)
        told += not good and (bool(found.ambiguous) or not bool(Status.good(found.status)))
        worse += (
            good and error(found.pose, truth)[0] > 1.001 * error(align(reference, frame, truth).pose, truth)[0] + 1e-3
        )
        begun = time.perf_counter()
        rough = bank(halvings(frame.float(), level + 1)[-1][0, 0])
        times["cv2"].append(time.perf_counter() - begun)
        rough[:, :2] *= 2**level
        px, deg = error(rough, truth)
        step = math.degrees(math.tau / len(bank.turns))
        cv_hits += px < 2 * 2**level and deg < step
        if count % 10 == 1:
            slow = TurnedBank(template[0, 0].float(), torch.arange(180) * math.radians(2.0))
            begun = time.perf_counter()
            fine.append(hit(slow(frame[0, 0].float()), truth) if begun else False)
            times["fine"].append(time.perf_counter() - begun)
    row = f"{hits} of {count}", f"{told} of {count - hits}", str(alarms), str(worse), f"{level}, {len(bank.turns)}"
    return (
        *row,
        quartiles(times["locate"]),
        f"{cv_hits} of {count}",
        quartiles(times["cv2"]),
        f"{sum(fine)} of {len(fine)}",
        quartiles(times["fine"]),
    )


def quartiles(seconds: list[float]) -> str:
    low, middle, high = torch.tensor(seconds).quantile(torch.tensor([0.25, 0.5, 0.75])).tolist()
    return f"{1e3 * middle:.0f} ({1e3 * low:.0f}-{1e3 * high:.0f})"


def main() -> None:
    data = Path(sys.argv[1] if len(sys.argv) > 1 else os.environ["TORCH_ECC_DATA"])
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 200
    torch.set_num_threads(int(sys.argv[3]) if len(sys.argv) > 3 else torch.get_num_threads())
    cv2.setNumThreads(torch.get_num_threads())
    columns = ("hits", "misses told", "false alarms", "worse than tracking", "level, turns", "ms (IQR)")
    others = ("cv2 same bank: near", "ms (IQR)", "cv2 fine: hits", "ms (IQR)")
    table = Table("set", *columns, *others, title=f"Global search, {torch.get_num_threads()} threads")
    scenes: dict[str, Scene] = {
        "micrograph": micrograph(),
        "plane waves": PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0),
        "pads": Pads.wafer(),
        "speckle": Speckle.random(),
        "fine speckle": Speckle.random(count=250_000, sigmas=(0.7, 1.0)),
    }
    for name, scene in scenes.items():
        table.add_row(name, *measure(simulated(scene, count)))
    for path in sorted((data / "stills").glob("*.png")):
        h, w = next(iter(open_frames(str(path)))).shape[-2:]
        scene = image_scene(path, reflected=False)
        table.add_row(path.stem, *measure(simulated(scene, max(count // 2, 1), (w - 500.0, h - 500.0), noise=2.0)))
    table.add_row("rotation_full", *measure(parts(data / "rotation_full")))
    console.print(table)


if __name__ == "__main__":
    main()
