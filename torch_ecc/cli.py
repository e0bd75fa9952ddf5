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

import torch_ecc
from torch_ecc.commands.jobs import Align, BatchJob, CompareJob, TrackJob
from torch_ecc.commands.options import given, options_of, read_polygons, read_scale, read_size, track_toml, write_new
from torch_ecc.config import fill, read_toml

INTERRUPTED = 130

TRACK_FORMS: dict[str, dict[str, Any]] = {  # of those options of TrackJob that are no single number or word
    "centers": {"flag": "--center", "nargs": 2, "type": float, "multiple": True, "metavar": "X Y"},
    "size": {"type": str, "metavar": "N|H,W", "callback": read_size},
    "um_per_px": {"type": str, "metavar": "S|SX,SY", "callback": read_scale},
    "max_step": {"nargs": 2, "type": float, "metavar": "PX DEG"},
    "polygons": {
        "flag": "--polygon",
        "type": str,
        "multiple": True,
        "metavar": "'X,Y X,Y ...'",
        "callback": read_polygons,
    },
}

console = Console(highlight=False, markup=False)  # names of files may look like markup

TRACKING = options_of(TrackJob, without=("input",), **TRACK_FORMS)


def _say_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    """And which engine serves on this computer's processor."""
    if not wanted:
        return
    import torch

    from torch_ecc.core.native.library import describe

    console.print(f"torch-ecc {torch_ecc.__version__}, torch {torch.__version__}, engine: {describe()}", soft_wrap=True)
    context.exit()


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_say_version,
    help="Show the version and the engine in use, and exit.",
)
def app() -> None:
    """Planar pose tracking of textured patches: x, y and theta to a thousandth of a pixel."""


@app.command()
@click.option("--out", default="torch-ecc-demo", show_default=True, help="Folder for the outputs.")
@click.option("--frames", default=120, show_default=True, type=click.IntRange(8), help="Frames of one cycle of motion.")
def demo(out: str, frames: int) -> None:
    """Make a microscope-like sequence with known motion, track it with ECC and SSD, print the errors."""
    from torch_ecc.commands.demo import run_demo

    with progress_bar("demo") as advance:
        result = run_demo(Path(out).expanduser(), frames, advance)
    console.print(result.table())
    console.print(f"In {out}/: demo.png, and track.png, overlay.mp4, track.csv ... of each method in ecc/ and ssd/")


@app.command()
@click.argument("input", required=False)
@click.option("--config", type=click.Path(), help="TOML file of settings; options given here win.")
@click.option(
    "--write-config",
    metavar="[FILE]",
    is_flag=False,
    flag_value="-",
    help="Write all settings, commented, as a file for --config, and do nothing else; without FILE, to the screen.",
)
@TRACKING
def track(config: str | None, write_config: str | None, **options: Any) -> None:
    """Track patches through a video: x, y and theta of each in every frame.

    INPUT is a video, a folder or glob of images, a multi-page TIFF, an .npy or .npz stack or a camera index. Repeat
    --center (or --polygon, or --template) for more templates.
    """
    values = (read_toml(config) if config else {}) | given(options)
    if write_config is not None:
        write_new(track_toml(values, config or "track"), write_config)
        return
    if "input" not in values:
        raise ValueError("track: INPUT is missing, and no config names one")
    import cv2

    from torch_ecc.commands.track import Session

    session = Session(fill(TrackJob, values, config or "track"))
    cv2.setNumThreads(1)  # OpenCV's wait for each other, spinning, longer than one picture keeps them busy
    for remark in session.remarks():
        console.print(remark, soft_wrap=True)
    with progress_bar(session.source.name, session.source.length) as advance:
        finished = session.run(advance)
    for line in finished.words():
        console.print(line, soft_wrap=True)
    if finished.interrupted:
        if finished.frames:
            console.print("The same command with --resume goes on from there.")
        sys.exit(INTERRUPTED)


@app.command()
@click.argument("input")
@click.option("--port", default=0, show_default="any that is free", help="Of the page, on 127.0.0.1.")
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page.")
@TRACKING
def pick(port: int, browser: bool, **options: Any) -> None:
    """Mark patches on a page in the browser, see how well each can be tracked, track, watch, download.

    INPUT is what track reads, or the folder of a result, to look at its frames beside its curves. Options are those of
    track, and where the page begins.
    """
    from torch_ecc.view import serve

    stopped = serve(given(options), port, show=lambda url: _show(url, browser))
    for line in stopped:
        console.print(line, soft_wrap=True)
    if stopped:
        sys.exit(INTERRUPTED)


def _show(url: str, browser: bool) -> None:
    """Tell people where the page is, and open it."""
    console.print(f"The page: {url}", soft_wrap=True)
    console.print("Ctrl-C ends it.")
    if browser:
        click.launch(url)


@app.command()
@click.argument("recordings", nargs=-1, required=True, metavar="RECORDINGS...|LIST.toml")
@options_of(BatchJob, without=("recordings", "match"))
@options_of(TrackJob, without=("input", "out", "force", "resume"), **TRACK_FORMS)
def batch(recordings: tuple[str, ...], **options: Any) -> None:
    """Track many recordings, on the cores here or on a Dask cluster; again, only what is missing or has changed.

    A recording is whatever track takes but a camera: a video, a folder of images, a TIFF, an array. LIST.toml names
    them, with settings for all and for some. Exit status 0 only if every one was tracked.
    """
    from torch_ecc.commands.batch import batch as run

    def say(words: str) -> None:
        console.print(words, soft_wrap=True)

    with progress_bar("batch") as advance:
        done = run(recordings, progress=advance, say=say, **given(options))
    failed, unfinished = done.of("failed"), done.of("unfinished")
    for row in failed:
        say(f"Failed: {one_line(ValueError(row['recording']))}: {one_line(ValueError(row['words']))}")
    tracked = len(done.of("tracked"))
    say(f"Tracked {done.tracked_now} now; {tracked} of {len(done.rows)} are done, {len(failed)} have failed")
    say(f"In {done.folder}/: batch.csv, batch.png, and a folder for each recording")
    if done.interrupted:
        say(f"Stopped: {len(unfinished)} recordings are left. The same command goes on with them.")
        sys.exit(INTERRUPTED)
    sys.exit(1 if failed or unfinished else 0)


