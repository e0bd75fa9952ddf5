"""Robust solve: where blocks of a patch do not fit, they are trusted less, by iteratively re-weighted least squares.

What covers a part of a template leaves residuals there that no noise explains; whole blocks of pixels show that where
single pixels do not. Least squares is tried first: if all blocks fit alike, that is the answer. Else each block's trust
follows from its residual, at first at the start and under a model that a minority of blocks cannot bend (medians), then
where the engine comes to with that trust, until it settles.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, log
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.blocks import Blocks
from torch_ecc.core.normal import LEAST
from torch_ecc.core.reference import Fields, Reference, each
from torch_ecc.core.sampling import SAMPLERS, is_cpu
from torch_ecc.core.scale import (
    LEAST_SLIP,
    Scale,
    excess,
    median_fit,
    residual_variance,
    robust_scale,
    weighted_median,
)
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Engine, Solution, Trust
from torch_ecc.core.verdict import LEAST_COVERAGE, Number, correlation, detrended, expected_score, within_margin

ROUNDED_OFF = 0.15  # of the contrast, by bilinear interpolation
OUTLIER = 3.0  # times the variance that is expected of a block: beyond it less and less is believed
DISTRUST = 3.0  # trust = (OUTLIER / ratio)^this
NO_TRUST = 0.02  # less is none
SLIP, FIRST_SLIP = 0.045, 1.0  # px^2 / 2: blocks may seem to have slipped by 0.3 px rms; before the solve by more
LARGEST_SLIP = 0.5  # where all do, as of blur, nothing need cover any of them
LEAST_NOISE = 0.01  # of the template's contrast: smaller residuals shift nothing
ROUNDS, FEW_ROUNDS = 8, 3  # until trust settles; where the host does not look
CLEARLY_LESS = 0.9  # of the cost of least squares, where that has not found the template
LEAST_WORSE = 0.2  # of what blocks gain, others lose: a cover fits as badly as before, but blurred edges fit worse
AS_BAD = 15.0  # excess: how far above it is no matter
WORST = 1e30  # excess of what does not fit at all
FITS = 1.4  # median excess: nothing else is tried
BRIGHTER = 2.0  # times the gain of least squares
RECOGNISED = 0.9  # of the usual score: least squares that reaches it has found the template
FAMILIAR = 0.8  # of the usual score: what has less where it was tracked to may be something else
THERE = 0.5  # gain of most blocks: what is covered has about the gain that it always has, what has jumped has none
FARTHEST = 8.0  # px, of the farthest pixel: what is seen in part has not moved more
SETTLED = 0.01  # of the template's weight: trust changes no more


class Memory(NamedTuple):
    """What is known of B templates from the frames before: their usual ``score`` (B,), and the ``trust`` (B, blocks)
    that there was in them in the last one; and in how many they ``answered`` (B,) a push, see ``pushed``.
    ``put_off``: templates that are in doubt are only named, not solved again; ``put_off_gone``: only those that are
    ``gone``, where the host can see them."""

    score: Tensor
    trust: Tensor
    answered: Tensor
    put_off: bool = False
    put_off_gone: bool = False

    @staticmethod
    def none(reference: Reference) -> Memory:
        """Of templates that have not been seen yet."""
        score = expected_score(reference)
        return Memory(score, torch.ones_like(reference.blocks.weight), torch.zeros_like(score, dtype=torch.long))

    def kept(self) -> dict[str, Tensor]:
        """What lasts from one frame to the next."""
        return {"score": self.score, "trust": self.trust, "answered": self.answered}


class Doubted(NamedTuple):
    """Templates at ``which`` (n,) of a solve by an ``engine`` that are solved again: what they have in their blocks,
    the ``floor`` (n, 1) of the noise's variance, their ``usual`` (n,) score and the ``last`` (n, blocks) trust; which
    are ``asked`` (n,) for, None if all are."""

    engine: Engine
    reference: Reference
    image: Tensor
    settings: Settings
    which: Tensor
    blocks: Blocks
    floor: Tensor
    usual: Tensor
    last: Tensor
    asked: Tensor | None = None

    @staticmethod
    def of(engine: Engine, reference: Reference, image: Tensor, settings: Settings, memory: Memory) -> Doubted:
        """All of them."""
        which, floor = torch.arange(len(memory.score), device=memory.score.device), least_noise(reference, settings)
        usual, last = memory.score, memory.trust
        return Doubted(engine, reference, image, settings, which, reference.blocks, floor, usual, last)

    def at(self, part: Tensor) -> Doubted:
        """Some of them (n,) bool."""
        if part.all():
            return self
        blocks = each(lambda value: value[part], self.blocks)
        known = {name: getattr(self, name)[part] for name in ("which", "floor", "usual", "last")}
        return self._replace(blocks=blocks, **known)

    def solve(self, start: Tensor, settings: Settings, trusted: Tensor) -> Solution:
        """From ``start`` (B, 3) on, with blocks (n, blocks) as they are trusted."""
        return self._solve(start, settings, Trust(self.which, trusted, self.asked))

    def look(self, start: Tensor, settings: Settings, trusted: Tensor) -> Solution:
        """The same without the normal equations, if the engine can leave them to those that need them."""
        judged = not is_cpu(start.device) or self.reference.sight is not None
        return self._solve(start, settings, Trust(self.which, trusted, self.asked, judged))

    def _solve(self, start: Tensor, settings: Settings, trust: Trust) -> Solution:
        found = self.engine(self.reference, self.image, start, settings, trust)
        return found._replace(trust=trust.blocks)


class Plain(NamedTuple):
    """What least squares has ``found`` of n templates: their ``score`` (n,), and by how many times the variance of
    their blocks is more than that of most lets expect, the ``ratio`` (n, blocks)."""

    found: Solution
    score: Tensor
    ratio: Tensor

    @staticmethod
    def of(doubted: Doubted, found: Solution) -> Plain:
        """Of those that are doubted."""
        _, ratio = compared(doubted, residual_variance(found.sums), found.sums[:, 0], any_scale(doubted))
        return Plain(found, correlation(found.normal, found.total), ratio)

    @property
    def uneven(self) -> Tensor:
        """Which (n,) have blocks that fit far worse than others."""
        return ~(self.ratio <= OUTLIER).all(1)

    def at(self, some: Tensor) -> Plain:
        """Some of them (n,) bool."""
        return part_of(self, some)


def solve(
    engine: Engine,
    reference: Reference,
    image: Tensor,
    start: Tensor,
    settings: Settings,
    memory: Memory | None = None,
) -> Solution:
    """Poses of B templates in (B or 1, 1, H, W) from ``start`` (B, 3) on, with a ``memory`` of the frames before."""
    found = engine(reference, image, start, settings, None)
    if not settings.robust:
        return found
    memory, on_cpu = Memory.none(reference) if memory is None else memory, is_cpu(start.device)
    odd = unusual(reference, found, settings, memory.score)
    if odd is None:
        return found
    doubted, least = Doubted.of(engine, reference, image, settings, memory), found._replace(trust=whole(found))
    if on_cpu:  # nowhere else does the host ask which ones
        doubted, least = doubted.at(odd), part_of(least, odd)
    plain = Plain.of(doubted, least)
    doubtful = plain.uneven | ~within_margin(plain.score, doubted.usual)
    if memory.put_off:
        return found._replace(odd=odd, doubtful=doubtful)
    if on_cpu:
        if not doubtful.any():
            return found._replace(odd=odd)
        doubted, plain = doubted.at(doubtful), plain.at(doubtful)
        if memory.put_off_gone and (left := gone(doubted, start, plain)).any():
            named = torch.zeros_like(odd).index_put((doubted.which,), left)
            found = found._replace(odd=odd, doubtful=named)
            if left.all():
                return found
            doubted, plain = doubted.at(~left), plain.at(~left)
        doubtful = torch.ones_like(plain.uneven)
    again, taken = solved_again(doubted if on_cpu else doubted._replace(asked=doubtful), start, plain)
    answer = found
    if not on_cpu or taken.any():
        new = chosen(doubtful & taken, again, plain.found)
        before = found._replace(trust=whole(found), odd=None, doubtful=None)
        answer = each(lambda old, new: old.index_copy(0, doubted.which, new), before, new)
    return answer._replace(odd=odd, doubtful=found.doubtful)


def unusual(reference: Reference, found: Solution, settings: Settings, usual: Tensor) -> Tensor | None:
    """Which templates (B,) have blocks with residuals that would be too much even for noise as it is ``usual`` (B,), or
    the least there is: others need no scale of this frame's own. None if the host knows that there are none."""
    blocks, known = reference.blocks, (found.normal.contrast, found.gain, usual)
    if found.normal is reference.normal:  # all pixels count
        worst = (found.sums[:, 6] * blocks.share).amax(1)
    else:
        worst = (residual_variance(found.sums) * blocks.enough).amax(1)
    if on_cpu := is_cpu(usual.device):
        numbers = zip(worst.tolist(), *(value.tolist() for value in known), strict=True)
        if all(most <= OUTLIER * usual_variance(*each) for most, *each in numbers):
            return None
    expected = torch.maximum(usual_variance(*known), least_noise(reference, settings)[:, 0])
    odd = ~(worst <= OUTLIER * expected)  # NaN is unusual
    return None if on_cpu and not odd.any() else odd


