"""Is CONVERGED true where the world is hostile?

python benchmarks/hostile.py [--rows WORDS]... [--scenes N] [--by NAME]... [--quick] [--data DATA] [--out FILE.json]

Most rows are a disturbance over four families of scenes (waves, pads, speckle, micrograph), N of each. Columns, frames:

right        CONVERGED, every component at most 0.1 px or 0.1 deg off
off          CONVERGED, not right
wrong        off by 5 of its sigma too
far          CONVERGED, over 2 px off
after        wrong when nothing disturbs any more
disbelieved  at most 0.1 px and 0.1 deg off, not CONVERGED
lost         no pose, half of the template to be seen
recovery     from when nothing disturbs any more until right, the longest

and of the worst of x, y, theta:

bound        rms error of what is CONVERGED and not wrong over the Cramer-Rao bound of what is to be seen
sigma        rms of error over sigma of all that is CONVERGED

coverage     rms of coverage minus the share that is to be seen
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path

import click
import torch
from films import cameras, covers, disturbed, repeats, weak
from films.shot import SCENES, Film, Shot
from honesty import BY, Run, figures, follow, follow_peer, numbers, worst
from results import save
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rivals import rivals

SHARES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
ARRAYS = 25  # of each kind
PEER = "OpenCV ECC, fastest fair"
COUNTS = ("frames", "converged", "right", "off", "wrong", "far", "after", "disbelieved", "lost")
RATIOS = {"recovery": ".0f", "bound": ".2f", "sigma": ".2f", "coverage": ".2f", "median": ".2f", "longest": ".0f"}
console = Console(width=190)

Row = Callable[[Shot], Film]
Runs = dict[str, list[Run]]


def disturbances() -> dict[str, Row]:
    """What is done to every scene, by name."""
    rows: dict[str, Row] = {"none": lambda shot: shot.film(shot.clean)}
    for share in SHARES:
        for kind in covers.KINDS:
            for motion in covers.MOTIONS:
                strip = partial(covers.cover, share=share, kind=kind, motion=motion)
                rows[f"cover {100 * share:.0f} % {kind} {motion}"] = strip
    for share in (0.02, 0.03):
        rows[f"thin cover {100 * share:.0f} %"] = partial(covers.cover, share=share, kind="textured", motion="moving")
    rows |= {f"needle {w} px": partial(covers.needle, width=float(w), level=g) for w, g in ((2, 250.0), (5, 20.0))}
    rows["hair"] = partial(covers.needle, width=4.0, level=20.0, opacity=0.5)
    rows |= {f"glass {100 * s:.0f} %": partial(covers.glass, share=s, opacity=0.4) for s in (0.2, 0.4)}
    rows |= {f"layer {d} px aside": partial(covers.layer, share=0.2, shift=d) for d in (3, 9)}
    rows |= {f"shadow {100 * s:.0f} %": partial(covers.shadow, share=s) for s in (0.2, 0.5)}
    rows |= {f"drops {100 * s:.0f} %": partial(covers.drops, share=s) for s in (0.05, 0.1, 0.2)}
    rows |= {f"stuck {100 * s:.0f} %": partial(covers.stuck, share=s) for s in (0.05, 0.1, 0.2)}
    return rows | pictures() | sensors()


def pictures() -> dict[str, Row]:
    """Light, optics, read-out and the target's own doing."""
    return {
        "twin": repeats.twin,
        "twin, 15 % covered": partial(repeats.twin, share=0.15),
        "leaves by half": partial(disturbed.leaving, nearest=0.0),
        "leaves and returns": partial(disturbed.leaving, nearest=-90.0),
        "jumps and darkness": disturbed.jumping,
        "turns by 9 deg a frame": partial(disturbed.turning, degrees=9.0),
        "flicker": disturbed.flicker,
        **{f"blur {s} px": partial(disturbed.blurred, sigma=float(s)) for s in (1, 2, 4)},
        "open shutter": disturbed.smeared,
        "noise taken out over time": partial(disturbed.averaged, share=0.3),
        "gamma 0.6": partial(disturbed.gamma, power=0.6),
        "scale +1 %": partial(disturbed.scaled_up, percent=1.0),
        "shear 1 %": partial(disturbed.sheared, percent=1.0),
        "specular spot": disturbed.specular,
        "rolling shutter": disturbed.rolling,
        "interlace": disturbed.interlaced,
        "JPEG 20": partial(disturbed.compressed, quality=20),
        "salt and pepper 5 %": partial(disturbed.salted, share=0.05),
        "dead rows 5 %": partial(disturbed.without_rows, share=0.05, same=True),
        "lost rows 5 %": partial(disturbed.without_rows, share=0.05, same=False),
    }