@app.command()
@click.argument("config", type=click.Path())
@click.option("--out", default="torch-ecc-sequence", show_default=True, help="Folder for the sequence, new or empty.")
def simulate(config: str, out: str) -> None:
    """Render a sequence whose motion is known exactly, as images, poses.csv and metadata.json.

    CONFIG is a TOML file such as configs/simulate.toml.
    """
    from torch_ecc.sim import from_config, save

    simulation = from_config(read_toml(config), folder=Path(config).expanduser().parent)
    sequence, template = simulation.sequence, simulation.template
    with progress_bar("simulate", len(sequence)) as advance:
        save(sequence, Path(out).expanduser(), metadata=simulation.metadata, progress=advance)
    x, y = template.center or (0.0, 0.0)
    h, w = template.size
    console.print(f"{len(sequence)} frames in {out}/. To track them:")
    console.print(f"  torch-ecc track {out}/frames --center {x:g} {y:g} --size {h},{w}", soft_wrap=True)


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
                outcome = run(name, Path(out).expanduser(), quick, advance)
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
        sign = ">=" if record.better == "higher" else "<="
        text = f"  not kept: {record.name}: {record.value:.4g} {record.unit}, limit {sign} {record.tolerance:.4g}"
        console.print(text, soft_wrap=True)


@app.command()
@click.argument("track")
@click.argument("sensors")
@options_of(CompareJob, without=("track", "sensors"))
def compare(**options: Any) -> None:
    """Compare a track.csv with other sensors' record of the same motion, at another rate and untriggered.

    SENSORS is any log in text: columns are found by names such as "Time [ms]", "x_um", "Theta (deg)", or see --columns;
    at least one of x, y and theta. Exit status 2 if the records were not brought together.
    """
    from torch_ecc.commands import compare as job_of

    job = fill(CompareJob, given(options), "compare")
    figures = job_of.write(job, job_of.compare(job))
    console.print(job_of.report(figures), soft_wrap=True)
    console.print(f"In {job.out}/: comparison.json, comparison.png, errors.csv")
    if not figures["converged"]:
        sys.exit(2)


@app.command()
@click.argument("config", type=click.Path())
@options_of(Align, without=("desired", "landing", "size"))
def servo(config: str, **options: Any) -> None:
    """Align a probe with a substrate by visual servoing on the simulated workstation (section V).

    CONFIG is a TOML file such as configs/servo.toml, or, for a stage and a camera that Micro-Manager drives,
    configs/servo_micromanager.toml. Exit status 0 only if the probe, or the patch, is where it should be.
    """
    from torch_ecc.commands.servo import describe, run_session
    from torch_ecc.commands.servo_job import ServoJob

    values = read_toml(config)
    if "micromanager" in values:
        _servo_stage(values | {"align": values.get("align", {}) | given(options)})
        return
    job = ServoJob.read(
        values | {"align": values.get("align", {}) | given(options)}, folder=Path(config).expanduser().parent
    )
    with Console(stderr=True).status("teaching the templates") as live:
        run = run_session(job, lambda part, step: live.update(f"{part}  {step}"))
    for line in describe(job, run):
        console.print(line, soft_wrap=True)
    if not run.alignment.aligned:
        sys.exit(INTERRUPTED if run.alignment.ending.name == "INTERRUPTED" else 1)


def _servo_stage(values: dict[str, Any]) -> None:
    """Servo a stage of Micro-Manager's."""
    from torch_ecc.commands.stage import run_stage

    with Console(stderr=True).status("looking") as live:
        result, folder = run_stage(values, lambda step: live.update(str(step)))
    x, y, _ = result.log.error[-1].tolist()
    console.print(f"{result.ending.sentence} Last seen {x:+.3f}, {y:+.3f} px off, after {len(result.log.time)} frames.")
    console.print(f"In {folder}/: " + ", ".join(sorted(path.name for path in folder.iterdir())), soft_wrap=True)
    if not result.aligned:
        sys.exit(INTERRUPTED if result.ending.name == "INTERRUPTED" else 1)


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
    """A bar with the rate; yields a function that advances it by one, or sets (done, total) when given them. It shows
    once something is done: before, there may be an error to tell instead."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(unit),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task(title, total=total)

    def advance(done: int | None = None, out_of: int | None = None) -> None:
        if done != 0:
            bar.start()
        bar.update(task, advance=1 if done is None else None, completed=done, total=out_of or total)

    try:
        yield advance
    finally:
        if bar.live.is_started:
            bar.stop()


def main() -> None:
    """Entry point: errors of the user's making in a few words, exit status 2; Ctrl-C anywhere, 130."""
    try:
        sys.exit(app(prog_name="torch-ecc", standalone_mode=False))
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        Console(stderr=True).print("torch-ecc: stopped from the keyboard", style="red")
        sys.exit(INTERRUPTED)
    except (ValueError, OSError, MemoryError) as error:
        Console(stderr=True, highlight=False, soft_wrap=True).print(
            f"torch-ecc: {one_line(error)}", style="red", markup=False
        )
        sys.exit(2)


def one_line(error: BaseException) -> str:
    """The words of an error, which may quote names of files."""
    from torch_ecc.io.output import printable  # slow to import

    return printable(str(error).strip())
