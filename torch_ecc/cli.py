"""The command ``torch-ecc``: arguments in, library calls, words out. Exit status 0 only if the job was done."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Task as RichTask
from rich.text import Text

from torch_ecc.config import fill, read_toml

INTERRUPTED = 130

console = Console(highlight=False)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="torch-ecc")
def app() -> None:
    """Planar pose tracking of textured patches: x, y and theta to a thousandth of a pixel."""


@app.command()
@click.option("--out", default="torch-ecc-demo", show_default=True, help="Folder for the outputs.")
@click.option("--frames", default=120, show_default=True, type=click.IntRange(8), help="Frames of one cycle of motion.")
def demo(out: str, frames: int) -> None:
    """Make a microscope-like sequence with known motion, track it with ECC and SSD, print the errors."""
    from torch_ecc.commands.demo import run_demo

    with progress_bar("demo") as advance:
        result = run_demo(Path(out), frames, advance)
    console.print(result.table())
    console.print(f"In {out}/: demo.png, and track.png, overlay.mp4, track.csv ... of each method in ecc/ and ssd/")


@app.command(context_settings={"show_default": False})
@click.argument("input", required=False)
@click.option(
    "--center", "centers", nargs=2, type=float, multiple=True, metavar="X Y", help="Centre of a template, px."
)
@click.option("--size", metavar="N|WxH", help="Size of the templates, px.")
@click.option("--polygon", "polygons", multiple=True, metavar="'X,Y X,Y ...'", help="Outline of a template, frame px.")
@click.option("--reference", help="Image to cut the templates from [default: the first frame].")
@click.option("--template", multiple=True, help="Image of a template: found anywhere in the first frame, at any angle.")
@click.option("--config", type=click.Path(), help="TOML file of settings; options given here win.")
@click.option("--out", help="Folder for the outputs [default: torch-ecc-out].")
@click.option("--um-per-px", type=float, help="Scale of the camera: adds micrometres.")
@click.option("--axis-angle-deg", type=float, help="From the camera's axes to the stage's [default: 0].")
@click.option("--fps", type=float, help="Frames per second: adds times [default: the video's].")
@click.option("--criterion", help="ecc, ecc_paper or ssd [default: ecc].")
@click.option("--illumination", help="Light model of ecc: gain, linear or quadratic [default: linear].")
@click.option("--interpolation", help="bilinear, bspline3 or bspline5 [default: bspline3].")
@click.option("--max-iterations", type=int, help="Iterations per frame at most [default: 15].")
@click.option("--tolerance", type=float, help="Remaining error at the template's corner, px [default: 0.001].")
@click.option("--levels", type=int, help="Pyramid levels, for large motion [default: 1].")
@click.option("--prediction", help="Start of each frame: hold or velocity [default: velocity].")
@click.option("--min-score", type=float, help="Below this correlation a template is lost [default: 0.5].")
@click.option("--search/--no-search", default=None, help="Look for a lost template in the whole frame [default: yes].")
@click.option("--device", help="cpu, cuda, ... [default: cpu].")
@click.option("--backend", help="On a CPU: auto, torch or native [default: auto].")
@click.option("--overlay/--no-overlay", default=None, help="Write overlay.mp4 [default: yes].")
def track(config: str | None, size: str | None, polygons: tuple[str, ...], **options: Any) -> None:
    """Track patches through a video: x, y and theta of each in every frame.

    INPUT is a video, a folder or glob of images, a multi-page TIFF, an .npy or .npz stack or a camera index. Repeat
    --center (or --polygon, or --template) for more templates.
    """
    from torch_ecc.commands.track import Session, TrackJob

    if size is not None:
        options["size"] = _size(size)
    options["polygons"] = [_polygon(text) for text in polygons]
    values = read_toml(config) if config else {}
    values |= {name: value for name, value in options.items() if value is not None and value not in ((), [])}
    if "input" not in values:
        raise ValueError("track: INPUT is missing (a video, a folder or glob of images, a TIFF, .npy, .npz, a camera)")
    session = Session(fill(TrackJob, values, config or "track"))
    with progress_bar(session.source.name, session.source.length) as advance:
        outcome = session.run(lambda estimate: advance())
    _report(outcome)
    if outcome.interrupted:
        sys.exit(INTERRUPTED)


@app.command()
@click.argument("config", type=click.Path())
@click.option("--out", default="torch-ecc-sequence", show_default=True, help="Folder for the sequence, new or empty.")
def simulate(config: str, out: str) -> None:
    """Render a sequence whose motion is known exactly, as images, poses.csv and metadata.json.

    CONFIG is a TOML file such as configs/simulate.toml.
    """
    from torch_ecc.sim import from_config, save

    simulation = from_config(read_toml(config), folder=Path(config).parent)
    sequence, template = simulation.sequence, simulation.template
    with progress_bar("simulate", len(sequence)) as advance:
        save(sequence, out, metadata=simulation.metadata, progress=advance)
    x, y = template.center or (0.0, 0.0)
    h, w = template.size
    console.print(f"{len(sequence)} frames in {out}/. To track them:")
    console.print(f"  torch-ecc track {out}/frames --center {x:g} {y:g} --size {w}x{h}", soft_wrap=True)


@app.command()
@click.argument("names", nargs=-1, metavar="NAME...")
@click.option("--quick", is_flag=True, help="Short versions of all experiments.")
@click.option("--out", default="torch-ecc-reproduce", show_default=True, help="Folder for pictures, numbers, report.")
def reproduce(names: tuple[str, ...], quick: bool, out: str) -> None:
    """Reproduce the paper's figures and tables, with our numbers beside the paper's.

    NAME is fig2, fig3, fig4, table1, ... or all. DIR/report.html collects everything that was reproduced in DIR.
    """
    from torch_ecc.paper.reproduce import chosen, run

    try:
        for name in chosen(names):
            with progress_bar(name, unit="steps") as advance:
                outcome = run(name, out, quick, advance)
            _say_numbers(outcome)
    except KeyboardInterrupt:
        console.print(f"Stopped from the keyboard. What was finished before is in {out}/", soft_wrap=True)
        sys.exit(INTERRUPTED)
    console.print(f"Report: {out}/report.html", soft_wrap=True)


def _say_numbers(outcome: Any) -> None:
    """How many numbers keep their limits, and which do not."""
    limited = [record for record in outcome.records if record.tolerance is not None]
    missed = [record for record in limited if not record.kept]
    if limited:
        console.print(f"{outcome.name}: {len(limited) - len(missed)} of {len(limited)} numbers are within their limits")
    for record in missed:
        text = f"  not kept: {record.name}: {record.value:.4g} {record.unit}, limit {record.tolerance:.4g}"
        console.print(text, soft_wrap=True, markup=False)


@app.command()
@click.argument("track")
@click.argument("sensors")
@click.option("--out", help="Folder for the outputs [default: torch-ecc-comparison].")
@click.option("--template", type=int, help="Which template of the track [default: 0].")
@click.option("--um-per-px", type=float, help="Scale of the camera, if the track has no micrometres.")
@click.option(
    "--axis-angle-deg", type=float, help="From the track's axes to the stage's, as far as known [default: 0]."
)
@click.option("--fps", type=float, help="Frames per second, if the track has no times.")
@click.option("--flip-theta", is_flag=True, help="The sensors' theta counts the other way (a mirrored view).")
@click.option(
    "--fixed-angle", is_flag=True, help="Take the axis angle as given (needed with --lever if only theta moves)."
)
@click.option("--scale", is_flag=True, help="Estimate a factor between the records, too.")
@click.option("--lever", is_flag=True, help="Estimate where the template lies from the sensors' point, too.")
@click.option("--exposure-s", type=float, help="Exposure of the camera, which averages the motion [default: 0].")
@click.option("--max-offset-s", type=float, help="How far the two clocks may be apart [default: 2].")
def compare(**options: Any) -> None:
    """Compare a track.csv with other sensors' record of the same motion, at another rate and untriggered.

    SENSORS is a CSV file with the columns time_s, x_um, y_um and theta_urad, theta_deg or theta_rad.
    """
    from torch_ecc.commands import compare as job_of

    job = fill(job_of.CompareJob, {name: value for name, value in options.items() if value is not None}, "compare")
    figures = job_of.write(job, job_of.compare(job))
    console.print(job_of.report(figures), markup=False)
    console.print(f"In {job.out}/: comparison.json, comparison.png, errors.csv")


@app.command()
@click.argument("config", type=click.Path())
@click.option("--out", help="Folder for the outputs [default: torch-ecc-servo].")
@click.option("--overlay/--no-overlay", default=None, help="Write overlay.mp4 [default: yes].")
def servo(config: str, **options: Any) -> None:
    """Align a probe with a substrate by visual servoing on the simulated workstation (section V).

    CONFIG is a TOML file such as configs/servo.toml. Exit status 0 only if the probe is where it should be.
    """
    from torch_ecc.commands.servo import describe, run_session
    from torch_ecc.commands.servo_job import ServoJob

    values = read_toml(config)
    given = {name: value for name, value in options.items() if value is not None}
    job = ServoJob.read(values | {"align": values.get("align", {}) | given}, folder=Path(config).parent)
    with Console(stderr=True).status("teaching the templates") as live:
        run = run_session(job, lambda part, step: live.update(f"{part}  {step}"))
    for line in describe(job, run):
        console.print(line, soft_wrap=True)
    if not run.alignment.aligned:
        sys.exit(INTERRUPTED if run.alignment.ending.name == "INTERRUPTED" else 1)


def _size(text: str) -> int | list[int]:
    parts = text.lower().split("x")
    if not (1 <= len(parts) <= 2 and all(part.strip().isdecimal() for part in parts)):
        raise ValueError(f"size: expected a number of px or WxH, got {text!r}")
    numbers = [int(part) for part in parts]
    return numbers[0] if len(numbers) == 1 else numbers[::-1]


def _polygon(text: str) -> list[list[float]]:
    try:
        corners = [[float(number) for number in corner.split(",")] for corner in text.split()]
    except ValueError:
        corners = []
    if not corners or any(len(corner) != 2 for corner in corners):
        raise ValueError(f"polygon: expected corners as 'X,Y X,Y ...' in px, got {text!r}")
    return corners


def _report(outcome: Any) -> None:
    """Say in words what became of a run."""
    from torch_ecc.core.estimate import Status

    for number, lost in enumerate(outcome.lost.tolist()):
        if lost:
            sentence = Status.describe(int(outcome.last_status[number]))
            console.print(
                f"Template {number} was not found in {lost} of {outcome.frames} frames. Last frame: {sentence}"
            )
    end = "Stopped from the keyboard after" if outcome.interrupted else "Tracked"
    names = ", ".join(sorted(path.name for path in outcome.folder.iterdir())) if outcome.frames else "nothing"
    console.print(f"{end} {outcome.frames} frames. In {outcome.folder}/: {names}")


class _Rate(ProgressColumn):
    """Frames, or whatever is counted, per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self.unit = unit

    def render(self, task: RichTask) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.0f} {self.unit}/s")


@contextmanager
def progress_bar(title: str, total: int | None = None, unit: str = "frames") -> Iterator[Callable[..., None]]:
    """A bar with the rate; yields a function that advances it by one, or sets (done, total) when given them."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(unit), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=total)

        def advance(done: int | None = None, out_of: int | None = None) -> None:
            bar.update(task, advance=1 if done is None else None, completed=done, total=out_of or total)

        yield advance


def main() -> None:
    """Entry point: errors of the user's making in one line, exit status 2."""
    try:
        app(prog_name="torch-ecc")
    except (ValueError, OSError) as error:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"torch-ecc: {error}", style="red", markup=False)
        sys.exit(2)
