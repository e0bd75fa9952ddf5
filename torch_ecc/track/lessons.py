"""Templates that last: the first one as the mean of some frames, and made anew, slowly, of surfaces that change.

A template that follows its surface must not drift off it. Every new one is the mean of frames placed by the last one,
and is then put where the means before it have it, some of all ages, the first frame among them for as long as it is
like the last one at all (``track.ages``): nothing adds up but what the surface itself has lost. Means are kept as they
were seen, with how far they are off: rounding of 1e-7 px each time that they are put right would add up, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from torch_ecc.core.ambient import lasting
from torch_ecc.core.criteria import Criterion
from torch_ecc.core.estimate import Estimate, Origin, Status
from torch_ecc.core.normal import LEAST
from torch_ecc.core.patches import Crop
from torch_ecc.core.pose import inverse as inverse_pose
from torch_ecc.core.pose import pose_dtype, rotation
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.sampling import SAMPLERS, inside, make_sampler
from torch_ecc.core.sight import eroded, picked
from torch_ecc.track.ages import Places, placed
from torch_ecc.track.lined import unknown_lines
from torch_ecc.track.surface import Surface, news, pixels, with_contrast

HIGH = 0.75  # coverage: with less a frame teaches nothing
SHARE = 0.5  # of a round's frames must have shown a pixel: else it stays what it was
AGES = 11  # older means that are kept
UNLIKE = 0.2  # correlation: the first mean tells nothing of a template less like it
PASSES = 2  # in which means are placed among each other
AT_ONCE = 4  # templates that are renewed together
FEWEST = 2  # frames of a round
FEWEST_EVEN = 5  # frames that tell how it has moved in them
CHANCE = 6.0  # over the square root of frames: so much more than noise may be noise
SLOW = 2.0  # standard deviations of a speed that may be none
UNSURE = 3.0  # times what renewals usually correct
SOME = 5.0  # renewals over which what they have corrected is averaged


State: TypeAlias = Mapping[str, Tensor]


class Lessons(NamedTuple):
    """What R templates learn, written in place: what the frames of this round have shown ``fresh`` in every pixel, its
    sum, and ``times`` (R, 1, h, w) each, how many frames; how many ``learned`` (R,) from in this round, and how many
    ``rounds`` (R,) there have been; the template's ``noise`` (R,) at first, and of how many ``frames`` (R,) it is the
    mean now; of the first round the sums of poses from the start (R, 3, 3): of p, p times the number of the frame, and
    p^2, the ``moves``, and what they leave of one frame's scatter in where the template lies, the ``share`` (R,); the
    first frame and means of all ages, the ``older`` (R, AGES, h, w), off by ``places`` (R, AGES, 3), of which so many
    are ``held`` (R,), the oldest first; covariances (R, 3, 3), in the template's axes, of the place of that one,
    ``oldest``, the template's own, ``place``, and what renewals have corrected, ``lag``; and by how much (R, 3) what is
    new in a round is expected to drag poses along, the ``lead`` that the template is given over that; how ``uneven``
    (R,) changes have been at most, see ``ages``.
    """

    fresh: Tensor
    times: Tensor
    learned: Tensor
    rounds: Tensor
    noise: Tensor
    frames: Tensor
    moves: Tensor
    share: Tensor
    older: Tensor
    places: Tensor
    held: Tensor
    oldest: Tensor
    place: Tensor
    lag: Tensor
    lead: Tensor
    uneven: Tensor

    @staticmethod
    def begin(template: Tensor, noise: Tensor, pose: Tensor) -> dict[str, Tensor]:
        """Those of templates (R, 1, h, w) that are one frame's with ``noise`` (R,), at ``pose`` (R, 3), by their names
        in the state of a tracker: that frame has been the first lesson."""
        none, one, place = torch.zeros_like(template), torch.ones_like(pose[:, 0]), pose.new_zeros(len(pose), 3, 3)
        images = none, torch.ones_like(template)
        counts = one.long(), torch.zeros_like(one).long()
        moves, *trusted = (place.clone() for _ in range(4))
        more = noise.clone(), one.clone(), moves, one.clone()
        ages = template.repeat(1, AGES, 1, 1), pose.new_zeros(len(pose), AGES, 3), one.long()
        values = *images, *counts, *more, *ages, *trusted, torch.zeros_like(pose), torch.zeros_like(pose[:, 0])
        return dict(zip(LESSONS, values, strict=True))


LESSONS = tuple(f"lesson_{name}" for name in Lessons._fields)  # their names in the state of a tracker


def lessons_in(state: State) -> Lessons | None:
    """Those in the ``state`` of a tracker, None if it does not learn."""
    return Lessons(*(state[name] for name in LESSONS)) if LESSONS[0] in state else None


def with_new_parts(state: dict[str, Any], prefix: str) -> None:
    """What was saved with fewer means of older ages, or before these had places of their own or changes were uneven, or
    a tracker shares of noise and lines that stay and doubts of a look, is filled, in place."""
    start = state.get(f"{prefix}start")
    if isinstance(start, Tensor) and start.dim() == 2:
        state.setdefault(f"{prefix}fixed", torch.zeros_like(start[:, 0]))
        state.setdefault(f"{prefix}doubt", start.new_zeros(len(start), 3, 3))
        state.setdefault(f"{prefix}lines", unknown_lines(start))
    images, places, uneven = (f"{prefix}lesson_{name}" for name in ("older", "places", "uneven"))
    older = state.get(images)
    if isinstance(older, Tensor) and older.dim() == 4 and 0 < older.shape[1] <= AGES:
        right = older.new_zeros(len(older), older.shape[1], 3, dtype=pose_dtype(older.device))
        known, missing = state.get(places, right), AGES - older.shape[1]
        state.setdefault(uneven, right[:, 0, 0].clone())
        state[images] = torch.cat((older, older[:, -1:].expand(-1, missing, -1, -1)), 1)
        if isinstance(known, Tensor) and known.shape == right.shape:
            state[places] = torch.nn.functional.pad(known, (0, 0, 0, missing))


def noise_left(state: State) -> Tensor | None:
    """The noise (R,) of the templates in a ``state``, grey levels, None if nothing is known of it."""
    lessons = lessons_in(state)
    return None if lessons is None else lessons.noise / lessons.frames.sqrt()


def told(reference: Reference, state: State) -> Reference:
    """A ``reference`` of the templates in a ``state`` that knows what they are worth."""
    lessons = lessons_in(state)
    if lessons is None:
        return reference
    place, share = lessons.place + lessons.lag, lessons.share.clone()
    noise = reference.noise._replace(frames=lessons.frames.clone(), place_share=share, place=place)
    return reference._replace(noise=noise)


def renewed(
    references: list[Reference], which: Tensor, state: State, prepared: Callable[[State], list[Reference]]
) -> list[Reference]:
    """The levels with those templates of a ``state`` ``prepared`` anew that have become others, at ``which`` (n,)."""
    mask = state["mask"]
    if not bool((mask == mask[:1]).all()):  # they share the pixels that any of them counts
        return prepared(state)
    new = prepared({name: state[name][which] for name in (*Crop._fields, *LESSONS)})
    pairs = zip(references, new, strict=True)
    return [each(lambda old, part: old.index_copy(0, which, part), *pair) for pair in pairs]


def as_rounds(average: int, renew: int | None) -> tuple[int, int]:
    """How many frames the first lesson takes and each later one, 0 for none. ValueError for what is no such number."""
    if not isinstance(average, int) or isinstance(average, bool) or average < 1:
        raise ValueError(f"average: expected a whole number of frames from 1 on, got {average!r}")
    if renew is None:
        return average, 0
    if not isinstance(renew, int) or isinstance(renew, bool) or renew < FEWEST:
        raise ValueError(f"renew: expected a whole number of frames from {FEWEST} on, got {renew!r}")
    return average if average > 1 else renew, renew


def begun(state: State, pose: Tensor) -> None:
    """Templates of some other image begin at ``pose`` (R, 3), where a search has found them in the first frame: what
    the next ones tell of that place says nothing of the image."""
    state["start"].copy_(pose)
    state["pose"].copy_(pose)
    if "past_poses" in state:
        state["past_poses"].copy_(pose[:, None])
    if "lesson_moves" in state:
        state["lesson_moves"][:, 2] = 1e30  # not even


def teaches(estimate: Estimate, suspects: list[bool]) -> Tensor:
    """Which templates (R,) a frame may teach."""
    right = (estimate.status == Status.CONVERGED) & (estimate.origin == Origin.TRACKED)
    return right & (estimate.coverage >= HIGH) & ~torch.tensor(suspects, device=right.device)


class Teacher:
    """Of one tracker: what it makes of frames, and when, in ``rounds`` of ``as_rounds``. ``shown`` (H, W): where the
    camera shows the scene."""

    def __init__(self, criterion: Criterion, interpolation: str, rounds: tuple[int, int], shown: Tensor | None) -> None:
        self.criterion, self.rounds = criterion, rounds
        self.interpolation = interpolation if SAMPLERS[interpolation].ring else "bspline3"
        self.shown = None if shown is None else eroded(shown)
        self.surface: Surface | None = None  # of the templates as they are

    @lasting
    def __call__(self, image: Tensor, warp: Tensor, estimate: Estimate, suspects: list[bool], state: State) -> Tensor:
        """Learn from an ``image`` (1 or R, 1, H, W), which shows the templates at ``warp`` (R, 2, 3), what is not
        suspect; which of them (n,) have become others, in the ``state``."""
        (first, later), crop, lessons = self.rounds, Crop(*(state[name] for name in Crop._fields)), lessons_in(state)
        if lessons is None:
            return torch.empty(0, dtype=torch.long)
        lengths = torch.where(lessons.rounds == 0, first, later)
        which = (teaches(estimate, suspects) & (lengths > 0)).nonzero()[:, 0]
        if len(which) == 0:
            return which
        self.learn(image if len(image) == 1 else image[which], warp[which], which, crop, lessons)
        moved = (estimate.pose - state["start"])[which]
        numbered = moved * (lessons.learned[which, None] - 1)
        lessons.moves.index_add_(0, which, torch.stack((moved, numbered, moved * moved), 1))
        done = which[lessons.learned[which] >= lengths[which]]
        if len(done) > 0:
            for some in done.split(AT_ONCE):
                self.renew(some, estimate.sigma[some], crop, lessons)
            self.surface = None
        return done

    def learn(self, image: Tensor, warp: Tensor, which: Tensor, crop: Crop, lessons: Lessons) -> None:
        """What the templates at ``which`` (n,) show at ``warp`` (n, 2, 3)."""
        if self.surface is None:
            self.surface = Surface.of(self.criterion, *crop)
        part = self.surface if len(which) == len(crop.mask) else self.surface.select(which)
        g, grid = sampled(image.float(), self.interpolation, warp, crop.template), pixels(crop.template)
        seen = inside(warp, grid, image.shape[2:])
        if self.shown is not None:
            seen &= picked(self.shown, warp, grid)
        fresh, own = news(self.criterion, part, g, seen)
        for total, value in ((lessons.fresh, fresh), (lessons.times, own)):
            total.index_add_(0, which, part.images(value[:, None].to(total)))
        lessons.learned.index_add_(0, which, torch.ones_like(which))

    def renew(self, which: Tensor, sigma: Tensor, crop: Crop, lessons: Lessons) -> None:
        """A round of the templates at ``which`` (n,), whose poses have ``sigma`` (n, 3), is over."""
        old, times = crop.template[which], lessons.times[which]
        enough = times >= SHARE * lessons.learned[which, None, None, None]
        mean = old + lessons.fresh[which] / times.clamp(min=1)
        if self.surface is not None and self.surface.columns.shape[1] > 3:
            # A gain by least squares is too small by the template's noise, and round after round that would add up.
            mean = with_contrast(mean, old, crop.mask[which] * enough)
        first = lessons.rounds[which] == 0
        offset, share = at_first(lessons.moves[which], lessons.learned[which], sigma)
        lessons.share[which] = torch.where(first, share, lessons.share[which])
        new, off = torch.where(enough, mean, old), torch.where(first[:, None], offset, 0.0)
        if self.rounds[1] > 0:
            seen = Crop(new, crop.mask[which] * enough, crop.centre[which])
            lessons.places[which, 0] += off  # the first frame, as far as what was placed by it
            off = self.among_older(which, seen, off, lessons) + lessons.lead[which]
        crop.template[which] = torch.where(enough, shifted(new, self.interpolation, off, crop.centre[which]), old)
        lessons.frames[which] = lessons.learned[which].to(lessons.frames)
        lessons.rounds[which] += 1
        for counted in (lessons.fresh, lessons.times, lessons.learned):
            counted[which] = 0

    def among_older(self, which: Tensor, seen: Crop, off: Tensor, lessons: Lessons) -> Tensor:
        """By how much (n, 3) the means ``seen`` of the templates at ``which`` (n,) are off as the older ones have them,
        from ``off`` (n, 3) on; and these, as all of them have each other."""
        images, places = torch.cat((lessons.older[which], seen.template), 1), lessons.places[which]
        places, there = torch.cat((places, off[:, None]), 1), present(lessons.held[which])
        noise = lessons.noise[which].square() / lessons.learned[which]
        about = seen.centre.repeat_interleave(AGES + 1, 0)
        for _ in range(PASSES):
            right = shifted(images.flatten(0, 1)[:, None], self.interpolation, places.flatten(0, 1), about)
            found = placed(right.view_as(images), there, noise, seen.mask, seen.centre, lessons.uneven[which])
            lessons.uneven[which] = found.uneven
            places = places + steady(found, lessons.lag[which]).nan_to_num(0.0, 0.0, 0.0)
        trust(which, places[:, -1] - off, found.covariance[:, -1], lessons)
        remember(which, images, places, there, found, lessons)
        return places[:, -1]


def steady(found: Places, lag: Tensor) -> Tensor:
    """The steps (n, images, 3) that are ``found``; of one that is far less certain than what renewals usually correct,
    ``lag`` (n, 3, 3), as much as is likely, s^2 / (s^2 + sigma^2). Without noise all images are lines through others,
    and so are places that are wrong: each new one would be farther off than the last."""
    square, of_step = found.step.square(), found.covariance.diagonal(dim1=2, dim2=3)
    usual = lag.diagonal(dim1=1, dim2=2)[:, None]
    vague = (of_step > UNSURE**2 * usual) & (usual > 0)
    return torch.where(vague, square / (square + of_step).clamp(min=LEAST) * found.step, found.step)


def trust(which: Tensor, step: Tensor, covariance: Tensor, lessons: Lessons) -> None:
    """What is known of the places of the templates at ``which`` (n,), which have been put right by a ``step`` (n, 3)
    with a ``covariance`` (n, 3, 3) as against the oldest mean."""
    rounds, square = lessons.rounds[which][:, None, None], step[:, :, None] * step[:, None]
    place = lessons.oldest[which] + covariance
    lessons.place[which] = torch.where(place.isfinite(), place, lessons.place[which])
    share = torch.where(rounds > 0, 1 / rounds.clamp(min=1, max=SOME), 0.0).to(step)
    lessons.lag[which] = torch.lerp(lessons.lag[which], square, share)
    lessons.lead[which] += share[:, 0] * step


def present(held: Tensor) -> Tensor:
    """Which of the older means, and a new one, there are, (n, AGES + 1) bool, if so many are ``held`` (n,)."""
    older = torch.arange(AGES, device=held.device) < held[:, None]
    return torch.nn.functional.pad(older, (0, 1), value=True)


def remember(which: Tensor, images: Tensor, places: Tensor, there: Tensor, found: Places, lessons: Lessons) -> None:
    """Of the ``images`` (n, AGES + 1, h, w), off by ``places`` (n, AGES + 1, 3), that are ``there`` (n, AGES + 1), all
    are kept but the first one, once it is not alike to the last one any more; and, of too many, that whose
    neighbours are most alike."""
    number = torch.arange(AGES + 1, device=there.device)
    gone = found.alike[:, 0, -1] < UNLIKE
    least = found.alike.diagonal(offset=2, dim1=1, dim2=2).argmax(1, keepdim=True) + 1
    dropped = torch.where(gone[:, None], number == 0, there.all(1, keepdim=True) & (number == least))
    stay = there & ~dropped
    order = (number + len(number) * ~stay).argsort(1)[:, :AGES]
    moved = lessons.oldest[which] + found.covariance.gather(1, order[:, :1, None, None].expand(-1, -1, 3, 3))[:, 0]
    lessons.oldest[which] = torch.where(moved.isfinite(), moved, lessons.oldest[which])
    lessons.places[which] = places.gather(1, order[:, :, None].expand(-1, -1, 3))
    lessons.older[which] = images.gather(1, order[:, :, None, None].expand(-1, -1, *images.shape[2:]))
    lessons.held[which] = stay.sum(1)


def at_first(moves: Tensor, frames: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Where n templates were in the first frame as all of the ``frames`` (n,) tell it, from where that alone has them,
    (n, 3), and the share (n,) of one frame's scatter that is left in that; ``moves`` (n, 3, 3) as in ``Lessons``.

    That is known only of what stood still in these frames, or moved evenly: by no more off a line than by noise. The
    first of them lies at 0 by itself.
    """
    n, frame = frames[:, None].to(moves), sigma.square() / 2  # half of it is the template's
    (total, numbered, square), middle = moves.unbind(1), (n - 1) / 2
    spread, mean = (n * (n * n - 1) / 12).clamp(min=LEAST), total / n
    slope = (numbered - middle * total) / spread
    left = (square - n * mean * mean - slope * slope * spread) / (n - 2).clamp(min=1)
    even = ((left <= frame * (1 + CHANCE / (n - 2).clamp(min=1).sqrt())) & (n > FEWEST_EVEN)).all(1)
    still = (slope.square() * spread <= SLOW**2 * frame).all(1)
    line = mean - slope * middle
    offset = torch.where(still[:, None], mean, line)
    share = torch.where(still, 1 / n[:, 0], (4 * n - 2)[:, 0] / (n * (n + 1))[:, 0])
    return torch.where(even[:, None], offset, 0.0), torch.where(even, share, 1.0)


def sampled(image: Tensor, interpolation: str, warp: Tensor, template: Tensor) -> Tensor:
    """What an ``image`` (1 or n, 1, H, W) shows at ``warp`` (n, 2, 3) of the N pixels of ``template`` (R, 1, h, w):
    (n, N)."""
    grid, width = pixels(template), template.shape[3]
    box = torch.stack((grid[:, 0], grid[:, width - 1], grid[:, -1], grid[:, -width]), 1)
    return make_sampler(interpolation, image, warp, box)(warp, grid)


def shifted(mean: Tensor, interpolation: str, step: Tensor, centre: Tensor) -> Tensor:
    """Images ``mean`` (n, 1, h, w), of a pose that is off by ``step`` (n, 3) about the ``centre`` (n, 2), put right."""
    back, about = inverse_pose(step), centre.to(step)[:, :, None]
    turn = rotation(back[:, 2])
    middle = step.new_tensor([[(n - 1) / 2] for n in (mean.shape[3], mean.shape[2])])
    warp = torch.cat((turn, middle + about + back[:, :2, None] - turn @ about), 2)
    return sampled(mean, interpolation, warp, mean).view_as(mean)
