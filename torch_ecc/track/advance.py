"""What a tracker knows from one frame to the next: the parts of its state that every frame changes, in place."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torch_ecc.core.align import solve_again
from torch_ecc.core.estimate import Estimate, Origin, Reason, Status
from torch_ecc.core.reference import Reference
from torch_ecc.core.robust import Memory
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution
from torch_ecc.track.budget import BURST
from torch_ecc.track.lined import lined, unknown_lines
from torch_ecc.track.pinned import held

PREDICTIONS = ("hold", "velocity")
MEMORY = 0.05  # weight of the newest frame in the usual score
KEPT = 16  # frames for which a template that is not found is expected to go on as before
FARTHEST = 44.0  # px that it may have gone on by: farther away are look-alikes that nothing is known of

State = Mapping[str, Tensor]  # a tracker's buffers: see there


def check_prediction(prediction: str) -> None:
    """ValueError for one that is not known."""
    if prediction not in PREDICTIONS:
        raise ValueError(f"prediction: expected one of {list(PREDICTIONS)}, got {prediction!r}")


def beginning(start: Tensor) -> dict[str, Tensor]:
    """What is known of templates that are at ``start`` (R, 3), but for their looks."""
    none = torch.zeros_like(start[:, 0], dtype=torch.int64)
    return {
        "start": start,  # all (R, 3), px, px, rad
        "pose": start.clone(),  # the last good one
        "velocity": torch.zeros_like(start),  # what the frames since will have added to it
        "since": none + 1,  # frames from then to the next one
        "found": none.to(torch.int8),  # by a search, 0 or 1: averages of bool fail
        "suspect_frames": none,  # in a row
        "fixed": torch.zeros_like(start[:, 0]),  # share of the noise that is the same in all frames, see ``pinned``
        "lines": unknown_lines(start),
        "turn": none[0].clone(),  # (): which of many lost ones is searched for next
        "credit": start.new_tensor(BURST),  # (): for searches, in frames, see ``budget``
    }


class Remembering:
    """How templates are found in an ``image``, from poses (R, 3) on, with what is known of them in a ``state``; what of
    them is believed where there is a pose, is what the next look begins with.

    ``put_off``, ``put_off_gone``: those that must be solved again, or of them those that are gone, are only named, see
    ``Memory``. ``odd``: which (R,) have blocks with more left than any
    noise leaves, and ``doubtful``: which must be solved again, None if it is known that none has, or must."""

    def __init__(self, state: State, image: Tensor, settings: Settings, *put_off: bool) -> None:
        self.state, self.image, self.settings, self.put_off = state, image, settings, put_off
        self.odd: Tensor | None = None
        self.doubtful: Tensor | None = None

    def __call__(self, reference: Reference, pose: Tensor) -> Estimate:
        state = self.state
        memory = Memory(state["score"], state["trust"], state["answered"], *self.put_off)
        estimate, found = solve_again(reference, self.image, pose, self.settings, state["start"], memory)
        self.odd, self.doubtful = found.odd, found.doubtful
        return remembered(estimate, found, reference, state)


def remembered(estimate: Estimate, found: Solution, reference: Reference, state: State) -> Estimate:
    """The ``estimate`` (R, ...) of what was ``found`` in a frame, whose covariance tells of what the frames before have
    shown, too."""
    if found.trust is None:
        state["trust"].fill_(1)
    else:
        state["trust"].copy_(torch.where(Status.good(estimate.status)[:, None], found.trust, 1.0))
    return lined(held(estimate, found, reference, state), found, reference, state)


def advanced(state: State, estimate: Estimate) -> Estimate:
    """One frame on, in which nothing is suspect: the ``estimate``."""
    last, since, pose = state["pose"], state["since"], estimate.pose.detach()
    state["score"].lerp_(estimate.score.detach(), MEMORY)
    step = torch.sub(pose, last, out=state["velocity"])
    if not is_cpu(pose.device) or max(since.tolist()) > 1:
        step.div_(since.unsqueeze(1))
        since.fill_(1)
    state["found"].zero_()
    state["suspect_frames"].zero_()
    last.copy_(pose)
    return estimate


def advanced_in_doubt(state: State, estimate: Estimate, suspects: list[bool]) -> Estimate:
    """The same where some are suspect or were, with the last good pose of what was not found. What a search has found
    is no step: it tells nothing of the velocity, but in the second frame in which it has."""
    last, usual, velocity = state["pose"], state["score"], state["velocity"]
    good = Status.good(estimate.status)
    pose = torch.where(good[:, None], estimate.pose, last)
    usual.lerp_(torch.where(good, estimate.score.detach(), usual), MEMORY)
    step = (pose.detach() - last) / state["since"].unsqueeze(1)
    found = good & (estimate.origin != Origin.TRACKED)
    leapt = found & ((state["found"] == 0) | (state["since"] > 1))
    velocity.copy_(torch.where(good[:, None], step.masked_fill_(leapt[:, None], 0.0), velocity))
    state["found"].copy_(torch.where(good, found, state["found"]))
    coast(state, good)
    state["suspect_frames"].add_(1).mul_(torch.tensor(suspects, device=last.device))
    last.copy_(pose.detach())
    return estimate._replace(pose=pose, displacement=pose - state["start"])


def skipped(state: State) -> Estimate:
    """One frame on, that cannot be looked at: its record (R, ...)."""
    coast(state, torch.zeros_like(state["since"], dtype=torch.bool))
    pose, none = state["pose"].clone(), torch.zeros_like(state["pose"][:, 0])
    codes = (Status.DAMAGED, Origin.TRACKED, Reason.DAMAGED)
    status, origin, reason = (none.to(torch.int8) + int(code) for code in codes)
    unknown, moved = torch.diag_embed(torch.full_like(pose, torch.inf)), pose - state["start"]
    return Estimate(pose, moved, none, status, none.long(), unknown, none.clone(), origin, none.clone(), reason)


def coast(state: State, good: Tensor) -> None:
    """One frame on, in which those were found that are ``good`` (R,): the others are expected to go on as they went
    for a while, and then where they were last."""
    since = state["since"]
    longer = (since + 1) / since
    far = torch.linalg.vector_norm(state["velocity"][:, :2], dim=1) * longer > FARTHEST
    longer = torch.where((since < KEPT) & ~far, longer, 0.0)
    state["velocity"].mul_(torch.where(good, 1.0, longer).unsqueeze(1))
    since.add_(1).masked_fill_(good, 1)
