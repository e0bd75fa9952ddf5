"""Global search: hit rate and time, beside cv2.matchTemplate: python benchmarks/locate.py [DATA] [poses] [threads].

A hit is within 1 px and 1 deg where the last refinement began (``pose`` less ``displacement``). Templates (121 x 121
px) and frames (640 x 480 px, uneven light) are drawn apart with noise of 5 grey levels (2 on the stills), poses
anywhere at any angle. "trackable" are those of them that ``align`` has an answer for when it starts at the truth: in
the others light and noise have left too little of the texture. "rms px": of the hits and of tracking them from the
truth, where tracking has an answer; "worse": than tracking by more than 0.001 px and a quarter of the standard
deviation that tracking states, or no answer where tracking has one. "ms": of unambiguous answers, and of ambiguous
ones. OpenCV turns the same template by the same turns at the same level and takes the best TM_CCOEFF_NORMED: near is
within two pixels and one turn of that bank, its time compares with "bank ms". "cv2 fine" is the same at full
resolution in steps of 2 deg, in every tenth frame, hits as for locate. All run alternately in one process on as many
threads; times are median and quartiles. ``--seed``: other poses and patches; ``--only``: some of the sets.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from work import data_folder

from torch_ecc import Locator, Status, align, prepare, texture
from torch_ecc.core.pose import compose, inverse, to_opencv
from torch_ecc.core.reference import Reference
from torch_ecc.io import open_frames
from torch_ecc.search.locate import image_pyramid
from torch_ecc.sim import Camera, GradientLight, Pads, PlaneWaves, Scene, Speckle, micrograph
from torch_ecc.sim.camera.still import image_scene

SIZE, SIDE = (480, 640), 121
ALIKE = 0.25  # of the standard deviation: by less the stopping rules of two solves may part them
T = TypeVar("T")
console = Console(width=190)


class Trial(NamedTuple):
    """A template (1, 1, h, w), a frame (1, 1, H, W) and where the template is in it, (1, 3)."""

    template: Tensor
    frame: Tensor
    truth: Tensor


def simulated(
    scene: Scene, count: int, seed: int, *, spread: tuple[float, float] = (0.0, 0.0), noise: float = 5.0
) -> Iterator[Trial]:
    """Patches of a scene, the middle one or anywhere within ``spread`` px of it, each in a frame at a random pose."""
    u = torch.rand(8 * count, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    x, y = SIDE * 0.71 + u[:, 0] * (SIZE[1] - SIDE * 1.42), SIDE * 0.71 + u[:, 1] * (SIZE[0] - SIDE * 1.42)
    truth = torch.stack((x, y, (u[:, 2] - 0.5) * math.tau), -1)
    place = torch.cat(((u[:, 3:] - 0.5) * torch.tensor(spread), torch.zeros(len(u), 1)), -1)
    # 0.7: the exposure at which the bright corner of the light does not saturate
    camera = Camera(size=SIZE, noise_sigma=noise, light=GradientLight(), gain=0.7)
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
    facts, still = json.loads((folder / "truth.json").read_text()), open_frames(folder / "ref.png").first
    c = torch.tensor([*facts["centre_px"], 0.0]).double()
    for x, y, half in ((70, 52, 24), (205, 138, 30), (70, 190, 40), (98, 52, 30), (126, 126, 100)):
        local = torch.tensor([x, y, 0.0]).double() - c
        for fact, frame in zip(facts["frames"], open_frames(str(folder / "f*.png")), strict=True):
            turn = torch.tensor([0.0, 0.0, -math.radians(fact["theta_deg"])]).double()
            truth = compose(c, compose(turn, local))[None]
            rows, columns = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
            template, image = (image.reshape(1, 1, *image.shape[-2:]) for image in (still, frame.pixels))
            yield Trial(template[..., rows, columns], image, truth)


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
        found = (cv2.minMaxLoc(cv2.matchTemplate(image.numpy(), t, cv2.TM_CCOEFF_NORMED)) for t in self.templates)
        (_, _, _, (x, y)), k = max(((best, k) for k, best in enumerate(found)), key=lambda pair: pair[0][1])
        middle = (self.side - 1) / 2
        return torch.tensor([[x + middle, y + middle, float(self.turns[k])]], dtype=torch.float64)


class Tally:
    """What is counted and timed over the trials of one set."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.errors: list[tuple[float, float]] = []  # px of hits, and of tracking them
        self.times: dict[str, list[float]] = {}

    def timed(self, name: str, call: Callable[[], T]) -> T:
        begun = time.perf_counter()
        result = call()
        self.times.setdefault(name, []).append(time.perf_counter() - begun)
        return result

    def row(self) -> tuple[str, ...]:
        n, c, t = self.counts["trials"], self.counts, self.times
        hits = (f"{c['hits']} of {n}", f"{c['trackable hits']} of {c['trackable']}")
        parts = (*hits, f"{c['told']} of {n - c['hits']}", str(c["alarms"]), str(c["worse"]))
        ours, tracked = torch.tensor(self.errors or [(math.nan, math.nan)]).square().mean(0).sqrt().tolist()
        times = (quartiles(t.get(name, [])) for name in ("clear", "ambiguous", "bank"))
        near, fine = f"{c['near']} of {n}", f"{c['fine']} of {len(t['fine'])}"
        rms = f"{ours:.4f} {tracked:.4f}"
        return *parts, rms, *times, near, quartiles(t["cv2"]), fine, quartiles(t["fine"])


