"""Whether a place where a template was tracked to, or found, is believed to be its own, by what was known before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Origin, Reason, Status
from torch_ecc.core.reference import Reference
from torch_ecc.core.robust import FAMILIAR, RECOGNISED
from torch_ecc.core.sampling import inside
from torch_ecc.core.verdict import LEAST_COVERAGE, just_as_good, predicted_sigma, within_margin
from torch_ecc.search.locate import pose_distance
from torch_ecc.track.lost import disproved

BASIN = 4.0  # px at the farthest pixel beyond the last step: a place that was tracked to so near is plausible
SLID = 16.0  # px beyond the last step: where something else was tracked, if it does not look as usual either
WHOLE = 0.9  # of a template's weight must be in sight where it has leapt to: many things have parts that look alike
STRAIN = 0.1  # px at the farthest pixel: less is a sampler's own
STRAINED = 8.0  # times the sigma that noise as large as the residuals would leave: what was found is something else


class Past(NamedTuple):
    """What is known of R templates before a frame: last good ``pose`` (R, 3), ``since`` (R,) how many frames, if a
    search has ``found`` it (R,) 0 or 1, ``usual`` score (R,), ``suspect_frames`` (R,) in a row, and the ``first`` frame
    (1 or R, 1, H, W), where they were at ``home`` (R, 3). ``velocity`` (R, 3): what is expected to be added since."""

    pose: Tensor
    velocity: Tensor
    since: Tensor
    found: Tensor
    usual: Tensor
    suspect_frames: Tensor
    first: Tensor
    home: Tensor

    @staticmethod
    def of(state: Mapping[str, Tensor]) -> Past:
        """From a tracker's buffers."""
        names = ("pose", "velocity", "since", "found", "score", "suspect_frames", "first", "start")
        return Past(*(state[name] for name in names))


def suspect(estimate: Estimate, usual: Tensor) -> list[bool]:
    """Templates that were not found, or look less like themselves than ``usual`` (R,): perhaps a wrong place."""
    each = zip(estimate.status.tolist(), estimate.score.tolist(), usual.tolist(), strict=True)
    return [status > Status.MAX_ITERATIONS or score < just_as_good(most) for status, score, most in each]


def hopeful(suspects: list[bool], hopeless: list[bool], estimate: Estimate) -> int:
    """How many of the ``suspects`` (R,) are not ``hopeless`` (R,), or are believed to be somewhere."""
    if not any(suspects):
        return 0
    each = zip(suspects, hopeless, estimate.ok.tolist(), strict=True)
    return sum(suspect and (ok or not lost) for suspect, lost, ok in each)


def plausible(estimate: Estimate, start: Tensor, past: Past, radius: Tensor) -> Tensor:
    """Places (R,) that were tracked to, look familiar, and lie about as close to the ``start`` (R, 3) as that does to
    the last pose, if that has been tracked to as well: else nobody knows where it was going."""
    near = ~strayed(estimate, start, past, radius, BASIN) & (past.found == 0)
    return Status.good(estimate.status) & (estimate.score >= FAMILIAR * past.usual) & near


def strayed(estimate: Estimate, start: Tensor, past: Past, radius: Tensor, most: float) -> Tensor:
    """Which places (R,) lie over ``most`` px farther from the ``start`` (R, 3) than that does from the last pose."""
    step, last = (pose_distance(start, pose, radius=radius) for pose in (estimate.pose, past.pose))
    return step > most + last


def gone_elsewhere(estimate: Estimate, start: Tensor, past: Past, radius: Tensor) -> Tensor:
    """Which templates (R,) were tracked away from where they were expected at the ``start`` (R, 3); or, if a search had
    found them, which tells nothing of where they go, from there."""
    step, moved = (pose_distance(estimate.pose, pose, radius=radius) for pose in (start, past.pose))
    return (step > BASIN) | ((past.found == 1) & (moved > BASIN))


def disbelieved(
    estimate: Estimate, suspects: list[bool], start: Tensor, past: Past, reference: Reference, frame: Tensor
) -> Estimate:
    """The ``estimate`` in a ``frame`` (..., H, W) in which those that are still suspect are lost if they have slid away
    from where they were expected, or hardly look like themselves and are not in sight as a whole."""
    index = (torch.tensor(suspects, device=start.device) & Status.good(estimate.status)).nonzero()[:, 0]
    if len(index) == 0:
        return estimate
    slid = (estimate.origin == Origin.TRACKED) & strayed(estimate, start, past, reference.place.radius, SLID)
    part = share_in_sight(reference.select(index), estimate.pose.detach()[index], frame) < WHOLE
    part &= (estimate.score < RECOGNISED * past.usual)[index]
    lost = torch.zeros_like(slid).index_put((index,), slid[index] | part)
    return disproved(estimate, lost, Reason.ELSEWHERE)


def share_in_sight(reference: Reference, pose: Tensor, frame: Tensor) -> Tensor:
    """What share (n,) of the templates' weight lies in a ``frame`` (..., H, W) at poses (n, 3)."""
    shown = inside(reference.warps(pose), reference.grid.pixels, (frame.shape[-2], frame.shape[-1]))
    share: Tensor = (reference.weight * shown).sum(1) / reference.weight.sum(1)
    return share


def of_a_part(reference: Reference, found: Estimate, frame: Tensor) -> Tensor:
    """Which templates (n,) were ``found`` in a ``frame`` (..., H, W) by less than half of them, beyond its border or
    not believed: something else may look like that part."""
    return found.coverage * share_in_sight(reference, found.pose.detach(), frame) < LEAST_COVERAGE


def familiar(found: Estimate, usual: Tensor) -> Tensor:
    """Places (n,) that were found and look as the templates ``usual`` (n,) do."""
    return within_margin(found.score, usual) & (found.status == Status.CONVERGED)


def strained(reference: Reference, found: Estimate) -> Tensor:
    """Places (n,) where templates were found whose residuals cling together as those of noise do not: what is there
    is much like the template, but another thing."""
    sigma = predicted_sigma(reference, reference.normal, found.residual_rms.to(found.pose).square())
    usual, here = ((value * reference.place.lever).norm(dim=1) for value in (sigma, found.sigma))
    much: Tensor = here > (STRAINED * usual).clamp(min=STRAIN)
    return much


def beats(found: Estimate, hand: Estimate) -> Tensor:
    """Whether ``found`` places (n, ...) are clearly better than those at ``hand``: bool (n,)."""
    return ~Status.good(hand.status) | ~within_margin(hand.score, found.score)
