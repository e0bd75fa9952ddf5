"""Accuracy on analytic scenes, printed as tables: python benchmarks/accuracy.py [draws].

Scatter over the Cramer-Rao bound and normalised error squared (template and frame redrawn), sequences of eq. (11), two
full turns, and uneven light.
"""

from __future__ import annotations

import math
import sys

import torch
from rich.console import Console
from rich.table import Table

from torch_ecc.experiments.accuracy import Draws, Harmonic, scatter, track_path, under_light
from torch_ecc.sim.camera import Camera
from torch_ecc.sim.light import GradientLight, SpotLight
from torch_ecc.sim.pads import Pads
from torch_ecc.sim.sequence import Sequence
from torch_ecc.sim.waves import PlaneWaves

SCENES = {"waves": PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0), "pads": Pads.wafer()}
console = Console(width=120)


def show(title: str, header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    table = Table(*header, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def scatters(draws: int) -> None:
    rows = []
    for name, scene in SCENES.items():
        for noise in (0.0, 2.0, 5.0, 10.0):
            for turn in (False, True):
                s = scatter(scene, Draws(noise, draws, turn, seed=int(noise)))
                rms = s.error.square().mean(0).sqrt().tolist()
                cells = [f"{v:.5f}" for v in (rms[0], rms[1], math.degrees(rms[2]))]
                ratio = " ".join(f"{v:.2f}" for v in s.ratio)
                mean = f"{float(s.nees.mean()):.2f}"
                iterations = f"{float(s.iterations.double().mean()):.1f}"
                motion = "any angle" if turn else "shifts only"
                rows.append(
                    (name, f"{noise:g}", motion, *cells, ratio, mean, iterations, str(int((s.status != 0).sum())))
                )
    header = (
        "scene",
        "noise",
        "motion",
        "x px",
        "y px",
        "theta deg",
        "rms / bound",
        "NEES",
        "iterations",
        "not converged",
    )
    show(f"Scatter, {draws} redrawn pairs (chance: {1 / math.sqrt(2 * draws):.0%} of an rms)", header, rows)


def sequences() -> None:
    rows = []
    scene = SCENES["waves"]
    for noise in (0.0, 2.0, 5.0, 10.0):
        camera = Camera(noise_sigma=noise)
        run = track_path(Sequence(scene, Harmonic().path(camera), camera))
        rows.append(("eq. (11), 20 px, 5 deg", f"{noise:g}", *_cells(run)))
    angles = torch.arange(0, 722, 2) * math.pi / 180
    camera = Camera(size=(221, 221))
    path = torch.stack((110 + 0 * angles, 110 + 0 * angles, angles), -1).double()
    rows.append(("0 to 720 deg in steps of 2", "0", *_cells(track_path(Sequence(scene, path, camera)))))
    show("Sequences, 8 bit", ("motion", "noise", "rms px", "rms deg", "largest px", "largest deg", "lost"), rows)


def _cells(run) -> tuple[str, ...]:
    return (*(f"{v:.5f}" for v in (*run.rms, *run.largest)), str(run.lost))


def lights() -> None:
    rows = []
    for light in (None, GradientLight(scale_px=640), SpotLight(scale_px=640)):
        for name, scene in SCENES.items():
            for method, run in under_light(scene, light, Harmonic(50.0, 10.0, 60)).items():
                rows.append((type(light).__name__ if light else "even", name, method, *_cells(run)))
    header = ("light", "scene", "method", "rms px", "rms deg", "largest px", "largest deg", "lost")
    show("Uneven light, no noise, eq. (11) with 50 px and 10 deg", header, rows)


if __name__ == "__main__":
    torch.set_num_threads(1)
    scatters(int(sys.argv[1]) if len(sys.argv) > 1 else 1500)
    sequences()
    lights()
