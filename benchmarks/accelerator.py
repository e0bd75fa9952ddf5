"""Thousands of templates on one device, beside its copy rate: python benchmarks/accelerator.py [--device cuda]

Every iteration has to read of each pixel 4 rows of K and the frame's value, 20 bytes; so many times the pixels and the
iterations over the measured rate of a copy is the roofline, of which the share reached is printed. The page's solve is
the one of an accelerator on any device, all iterations, no look of the host at a value: eager, as what torch.compile
makes of it, and on a CUDA device replayed as a graph; there the fused engine too, which reads less and ends sooner than
that, and on a CPU the native one, as it is used. First, a whole tracker, frame by frame, from an H.264 file too, and
what the gradient of poses costs. The cases come in the order of what they tell; when the ``--minutes`` are over those
that are left are named. All is written as it comes. Nothing has to be installed: beside torch it imports numpy, OpenCV,
kornia, pydantic, click and rich, and for the file what torch_ecc.io does.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Some
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import click
import torch
from command import write_video
from results import save
from rich.console import Console
from scaling import SCENE, spread
from torch import Tensor

from torch_ecc import Estimate, Tracker
from torch_ecc.core import sampling
from torch_ecc.core.align import solve
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.paper.result import Number
from torch_ecc.paper.scheme import Harmonic
from torch_ecc.sim import Camera, Sequence

FRAME = (480, 640)
BYTES = 4 * (4 + 1)  # per pixel and iteration: float32 of the rows of K that the step needs, and of the frame
SAMPLERS = ("bilinear", "bspline3")
CHECKED = 16  # templates that are solved on the CPU too
console = Console(width=110)
Solve = Callable[[Tensor, Tensor], Estimate]


def wait(device: torch.device) -> None:
    """Until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def seconds(device: torch.device, work: Callable[[], object], times: int) -> float:
    """Of one call, on average over ``times`` after a first one."""
    work()
    wait(device)
    start = time.perf_counter()
    for _ in range(times):
        work()
    wait(device)
    return (time.perf_counter() - start) / times


