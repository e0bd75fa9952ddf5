"""Thousands of templates on one device, beside its copy rate: python benchmarks/accelerator.py [--device cuda]

Every iteration has to read of each pixel 4 rows of K and the frame's value, 20 bytes; so many times the pixels and the
iterations over the measured rate of a copy is the roofline, of which the share reached is printed. The solve is the one
of an accelerator on any device: all iterations, no look of the host at a value; a CUDA device replays it as a graph.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import torch
from results import save
from rich.console import Console
from scaling import SCENE, spread
from torch import Tensor

from torch_ecc import Estimate, Tracker
from torch_ecc.core import sampling, solver, verdict
from torch_ecc.core.align import solve
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.paper.result import Number
from torch_ecc.paper.scheme import Harmonic
from torch_ecc.sim import Camera, Sequence

FRAME = (480, 640)
BYTES = 4 * (4 + 1)  # per pixel and iteration: float32 of the rows of K that the step needs, and of the frame
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
    modules, looks = (sampling, solver, verdict), sampling.is_cpu
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


def measure(reference: Reference, images: list[Tensor], start: Tensor, settings: Settings) -> tuple[float, float]:
    """Poses per second, and how far at most they are from the CPU's, px or rad."""
    some = torch.arange(min(CHECKED, len(start)), device=start.device)
    near = reference.select(some).map(lambda tensor: tensor.cpu())
    exact = follow(lambda image, pose: solve(near, image, pose, settings), [i.cpu() for i in images], start[some].cpu())
    with never_looking():
        replay = captured(lambda image, pose: solve(reference, image, pose, settings), images[0], start)
        found = follow(replay, images, start)
        taken = seconds(start.device, lambda: follow(replay, images, start), 3)
    apart = max(float((a[some].cpu() - b).abs().max()) for a, b in zip(found, exact, strict=True))
    return len(start) * len(images) / taken, apart


@torch.no_grad()
@click.command()
@click.option("--device", default="cuda" if torch.cuda.is_available() else "cpu", show_default=True)
@click.option("--count", type=int, help="templates in a frame [default: 4096, on a CPU 16]")
@click.option("--frames", default=10, show_default=True)
@click.option("--size", default=121, show_default=True, help="px")
@click.option("--iterations", default=8, show_default=True)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(device: str, count: int | None, frames: int, size: int, iterations: int, out: Path | None) -> None:
    """Poses per second, share of the roofline, agreement with the CPU, by sampler."""
    place = torch.device(device)
    count = count or (4096 if place.type == "cuda" else 16)
    first, *rest = Sequence(SCENE, Harmonic(6.0, 1.0, frames + 1).closed(), Camera())
    tracker = Tracker(first, spread(count, size + 40, FRAME).round(), size, device=place)
    images, rate = [view[None].to(place) for view in rest], copy_rate(place)
    console.print(
        f"{place}: copies {rate / 1e9:.1f} GB/s; {count} templates of {size} px in each of {len(rest)} frames"
    )
    figures = [Number("copy rate", rate / 1e9, "GB/s", "higher")]
    for sampler in ("bilinear", "bspline3"):
        settings = Settings(sampler, iterations, backend="torch")
        speed, apart = measure(tracker.references[0], images, tracker.pose, settings)
        least = visited(tracker.references[0], settings) * BYTES
        console.print(
            f"{sampler}: {speed:,.0f} poses/s; {least / iterations / 1e3:.0f} kB per template and iteration, "
            f"{speed * least / rate:.1%} of the roofline; {apart:.1e} px or rad from the CPU's poses"
        )
        figures += [
            Number(f"{sampler}: poses", speed, "1/s", "higher", 0.3),
            Number(f"{sampler}: share of the roofline", speed * least / rate, "", "higher", 0.3),
            Number(f"{sampler}: from the CPU's poses", apart, "px"),
        ]
    if out:
        save(out, figures, device=str(place), count=str(count), size=str(size), iterations=str(iterations))


if __name__ == "__main__":
    main()
