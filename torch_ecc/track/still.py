"""Marks of the camera that nobody has told of (aperture, stripe, dust), and still background in a template: they stay
as they were in the first frame while the template moves.

Of a frame of which a template leaves more than noise does, every pixel has two explanations: it shows the template
where that is now, or what it showed in the first frame. Where the second one holds to within noise, and the first one
clearly does not, there is a mark: the pixel tells nothing of the template, nor does what the template was there.

A mark bends the very pose that it is told from. If what it then seems to be does not let the rest fit, all that shows
texture and stands still is left out once, and the mark is told from the pose that the rest has. Nothing is taken for a
mark unless the template fits without it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.align import solve_again
from torch_ecc.core.covariance import largest_variance
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.leverage import disagreement
from torch_ecc.core.noise import noise_level
from torch_ecc.core.normal import LEAST
from torch_ecc.core.pose import turn
from torch_ecc.core.reference import Reference, each, reweigh
from torch_ecc.core.robust import LEAST_NOISE, Memory, unusual
from torch_ecc.core.sampling import Sampler, inside
from torch_ecc.core.settings import Settings
from torch_ecc.core.sight import eroded, picked, seen_through
from torch_ecc.core.verdict import expected_score, within_margin
from torch_ecc.search.locate import pose_distance
from torch_ecc.track.frame_mask import unexplained

AROUND = 3  # px: pixels are compared in squares of so many
STILL = 3.0  # times the noise of a difference: so much is left of squares that stand still
EXCESS = 9.0  # times it, and
CONTRAST = 0.2  # of the template's, must be left by the template, which light and the sampler do not leave
NEARLY, MORE = 0.4, 1.15  # of what a mark leaves, times what the rest does: in 40 marks at least 0.5, or 1.5
BELIEVED = 0.95  # of what is in sight must fit without the marks
BY_CHANCE = 3.0  # standard deviations of what noise may leave
QUIET, TO_MEAN = 0.3, 1.41  # a quantile of what noise leaves of squares, and their mean over it
CODED = 2.0  # times what is left of the quieter squares beside noise, as of a coder: it is uneven
MOST_NOISE = 0.04  # of the template's contrast
AWAY = 1.0  # px: nearer to where it was, a coder changes edges of marks by more than they change by themselves
SETTLED = 0.05  # px
CLEARLY = 3.0  # times as much must be left with the marks
UNSEEN = 1.0  # px: what holds it back by more has been told before, as a mark
ROUNDS = 4  # in which they are told from poses that they bend less and less

Made = TypeVar("Made")


class Look(NamedTuple):
    """Pixels (h, w) of a frame from ``corner`` (y, x) on, around one template. Variances over AROUND px: how much has
    ``changed`` since the first frame, and what the template has ``left`` unexplained here, or where what was here in
    the first frame is now, 0 where it says nothing; of the first frame, its ``texture``; ``noise`` of a difference of
    two frames, and ``contrast`` of the template."""

    corner: tuple[int, int]
    changed: Tensor
    left: Tensor
    texture: Tensor
    noise: float
    contrast: float

    @property
    def still(self) -> Tensor:
        """All that stands still, and shows it (h, w)."""
        return (self.changed < STILL * self.noise) & (self.texture > CONTRAST**2 * self.contrast)

    @property
    def most(self) -> float:
        """What may be left of a square without a mark."""
        return max(EXCESS * self.noise, CONTRAST**2 * self.contrast)

    @property
    def marks(self) -> Tensor:
        """What stands still and should not (h, w)."""
        return (self.changed < STILL * self.noise) & (self.left > self.most)

    @property
    def strange(self) -> bool:
        """Whether anything that stands still leaves nearly so much, or more of it is left than of the rest: else no
        pose is bent by it."""
        still = self.still
        left, rest = self.left[still], self.left[~still]
        return len(left) > 0 and bool((left.max() > NEARLY * self.most) | (left.mean() > MORE * rest.mean()))

    def within(self, part: Tensor, like: Tensor) -> Tensor:
        """A ``part`` (h, w) of it as one of a frame ``like`` (H, W)."""
        whole, (y, x) = torch.zeros_like(like, dtype=torch.bool), self.corner
        whole[y : y + part.shape[0], x : x + part.shape[1]] = part
        return whole


def look(still: Still, pose: Tensor, clean: Reference, *, through_coder: bool = True) -> Look:
    """At one template at a ``pose`` (1, 3), which is ``clean`` of marks as far as one knows; a coder may leave more
    noise than the template shows."""
    contrast = clean.normal.energy / clean.normal.total
    name = "look" if through_coder else "look without a coder"
    return still.once(name, lambda: looked(still, pose, float(contrast), through_coder), pose, contrast)


def looked(still: Still, pose: Tensor, contrast: float, through_coder: bool) -> Look:
    """That of a template with a ``contrast``."""
    reference, (height, width) = still.reference, still.shown.shape
    warps = reference.warps(torch.cat((pose, still.home)))
    x, y = (warps @ reference.grid.box.to(warps.dtype)).round().long().unbind(1)
    x0, x1, y0, y1 = (*span(x, width), *span(y, height))
    view, before = still.image[0, 0, y0:y1, x0:x1].float(), still.first[y0:y1, x0:x1].float()
    before = before * still.level[1] + still.level[0]
    now, home = (warps - shift(y0, x0, warps)).unbind()
    pixels = homogeneous(view)
    expected, known = projected(reference, now, pixels, (y1 - y0, x1 - x0))
    known &= still.shown[y0:y1, x0:x1]
    left = unexplained(view[None], torch.where(known, expected, torch.nan)[None], expected[None])[0]
    images = torch.where(known, left, 0.0).square(), (view - before).square(), expected, before
    left, changed, *means = mean(*images, expected.square(), before.square())
    of_template, texture = (square - once.square() for once, square in zip(means[:2], means[2:], strict=True))
    noise = 2 * max(float(reference.noise.of_frame), LEAST_NOISE**2 * contrast)
    if through_coder and bool(known.any()):
        noise = coded(noise, left[known], of_template[known], MOST_NOISE * contrast)
    new = torch.where(changed < STILL * noise, 0.0, left)  # else a mark may have come to be there
    since = composed(now, inverted(home))[None]  # from where a pixel was to where that is now
    own = torch.where(inside(since, pixels, view.shape), picked(new, since, pixels), 0.0).view(view.shape)
    return Look((y0, x0), changed, left if still.pure else left.maximum(own), texture, noise, contrast)


def coded(noise: float, left: Tensor, texture: Tensor, most: float) -> float:
    """The ``noise`` of a difference of two frames, or, at ``most``, what a coder has made of it, if even of the quieter
    ones of those squares more is ``left`` (n,) whose ``texture`` (n,) is finer than that of others."""
    own = TO_MEAN * float(left[texture >= texture.median()].quantile(QUIET))
    return max(noise, min(noise + CODED * (own - noise), most))


def shift(y: int, x: int, like: Tensor) -> Tensor:
    """From the frame's first pixel to another one: (2, 3), to be taken from warps."""
    return torch.tensor([[0, 0, x], [0, 0, y]], dtype=like.dtype, device=like.device)