def measure(trials: Iterator[Trial]) -> tuple[str, ...]:
    """One line of the table."""
    tally, last = Tally(), None
    for number, trial in enumerate(trials):
        if last is None or not torch.equal(trial.template, last):
            last, reference = trial.template, prepare(trial.template)
            locator = Locator(reference, (trial.frame.shape[-2], trial.frame.shape[-1]))
            level, turns = locator.levels - 1, locator.banks[0].angles
            bank = TurnedBank(image_pyramid(trial.template.float(), level + 1)[-1][0, 0], turns)
        one(tally, trial, locator, reference)
        grain = 0.3 * torch.randn(trial.frame.shape, generator=torch.Generator().manual_seed(number))
        noisy = trial.frame.float() + grain  # without it OpenCV takes flat areas for perfect matches
        coarse = image_pyramid(noisy, level + 1)[-1][0, 0]
        rough = tally.timed("cv2", lambda bank=bank, coarse=coarse: bank(coarse))
        px, deg = error(rough * torch.tensor([2.0**level, 2.0**level, 1.0]), trial.truth)
        tally.counts["near"] += px < 2 * 2**level and deg < 360 / len(turns)
        if number % 10 == 0:
            slow = TurnedBank(trial.template[0, 0].float(), torch.arange(180) * math.radians(2.0))
            found = tally.timed("fine", lambda slow=slow, image=noisy[0, 0]: slow(image))
            tally.counts["fine"] += hit(found, trial.truth)
    return tally.row()


def one(tally: Tally, trial: Trial, locator: Locator, reference: Reference) -> None:
    """Locate one trial: hit or not, told or not, worse than tracking from the truth or not."""
    found = tally.timed("locate", lambda: locator(trial.frame))
    good, doubt = hit(found.pose - found.estimate.displacement, trial.truth), bool(found.ambiguous)
    answered = bool(Status.good(found.status))
    tally.times.setdefault("ambiguous" if doubt else "clear", []).append(tally.times["locate"][-1])
    coarse = image_pyramid(trial.frame.float(), locator.levels)[-1][0, 0]
    tally.timed("bank", lambda: locator.banks[0].candidates(coarse, 1))
    tally.counts["trials"] += 1
    tally.counts["hits"] += good
    tally.counts["alarms"] += good and doubt
    tally.counts["told"] += not good and (doubt or not answered)
    tracked = align(reference, trial.frame, trial.truth)
    trackable = bool(Status.good(tracked.status))
    tally.counts["trackable"] += trackable
    tally.counts["trackable hits"] += trackable and good
    if trackable and good:
        ours, theirs = (error(pose, trial.truth)[0] for pose in (found.pose, tracked.pose))
        alike = max(1e-3, ALIKE * float(tracked.sigma[0, :2].norm()))
        tally.errors.append((ours, theirs))
        tally.counts["worse"] += not answered or ours > theirs + alike


def quartiles(seconds: list[float]) -> str:
    if not seconds:
        return "-"
    low, middle, high = torch.tensor(seconds).quantile(torch.tensor([0.25, 0.5, 0.75])).tolist()
    return f"{1e3 * middle:.0f} ({1e3 * low:.0f}-{1e3 * high:.0f})"


def trials(data: Path, count: int, seed: int) -> dict[str, Iterator[Trial]]:
    """Every set by its name."""
    scenes: dict[str, Scene] = {
        "micrograph": micrograph(),
        "plane waves": PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0),
        "pads": Pads.wafer(),
        "speckle": Speckle.random(),
        "fine speckle": Speckle.random(count=250_000, sigmas=(0.7, 1.0)),
    }
    sets = {name: simulated(scene, count, seed) for name, scene in scenes.items()}
    for path in sorted((data / "stills").glob("*.png")):
        h, w = open_frames(path).shape
        scene, spread = image_scene(path, reflected=False), (w - 500.0, h - 500.0)
        sets[path.stem] = simulated(scene, max(count // 2, 1), seed, spread=spread, noise=2.0)
    return {**sets, "rotation_full": parts(data / "rotation_full")}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", nargs="?")
    parser.add_argument("poses", nargs="?", type=int, default=200)
    parser.add_argument("threads", nargs="?", type=int, default=torch.get_num_threads())
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    ours = ("hits", "trackable", "misses told", "false alarms", "worse", "rms px", "ms", "ambiguous", "bank ms")
    theirs = ("cv2 near", "cv2 ms", "cv2 fine hits", "cv2 fine ms")
    table = Table("set", *ours, *theirs, title=f"Global search, {options.threads} threads, times with quartiles")
    for name, some in trials(data_folder(options.data), options.poses, options.seed).items():
        if not options.only or name in options.only:
            table.add_row(name, *measure(some))
    console.print(table)


if __name__ == "__main__":
    main()