def card(device: torch.device) -> str:
    """Its name."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def copy_rate(device: torch.device) -> float:
    """Bytes per second, read and written, of a copy too large for any cache: 256 MB, on a CPU 64 MB."""
    source = torch.zeros(2**26 if device.type == "cuda" else 2**24, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() * source.element_size() / seconds(device, lambda: target.copy_(source), 10)


def captured(solve: Solve, image: Tensor, pose: Tensor) -> Solve:
    """``solve`` as a CUDA graph, replayed with the data of each call; on another device as it is."""
    if image.device.type != "cuda":
        return solve
    inputs = image.clone(), pose.clone()
    stream = torch.cuda.Stream(image.device)
    stream.wait_stream(torch.cuda.current_stream(image.device))
    with torch.cuda.stream(stream):  # constants are made, libraries loaded
        for _ in range(3):
            solve(*inputs)
    torch.cuda.current_stream(image.device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = solve(*inputs)

    def replay(image: Tensor, pose: Tensor) -> Estimate:
        for held, new in zip(inputs, (image, pose), strict=True):
            held.copy_(new)
        graph.replay()
        return result

    return replay


def visited(reference: Reference, settings: Settings) -> int:
    """Pixels that one pose takes where the host never looks: every stage does all the iterations that it may."""
    most, coarse = settings.max_iterations, reference.coarse or reference
    first = 0 if coarse is reference and settings.interpolation == "bilinear" else max(most * 2 // 3, 1)
    return coarse.K.shape[-1] * first * (most > 1) + reference.K.shape[-1] * most


@contextmanager
def never_looking() -> Iterator[None]:
    """Within, a CPU does what an accelerator does."""
    loaded, looks = list(sys.modules.items()), sampling.is_cpu
    modules = [each for name, each in loaded if name.startswith("torch_ecc.") and hasattr(each, "is_cpu")]
    try:
        for module in modules:
            module.is_cpu = lambda device: False
        yield
    finally:
        for module in modules:
            module.is_cpu = looks


def follow(solve: Solve, images: list[Tensor], pose: Tensor) -> list[Tensor]:
    """Poses (B, 3) in one image after the other, each from those in the last."""
    poses = [pose]
    for image in images:
        poses.append(solve(image, poses[-1]).pose.clone())
    return poses[1:]


class Case(NamedTuple):
    """What is measured: ``count`` templates of ``size`` px in a frame, by a sampler, in one of ``WAYS``."""

    count: int
    size: int
    sampler: str
    way: str
    robust: bool = False

    def __str__(self) -> str:
        return f"{self.count} of {self.size} px, {self.sampler}, {self.way}{', robust' if self.robust else ''}"


def compiled(solve: Solve, image: Tensor, pose: Tensor) -> Solve:
    """What torch.compile makes of ``solve``, in one graph."""
    return torch.compile(solve, fullgraph=True, dynamic=False)


def as_it_is(solve: Solve, image: Tensor, pose: Tensor) -> Solve:
    """``solve``, operation by operation."""
    return solve


WAYS: dict[str, tuple[str, Callable[[Solve, Tensor, Tensor], Solve]]] = {  # a backend, and how it is called
    "fused graph": ("fused", captured),
    "graph": ("torch", captured),
    "fused": ("fused", as_it_is),
    "native": ("native", as_it_is),
    "eager": ("torch", as_it_is),
    "compiled": ("torch", compiled),
}
THERE = {"cuda": ["fused graph", "graph", "fused", "eager"], "cpu": ["native", "eager"]}  # elsewhere the page alone


def cases(counts: Some[int], sizes: Some[int], ways: Some[str]) -> list[Case]:
    """The goal's first (the most templates of the largest size), then all counts and sizes, then what a robust solve
    costs; the compiled ones last: they take minutes to make."""
    first = [way for way in ways if way != "compiled"]
    every = [
        Case(n, size, sampler, way) for size in sizes[::-1] for n in counts for sampler in SAMPLERS for way in first
    ]
    every.sort(key=lambda case: (case.count, case.size) != (counts[-1], sizes[-1]))
    last = [Case(counts[-1], sizes[-1], "bspline3", way) for way in ways if way == "compiled"]
    return [*every, Case(counts[-1], sizes[-1], "bspline3", ways[0], robust=True), *last]


def measure(case: Case, frames: list[Tensor], place: torch.device, iterations: int) -> tuple[float, float, int]:
    """Poses per second, how far at most they are from the CPU's, px or rad, and the bytes that one has to read."""
    first, *images = frames
    tracker = Tracker(first, spread(case.count, case.size + 40, FRAME).round(), case.size, device=place)
    reference, start = tracker.references[0], tracker.pose.clone()
    backend, made = WAYS[case.way]
    settings = Settings(case.sampler, iterations, backend=backend, robust=case.robust)
    some = torch.arange(min(CHECKED, case.count), device=place)
    near = reference.select(some).map(lambda tensor: tensor.cpu())
    page = replace(settings, backend="torch")
    exact = follow(lambda image, pose: solve(near, image, pose, page), [i.cpu() for i in images], start[some].cpu())
    with nullcontext() if case.way == "native" else never_looking():
        replay = made(lambda image, pose: solve(reference, image, pose, settings), images[0], start)
        found = follow(replay, images, start)
        taken = seconds(place, lambda: follow(replay, images, start), 3)
    apart = max(float((a[some].cpu() - b).abs().max()) for a, b in zip(found, exact, strict=True))
    return case.count * len(images) / taken, apart, visited(reference, settings) * BYTES


