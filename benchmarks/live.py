"""Latency from a frame's arrival to its pose on a simulated camera, and frames lost, with and without the page open.

``python benchmarks/live.py [--seconds N] [--camera WIDTHxHEIGHT@HZ] [--patches N] [--only alone page]
[--out FILE.json]``: a run of ``torch-ecc track camera:test:...`` in one process with whatever shows it. The page is a
real browser's (Chromium through playwright), which draws pictures and curves of the run on the same machine. Latency is
told twice: from when a picture was read, and from the beat of the camera, which counts how late it was read too.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from results import save

from torch_ecc.commands.live import PERCENTILES, Latency
from torch_ecc.paper.result import Number
from torch_ecc.view.desk import Desk
from torch_ecc.view.history import History
from torch_ecc.view.server import Server

SIZE = 121  # px
QUIET = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]


def desk_of(camera: str, seconds: float, patches: int, out: Path) -> Desk:
    """A camera with its patches marked, ready to be tracked for so long."""
    size, hz = camera.split("@")
    width, height = map(int, size.split("x"))
    centers = [[width * (k + 1) / (patches + 1), height / 2] for k in range(patches)]
    frames = f"0:{round(seconds * float(hz)) - 1}"
    values = {"centers": centers, "size": SIZE, "frames": frames, "overlay": False, "out": str(out)}
    return Desk({"input": f"camera:test:{camera}"} | values)


@contextmanager
def browser(url: str) -> Iterator[None]:
    """A browser that has the page open."""
    from playwright.sync_api import sync_playwright

    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=path, args=QUIET)
        page = opened.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.wait_for_selector("tbody tr")
        yield
        opened.close()


def measure(desk: Desk) -> tuple[History, Latency, float]:
    """The rows and the latencies of a whole run, and the seconds of a processor that this process took for it."""
    begun = time.process_time()
    desk.track()
    while desk.running:
        time.sleep(0.5)
    run = desk.run
    if run is None or run.state != "done":
        raise SystemExit(f"the run failed: {run and run.words}")
    return run.history, run.latency, time.process_time() - begun


def numbers(name: str, hz: float, found: tuple[History, Latency, float]) -> Iterator[Number]:
    """As records."""
    history, latency, busy = found
    number, time_s = history.rows[:, :2].T
    late = time_s - number / hz  # but for when the camera began: no picture is read before it is there
    seconds = np.array(latency.seconds)
    for kind, each in (("reading", seconds), ("the beat", seconds + late - late.min())):
        for share, ms in zip(PERCENTILES, 1e3 * np.percentile(each, PERCENTILES), strict=True):
            yield Number(f"{name}: latency from {kind}, {share:g} %", ms, "ms")
    yield Number(f"{name}: frames lost of {latency.lost + len(history)}", latency.lost, "frames")
    yield Number(f"{name}: processor of this process", busy / (time_s[-1] - time_s[0]), "cores")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--camera", default="2048x2048@100")
    parser.add_argument("--patches", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=["alone", "page"], choices=["alone", "page"])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    records: list[Number] = []
    for kind in given.only:
        with tempfile.TemporaryDirectory() as folder:
            desk = desk_of(given.camera, given.seconds, given.patches, Path(folder) / "out")
            if kind == "page":
                server = Server(desk)
                threading.Thread(target=server.run, daemon=True).start()
                with browser(server.url):
                    found = measure(desk)
            else:
                found = measure(desk)
        hz = float(given.camera.split("@")[1])
        for record in numbers(f"{given.camera}, {given.patches} patches, {kind}", hz, found):
            print(f"{record.name}: {record.value:.3g} {record.unit}", flush=True)
            records.append(record)
    if given.out:
        save(given.out, records)


if __name__ == "__main__":
    main()