def span(places: Tensor, size: int) -> tuple[int, int]:
    """The first pixel, and that after the last one, of those (n,) in a row of ``size``."""
    return int(places.min().clamp(0, size - 1)), int(places.max().clamp(0, size - 1)) + 1


def homogeneous(view: Tensor) -> Tensor:
    """The pixels (3, h w) of a ``view`` (h, w), from its first one on."""
    y, x = torch.meshgrid(*(torch.arange(n, device=view.device, dtype=view.dtype) for n in view.shape), indexing="ij")
    return torch.stack((x.flatten(), y.flatten(), torch.ones_like(x.flatten())))


def inverted(warp: Tensor) -> Tensor:
    """Of a ``warp`` (2, 3)."""
    turn = torch.linalg.inv(warp[:, :2])
    return torch.cat((turn, -turn @ warp[:, 2:]), 1)


def composed(outer: Tensor, inner: Tensor) -> Tensor:
    """Warps (2, 3): first the ``inner`` one."""
    return torch.cat((outer[:, :2] @ inner[:, :2], outer[:, :2] @ inner[:, 2:] + outer[:, 2:]), 1)


def projected(reference: Reference, warp: Tensor, pixels: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """One template as the ``warp`` (2, 3) puts it into a view of ``size`` (h, w) with these ``pixels`` (3, h w), and
    where it counts there, bool."""
    (image, weight), back = images(reference), inverted(warp)
    back = torch.cat((back[:, :2], back[:, 2:] - reference.grid.box[:2, :1].to(back)), 1)[None]
    known = picked(weight[0, 0] > 0, back, pixels) & inside(back, pixels, image.shape[2:])
    return Sampler.of(image, "bspline3")(back, pixels).view(size), known.view(size)


def images(reference: Reference) -> tuple[Tensor, Tensor]:
    """The templates, and their weights, as images (B, 1, h, w) with 0 where no pixel counts."""
    grid = reference.grid
    column, row = (grid.pixels[:2] - grid.box[:2, :1]).long()
    both = torch.stack((reference.signal[:, 3], reference.weight)).detach()
    whole = both.new_zeros(2, both.shape[1], 1, *(int(n) for n in grid.sides.flip(0).tolist()))
    whole[:, :, 0, row, column] = both
    return whole[0], whole[1]


def mean(*images: Tensor) -> Tensor:
    """Of n images (h, w) over squares of AROUND px, (n, h, w)."""
    total = torch.stack((*images, torch.ones_like(images[0])))
    for axis in (1, 2):
        n, wide = total.shape[axis], F.pad(total, (0, 0, AROUND // 2, AROUND // 2) if axis == 1 else (AROUND // 2,) * 2)
        total = sum((wide.narrow(axis, k, n) for k in range(1, AROUND)), wide.narrow(axis, 0, n))
    return total[:-1] / total[-1]


def behind(reference: Reference, home: Tensor, marks: Tensor, which: Tensor) -> Reference:
    """The templates, cut at ``home`` (B, 3), as a camera sees them that has ``marks`` (H, W), bool: those of them at
    ``which`` (B,) that heed them, in the frame and in what they were cut from."""
    if not bool(which.any()):
        return reference
    shown, index = ~marks, which.nonzero()[:, 0]
    clear = eroded(shown)

    def without(part: Reference) -> Reference:
        return reweigh(part, picked(clear, part.warps(home[index]), part.grid.pixels))

    some = reference.through(None).select(index)
    coarse = None if some.coarse is None else without(some.coarse)
    some = without(some)
    level = noise_level(*images(some)).maximum(some.noise.level)  # dark marks have less of it
    some = some._replace(coarse=coarse, noise=some.noise._replace(level=level, power=level.to(home).square()))
    if len(index) < len(which):
        whole = reference.through(None)
        some = each(lambda old, new: old.index_copy(0, index, new), whole, some)
    return seen_through(some, shown, None if len(index) == len(which) else which)


class Trial(NamedTuple):
    """One template without marks: the ``estimate`` (1, ...), whether it leaves ``odd`` blocks, and how much is ``left``
    of it, a variance per pixel; the ``reference``, and what is ``shown`` (H, W)."""

    estimate: Estimate
    odd: bool
    left: float
    reference: Reference
    shown: Tensor

    @property
    def known(self) -> bool:
        """Whether all that is in sight has been found."""
        return bool((self.estimate.coverage > BELIEVED) & (self.estimate.status == Status.CONVERGED))

    @property
    def fits(self) -> bool:
        """Whether no more is left of it than noise leaves."""
        score = self.estimate.score
        return self.known and not self.odd and bool(within_margin(score, expected_score(self.reference)))


class Still(NamedTuple):
    """One template in one ``image`` (1, 1, H, W), expected at ``start`` (1, 3) after it was at ``home`` (1, 3) in the
    ``first`` one (H, W), known as so many standard deviations about a mean, its ``level`` (2,); where the camera has
    ``shown`` (H, W) the scene, as far as one knows; ``pure``: it has been seen elsewhere as it is, so no mark is in it;
    what has been ``made`` of it.
    """

    reference: Reference
    image: Tensor
    first: Tensor
    level: Tensor
    start: Tensor
    home: Tensor
    shown: Tensor
    pure: bool
    settings: Settings
    made: list[tuple[str, tuple[Tensor, ...], Any]]

    def once(self, name: str, make: Callable[[], Made], *given: Tensor) -> Made:
        """What is to be made of tensors that are ``given``, as it was made of the same ones: what a mark seems to be
        mostly leads to the same pose again, and that to the same mark."""
        for other, those, made in self.made:
            if other == name and all(map(torch.equal, those, given)):
                return made  # type: ignore[no-any-return]
        new = make()
        self.made.append((name, given, new))
        return new

    def disagreement(self) -> Tensor | None:
        """By what (1, 3) least squares may be off if the blocks that fix it are wrong, None if all say the same."""
        memory, settings = Memory.none(self.reference), replace(self.settings, robust=False)
        _, found = solve_again(self.reference, self.image, self.start, settings, self.home, memory)
        off = disagreement(self.reference.leverage, found)
        return off if off is not None and bool((off != 0).any()) else None

    def trial(self, shown: Tensor) -> Trial | None:
        """With less that is ``shown``; None if hardly anything is left of it."""
        return self.once("trial", lambda: self._tried(shown), self.start, shown)

    def _tried(self, shown: Tensor) -> Trial | None:
        which = torch.ones_like(self.home[:, 0], dtype=torch.bool)
        reference = self.once("behind", lambda: behind(self.reference, self.home, ~shown, which), shown)
        if not bool(reference.normal.total > LEAST):
            return None
        memory = Memory.none(reference)
        found, solution = solve_again(
            reference, self.image, self.start, replace(self.settings, robust=False), self.home, memory
        )
        odd = bool(unusual(reference, solution, self.settings, memory.score))
        left = float(solution.total[:, 6] / solution.total[:, 0].clamp(min=LEAST))
        return Trial(found, odd, left, reference, shown)

    def distance(self, pose: Tensor, other: Tensor) -> float:
        """Px, of its farthest pixel at poses (1, 3)."""
        return float(pose_distance(pose, other, radius=self.reference.place.radius))

    def explains(self, trial: Trial, last: Trial | None) -> bool:
        """Whether a ``trial`` without marks is what it is, and not as well with them, at that place: because it fits,
        or, as behind a coder nothing does, because the marks told from it lead back to it, as from the ``last`` one,
        and with them far more is left."""
        settled = last is not None and self.distance(trial.estimate.pose, last.estimate.pose) < SETTLED
        if not trial.fits and not (settled and trial.known and self.distance(trial.estimate.pose, self.home) > AWAY):
            return False
        there = self._replace(start=trial.estimate.pose)
        if trial.fits:
            marked = there.trial(self.shown)
            return marked is None or not marked.fits
        marked = there.trial(torch.ones_like(self.shown))
        return marked is None or marked.left > CLEARLY * trial.left

    def told(self, pose: Tensor, clean: Reference) -> Trial | None:
        """Without the marks that are told from a ``pose`` (1, 3) on, and a template that is ``clean`` of them as far as
        one knows; None if it then does not fit."""
        last = None
        for _ in range(ROUNDS):
            seen = look(self, pose, clean)
            marks = seen.within(seen.marks, self.shown) & self.shown
            trial = self.trial(self.shown & ~marks) if bool(marks.any()) else None
            if trial is None or not Status.good(trial.estimate.status):
                return None
            if self.explains(trial, last):
                return trial
            if trial.fits:  # with the marks as well: it was looked for at another place, and nothing marks it
                return None
            pose, clean, last = trial.estimate.pose, trial.reference, trial
        return None

    def without_marks(self, pose: Tensor) -> Trial | None:
        """What it is without them, as told from a ``pose`` (1, 3) that they may bend; None if there are none, or one
        cannot tell."""
        trial = self.told(pose, self.reference)
        if trial is not None or self.pure:
            return trial
        seen = look(self, pose, self.reference)
        trial = self.trial(self.shown & ~seen.within(seen.still, self.shown)) if seen.strange else None
        if trial is None or not Status.good(trial.estimate.status):
            return None
        return self.told(trial.estimate.pose, trial.reference)

    def doubt(self, pose: Tensor, trusted: Tensor) -> Tensor:
        """By what (1, 3, 3) it may be off at a ``pose`` (1, 3) if all that stands still is no part of it: a covariance
        of as much as leaves what is left of the others in blocks that are ``trusted`` (1, blocks), and more than noise;
        no more than it may have moved unseen, and none if all blocks say the same of the pose."""
        reference, axes = self.reference, turn(pose[:, 2])
        off = self._replace(start=pose).disagreement()
        if off is None:
            return torch.zeros_like(axes)
        there = axes @ off[:, :, None]
        seen = look(self, pose, reference, through_coder=False)
        warps = reference.warps(torch.cat((pose, self.home)))
        now, home = (warps - shift(*seen.corner, warps)).split(1)
        pixels, size = reference.grid.pixels, seen.left.shape
        frozen = picked(seen.still, now, pixels) | picked(seen.still, home, pixels)
        moving = inside(now, pixels, size) & ~frozen & (trusted[:, reference.grid.block] == 1)
        left = picked(seen.left, now, pixels)[moving]
        if len(left) == 0:
            return there @ there.mT
        noise = left.quantile(QUIET).mul(TO_MEAN).clamp(max=seen.noise)  # the estimate is an upper one
        more = (left - noise).sum() - BY_CHANCE * noise * (2 * len(left)) ** 0.5
        normal = reweigh(reference, moving).normal
        half = axes @ normal.inverse[:, :3, :3]
        doubt: Tensor = half @ normal.meat @ half.mT * more.clamp(min=0)
        most = largest_variance(reference.place.lever2, doubt)
        return doubt * (UNSEEN**2 / most.clamp(min=UNSEEN**2)).view(-1, 1, 1) + there @ there.mT
