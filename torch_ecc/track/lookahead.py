"""Frames that are there already, as those of a file are, solved before it is their turn and judged together.

To judge one template takes three times as long as to solve it: a hundred operations on a few numbers each, which are as
fast for several frames at once. So each frame is solved from where the last one has led, the verdict on all is made
together, and taken when the tracker comes to them and is where it was expected to be. What is not ordinary (blocks that
do not fit, a part beyond the border, a pose that is not found) is not looked at ahead, but in its turn as ever: nothing
that is found depends on this.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import torch
from torch import Tensor

from torch_ecc.core.align import engine_for
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import ahead
from torch_ecc.core.pushed import Push
from torch_ecc.core.reference import Reference
from torch_ecc.core.robust import unusual
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.solution import Solution
from torch_ecc.core.verdict import LEAST_SHARE, judge
from torch_ecc.track.advance import MEMORY, State

if TYPE_CHECKING:
    from torch_ecc.track.look import Look

MOST = 16  # frames
DOUBLINGS = 6  # of the frames after one has looked ahead in vain, until one does so again, at fewer

View = Callable[[Tensor], Tensor]
# Frames that are there, which those of other sequences may not be before they are asked for.
Frames: TypeAlias = "Tensor | list[Tensor] | list[Tensor | None] | tuple[Tensor | None, ...]"

inference: Callable[[], bool] = torch.is_inference_mode_enabled


def same(one: Tensor | None, frame: Tensor) -> bool:
    """Whether both are ``one`` place in memory, as what a stack of frames gives each time it is asked for one."""
    if one is frame or not (isinstance(one, Tensor) and isinstance(frame, Tensor)):
        return one is frame
    alike = one.shape == frame.shape and one.dtype == frame.dtype and one.stride() == frame.stride()
    return alike and one.data_ptr() == frame.data_ptr()


class Known(NamedTuple):
    """What a tracker of one template knows before a frame: ``pose``, ``velocity`` (1, 3) and usual ``score`` (1,)."""

    pose: Tensor
    velocity: Tensor
    score: Tensor

    @staticmethod
    def of(state: State) -> Known:
        """From its buffers."""
        return Known(*(state[name] for name in Known._fields))


class Step(NamedTuple):
    """A ``frame``, as it was given, its ``image``, and what is ``found`` there from ``start`` (1, 3) on, where one is
    to look who has ``known`` this."""

    frame: Tensor
    version: int
    image: Tensor
    known: Known
    start: Tensor
    found: Solution


class Foreseen(NamedTuple):
    """A ``step``, and the ``estimate`` of its frame."""

    step: Step
    estimate: Estimate

    def is_of(self, frame: Tensor, known: Known) -> bool:
        """Whether that is this ``frame``, unchanged, that of one who has ``known`` this, and may be used here."""
        step = self.step
        if not same(step.frame, frame) or step.version != frame._version or frame.requires_grad:
            return False
        return step.start.is_inference() == inference() and all(map(torch.equal, step.known, known))


class Noted(Push):
    """One that is not made: it only tells which of n frames it was ``wanted`` (n,) in, None if in none."""

    wanted: Tensor | None = None

    def unanswered(self, share: Tensor) -> Tensor:
        """The ``share`` (n,) as it is."""
        self.wanted = share > LEAST_SHARE
        return share

    def left(self, found: Solution, asked: Tensor) -> Tensor:
        """Nothing is, (n,)."""
        return torch.zeros_like(found.error)


class Lookahead:
    """Of a tracker that has this ``look`` at frames, of which a ``view`` makes images, or raises ValueError. There is
    none where its template ``learns``, or there are several: only one costs less to solve than to judge. ``before``:
    what the tracker had, whose frames are still to come."""

    def __init__(self, look: Look, view: View, learns: bool, before: Lookahead | None) -> None:
        self.reference, self.settings, self.state = look.references[0], look.settings, look.state
        self.moving, self.view, self.copies = look.moving, view, cache(self.reference.copies)
        alone = len(self.reference.K) == len(look.references) == 1 and is_cpu(self.reference.K.device)
        self.gains = alone and not (learns or look.own or look.shutter.line or self.reference.sight)
        self.foreseen: deque[Foreseen] = deque()
        self.coming: deque[Tensor | None] = deque()
        self.careful = False  # whether something has not been ordinary in the last look
        self.failures = self.pause = 0  # in a row, and frames until one looks ahead again
        if before is not None and self.gains:
            self.coming, self.careful = before.coming, before.careful
            self.failures, self.pause = before.failures, before.pause

    def expect(self, frames: Frames) -> None:
        """These are the next ones. ValueError for such that are not there yet."""
        if not isinstance(frames, Tensor | list | tuple):
            raise ValueError(f"look_ahead: expected a list or a tensor of frames, got {type(frames).__name__}")
        self.coming = deque(frames if self.gains else ())
        self.foreseen.clear()

    def __call__(self, frame: Tensor) -> Foreseen | None:
        """What is known of the ``frame`` whose turn it is."""
        while self.coming and not same(self.coming.popleft(), frame):
            self.foreseen.clear()
        if not self.foreseen:
            if self.pause > 0 or not self.coming:
                self.pause = max(self.pause - 1, 0)
                return None
            self.look([frame, *islice(self.coming, max(MOST >> self.failures, 2) - 1)])
        seen = self.foreseen.popleft() if self.foreseen else None
        if seen is None or not seen.is_of(frame, Known.of(self.state)):
            self.foreseen.clear()
            self.pause, self.failures = 2**self.failures - 1, min(self.failures + 1, DOUBLINGS)
            return None
        if not self.foreseen:
            self.pause, self.failures = int(self.careful), 0  # for the frame that is not ordinary
        return seen

    def look(self, frames: list[Tensor | None]) -> None:
        """At ``frames``, the first of which is next."""
        chain = self.solved(frames)
        self.foreseen.extend(self.judged(chain) if chain else [])
        self.careful = len(self.foreseen) < len(frames)

    def solved(self, frames: list[Tensor | None]) -> list[Step]:
        """Those before the first one that is not ordinary, as far as its solution tells."""
        reference, settings, chain, known = self.reference, self.settings, list[Step](), Known.of(self.state)
        known = Known(*(value.clone() for value in known))
        for frame in frames:
            if frame is None or frame.requires_grad or frame.is_inference():
                break
            try:
                image = self.view(frame)
            except ValueError:
                break
            start = ahead(known.pose, known.velocity) if self.moving else known.pose
            found = engine_for(reference, image, settings)(reference, image, start, settings, None)
            if found.normal is not reference.normal or (self.careful and self.doubtful(found, known)):
                break
            chain.append(Step(frame, frame._version, image, known, start, found))
            known = known._replace(pose=found.pose, velocity=found.pose - known.pose)
        return chain

    def judged(self, chain: list[Step]) -> Iterator[Foreseen]:
        """Those of a ``chain`` before the first one that is not ordinary."""
        many, settings, image = self.copies(len(chain)), self.settings, chain[0].image
        start = torch.cat([step.start for step in chain])
        pose, error, iterations, gain, sums, total = (
            torch.cat(values) for values in zip(*(step.found[:6] for step in chain), strict=True)
        )
        found = Solution(pose, error, iterations, gain, sums, total, many.normal)
        push = Noted(partial(engine_for, many, image, settings), many, image, settings)
        estimate = judge(many, found, start, settings, self.state["start"].expand(len(chain), 3), push)
        scores = [chain[0].known.score]
        for score in estimate.score.split(1):
            scores.append(scores[-1].lerp(score, MEMORY))
        strange = estimate.status != Status.CONVERGED
        for more in (push.wanted, self.odd(many, found, torch.cat(scores[:-1]))):
            strange = strange if more is None else strange | more
        each = zip(*(value.split(1) for value in estimate), strict=True)
        for step, score, one, out in zip(chain, scores, each, strange.tolist(), strict=False):
            if out:
                return
            yield Foreseen(step._replace(known=step.known._replace(score=score)), Estimate(*one))

    def doubtful(self, found: Solution, known: Known) -> bool:
        """Whether what was ``found`` in a frame cannot be ordinary."""
        moving = not float(found.error) <= self.settings.tolerance
        return moving or self.odd(self.reference, found, known.score) is not None

    def odd(self, reference: Reference, found: Solution, usual: Tensor) -> Tensor | None:
        """Which of n frames have blocks that do not fit, (n,) bool, None if none has: see ``robust.unusual``."""
        return unusual(reference, found, self.settings, usual) if self.settings.robust else None
