"""Accuracy on analytic scenes: python benchmarks/accuracy.py [DRAWS] [--poses N] [--only SECTION]... [--out FILE.json]

Sections: scatter over the Cramer-Rao bound and normalised error squared (template and frame redrawn); the largest error
in N random poses, unrounded and rounded, beside what rounding leaves to one who knows the scene; sequences of eq. (11)
and two full turns; uneven light.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import click
import torch
from results import save, show
from scatter import Draws, Scatter, by_sampler, least, scatter
from sequences import Run, track_path, under_light
from torch import Tensor

from torch_ecc.paper.errors import by_unit, in_degrees, largest, rms
from torch_ecc.paper.result import Number, cells
from torch_ecc.paper.scheme import Harmonic
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.light import GradientLight, SpotLight
from torch_ecc.sim.camera.sequence import Sequence
from torch_ecc.sim.scene.pads import Pads
from torch_ecc.sim.scene.waves import PlaneWaves

SCENES = {"waves": PlaneWaves.random(count=200, fmax=0.25, rms_gradient=7.0), "pads": Pads.wafer()}
SAMPLERS = ("bilinear", "bspline3", "bspline5")
MOTIONS = {False: "shifts only", True: "any angle"}


def scatters(draws: int) -> list[Number]:
    rows, figures = [], []
    for name, scene in SCENES.items():
        for noise in (0.0, 2.0, 5.0, 10.0):
            for turn in (False, True):
                s = scatter(scene, Draws(noise, draws, turn, seed=int(noise)))
                errors, ratio = cells(in_degrees(rms(s.error)), ".5f"), " ".join(cells(s.ratio, ".2f"))
                title = f"{name}, noise {noise:g}, {MOTIONS[turn]} / worst rms over the bound"
                figures.append(Number(title, float(s.ratio.max()), "x", "lower", 0.1))
                mean = f"{float(s.nees.mean()):.2f}"
                iterations = f"{float(s.iterations.double().mean()):.1f}"
                bad = str(int((s.status != 0).sum()))
                rows.append((name, f"{noise:g}", MOTIONS[turn], *errors, ratio, mean, iterations, bad))
    header = ("scene", "noise", "motion", "x px", "y px", "theta deg", "rms / bound", "NEES", "iterations", "bad")
    chance = f"{1 / math.sqrt(2 * draws):.0%} of an rms"
    show(f"Scatter, {draws} redrawn pairs (chance: {chance}); bad: not converged", header, rows)
    return figures


def poses(count: int) -> list[Number]:
    """Errors without noise, start 0.3 px and 0.17 deg off, by sampler; unrounded, and in 8 bit beside those of an
    oracle: the scene itself fitted to the same frames by least squares."""
    rows, figures = [], []
    for name, scene in SCENES.items():
        for turn, motion in MOTIONS.items():
            for bits in (None, 8):
                draws = Draws(0.0, count, turn, bits=bits, seed=1)
                found = by_sampler(scene, draws, SAMPLERS)
                rows += [(name, motion, *row) for row in _by_error(found, least(scene, draws) if bits else None)]
                for sampler, s in found.items():
                    title = f"{name}, {motion}, {sampler}{'' if bits else ', unrounded'} / largest error"
                    px, deg = by_unit(in_degrees(largest(s.error)))
                    figures.append(Number(title, px, "px", "lower", 0.1))
                    figures.append(Number(f"{title}, theta", deg, "deg", "lower", 0.1))
    header = ("scene", "motion", "bits", "sampler", "bad", "largest px", "deg", "rms px", "deg", "off oracle px", "deg")
    show(f"{count} random poses, no noise; bad: not converged; off oracle: largest difference", header, rows)
    return figures


def _by_error(found: dict[str, Scatter], best: Tensor | None) -> list[tuple[str, ...]]:
    """Rows by sampler; where the oracle's errors (draws, 3) are given, these and the Cramer-Rao bound too."""
    rows = []
    for sampler, s in found.items():
        off = () if best is None else _numbers(largest(s.error - best))
        bad = str(int((s.status != 0).sum()))
        rows.append(("none" if best is None else "8", sampler, bad, *_errors(s.error), *off))
    if best is not None:
        rows.append(("8", "oracle", "", *_errors(best)))
        rows.append(("8", "bound", "", "", "", *_numbers(found[SAMPLERS[0]].bound)))
    return rows


def _errors(error: Tensor) -> tuple[str, ...]:
    """Largest and root mean square of (draws, 3)."""
    return (*_numbers(largest(error)), *_numbers(rms(error)))


def _numbers(error: Tensor) -> tuple[str, ...]:
    """The worse of x and y, px, and theta, deg, of (3,) px, px, rad."""
    return tuple(cells(by_unit(in_degrees(error)), ".5f"))


def sequences() -> list[Number]:
    rows, figures = [], []
    scene = SCENES["waves"]
    for noise in (0.0, 2.0, 5.0, 10.0):
        camera = Camera(noise_sigma=noise)
        run = track_path(Sequence(scene, Harmonic().closed(), camera))
        rows.append(("eq. (11), 20 px, 5 deg", f"{noise:g}", *_cells(run)))
        figures.append(Number(f"eq. (11), noise {noise:g} / rms", run.rms[0], "px", "lower", 0.1))
    angles = torch.arange(0, 722, 2) * math.pi / 180
    camera = Camera(size=(221, 221))
    path = torch.stack((110 + 0 * angles, 110 + 0 * angles, angles), -1).double()
    rows.append(("0 to 720 deg in steps of 2", "0", *_cells(track_path(Sequence(scene, path, camera)))))
    show("Sequences, 8 bit", ("motion", "noise", "rms px", "rms deg", "largest px", "largest deg", "lost"), rows)
    return figures


def _cells(run: Run) -> tuple[str, ...]:
    return (*cells((*run.rms, *run.largest), ".5f"), str(run.lost))


def lights() -> list[Number]:
    rows, figures = [], []
    for light in (None, GradientLight(scale_px=640), SpotLight(scale_px=640)):
        for name, scene in SCENES.items():
            for method, run in under_light(scene, light, Harmonic(50.0, 10.0, 60)).items():
                kind = type(light).__name__ if light else "even"
                rows.append((kind, name, method, *_cells(run)))
                figures.append(Number(f"{kind}, {name}, {method} / largest", run.largest[0], "px", "lower", 0.1))
    header = ("light", "scene", "method", "rms px", "rms deg", "largest px", "largest deg", "lost")
    show("Uneven light, no noise, eq. (11) with 50 px and 10 deg", header, rows)

    return figures


@click.command()
@click.argument("draws", default=1500)
@click.option("--poses", "count", default=1000, show_default=True)
@click.option("--only", multiple=True, type=click.Choice(["scatters", "poses", "sequences", "lights"]))
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(draws: int, count: int, only: tuple[str, ...], out: Path | None) -> None:
    """Print what the README quotes."""
    torch.set_num_threads(1)
    sections: dict[str, Callable[[], list[Number]]] = {
        "scatters": lambda: scatters(draws),
        "poses": lambda: poses(count),
        "sequences": sequences,
        "lights": lights,
    }
    figures = [figure for name, make in sections.items() if not only or name in only for figure in make()]
    if out is not None:
        save(out, figures, draws=str(draws), poses=str(count))


if __name__ == "__main__":
    main()
