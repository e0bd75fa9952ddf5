"""Trackers side by side on one work: time and error of every one of them."""

from __future__ import annotations

import math
import random
import statistics
import time
from typing import NamedTuple

import torch
from adapters import Peer
from torch import Tensor
from work import Work

BLOCK = 6  # frames that one tracker follows before it is the next one's turn
LOST_PX = 0.5  # a pose farther off than this, or none, is a lost frame


class Result(NamedTuple):
    """Of one tracker on one work: ``wall`` and processor time ``cpu``, s per frame (the first of each block left
    out), and ``error`` (n, 3) px, px, deg, NaN where it gave no pose."""

    wall: list[float]
    cpu: list[float]
    error: Tensor

    def ms(self) -> tuple[float, float, float]:
        """Quartiles of the time per frame, ms."""
        low, middle, high = (1e3 * v for v in statistics.quantiles(self.wall, n=4))
        return low, middle, high

    def cpu_ms(self) -> float:
        """Median processor time per frame, ms: what a busy machine disturbs less."""
        return 1e3 * statistics.median(self.cpu)

    @property
    def lost(self) -> int:
        """Frames without a pose, or with a wrong one."""
        return int((~self._good).sum())

    @property
    def _good(self) -> Tensor:
        return self.error[:, :2].abs().amax(1) <= LOST_PX  # NaN is not

    def rms(self) -> tuple[float, float]:
        """Root mean square error of the worse of x and y, px, and of theta, deg, in the frames that were not lost."""
        x, y, theta = self.rms3().tolist()
        return max(x, y), theta

    def rms3(self) -> Tensor:
        """The same of x, y and theta, (3,)."""
        return self.error[self._good].square().mean(0).sqrt()

    def largest(self) -> tuple[float, float]:
        """The same of the largest error."""
        good = self.error[self._good].abs()
        x, y, theta = good.amax(0).tolist() if len(good) else [math.nan] * 3
        return max(x, y), theta


def measure(work: Work, peers: dict[str, Peer], frames: int) -> dict[str, Result]:
    """All trackers through the frames side by side: in turns, each for BLOCK frames, in an order drawn anew each time.

    The first frame of a block is not timed: in use nothing else has filled the caches between two frames.
    """
    follow = {name: peer.start(work.frames[0], work.center, work.size) for name, peer in peers.items()}
    wall, cpu, error = ({name: [] for name in peers} for _ in range(3))
    frames = min(frames, len(work.truth))
    for first in range(0, frames, BLOCK):
        for name in random.Random(first).sample(list(peers), len(peers)):
            for k in range(first, min(first + BLOCK, frames, peers[name].frames)):
                begun, worked = time.perf_counter(), time.process_time()
                pose = follow[name](work.frames[k + 1])
                if k > first:
                    wall[name].append(time.perf_counter() - begun)
                    cpu[name].append(time.process_time() - worked)
                error[name].append(_error(pose, work.truth[k]))
    return {name: Result(wall[name], cpu[name], torch.stack(error[name])) for name in peers}


def _error(pose: tuple[float, float, float] | None, truth: Tensor) -> Tensor:
    """Pose minus truth (3,) px, px, deg; whole turns do not count, since the peers do not."""
    if pose is None:
        return torch.full((3,), math.nan, dtype=torch.float64)
    error = torch.tensor(pose, dtype=torch.float64) - truth
    error[2] = math.degrees(math.remainder(float(error[2]), math.tau))
    return error


def together(rounds: list[dict[str, Result]]) -> dict[str, Result]:
    """The rounds of one work as one."""
    parts = {name: [one[name] for one in rounds] for name in rounds[0]}
    return {
        name: Result([s for p in ps for s in p.wall], [s for p in ps for s in p.cpu], torch.cat([p.error for p in ps]))
        for name, ps in parts.items()
    }
