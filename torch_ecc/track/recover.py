"""Templates that were not found, or look less like themselves than usual, are searched for: near, then anywhere."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torch_ecc.core.ambient import lasting
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import unwrap
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.search.locate import LEAST_VISIBLE, Locator, image_pyramid, within_margin
from torch_ecc.search.nearby import Nearby

FAMILIAR = 0.8  # share of its usual score that a template must have to count as found by a search
AT_ONCE = 8  # templates searched for in the whole of one frame; the others in turn
NEARBY_AT_ONCE = 64  # and near where they are expected
PATIENCE = 16  # frames in which a lost template is searched for at every chance; later ever more seldom
SELDOM = 16  # frames between two searches for what has been lost for long


def suspect(estimate: Estimate, usual: Tensor) -> list[bool]:
    """Templates that were not found, or look less like themselves than ``usual`` (R,): perhaps a wrong place."""
    each = zip(estimate.status.tolist(), estimate.score.tolist(), usual.tolist(), strict=True)
    return [status > Status.MAX_ITERATIONS or not within_margin(score, most) for status, score, most in each]


class Recovery:
    """The searches of one tracker, and what is prepared for them."""

    def __init__(self, reference: Reference, settings: Settings, turn: Tensor) -> None:
        self.reference, self.settings = reference, settings
        self.turn = turn  # whose turn it is if they are many, (): the tracker's, written in place
        self.locators: dict[int, Locator] = {}  # of the templates last searched for
        self.nearby: tuple[list[int], Nearby] | None = None

    def __call__(
        self, images: list[Tensor], estimate: Estimate, start: Tensor, last: tuple[Tensor, Tensor], frames: Tensor
    ) -> Estimate:
        """The ``estimate`` of a frame with those templates searched for that are suspect and due: at ``start`` (R, 3)
        first, then in the whole frame. ``images``: the frame, and as many coarser levels as there are already;
        ``last``: the last good pose (R, 3) and usual score (R,); ``frames`` (R,) in a row that they were suspect for.
        """
        suspects = suspect(estimate, last[1])
        due = self.due(suspects, frames.tolist())
        if not due:
            return estimate
        images[0] = images[0].float()
        estimate = self.search_near(images[0], estimate, start, last[1], sorted(due))
        suspects = suspect(estimate, last[1])
        for r in [r for r in due if suspects[r]][:AT_ONCE]:
            estimate = self.search_anywhere(images, estimate, last, r)
        return estimate

    def due(self, suspects: list[bool], frames: list[int]) -> list[int]:
        """Which of the suspect templates to search for in this frame."""
        due = [r for r, n in enumerate(frames) if suspects[r] and n % min(1 << min(n // PATIENCE, 8), SELDOM) == 0]
        if len(due) > AT_ONCE:
            turn = int(self.turn.add_(AT_ONCE).remainder_(len(due)))
            due = due[turn:] + due[:turn]
        return due[:NEARBY_AT_ONCE]

    def search_near(self, image: Tensor, estimate: Estimate, start: Tensor, usual: Tensor, due: list[int]) -> Estimate:
        """Second attempt for the templates ``due``: around their ``start`` (R, 3)."""
        index = torch.tensor(due, device=start.device)
        view = image if len(image) == 1 else image[index]
        found = self.surroundings(due).find(self.reference.select(index), view, start[index], self.settings)
        known = (found.status == Status.CONVERGED) & within_margin(found.score, usual[index])
        return estimate.put(index[known], found.at(known))

    def search_anywhere(
        self, images: list[Tensor], estimate: Estimate, last: tuple[Tensor, Tensor], r: int
    ) -> Estimate:
        """Third attempt for template ``r``: anywhere in the frame, of places that look alike the nearest."""
        locator, (pose, usual) = self.locator(r, (images[0].shape[-2], images[0].shape[-1])), last
        images += image_pyramid(images[-1], locator.levels - len(images) + 1)[1:]
        views = [image if len(image) == 1 else image[r : r + 1] for image in images]
        found, score = locator.candidates(views, 0, pose[r])
        if found.status[0] != Status.CONVERGED or score[0] < FAMILIAR * usual[r]:
            return estimate
        if Status.good(estimate.status[r]) and within_margin(estimate.score[r], found.score[0]):
            return estimate
        best = found._replace(pose=torch.cat((found.pose[:, :2], unwrap(found.pose[:, 2:], pose[r, 2])), -1))
        index = torch.tensor([r], device=pose.device)
        return estimate.put(index, best.at(index.new_zeros(1)))

    @lasting
    def surroundings(self, due: list[int]) -> Nearby:
        """The search near where the templates ``due`` are expected, kept while they are the same ones."""
        if self.nearby is None or self.nearby[0] != due:
            index = torch.tensor(due, device=self.reference.K.device)
            self.nearby = due, Nearby.of(self.reference.select(index))
        return self.nearby[1]

    @lasting
    def locator(self, r: int, size: tuple[int, int]) -> Locator:
        """The search for template ``r``, kept for the ``AT_ONCE`` last ones."""
        if r not in self.locators:
            if len(self.locators) >= AT_ONCE:
                del self.locators[next(iter(self.locators))]
            template = self.reference.select(torch.tensor([r], device=self.reference.K.device))
            self.locators[r] = Locator(template, size, replace(self.settings, min_visible=LEAST_VISIBLE))
        return self.locators[r]
