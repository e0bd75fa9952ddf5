"""Where two records of one motion may belong together: every offset of their clocks, every sense of their axes.

For one offset, all that is asked of two records are the sums of products of their components over the samples that both
have. On a grid the sums at all offsets are correlations; around one offset they are taken from the samples themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.records.motion import Motion
from torch_ecc.records.spline import Curve

GRID = 2**18  # instants of the grid over both records, at most
CHUNK = 64_000  # interpolated poses at once
PEAKS = 3  # offsets of each sense of the axes that are looked at
TRACK, SENSORS, LEVER = slice(1, 4), slice(4, 7), 6  # places in the sums: 1, x, y, theta of the track, of the sensors

Signs = tuple[float, float, float]


class Start(NamedTuple):
    """A place to begin at: offset in s, axis angle in rad, signs of the track's x, y, theta, and how much it explains
    (in nats: samples times the logarithm of what is there over what is left)."""

    offset_s: float
    angle: float
    signs: Signs
    explained: float


class Sense(NamedTuple):
    """What to take for granted: the ``signs`` of the track's axes, whether an angle between the axes is free, whether
    what goes along with theta is free (a lever arm), and a weight (3,) per component, 0 for one that is missing."""

    signs: Signs
    angle: bool
    lever: bool
    weight: Tensor


def grid_sums(track: Motion, curve: Curve, reach_s: float) -> tuple[Tensor, Tensor]:
    """Offsets (J,) and sums (J, 7, 7) at every offset of at most ``reach_s`` at which the records overlap."""
    time, pose = track.time_s[track.found], track.pose[track.found].nan_to_num()
    first = max(float(curve.time[0]), float(time[0]) - reach_s)
    last = min(float(curve.time[-1]), float(time[-1]) + reach_s)
    if last <= first:
        return time[:0], pose.new_zeros(0, 7, 7)
    step = max(track.period_s / 4, (last - first + float(time[-1] - time[0])) / GRID)
    place = ((time - time[0]) / step).round().long()
    seen = pose.new_zeros(int(place[-1]) + 1, 4).index_add(0, place, torch.cat((torch.ones_like(pose[:, :1]), pose), 1))
    seen = seen / seen[:, :1].clamp(min=1)
    instants = first + step * torch.arange(int((last - first) / step) + 1, dtype=torch.float64)
    value, inside = curve(instants)
    there = torch.cat((inside[:, None].double(), value * inside[:, None]), 1)
    lags = first - float(time[0]) + step * torch.arange(1 - len(seen), len(there), dtype=torch.float64)
    keep = lags.abs() <= reach_s + step / 2
    return lags[keep], _correlations(seen, there)[keep]


def _correlations(seen: Tensor, there: Tensor) -> Tensor:
    """Sums (n + m - 1, 7, 7) of products of (n, 4) and (m, 4), whose first columns say whether there is a sample."""
    n, m = len(seen), len(there)
    size = 2 ** math.ceil(math.log2(n + m))
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    a = torch.stack([seen[:, i] * seen[:, j] if i else seen[:, j] for i, j in pairs], 1)
    b = torch.stack([there[:, i] * there[:, j] if i else there[:, j] for i, j in pairs], 1)
    A, B = torch.fft.rfft(a, size, dim=0).conj(), torch.fft.rfft(b, size, dim=0)
    where = {pair: k for k, pair in enumerate(pairs)}

    def sums(i: int, j: int) -> Tensor:
        both = torch.fft.irfft(A[:, i] * B[:, j], size)
        return torch.cat((both[size - n + 1 :], both[:m]))

    whole = seen.new_zeros(n + m - 1, 7, 7)
    for i, j in pairs:
        whole[:, i, j] = sums(where[i, j], 0)
        if j:
            s, t = (0 if i == 0 else i + 3), j + 3
            whole[:, s, t] = sums(0, where[i, j])
    for i in range(1, 4):
        for j in range(1, 4):
            whole[:, i, j + 3] = sums(where[0, i], where[0, j])
    return whole.triu() + whole.triu(1).mT


def exact_sums(track: Motion, curve: Curve, lags: Tensor) -> Tensor:
    """Sums (J, 7, 7) at the offsets ``lags`` (J,)."""
    time, pose = track.time_s[track.found], track.pose[track.found].nan_to_num()
    own = torch.cat((torch.ones_like(pose[:, :1]), pose), 1)
    parts = []
    for some in lags.split(max(1, CHUNK // len(time))):
        value, inside = curve(time + some[:, None])
        both = torch.cat((own.expand(len(some), -1, -1), value), 2) * inside[..., None]
        parts.append(both.mT @ both)
    return torch.cat(parts)


def explained(sums: Tensor, sense: Sense) -> Tensor:
    """How many nats of the motion (J,) one record explains of the other, given sums (J, 7, 7)."""
    count = sums[:, 0, 0].round()
    moments, plane = _moments(sums, sense)
    turn = plane.new_tensor(sense.signs)[2] * moments[:, 3, 6] * sense.weight[2] ** 2
    alike = torch.linalg.vector_norm(plane, dim=1) if sense.angle else plane[:, 0]
    energy = (moments.diagonal(dim1=1, dim2=2)[:, 1:] * sense.weight.repeat(2).square()).sum(1).clamp(min=1e-300)
    left = (energy - 2 * (alike + turn)).maximum(1e-14 * energy)
    enough = count >= max(4.0, 0.5 * float(count.max())) if len(count) else count > 0
    return torch.where(enough, count * (energy / left).log(), -math.inf)


def _moments(sums: Tensor, sense: Sense) -> tuple[Tensor, Tensor]:
    """Central moments (J, 7, 7), and what x and y have in common under a turn: (J, 2) cosine and sine parts."""
    moments = _without(sums, 0)
    if sense.lever:
        free = _without(moments, LEVER)
        moments = moments.clone()
        moments[:, 1:3, 1:3], moments[:, 4:6, 4:6] = free[:, 1:3, 1:3], free[:, 4:6, 4:6]
        moments[:, 1:3, 4:6] = free[:, 1:3, 4:6]
    cross = moments[:, 1:3, 4:6] * moments.new_tensor(sense.signs)[:2, None] * (sense.weight[:2] ** 2)
    along, across = cross[:, 0, 0] + cross[:, 1, 1], cross[:, 1, 0] - cross[:, 0, 1]
    return moments, torch.stack((along, across), 1)


def _without(sums: Tensor, k: int) -> Tensor:
    """The sums of what is left of all when the part along component ``k`` has been taken out."""
    pivot = sums[:, k, k].clamp(min=1e-300)[:, None, None]
    return sums - sums[:, :, k, None] * sums[:, None, k, :] / pivot


def starts(track: Motion, curve: Curve, senses: Sequence[Sense], reach_s: float, near_s: float) -> list[Start]:
    """The offsets that explain most under each of ``senses``, and the one within ``near_s`` that does."""
    lags, sums = grid_sums(track, curve, reach_s)
    step = float(lags[1] - lags[0]) if len(lags) > 1 else track.period_s
    apart = max(4 * track.period_s, 2 * step)
    found = []
    for sense in senses:
        nats = explained(sums, sense)
        close = torch.where(lags.abs() <= near_s, nats, -math.inf)
        tops = [int(close.argmax())] if bool(close.isfinite().any()) else []
        for _ in range(PEAKS):
            if bool(nats.isfinite().any()):
                tops.append(int(nats.argmax()))
                nats = torch.where((lags - lags[tops[-1]]).abs() <= apart, -math.inf, nats)
        found += [_refined(track, curve, float(lags[top]), apart / 2, sense) for top in dict.fromkeys(tops)]
    return found


def _refined(track: Motion, curve: Curve, lag: float, around_s: float, sense: Sense) -> Start:
    """The best offset around one of the grid, to a sample of the sensors."""
    count = min(2 * math.ceil(around_s / curve.period_s) + 1, 2001)
    lags = lag + torch.linspace(-around_s, around_s, count, dtype=torch.float64)
    sums = exact_sums(track, curve, lags)
    best = int(explained(sums, sense).argmax())
    along, across = _moments(sums[best : best + 1], sense)[1][0].tolist()
    nats = float(explained(sums[best : best + 1], sense))
    return Start(float(lags[best]), math.atan2(across, along) if sense.angle else 0.0, sense.signs, nats)
