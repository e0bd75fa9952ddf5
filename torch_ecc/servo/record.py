"""What a servo run leaves behind: why it ended, and a row per frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor


class Ending(IntEnum):
    """Why a run ended. In every case the last command was velocity zero."""

    ALIGNED = 0
    LOST = 1
    FROZEN = 2
    STALLED = 3
    DIVERGED = 4
    TIME_OUT = 5
    INTERRUPTED = 6

    @property
    def sentence(self) -> str:
        """The same for people."""
        return _SENTENCES[self]


_SENTENCES = {
    Ending.ALIGNED: "The part is at the desired pose and stays there.",
    Ending.LOST: "The target was lost and not found again; the stage was stopped.",
    Ending.FROZEN: "The camera gives the same frame again and again while the stage moves; the stage was stopped.",
    Ending.STALLED: "The part does not follow the commands (end of travel? blocked?); the stage was stopped.",
    Ending.DIVERGED: "The error grows instead of falling (signs or axes of the Jacobian?); the stage was stopped.",
    Ending.TIME_OUT: "The desired pose was not reached in the frames allowed; the stage was stopped.",
    Ending.INTERRUPTED: "Stopped from the keyboard; the stage was stopped.",
}


class Step(NamedTuple):
    """One frame: ``time`` s; ``pose`` and ``error`` (3,) px, px, rad; the ``velocity`` (n,) commanded on it, um/s,
    rad/s; the tracker's ``score`` and ``status``."""

    time: float
    pose: Tensor
    error: Tensor
    velocity: Tensor
    score: float
    status: int

    def __str__(self) -> str:
        x, y, theta = self.error.tolist()
        return f"{self.time:6.2f} s   x {x:+9.3f} px   y {y:+9.3f} px   theta {math.degrees(theta):+9.4f} deg"


class Log(NamedTuple):
    """The fields of Step over F frames: (F, ...), float64 (status int64)."""

    time: Tensor
    pose: Tensor
    error: Tensor
    velocity: Tensor
    score: Tensor
    status: Tensor

    @classmethod
    def of(cls, steps: Sequence[Step], axes: int) -> Log:
        """One record of many, or of none, for a stage of ``axes`` axes."""
        time = torch.tensor([s.time for s in steps], dtype=torch.float64)
        score = torch.tensor([s.score for s in steps], dtype=torch.float64)
        pose, error = _stack([s.pose for s in steps], 3), _stack([s.error for s in steps], 3)
        velocity = _stack([s.velocity for s in steps], axes)
        return cls(time, pose, error, velocity, score, torch.tensor([s.status for s in steps], dtype=torch.int64))


def _stack(rows: Sequence[Tensor], width: int) -> Tensor:
    return torch.stack(tuple(rows)) if rows else torch.zeros(0, width, dtype=torch.float64)


class Result(NamedTuple):
    """How a run ended and its log."""

    ending: Ending
    log: Log

    @property
    def aligned(self) -> bool:
        """Was the desired pose reached, and kept for the dwell?"""
        return self.ending == Ending.ALIGNED

    def __str__(self) -> str:
        if not len(self.log.time):
            return self.ending.sentence
        x, y, theta = self.log.error[-1].tolist()
        left = f"x {x:+.3f} px, y {y:+.3f} px, theta {math.degrees(theta):+.4f} deg"
        return f"{self.ending.sentence} After {float(self.log.time[-1]):.2f} s the error is {left}."


def decay_rate(time: Tensor, error: Tensor, *, largest: float, smallest: float) -> Tensor:
    """The rate (1/s) of exponential decay of each column of ``error`` (F, m) over ``time`` (F,) s.

    Regression of ln |e| on the time from where |e| falls below ``largest`` to where it first falls below ``smallest``,
    both as a part of the column's first value; NaN for columns with less than three such frames.
    """
    rates = []
    for column in error.abs().unbind(1):
        part = column / column[0]
        begin = int((part < largest).int().argmax())
        after = (part[begin:] < smallest).nonzero()
        end = begin + int(after[0]) if len(after) else len(part)
        if end - begin < 3 or column[0] == 0:
            rates.append(torch.nan)
            continue
        t, y = time[begin:end] - time[begin:end].mean(), column[begin:end].log()
        rates.append(-float((t * y).sum() / t.square().sum()))
    return torch.tensor(rates, dtype=torch.float64)
