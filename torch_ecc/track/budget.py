"""How much of the time may go into searches: counted in pixels, not seconds, so that every machine does the same.

The credit is in frames, each of which costs the reading of its pixels and the solves of its templates. What a search
costs is taken from it, perhaps on loan; every frame adds what keeps searches at their share of all time.
"""

from __future__ import annotations

from torch import Tensor

from torch_ecc.core.sampling import is_cpu

BURST = 3000.0  # frames of credit at most, and at first
RESERVE = 500.0  # of it that searches of the whole frame leave to those near, which cost a tenth
LEAST_FRAME = 400_000  # pixels' worth that every frame takes, however small it is: it has to come from somewhere
SOLVE = 20  # times the pixels of a template: its solve
DOUBTED = 10  # times what a frame takes: what it takes where templates were not found, before any search
CORRELATION = 4  # times the pixels of a spectrum, for every angle


class Budget:
    """Of frames of ``pixels`` with templates of ``textured`` pixels in all. ``credit`` () and whose ``turn`` () it is
    if many are lost are parts of a tracker's state, written in place; ``income`` per frame, see there."""

    def __init__(self, credit: Tensor, turn: Tensor, pixels: int, textured: int, income: float) -> None:
        self.credit, self.turn, self.income = credit, turn, income
        self.frame = max(pixels + SOLVE * textured, LEAST_FRAME)

    def earn(self, frames: float = 1.0) -> None:
        """What so many ``frames`` bring, if there is not all the credit that there can be."""
        if not is_cpu(self.credit.device) or float(self.credit) < BURST:
            self.credit.add_(self.income * frames)

    def left(self, reserve: float = 0.0) -> bool:
        """Whether there is any credit, which is BURST at most, beyond a ``reserve``."""
        return float(self.credit.clamp_(max=BURST)) > reserve

    def spend(self, spectra: int, aligned: int) -> None:
        """On correlations with ``spectra`` values, and what it takes to align what they show, in pixels."""
        self.credit.sub_((CORRELATION * spectra + aligned) / self.frame)

    def in_turn(self, due: list[int], served: int) -> list[int]:
        """Those ``due`` in the order in which it is their turn, if no more than so many are ``served`` at once."""
        if len(due) <= served:
            return due
        turn = int(self.turn.add_(served).remainder_(len(due)))
        return due[turn:] + due[:turn]


def income(share: float) -> float:
    """Frames of credit per frame. ValueError for what is no share of the time."""
    if not (isinstance(share, int | float) and 0 < share <= 1):
        raise ValueError(f"search_share: expected a share of the time > 0 and at most 1, got {share!r}")
    return BURST if share == 1 else min(share / (1 - share), BURST)