def gone(doubted: Doubted, start: Tensor, plain: Plain) -> Tensor:
    """Which templates (n,), seen whole in the last frame, least squares does not find, and most of whose blocks do not
    see them at the ``start`` (B, 3), whatever may cover the others: they have jumped."""
    left = (plain.score < FAMILIAR * doubted.usual) & (doubted.last == 1).all(1)
    if not left.any():
        return left
    look = doubted.look(start, doubted.settings.once, torch.ones_like(doubted.blocks.weight))
    return left & (median_fit(look.sums, doubted.blocks)[1][:, 0] < THERE)


def solved_again(doubted: Doubted, start: Tensor, plain: Plain) -> tuple[Solution, Tensor]:
    """The best answer that trust leads to, and where (n,) it is to be taken for the ``plain`` one.

    Noise may have grown in all of the patch, or light be another: then least squares is right, and leaving out most of
    it is not.
    """
    least, found = RECOGNISED * doubted.usual, plain.found
    best, fits, other = best_trial(doubted, start, plain, plain.score >= least)
    if is_cpu(other.device) and not other.any():
        return best, other
    recognised = torch.maximum(plain.score, detrended(found.normal, found.total)) >= least
    return best, other & (plain.uneven | fits) & (covers_most(best) | ~recognised)


def covers_most(found: Solution) -> Tensor:
    """Where (n,) enough of what is in sight is believed."""
    return found.normal.total >= LEAST_COVERAGE * found.sums[:, 0].sum(1)


