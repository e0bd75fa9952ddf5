"""Poses on their way: how long after a frame's arrival they are there, and to whom else they are sent."""

from __future__ import annotations

import gc
import json
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Reason, Status
from torch_ecc.io.cameras.precedence import before_others
from torch_ecc.io.frames import Frame
from torch_ecc.io.summary import plain

PERCENTILES = (50, 99, 99.9)
Send = Callable[[Frame, Estimate], None]


class Latency:
    """Of a camera's frames: the ``seconds`` from arrival to pose, and how many were ``lost``: they came too fast."""

    def __init__(self) -> None:
        self.lost, self.seconds = 0, list[float]()

    def add(self, frame: Frame) -> None:
        """One whose pose is there."""
        if frame.arrival is not None:
            self.lost += frame.arrival.lost
            self.seconds.append(time.perf_counter() - frame.arrival.time_s)

    def milliseconds(self) -> list[float]:
        """At ``PERCENTILES``; empty if there was no frame of a camera."""
        return [1e3 * value for value in np.percentile(self.seconds, PERCENTILES)] if self.seconds else []

    def words(self) -> list[str]:
        """The same as a sentence, if there is something to say."""
        if not self.seconds:
            return []
        times = ", ".join(f"{ms:.1f}" for ms in self.milliseconds())
        shares = ", ".join(f"{share:g}" for share in PERCENTILES)
        return [f"{self.lost} frames of the camera were lost; {times} ms from arrival to pose ({shares} %)"]


@contextmanager
def as_it_comes() -> Iterator[None]:
    """While frames do not wait, until Ctrl-C: how else would a camera end. They go before all else, and what libraries
    have made is not looked through for garbage, 0.1 s in which nothing else is done."""
    gc.freeze()
    try:
        with before_others():
            yield
    except KeyboardInterrupt:
        pass
    finally:
        gc.unfreeze()


def sender(address: str, um_matrix: Tensor | None = None) -> Send:
    """What sends a frame's poses as one line of JSON to "-", the standard output, or to udp://HOST:PORT, as one packet.

    Each patch has x, y in px, theta in rad, their sigma, dx_um and dy_um where ``um_matrix`` (2, 2) tells them, score,
    coverage, status and reason; what was not found has null. ValueError for another address.
    """
    deliver = _output if address == "-" else _udp(address)

    def send(frame: Frame, estimate: Estimate) -> None:
        deliver(json.dumps(plain(as_record(frame, estimate, um_matrix)), allow_nan=False).encode() + b"\n")

    return send


def as_record(frame: Frame, estimate: Estimate, um_matrix: Tensor | None = None) -> dict[str, Any]:
    """A frame's poses by name."""
    um = None if um_matrix is None else (estimate.displacement[:, :2].cpu() @ um_matrix.T).tolist()
    found = [field.cpu().tolist() for field in (estimate.pose, estimate.sigma, estimate.score, estimate.coverage)]
    codes = [field.cpu().tolist() for field in (estimate.status, estimate.reason)]
    patches = []
    for number, (pose, sigma, score, coverage, status, reason) in enumerate(zip(*found, *codes, strict=True)):
        good = status <= Status.MAX_ITERATIONS
        names = ("x", "y", "theta", "sigma_x", "sigma_y", "sigma_theta")
        values = dict(zip(names, [*pose, *sigma] if good else [None] * 6, strict=True))
        if um is not None:
            values |= dict(zip(("dx_um", "dy_um"), um[number] if good else [None] * 2, strict=True))
        said = {"status": Status(status).name, "reason": Reason(reason).word}
        patches.append(values | {"score": score, "coverage": coverage} | said)
    lag = None if frame.arrival is None else 1e3 * (time.perf_counter() - frame.arrival.time_s)
    return {"frame": frame.number, "time_s": frame.time_s, "latency_ms": lag, "patches": patches}


def _output(line: bytes) -> None:
    sys.stdout.buffer.write(line)
    sys.stdout.buffer.flush()


def _udp(address: str) -> Callable[[bytes], None]:
    host, _, port = address.removeprefix("udp://").rpartition(":")
    if not address.startswith("udp://") or not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ValueError(f"send: expected - or udp://HOST:PORT, got {address!r}")
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.setblocking(False)
    where = (socket.gethostbyname(host), int(port))

    def deliver(packet: bytes) -> None:
        with suppress(BlockingIOError, ConnectionError):  # nobody listens, or not fast enough: tracking does not wait
            line.sendto(packet, where)

    return deliver