def told(case: Case, rate: float, speed: float, apart: float, least: int) -> list[Number]:
    """What was measured, printed."""
    console.print(
        f"{case}: {speed:,.0f} poses/s, {1e3 * case.count / speed:.3g} ms per frame, "
        f"{speed * least / rate:.1%} of the roofline; {apart:.1e} px or rad from the CPU's"
    )
    return [
        Number(f"{case}: poses", speed, "1/s", "higher", 0.3),
        Number(f"{case}: share of the roofline", speed * least / rate, "", "higher", 0.3),
        Number(f"{case}: from the CPU's poses", apart, "px"),
    ]


def gradient_cost(frames: list[Tensor], place: torch.device, count: int, size: int, backend: str) -> Number:
    """The time of a backward pass over that of the solve without one: ``count`` templates of ``size`` px in a frame."""
    first, image, *_ = frames
    tracker = Tracker(first, spread(count, size + 40, FRAME).round(), size, device=place)
    reference, start, settings = tracker.references[0], tracker.pose.clone(), Settings(backend=backend)
    wanted = image.float().requires_grad_()

    def both() -> None:
        with torch.enable_grad():
            solve(reference, wanted, start, settings).pose.sum().backward()

    alone = seconds(place, lambda: solve(reference, wanted, start, settings), 3)
    share = seconds(place, both, 3) / alone - 1
    name = f"gradient of poses over the solve, {count} of {size} px, {backend}"
    console.print(f"{name}: {share:.2f} times {1e3 * alone:.3g} ms")
    return Number(name, share, "", "lower", 0.3)


def moving(device: torch.device, count: int) -> list[Tensor]:
    """Frames (H, W) of a slow movement, and those of the way back."""
    views = list(Sequence(SCENE, Harmonic(3.0, 1.0, count).closed(), Camera()))
    return [view.to(device).reshape(FRAME) for view in (*views, *views[-2:0:-1])]


def whole_trackers(place: torch.device, counts: list[int], size: int, frames_each_way: int) -> list[Number]:
    """Of the fewest and the most templates; of the fewest under covers and from a file too."""
    frames, few = moving(place, frames_each_way), counts[0]
    figures = [number for count in sorted({few, counts[-1]}) for number in tracked(frames, place, count, size)]
    return [*figures, *tracked(frames, place, few, size, covered=True), *from_video(frames, place, few, size)]


def tracked(frames: list[Tensor], place: torch.device, count: int, size: int, covered: bool = False) -> list[Number]:
    """The time of a tracker per frame as it comes, robust as by default, and the memory of a template; ``covered``:
    under stripes over a tenth of all of them."""
    before = torch.cuda.memory_allocated(place) if place.type == "cuda" else 0
    tracker = Tracker(frames[0], spread(count, size + 40, FRAME).round(), size, device=place)
    if covered:
        frames = [frame.clone() for frame in frames]
        for frame in frames[1:]:
            frame[::40] = frame[1::40] = frame[2::40] = frame[3::40] = 10
    for frame in frames:  # which makes and records all that they need
        found = tracker(frame)
    held = torch.cuda.memory_allocated(place) - before if place.type == "cuda" else 0
    wait(place)
    start = time.perf_counter()
    for frame in frames:
        found = tracker(frame)
    wait(place)
    each = (time.perf_counter() - start) / len(frames)
    name = f"tracker, {count} of {size} px{', a tenth covered' if covered else ''}"
    good, kept = float((found.status == 0).float().mean()), held / count / 1e3
    console.print(f"{name}: {1e3 * each:.3g} ms per frame, {count / each:,.0f} poses/s, {kept:.0f} kB per template")
    console.print(f"  {good:.1%} CONVERGED in the last frame")
    memory = [Number(f"{name}: memory of a template", kept, "kB")] if held else []
    return [Number(f"{name}: time per frame", 1e3 * each, "ms", "lower", 0.3), *memory]