def best_trial(doubted: Doubted, start: Tensor, plain: Plain, recognised: Tensor) -> tuple[Solution, Tensor, Tensor]:
    """The best, whether it fits (n,), and whether it is another (n,), of the ``plain`` answer and those that trust
    leads to if it begins with the residuals of least squares, or with those under a median fit, at the ``start`` (B, 3)
    or where least squares has come to, and has not slid away. Where least squares has ``recognised`` (n,) the template
    and the first trial is no better, no other is made; where it has not, one that recognises most of the template fits.
    """
    strange, other, best, on_cpu = ~recognised, torch.zeros_like(recognised), plain.found, is_cpu(start.device)
    there = start.index_copy(0, doubted.which, best.pose)
    here, lever = start[doubted.which], doubted.reference.place.lever[doubted.which]
    seen, usual = best.sums[:, 0], usual_scale(doubted, best.gain, SLIP)
    share = seen / seen.sum(1, keepdim=True).clamp(min=LEAST)
    left, fits = cost(doubted, best, best.gain)
    least = CLEARLY_LESS * (left * share).sum(1)
    brightest = BRIGHTER * best.gain.abs()  # a few blocks fit with any gain
    first = usual, trust(plain.ratio)
    trials: list[tuple[Tensor, tuple[Scale, Tensor] | None]] = [(there, first), (start, None), (there, None)]
    remembered = on_cpu and bool((doubted.last < 1).any())
    if remembered:
        trials.insert(0, (start, (usual, doubted.last)))
    for place, begin in trials if on_cpu else trials[:1]:  # elsewhere all templates would go through all
        found, judged = reweighted(doubted, place, *(begin or median_look(doubted, place)))
        price, well = cost(doubted, found, found.gain.minimum(brightest))
        if not on_cpu or strange.any():
            found = judged(found)
            well |= strange & recognises_most(doubted, found)
        total = (price * share).sum(1)
        better = torch.where(well == fits, total < least, well)  # what fits most of it, or else what leaves less
        better = torch.where(recognised, (well >= fits) & improves(left, price, share), better)
        better &= torch.linalg.vector_norm((found.pose - here) * lever, dim=1) < FARTHEST
        recognised, other = recognised & ~better, other | better
        if not on_cpu or better.any():
            found = judged(found)
            best = chosen(better, found, best)
            left, fits = torch.where(better[:, None], price, left), torch.where(better, well, fits)
            least = torch.where(better, total, least)
            if remembered:  # a cover mostly stays: what has led here in the last frame, and does so again, is enough
                recognised |= better & covers_most(found)
        remembered = False
        if on_cpu and bool((fits | recognised).all()):
            break
    return best, fits, other


