"""``torch-ecc servo``: one alignment with everything that it leaves behind in a folder."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.commands.servo_job import Alignee, Run, ServoJob, prepare_parts, run_alignment
from torch_ecc.commands.servo_pictures import draw_errors, draw_steps, draw_velocities, square
from torch_ecc.commands.track import STATUS_NAMES
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.pose import transform
from torch_ecc.io import OverlayWriter
from torch_ecc.io.output import check_folder, part, publish
from torch_ecc.io.summary import write_json
from torch_ecc.servo.record import Log, Step

HEADER = (
    "part,time_s,x_px,y_px,theta_rad,error_x_px,error_y_px,error_theta_rad,vx_um_per_s,vy_um_per_s,omega_rad_per_s,"
    "score,status"
)
PARTS = ("substrate", "probe")
Progress = Callable[[str, Step], None]


def run_session(job: ServoJob, progress: Progress = lambda part, step: None) -> Run:
    """Align, and write log.csv, velocities.png, errors.png, steps.png, summary.json and overlay.mp4 into ``align.out``.

    ``progress(part, step)`` is called after every frame. Ctrl-C stops the stage and keeps what was done. Raises
    ValueError, before anything moves, for what cannot be aligned; then no file is written.
    """
    alignee, folder = prepare_parts(job), check_folder(job.align.out, "servo")
    overlay = OverlayWriter(
        folder, shapes=alignee.shapes, status_names=STATUS_NAMES, fps=1 / job.cell.microscope.period
    )
    with LogWriter(folder) as log, overlay:

        def observe(frame: Tensor, estimate: Estimate, step: Step) -> None:
            name = PARTS[0] if len(step.velocity) > 2 else PARTS[1]
            log.write(name, step)
            if job.align.overlay:
                overlay.write(frame, estimate)
            progress(name, step)

        run = run_alignment(job, alignee, observe)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in pictures(job, alignee, run).items():
        figure.savefig(part(folder, f"{name}.png"), dpi=130, format="png")
        publish(folder, f"{name}.png")
    write_json(part(folder, "summary.json"), summary(job, run))
    publish(folder, "summary.json")
    return run


class LogWriter:
    """Context manager: log.csv, a row per frame, whole after any end of the run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file: TextIO | None = None

    def write(self, name: str, step: Step) -> None:
        """Append a row."""
        if self._file is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._file = part(self.folder, "log.csv").open("w", newline="", encoding="utf-8")
            self._file.write(HEADER + "\n")
        velocity = [*step.velocity.tolist(), 0.0][:3]
        numbers = (step.time, *step.pose.tolist(), *step.error.tolist(), *velocity, step.score)
        csv.writer(self._file, lineterminator="\n").writerow(
            [name, *(f"{n:.9g}" for n in numbers), STATUS_NAMES[step.status]]
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
            publish(self.folder, "log.csv")


def pictures(job: ServoJob, alignee: Alignee, run: Run) -> dict[str, Figure]:
    """Velocities (Fig. 13), errors and the three steps (Fig. 12) of a run, as far as it went."""
    logs = _logs(run)
    if not logs:
        return {}
    titles = ["Step 2: the substrate", "Step 3: the probe"][: len(logs)]
    return {
        "velocities": draw_velocities(logs, titles),
        "errors": draw_errors(logs, titles, job.control.gain),
        "steps": draw_three_steps(job, alignee, run),
    }


def _logs(run: Run) -> list[Log]:
    return [result.log for result in run.alignment.results if len(result.log.time)]


def draw_three_steps(job: ServoJob, alignee: Alignee, run: Run) -> Figure:
    """Where both parts were found at first, and where they were after each step."""
    poses = [run.alignment.detected, *(log.pose[-1] for log in _logs(run))]
    box, landing = square(job.align.size), torch.tensor([alignee.substrate.point], dtype=torch.float64)
    substrate = [poses[0][0]] + [poses[1]] * (len(run.frames) - 1)
    probe = [poses[0][1]] * 2 + [poses[-1]]
    tip = torch.tensor([alignee.probe.point], dtype=torch.float64)
    lines = [
        [transform(s, box), transform(p, tip), transform(s, landing)]
        for s, p in zip(substrate, probe[: len(run.frames)], strict=True)
    ]
    titles = ("(b) step 1: detected", "(c) step 2: the substrate", "(d) step 3: the probe")
    return draw_steps(run.frames, lines, titles[: len(run.frames)])


def summary(job: ServoJob, run: Run) -> dict[str, Any]:
    """What became of a run, for scripts."""
    um = job.cell.mounts["substrate"].um_per_px
    x, y, theta = run.error.tolist()
    steps = dict(zip(PARTS, run.alignment.results, strict=False))
    return {
        "aligned": run.alignment.aligned,
        "ending": run.alignment.ending.name,
        "steps": {n: {"ending": s.ending.name, "frames": len(s.log.time)} for n, s in steps.items()},
        "substrate_error": {
            "x_px": x,
            "y_px": y,
            "theta_deg": math.degrees(theta),
            "nm": 1e3 * um * math.hypot(x, y),
        },
        "tip_miss": {"x_px": float(run.miss[0]), "y_px": float(run.miss[1]), "nm": 1e3 * um * float(run.miss.norm())},
        "settings": {"align": vars(job.align), "control": vars(job.control), "belief": vars(job.belief)},
    }


def describe(job: ServoJob, run: Run) -> list[str]:
    """The same in words."""
    found, out = summary(job, run), Path(job.align.out)
    lines = [f"{name}: {step}" for name, step in zip(PARTS, run.alignment.results, strict=False)]
    error, miss = found["substrate_error"], found["tip_miss"]
    lines.append(f"Truly, the substrate is off by {error['nm']:.1f} nm and {abs(error['theta_deg']):.4f} deg.")
    if run.alignment.aligned:
        lines.append(
            f"The tip is {miss['nm']:.1f} nm ({math.hypot(miss['x_px'], miss['y_px']):.3f} px) off its landing."
        )
    return [*lines, f"In {out}/: " + ", ".join(sorted(path.name for path in out.iterdir()))]