def sensors() -> dict[str, Row]:
    """What stays with the camera, and noise."""
    sizes = [(contrast, size) for contrast in (0.5, 1.0, 2.0, 3.0) for size in (61, 121, 241)]
    return {
        "fixed aperture": cameras.aperture,
        "fixed stripe": cameras.stripe,
        "fixed dust": cameras.dust,
        "fixed aperture with its mask": partial(cameras.aperture, known="told"),
        "fixed stripe with its mask": partial(cameras.stripe, known="told"),
        "fixed dust with its mask": partial(cameras.dust, known="told"),
        "fixed aperture that is found": partial(cameras.aperture, known="find"),
        "fixed stripe that is found": partial(cameras.stripe, known="find"),
        "fixed dust that is found": partial(cameras.dust, known="find"),
        "fixed stripe, faint": partial(cameras.stripe, opacity=0.3),
        "fixed dust, faint": partial(cameras.dust, opacity=0.3),
        **{
            f"fixed {one.__name__}, {what}": partial(by, one=one)
            for what, by in (("JPEG 70", cameras.coded), ("a drift of 0.05 px a frame", cameras.drifting))
            for one in (cameras.aperture, cameras.stripe, cameras.dust)
        },
        "fixed pattern": cameras.fixed_pattern,
        "fixed pattern, a drift of 0.05 px a frame": partial(cameras.drifting, one=cameras.fixed_pattern),
        "fixed columns": cameras.fixed_columns,
        "fixed columns, a drift of 0.05 px a frame": partial(cameras.drifting, one=cameras.fixed_columns),
        "noise in rows": partial(cameras.lined, across=False),
        "noise in columns": partial(cameras.lined, across=True),
        "noise blurred 1 px": cameras.soft,
        "noise and JPEG 50": partial(cameras.noisy_jpeg, quality=50),
        "noise of rounding": partial(cameras.white, sigma=0.0),
        **{f"noise {s}": partial(cameras.white, sigma=float(s)) for s in (5, 10)},
        **{f"photons {peak}": partial(cameras.photons, peak=float(peak)) for peak in (30, 100, 300)},
        **{f"photons {peak}, half dark": partial(cameras.dark_photons, peak=float(peak)) for peak in (30, 100, 300)},
        **{f"dim {c} x noise, {n} px": partial(cameras.dim, contrast=c, size=n) for c, n in sizes},
    }


