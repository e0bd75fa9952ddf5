"""Rigid bodies of many patches: python benchmarks/body.py [--draws N] [--only SECTION]... [--quick] [--data DATA]

Sections: the scatter of x, y, theta over the bound of all patches together, and its honesty; five of sixteen patches
that are covered, have jumped, or are on another body; a lens, unknown, known and self-calibrated, and moves that do not
tell it; frames per second beside a loop over OpenCV's ECC; Figs. 10 and 11 with a body; bodies drawn at random, and the
clockwork's three, told apart by their motion.
"""

from __future__ import annotations

import json
import math
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import click
import cv2
import numpy as np
import torch
from crowds import Crowd
from results import save, show
from rigid import SCENE, Drawn, Near, Plan, draw
from rivals import rivals
from scaling import slope
from torch import Tensor

import torch_ecc as te
from torch_ecc.core.pose import compose, inverse, transform
from torch_ecc.paper.body import run as experiment
from torch_ecc.paper.bound import cramer_rao, rounding
from torch_ecc.paper.errors import rms
from torch_ecc.paper.result import Number
from torch_ecc.sim import Camera, harmonic, placed

SECTIONS = ("scatters", "apart", "lenses", "speed", "steps", "crowds", "clockwork")
APART = (0, 1, 5, 10, 15)
TRUST = (0.03, 0.03, math.radians(0.1))  # px, px, rad: of the clockwork's truth, which is another tracker's
WHOLE = 0.97  # share of patches where they belong
RUN = 11  # frames that one tracker sees before it is another's turn
UM_PER_PX = 0.55  # of the paper's camera at 10 x