def from_video(frames: list[Tensor], place: torch.device, count: int, size: int) -> list[Number]:
    """Frames per second from an H.264 file to poses; nothing where something that it takes is not there."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "moving.mp4"
        try:
            from torch_ecc.io import open_frames

            write_video(path, "h264", (frame.cpu().numpy() for frame in frames))
        except ImportError as error:
            console.print(f"from an H.264 file: not measured ({error})")
            return []
        first, *_ = open_frames(path)
        tracker = Tracker(first.pixels, spread(count, size + 40, FRAME).round(), size, device=place)
        taken = seconds(place, lambda: [tracker(frame.pixels) for frame in open_frames(path)], 2) / len(frames)
    name = f"from an H.264 file, {count} of {size} px"
    console.print(f"{name}: {1 / taken:,.0f} frames/s, {count / taken:,.0f} poses/s")
    return [Number(name, 1 / taken, "frames/s", "higher", 0.3)]


def numbers(_: click.Context, __: click.Parameter, value: str | None) -> list[int] | None:
    """Of a list with commas."""
    return None if value is None else [int(v) for v in value.split(",")]


def ways_of(_: click.Context, __: click.Parameter, value: str | None) -> list[str]:
    """Those of a list with commas, by default all."""
    ways = list(WAYS) if value is None else value.split(",")
    if unknown := [way for way in ways if way not in WAYS]:
        raise click.BadParameter(f"expected some of {', '.join(WAYS)}, got {', '.join(unknown)}")
    return ways


@click.command()
@click.option("--device", default="cuda" if torch.cuda.is_available() else "cpu", show_default=True)
@click.option("--counts", callback=numbers, help="templates in a frame [default: 1,64,1024,4096,16384; on a CPU 1,16]")
@click.option("--sizes", callback=numbers, default="31,61,121", show_default=True, help="px")
@click.option("--frames", default=10, show_default=True)
@click.option("--iterations", default=8, show_default=True)
@click.option("--minutes", default=7.0, show_default=True, help="begin nothing after so many")
@click.option("--ways", callback=ways_of, help=f"some of {', '.join(WAYS)} [default: all there are]")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
@torch.no_grad()
def main(
    device: str,
    counts: list[int] | None,
    sizes: list[int],
    frames: int,
    iterations: int,
    minutes: float,
    ways: list[str],
    out: Path | None,
) -> None:
    """Poses per second, share of the roofline, agreement with the CPU."""
    place, end = torch.device(device), time.monotonic() + 60 * minutes
    counts = counts or ([1, 64, 1024, 4096, 16384] if place.type == "cuda" else [1, 16])
    there = [*THERE.get(place.type, ["eager"]), "compiled"]
    ways = [way for way in there if way in ways]
    if not ways:
        raise click.UsageError(f"--ways: expected some that {place.type} has: {', '.join(there)}")
    shots = Sequence(SCENE, Harmonic(6.0, 1.0, frames + 1).closed(), Camera())
    views, rate = [view[None].to(place) for view in shots], copy_rate(place)
    console.print(f"{card(place)}: copies {rate / 1e9:.1f} GB/s; {len(views) - 1} frames, {iterations} iterations")
    figures, left = [Number("copy rate", rate / 1e9, "GB/s", "higher")], cases(counts, sizes, ways)
    engines = dict.fromkeys(backend for backend, _ in (WAYS[way] for way in ways))
    some = {counts[0], min(counts[-1], CHECKED)} if minutes > 0 else ()
    if minutes > 0:
        figures += whole_trackers(place, counts, sizes[-1], 6 * frames)
    figures += [gradient_cost(views, place, count, sizes[-1], backend) for backend in engines for count in some]
    while left and time.monotonic() < end:
        case = left.pop(0)
        figures += told(case, rate, *measure(case, views, place, iterations))
        if out:
            save(out, figures, device=card(place), iterations=str(iterations))
    for case in left:
        console.print(f"{case}: no time was left")


if __name__ == "__main__":
    main()
