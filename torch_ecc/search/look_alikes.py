"""Look-alikes: what else in a frame looks like a template, so that a place that was found may be another's.

A place at distance d from where the template is expected is its own if nothing as good lies nearer than twice as far
from it: then all others are farther from the expected place. Who looks like a template is seen best in a frame in which
its own place is known and nothing covers it, which is the one that it was cut from.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.search.locate import SUPPRESSION, Locator, image_pyramid, pose_distance
from torch_ecc.search.nearby import HALF_WIDTH, SCORE_MARGIN, Nearby, solved_at

REACH = 2 * HALF_WIDTH  # px to each side: twice as far as a search near can lead
NEAR_MOST = 8  # places that are looked at near
EQUAL_MARGIN = (1.1, 0.002)  # (a, b) as in AMBIGUITY_MARGIN, as finely as the search near tells places apart
NEARER = 0.4  # of the distance to the next look-alike: a place found within it is believed to be the template's own
RIVAL = 0.8  # of what is believed of a template at one place, believed at another: it may be either


class LookAlikes(NamedTuple):
    """Of one template: the ``distance`` (K,) px of other places and their ``score`` (K,), inf and -1 for none."""

    distance: Tensor
    score: Tensor

    @staticmethod
    def around(found: Estimate, home: Tensor, radius: Tensor) -> LookAlikes:
        """Of aligned poses (K, ...) those that are not ``home`` (3,) itself."""
        distance = pose_distance(found.pose, home, radius=radius)
        other = Status.good(found.status) & (distance > SUPPRESSION)
        return LookAlikes(torch.where(other, distance, torch.inf), torch.where(other, found.score, -1.0))

    def nearest(self, score: Tensor, raised: Tensor) -> Tensor:
        """How far () the nearest one is that looks as good as a place of ``score`` () or better, in a frame that has
        ``raised`` () all scores by that factor since; inf if none does."""
        a, b = EQUAL_MARGIN
        return torch.where(1 - raised * self.score <= a * (1 - score) + b, self.distance, torch.inf).amin()


def look_alikes_near(reference: Reference, image: Tensor, home: Tensor, settings: Settings) -> list[LookAlikes]:
    """Of each of B templates in the ``image`` (1 or B, 1, H, W) where they are at ``home`` (B, 3): within REACH."""
    place, score = Nearby.of(reference, REACH).candidates(image, home, NEAR_MOST)
    high = score >= score.amax(-1, keepdim=True) - SCORE_MARGIN
    each, radius = solved_at(reference, image, place, high, settings), reference.place.radius
    each = each._replace(pose=torch.where(high[..., None], each.pose, home[:, None]))
    return [LookAlikes.around(Estimate(*(value[b] for value in each)), home[b], radius[b]) for b in range(len(home))]


def look_alikes_anywhere(locator: Locator, image: Tensor, home: Tensor) -> LookAlikes:
    """Of the one template of a ``locator`` in the whole ``image`` (1, 1, H, W) where it is at ``home`` (3,): of many
    the best."""
    images = image_pyramid(image, locator.levels)
    found, _ = locator.refined(images[0], 0, locator.coarse(images, 0, None))
    return LookAlikes.around(found, home, locator.pyramids[0][0].place.radius)