def scatters(draws: int) -> list[Number]:
    rows, figures = [], []
    for plan, noise, count in (
        (Plan(), 2.0, draws),
        (Plan(), 5.0, draws),
        (Plan(2048, 8, 61, 1700), 2.0, max(draws // 5, 10)),
        (Plan(2048, 8, 61, 1900), 2.0, max(draws // 5, 10)),
    ):
        found, bound = draw(plan, noise, count), plan.bound(noise)
        words = f"{plan.side}^2, {plan.across**2} patches over {plan.span} px, noise {noise:g}"
        one = float(cramer_rao(SCENE, (121, 121), 2 * (noise**2 + rounding(8)))[2])
        theta, ratio = 1e6 * float(rms(found.error)[2]), rms(found.error) / bound
        told = (f"{theta:.2f}", f"{1e6 * float(bound[2]):.2f}", f"{1e6 * one:.1f}", f"{1e6 * one / theta:.1f}")
        honest = f"{float(found.nees.mean()):.2f}"
        cells = tuple(f"{v:.2f}" for v in ratio.tolist())
        rows.append((words, str(count), *told, *cells, honest, f"{float(found.chi2.mean()):.2f}"))
        figures += [
            Number(f"{words} / theta over the bound", float(ratio[2]), "x", "lower", 0.1),
            Number(f"{words} / theta", theta, "urad", "lower", 0.1),
            Number(f"{words} / x, y over the bound", float(ratio[:2].max()), "x", "lower", 0.1),
            Number(f"{words} / normalised error squared", float(found.nees.mean()), "", "lower", 0.15),
        ]
    header = ("", "draws", "theta urad", "bound", "one of 121 px", "times better")
    header += ("x / bound", "y / bound", "theta / bound", "NEES", "chi2 / freedom")
    show("Scatter", header, rows)
    return figures


def apart(draws: int) -> list[Number]:
    rows, figures = [], []
    plan = Plan()
    left = torch.ones(16, dtype=torch.bool)
    left[list(APART)] = False
    bound = plan.bound(2.0, left)
    for wrong in ("covered", "jumped", "another body"):
        found: Drawn = draw(plan, 2.0, draws, wrong, APART)
        ratio = rms(found.error) / bound
        named = float((~found.used[:, ~left]).all(1).double().mean())
        kept = float(found.used[:, left].double().mean())
        rows.append((wrong, *(f"{v:.2f}" for v in ratio.tolist()), f"{100 * named:.1f} %", f"{100 * kept:.2f} %"))
        rows[-1] += (f"{float(found.nees.mean()):.2f}",)
        figures += [
            Number(f"5 of 16 {wrong} / over the bound of the others", float(ratio.max()), "x", "lower", 0.1),
            Number(f"5 of 16 {wrong} / the five named", named, "", "higher", 0.01),
        ]
    header = ("5 of 16", "x / bound of 11", "y / bound", "theta / bound", "all five named", "others used", "NEES")
    show(f"Patches that are wrong, noise 2, {draws} draws", header, rows)
    return figures


def lenses(frames: int) -> list[Number]:
    """A body moved over half the view and turned by 3 deg behind a lens that moves the corner by 0.5 %."""
    plan = Plan(span=480)
    lens = te.Lens((511.5, 511.5), math.hypot(1023, 1023) / 2, 0.005)
    angle = math.tau * torch.arange(frames, dtype=torch.float64) / frames
    path = torch.stack((170 * angle.cos(), 170 * angle.sin(), math.radians(3) * (2 * angle).sin()), 1) + plan.middle
    tracker, track = _followed(plan, lens, path)
    fit = te.calibrate(track, tracker=tracker)
    assert isinstance(fit, te.SelfCalibration)
    rows, figures = [], []
    for name, one in (("none", None), ("self-calibrated", fit.lens), ("known", lens)):
        error, residual = _behind(te.Body(tracker, lens=one), te.Body(tracker, lens=lens), track, path, plan)
        px = float(rms(error[:, :2].flatten()))
        told = (1e3 * UM_PER_PX * px, 1e6 * float(rms(error[:, 2])))
        rows.append((name, f"{px:.5f}", *(f"{v:.2f}" for v in told), f"{residual:.5f}"))
        figures.append(Number(f"lens of 0.5 %, {name} / body", px, "px", "lower", 0.1))
        figures.append(Number(f"lens of 0.5 %, {name} / patches", residual, "px", "lower", 0.1))
    header = ("lens", "body px rms", "nm", "theta urad", "patches px rms")
    show(f"A lens of 0.5 %, {frames} frames: {fit}", header, rows)
    line = plan.middle + torch.linspace(-170, 170, 6, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    for words, moves, commanded in (("one direction", line, True), ("no move", plan.middle.expand(6, 3), False)):
        tracker, track = _followed(plan, lens, moves)
        sent = UM_PER_PX * (moves - plan.middle)[:, :2] if commanded else None
        try:
            print(f"{words}: {te.calibrate(track, sent, tracker=tracker)}")
        except ValueError as error:
            print(f"{words}: {error}")
    return figures


def _followed(plan: Plan, lens: te.Lens, path: Tensor) -> tuple[te.Tracker, te.Track]:
    centers = plan.places + plan.middle[:2]
    near = Near(lens, transform(inverse(plan.middle), lens.undistort(centers)), plan.size // 2 + 16)
    camera = Camera(size=(plan.side, plan.side), noise_sigma=2.0)
    frames = [camera.capture(near, pose[None], seed=k)[0, 0] for k, pose in enumerate((plan.middle, *path))]
    tracker = te.Tracker(frames[0], centers, plan.size)
    return tracker, tracker.track_sequence(frames[1:])


def _behind(body: te.Body, true: te.Body, track: te.Track, path: Tensor, plan: Plan) -> tuple[Tensor, float]:
    """Errors (F, 3) of the displacement, and the rms of the patches' residuals."""
    found, start = body(track), true.layout.start[0]
    moved = compose(path, compose(inverse(plan.middle), start).expand_as(path)) - start
    return found.displacement[:, 0] - moved, float(rms(found.residual[..., :2].flatten()))


def speed(rounds: int) -> list[Number]:
    """640 x 480, patches of 51 px that do not overlap; OpenCV's ECC on the same patches in a loop."""
    torch.set_num_threads(2)
    cv2.setNumThreads(2)
    figures, rows, taken = [], [], dict[int, float]()
    path = placed(harmonic((6.0, 6.0, 0.02), 30, cycles=2), (320.0, 240.0))[: rounds + 4]
    frames = list(Camera(noise_sigma=2.0).capture(SCENE, path)[:, 0])
    for across, down in ((4, 4), (8, 4), (8, 8)):
        centers = _grid(across, down, 640, 480)
        a, b, c = _rates(frames, centers)
        taken[len(centers)] = 1 / a
        rows.append((str(len(centers)), f"{a:.0f}", f"{b:.0f}", f"{1e3 / a - 1e3 / b:.2f}", f"{c:.1f}", f"{a / c:.1f}"))
        figures.append(Number(f"{len(centers)} patches and their body / over OpenCV's", a / c, "x", "higher", 0.5))
    header = ("patches", "with body 1/s", "without 1/s", "body ms", "OpenCV 1/s", "times faster")
    show("640 x 480, two threads", header, rows)
    print(f"slope over patches: {slope(taken, taken.values()):.2f}")
    return figures + _large(rounds)


def _rates(frames: list[Tensor], centers: Tensor) -> tuple[float, float, float]:
    """Frames per second, medians, of the patches with their body, without, and of OpenCV's ECC in a loop; a run of
    frames each in turns, so that none finds the caches full of what the others left."""
    with_body, without = (te.Tracker(frames[0], centers, 51) for _ in range(2))
    body = te.Body(with_body)
    peers = [rivals()["OpenCV ECC, fastest fair"].start(frames[0][None], (x, y), 51) for x, y in centers.tolist()]
    calls: tuple[Callable[[Tensor], object], ...] = (
        lambda frame: body(with_body(frame)),
        without,
        lambda frame: [one(frame[None]) for one in peers],
    )
    taken: list[list[float]] = [[], [], []]
    for k in range(1, len(frames), RUN):
        for call, times in zip(calls, taken, strict=True):
            times.extend([_timed(call, frame) for frame in frames[k : k + RUN]][1:])
    a, b, c = (1 / statistics.median(times) for times in taken)
    return a, b, c


def _large(rounds: int) -> list[Number]:
    """The paper's whole camera."""
    path = placed(harmonic((6.0, 6.0, 0.005), 30, cycles=2), (1024.0, 1024.0))[: rounds + 4]
    camera = Camera(size=(2048, 2048), noise_sigma=2.0)
    frames = [camera.capture(SCENE, pose[None], seed=k)[0, 0] for k, pose in enumerate(path)]
    tracker = te.Tracker(frames[0], _grid(4, 4, 2048, 2048), 121)
    body = te.Body(tracker)
    taken = [_timed(lambda frame: body(tracker(frame)), frame) for frame in frames[1:]]
    rate = 1 / statistics.median(taken[2:])
    print(f"2048 x 2048, 16 patches of 121 px with their body: {rate:.0f} frames per second")
    return [Number("2048^2, 16 patches of 121 px and their body", rate, "1/s", "higher", 0.5)]


def _grid(across: int, down: int, width: int, height: int) -> Tensor:
    """Centres of as many equal fields, 10 px from the border."""
    sides = (across, width - 20), (down, height - 20)
    x, y = (10 + (torch.arange(n, dtype=torch.float64) + 0.5) * w / n for n, w in sides)
    return torch.cartesian_prod(y, x).flip(1).round()


def _timed(call: Callable[[Tensor], object], frame: Tensor) -> float:
    begun = time.perf_counter()
    call(frame)
    return time.perf_counter() - begun


def steps(quick: bool) -> list[Number]:
    """Figs. 10 and 11: the boxes of a dwell, and the means of dwells minus those of the capacitive sensors."""
    found = experiment(quick, lambda done, total: None)
    for table in found.tables:
        show(table.title, table.header, table.rows)
    return [number._replace(tolerance=0.2) for number in found.records]


def crowds(count: int) -> list[Number]:
    """How many are put together again."""
    shares = []
    for seed in range(count):
        crowd = Crowd.drawn(seed)
        try:
            shares.append(crowd.right(te.rigid_groups(crowd.track, crowd.bodies)))
        except ValueError:
            shares.append(0.0)
    whole = sum(share > WHOLE for share in shares)
    rows = [(str(count), str(whole), f"{100 * statistics.mean(shares):.1f} %", f"{100 * min(shares):.0f} %")]
    show("One to four bodies, a still frame, strays", ("drawn", "whole", "patches right", "least"), rows)
    return [Number(f"{count} crowds / whole", whole / count, "", "higher", 0.02)]


def clockwork(folder: Path) -> list[Number]:
    """--bodies 3 without masks, at the points that the truth speaks of."""
    from torch_ecc.commands.track import Session, TrackJob

    facts = json.loads((folder / "truth.json").read_text())
    out = Path(os.environ.get("TMPDIR", "/tmp")) / "torch-ecc-clockwork"
    job = TrackJob(input=str(folder / "f*.png"), grid=30, size=21, bodies=3, out=str(out), force=True, overlay=False)
    session = Session(job)
    session.run()
    bodies = json.loads((out / "body.json").read_text())["bodies"]
    with np.load(out / "track.npz") as found:
        named = {name: torch.from_numpy(found[name]) for name in te.Track._fields if name in found}
    none = torch.zeros_like(named["score"], dtype=torch.int8)
    track = te.Track(**(dict.fromkeys(te.Track._fields, none) | named))
    rows, figures = [], []
    for fact in bodies:
        body = te.Body(session.tracker, [fact["patches"]])(track)
        words, *cells = _nearest(body, facts)
        still = float(rms(body.displacement[:, 0, :2].flatten())) if fact["stands_still"] else math.nan
        words = "still frame" if fact["stands_still"] else words
        cells = ["", "", ""] if fact["stands_still"] else cells
        rows.append((str(len(fact["patches"])), words, *cells, f"{still:.4f}"))
    header = ("patches", "body of the truth", "px rms / max", "deg rms / max", "over sigma and trust", "moved px rms")
    show("mechanism_video --grid 30 --size 21 --bodies 3", header, rows)
    return figures


def _nearest(body: te.BodyEstimate, facts: dict) -> tuple[str, str, str, str]:
    """The body of the truth that this one is, the errors there, and what they are over our sigma and its trust."""
    best, least = ("", "", "", ""), math.inf
    for name, one in facts["bodies"].items():
        point = torch.tensor(one["centre_px"], dtype=torch.float64)
        rows = [[f["bodies"][name][k] for k in ("tx", "ty", "theta_deg")] for f in facts["frames"][-55:]]
        truth = torch.tensor(rows, dtype=torch.float64) * torch.tensor([1, 1, -math.pi / 180])
        pose, covariance = (value[1:, 0] for value in body.at(point))
        error = pose - torch.cat((point, point.new_zeros(1))) - truth
        both = covariance.diagonal(dim1=1, dim2=2) + torch.tensor(TRUST).double().square()
        px, deg, ratio = error[:, :2], error[:, 2].rad2deg(), error / both.sqrt()
        size = float(rms(px.flatten())) + float(rms(deg))
        if size < least:
            words = f"{float(rms(px.flatten())):.3f} / {float(px.abs().max()):.3f}"
            over = ", ".join(f"{v:.1f}" for v in rms(ratio).tolist())
            best = (name, words, f"{float(rms(deg)):.3f} / {float(deg.abs().max()):.3f}", over)
            least = size
    return best


@click.command()
@click.option("--draws", default=500, show_default=True)
@click.option("--only", multiple=True, type=click.Choice(SECTIONS))
@click.option("--quick", is_flag=True, help="few draws, short dwells")
@click.option("--data", type=click.Path(file_okay=False, path_type=Path), help="folder of the real sequences")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(draws: int, only: tuple[str, ...], quick: bool, data: Path | None, out: Path | None) -> None:
    """Print what the README quotes of bodies."""
    draws = min(draws, 20) if quick else draws
    sections: dict[str, Callable[[], list[Number]]] = {
        "scatters": lambda: scatters(draws),
        "apart": lambda: apart(draws),
        "lenses": lambda: lenses(6 if quick else 16),
        "speed": lambda: speed(8 if quick else 40),
        "steps": lambda: steps(quick),
        "crowds": lambda: crowds(10 if quick else 200),
    }
    if data is not None:
        sections["clockwork"] = lambda: clockwork(data / "mechanism_video")
    figures = [figure for name, make in sections.items() if not only or name in only for figure in make()]
    if out is not None:
        save(out, figures, draws=str(draws))


if __name__ == "__main__":
    main()