def recognises_most(doubted: Doubted, found: Solution) -> Tensor:
    """Where (n,) what is believed is enough, and looks about as usual."""
    return covers_most(found) & (correlation(found.normal, found.total) >= RECOGNISED * doubted.usual)


def cost(doubted: Doubted, found: Solution, gain: Tensor) -> tuple[Tensor, Tensor]:
    """What is left of templates when the noise is the usual one under a ``gain`` (n,): the log of the blocks' excess
    (n, blocks), whose mean asks less of what does not fit at all than of how much fits; and whether most do (n,)."""
    seen = found.sums[:, 0]
    scale = usual_scale(doubted, gain, LEAST_SLIP)
    ratio = excess(residual_variance(found.sums), doubted.blocks, seen, scale).clamp(min=1).nan_to_num(WORST, WORST)
    ratio = torch.where(found.gain.unsqueeze(1) > 0, ratio, WORST)
    fits = weighted_median(ratio, seen)[:, 0] < FITS
    return ratio.log(), fits


def improves(old: Tensor, new: Tensor, share: Tensor) -> Tensor:
    """Where (n,) from the ``old`` to the ``new`` cost (n, blocks) hardly a ``share`` of the blocks gets worse."""
    gained = (old.clamp(max=log(AS_BAD)) - new.clamp(max=log(AS_BAD))) * share
    return -gained.clamp(max=0).sum(1) < LEAST_WORSE * gained.clamp(min=0).sum(1)


def median_look(doubted: Doubted, place: Tensor) -> tuple[Scale, Tensor]:
    """Scale and trust (n, blocks) under a median fit at ``place`` (B, 3)."""
    look = doubted.look(place, doubted.settings.once, torch.ones_like(doubted.blocks.weight))
    variance, gain = median_fit(look.sums, doubted.blocks)
    scale, ratio = compared(doubted, variance, look.sums[:, 0], usual_scale(doubted, gain[:, 0], FIRST_SLIP))
    return scale, trust(ratio)


