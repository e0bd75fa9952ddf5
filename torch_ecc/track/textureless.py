"""Templates that have too little texture to be tracked, or to be found again."""

from __future__ import annotations

import warnings

from torch_ecc.core.estimate import Status
from torch_ecc.core.pyramid import as_images
from torch_ecc.core.reference import Reference
from torch_ecc.core.settings import Settings
from torch_ecc.core.verdict import expected_score, noise_share
from torch_ecc.search.correlation import about_mean

FLAT_NOISE, FLAT_TEXTURE = 1.5, 0.02  # of the variance of both: a frame that nowhere has more shows no template
NOISE_ALONE = 1.3  # times as much noise in some direction as there may be: no place can be told from the next one


def textureless(reference: Reference, settings: Settings) -> tuple[list[bool], list[bool]]:
    """Templates (B,) that most frames as noisy as themselves find LOW_TEXTURE; and those of them that no search can
    find: noise is all there is, in some direction, or so much that they would not know themselves again."""
    share, expected = noise_share(reference, reference.normal), expected_score(reference)
    hopeless = ~(share <= NOISE_ALONE) | ((share > 1) & (expected < settings.min_score))
    return (~(share <= 1)).tolist(), hopeless.tolist()


def least_contrast(reference: Reference) -> tuple[int, float]:
    """A window's side, px, and the variance of grey levels in it that the least of the templates (B,) needs to show at
    all: more than its noise leaves there."""
    (image, kept, _), power = as_images(reference), reference.noise.of_frame
    total = (kept * about_mean(image, kept).square()).sum((1, 2, 3)) / kept.sum((1, 2, 3))
    least = FLAT_NOISE * power + FLAT_TEXTURE * (total - power).clamp(min=0)
    return max(min(image.shape[-2:]) // 2, 2), float(least.amin())


def warn_of_textureless(each: list[bool]) -> None:
    """Says which templates will be LOW_TEXTURE in most frames, where the tracker is made."""
    which = [r for r, textureless in enumerate(each) if textureless]
    if which:
        names = f"template {which[0]}" if len(which) == 1 else f"templates {', '.join(map(str, which))}"
        warnings.warn(f"Tracker: {names}: {Status.describe(Status.LOW_TEXTURE)}", stacklevel=7)
