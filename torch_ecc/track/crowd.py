"""Templates that come to one place: of two equal parts that cross, each may be taken for the other.

Two patches of one picture that were apart can look alike at one place only if one of them is not there. They are told
apart if one of them alone has been tracked there, is where it was expected, or looks clearly more like itself; else
neither is believed.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Origin, Reason, Status
from torch_ecc.core.verdict import within_margin
from torch_ecc.track.lost import disproved

SAME = 2.0  # px between the centres: the same place
EXPECTED, UNEXPECTED = 1.0, 3.0  # px from where it was expected: of the one that is there, and of the other
MARGIN = 32.0  # px farther apart: pairs that are watched until something has moved by half as much
ROWS = 256  # of all distances, looked at at once


class Crowd:
    """Who of R templates of one frame, which were at ``home`` (R, 2) at first, may meet."""

    def __init__(self, home: Tensor) -> None:
        self.home, self.seen = home, torch.full_like(home, torch.inf)
        self.pairs = torch.empty(2, 0, dtype=torch.int64, device=home.device)

    def apart(self, estimate: Estimate, start: Tensor) -> Estimate:
        """The ``estimate`` in which templates at one place are lost, but for those that are told from the other;
        ``start`` (R, 3): where they were expected."""
        place = estimate.pose[:, :2]
        if not bool((place - self.seen).abs().amax() < MARGIN / 3):
            self.seen, self.pairs = place.clone(), _close(place, self.home)
        if self.pairs.shape[1] == 0:
            return estimate
        good = Status.good(estimate.status)
        a, b = self.pairs
        met = (torch.hypot(*(place[a] - place[b]).T) < SAME) & good[a] & good[b]
        if not bool(met.any()):
            return estimate
        first, second = torch.cat((a[met], b[met])), torch.cat((b[met], a[met]))
        lost = torch.zeros_like(good)
        lost[first[~_told(estimate, start, first, second)]] = True
        return disproved(estimate, lost, Reason.SHARED)


def _told(estimate: Estimate, start: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Which of the ``first`` (n,) are told from the ``second`` (n,), with which they have met."""
    searched, score = estimate.origin != Origin.TRACKED, estimate.score
    off = torch.hypot(*(estimate.pose - start)[:, :2].T)
    better = within_margin(score[first], score[second]) & ~within_margin(score[second], score[first])
    expected = (off[first] < EXPECTED) & (off[second] > UNEXPECTED)
    return torch.where(searched[first] == searched[second], better | expected, ~searched[first])


def _close(place: Tensor, home: Tensor) -> Tensor:
    """Pairs (2, n) of places (R, 2) that may meet soon, of those whose ``home`` (R, 2) is not the same."""
    pairs = []
    for first in range(0, len(place), ROWS):
        rows = slice(first, first + ROWS)
        near = torch.cdist(place[rows], place) < SAME + MARGIN
        near &= torch.cdist(home[rows], home) > 2 * SAME
        a, b = near.nonzero().unbind(1)
        pairs.append(torch.stack((a + first, b))[:, a + first < b])
    return torch.cat(pairs, 1)