def reweighted(
    doubted: Doubted, place: Tensor, scale: Scale, after: Tensor
) -> tuple[Solution, Callable[[Solution], Solution]]:
    """Solved from their ``place`` (B, 3) on, with trust that begins as ``after`` (n, blocks) a look of that ``scale``
    and settles; and what brings the normal equations to that if it has none: as long as all of the solve, and few ask
    for them."""
    blocks = doubted.blocks
    for _ in range(ROUNDS if is_cpu(place.device) else FEW_ROUNDS):
        begun, before = place, after
        found = doubted.look(place, doubted.settings, before)
        most = Scale(scale.noise, scale.slip.clamp(max=SLIP))  # no cover may talk itself in
        scale, ratio = compared(doubted, residual_variance(found.sums), found.sums[:, 0], most)
        after = trust(ratio)
        change = ((after - before).abs() * blocks.weight).sum(1)
        if is_cpu(place.device) and bool((change <= SETTLED * blocks.weight.sum(1)).all()):
            break
        place = place.index_copy(0, doubted.which, found.pose)

    def judged(found: Solution) -> Solution:
        known = found.normal is not doubted.reference.normal
        return found if known else doubted.solve(begun, doubted.settings, before)

    return found, judged


def any_scale(doubted: Doubted) -> Scale:
    """As large as any."""
    return Scale(doubted.floor + inf, torch.full_like(doubted.floor, LARGEST_SLIP))


def usual_scale(doubted: Doubted, gain: Tensor, slip: float) -> Scale:
    """The scale of templates seen with a ``gain`` (n,) if their noise is the usual one."""
    contrast = doubted.reference.normal.contrast[doubted.which]
    noise = usual_variance(contrast, gain, doubted.usual).to(doubted.floor.dtype)
    return Scale(noise.unsqueeze(1).maximum(doubted.floor), torch.full_like(doubted.floor, slip))


def compared(doubted: Doubted, variance: Tensor, seen: Tensor, most: Scale) -> tuple[Scale, Tensor]:
    """The scale, at ``most`` so large, and the ``variance`` (n, blocks) of blocks over what it lets expect."""
    scale = robust_scale(variance, doubted.blocks, seen, doubted.floor, most)
    return scale, excess(variance, doubted.blocks, seen, scale)


def usual_variance(contrast: Number, gain: Number, usual: Number) -> Number:
    """The residual variance of a template of some ``contrast``, seen with a ``gain``, whose score s is the ``usual``
    one: the share 1 - s^2 of its own. Numbers, or tensors (B,)."""
    return (1 - usual * usual) * gain * gain * contrast


def chosen(better: Tensor, new: Solution, old: Solution) -> Solution:
    """Of n templates the ``new`` answer where it is ``better`` (n,)."""
    return each(lambda a, b: torch.where(better.view(-1, *[1] * (a.dim() - 1)), a, b), new, old)


def part_of(found: Fields, some: Tensor) -> Fields:
    """That of ``some`` templates (B,) bool."""
    return found if some.all() else each(lambda value: value[some], found)


def whole(found: Solution) -> Tensor:
    """Trust (B, blocks) in all there is."""
    return torch.ones_like(found.sums[:, 0])


def trust(ratio: Tensor) -> Tensor:
    """How much is believed of blocks (B, n) whose variance is ``ratio`` times what is expected: 1, or falling to 0."""
    weight = (OUTLIER / ratio.clamp(min=OUTLIER)).pow(DISTRUST)
    return torch.where(weight < NO_TRUST, 0.0, weight)


def least_noise(reference: Reference, settings: Settings) -> Tensor:
    """Variance (B, 1) that noise has at least: that of the template's, or next to nothing of its contrast; of a sampler
    without prefilter, what it rounds off itself."""
    share = LEAST_NOISE if SAMPLERS[settings.interpolation].ring else ROUNDED_OFF
    least = torch.maximum(reference.noise.of_frame, share**2 * reference.normal.contrast)
    return least.to(reference.K.dtype).unsqueeze(1)