def worlds(count: int, data: Path | None) -> dict[str, Callable[[], Iterable[Film]]]:
    """Films that are made of no scene of the families; ``count``: arrays, or crossings."""
    own: dict[str, Callable[[], Iterable[Film]]] = {"leap": repeats.leap}
    for parts, spread in (("equal", 0.0), ("nearly equal", 0.03)):
        for event in repeats.EVENTS:
            own[f"{parts} parts, {event}"] = partial(repeats.arrays, event, spread, count)
    own["equal parts crossing"] = partial(repeats.crossings, count)
    own |= {
        f"small patches jump, {hidden}": partial(repeats.leaps, hidden, -(-count // 10)) for hidden in repeats.HIDDEN
    }
    for what, black in (("clipped", 0.0), ("noisy", 40.0)):
        for size in (61, 121):
            own[f"one edge, dark side {what}, {size} px"] = partial(weak.one_edge, 4, black, size)
    return own | ({"200 jump together": partial(weak.together, data)} if data else {})


def shots(scenes: int, families: Iterable[str]) -> Iterator[Shot]:
    """``scenes`` shots of every family."""
    for seed in range(scenes):
        for family in families:
            yield Shot(SCENES[family](seed), seed)


def filmed(rows: dict[str, Row], wanted: Container[str], shots: Iterable[Shot]) -> Iterator[tuple[str, Film]]:
    """All films of the ``wanted`` rows, a scene after the other, so that each is rendered once."""
    for shot in shots:
        for name, disturb in rows.items():
            if name in wanted:
                yield name, disturb(shot)


def made(own: dict[str, Callable[[], Iterable[Film]]], wanted: Container[str]) -> Iterator[tuple[str, Film]]:
    """The same of the worlds."""
    for name, films in own.items():
        for film in films() if name in wanted else ():
            yield name, film


def followed(runs: Runs, name: str, film: Film, by: Iterable[str]) -> None:
    """Adds the runs over a film to those of its row, without the frames."""
    for how in by:
        if how == "opencv" and film.truth.shape[1] > 1:
            continue
        run = follow_peer(film, rivals()[PEER].start) if how == "opencv" else follow(film, **BY[how])
        title = name if how == "default" else f"{name}, {how}"
        runs.setdefault(title, []).append(run._replace(film=film._replace(frames=film.frames[:0].clone())))


def show(found: dict[str, dict[str, float]]) -> None:
    """The table."""
    table = Table("row", box=None, pad_edge=False)
    for name in (*COUNTS, *RATIOS):
        table.add_column(name, justify="right")
    for title, row in found.items():
        ratios = ["" if row[name] != row[name] else f"{row[name]:{form}}" for name, form in RATIOS.items()]
        table.add_row(title, *(str(row[name]) for name in COUNTS), *ratios)
    console.print(table)


def show_worst(runs: Runs, count: int) -> None:
    """The worst frames of every row that are wrong and believed."""
    header = ("row", "where", "seen, coverage", "error px px deg", "sigma", "score", "origin")
    table = Table(*header, box=None, pad_edge=False)
    for title, some in runs.items():
        for cells in worst(some, count):
            table.add_row(title, *cells)
    console.print(table)


@click.command()
@click.option("--rows", "words", multiple=True, help="only rows with these words in their name")
@click.option("--scenes", default=1, show_default=True, help="of each family")
@click.option("--by", multiple=True, default=("default",), type=click.Choice([*BY, "opencv"]), show_default=True)
@click.option("--quick", is_flag=True, help="waves and pads only, and a tenth of the arrays")
@click.option("--worst", "listed", default=0, show_default=True, help="frames of each row to tell all of")
@click.option("--data", type=click.Path(path_type=Path), default=os.environ.get("TORCH_ECC_DATA"))
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(
    words: tuple[str, ...],
    scenes: int,
    by: tuple[str, ...],
    quick: bool,
    listed: int,
    data: Path | None,
    out: Path | None,
) -> None:
    """Count what is believed and wrong."""
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    rows, own = disturbances(), worlds(2 if quick else ARRAYS, data)
    wanted = {name for name in (*rows, *own) if not words or any(word in name for word in words)}
    if not wanted:
        raise click.UsageError(f"no row has {' or '.join(words)} in its name; known are {', '.join((*rows, *own))}")
    families = list(SCENES)[:2] if quick else list(SCENES)
    runs: Runs = {}
    films = chain(filmed(rows, wanted, shots(scenes, families)), made(own, wanted))
    with suppress(KeyboardInterrupt):  # what there is by then is shown
        for name, film in track(films, "films", console=Console(stderr=True), transient=True):
            followed(runs, name, film, by)
    found = {title: figures(some) for title, some in runs.items()}
    show(found)
    if listed:
        show_worst(runs, listed)
    if out is not None:
        save(out, [n for title, row in found.items() for n in numbers(title, row)])


if __name__ == "__main__":
    main()
