"""The tracker: the only place with a state, the poses of R templates from frame to frame (Algorithm 1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Self

import torch
from torch import Tensor, nn

from torch_ecc.align import solve
from torch_ecc.criteria import Criterion, centred, make_criterion
from torch_ecc.estimate import Estimate, Status, Track
from torch_ecc.frame import as_device, as_gray
from torch_ecc.patches import Centers, Patches, Size, cut, halve_patches, locate_patches
from torch_ecc.pose import compose, inverse
from torch_ecc.reference import Reference
from torch_ecc.sampling import halve
from torch_ecc.search import best_match
from torch_ecc.solver import Settings, State, stage

PREDICTIONS = ("hold", "velocity")
SMALLEST_COARSE = 12  # px: a template is not halved below this side
SEARCHED = (
    40  # px: for the search a template is halved until its smaller side is at most this; its cost grows as side^4
)
COARSE_TOLERANCE = 0.1  # px of a coarse level
FAMILIAR = 0.8  # share of its usual score that a template must have to count as found by a search
MEMORY = 0.05  # weight of the newest frame in the usual score


class SequenceError(ValueError):
    """A frame of a sequence was refused; ``track`` holds the frames before it (None if it was the first)."""

    def __init__(self, message: str, track: Track | None) -> None:
        super().__init__(message)
        self.track = track


class Tracker(nn.Module):
    """Track x, y and theta of R templates of one frame, or of one template in each of R streams.

    ``frame``: (H, W), (C, H, W) or (1 or R, C, H, W), uint8, uint16 or float, with the templates at ``centers``
    (R, 2) as (x, y) px, of ``size`` px (one number or (h, w)). ``criterion``: "ecc", "ecc_paper", "ssd" or an object
    (criteria.Criterion); ``illumination`` of "ecc": "gain" (the paper's), "linear", "quadratic"; ``interpolation``:
    "bilinear", "bspline3", "bspline5"; ``tolerance``: px at the template's corner; ``levels``: pyramid levels;
    ``prediction``: start each frame where the last one ended ("hold") or one step further ("velocity"); ``mask``:
    (h, w) or (R, h, w), True or a weight > 0 where the template counts; ``device``: where everything lives (default:
    the frame's); ``min_score``: below it a template is lost; ``search``: look for a lost template around its last good
    pose, with a pyramid, in this and the following frames. Raises ValueError for what does not fit.
    """

    pose: Tensor
    velocity: Tensor
    start: Tensor
    score: Tensor
    tracked: Tensor

    def __init__(  # noqa: PLR0913 - the constructor is the list of all choices
        self,
        frame: Tensor,
        centers: Centers,
        size: Size,
        *,
        criterion: str | Criterion = "ecc",
        illumination: str = "linear",
        interpolation: str = "bspline3",
        max_iterations: int = 15,
        tolerance: float = 1e-3,
        levels: int = 1,
        prediction: str = "velocity",
        mask: Tensor | None = None,
        device: torch.device | str | None = None,
        min_score: float = 0.5,
        search: bool = True,
    ) -> None:
        super().__init__()
        if prediction not in PREDICTIONS:
            raise ValueError(f"prediction: expected one of {list(PREDICTIONS)}, got {prediction!r}")
        self.settings = Settings(interpolation, max_iterations, tolerance, min_score)
        self.prediction, self.search = prediction, search
        chosen = make_criterion(criterion, illumination)
        gray = as_gray("Tracker", "frame", frame, as_device("Tracker", device))
        self.frame_shape = tuple(gray.shape)
        with torch.no_grad():
            patches = locate_patches("Tracker", gray, centers, size, mask)
            _check_levels(levels, patches.size)
            wanted = max(levels, search_levels(patches.size)) if search else levels
            self.references = pyramid(gray, patches, chosen, wanted)
        if len(self.references) < levels:
            raise ValueError(f"levels: expected at most {len(self.references)} for these templates, got {levels}")
        self.levels = levels
        start = torch.cat((patches.centers, torch.zeros_like(patches.centers[:, :1])), 1)
        self.register_buffer("start", start)
        self.register_buffer("pose", start.clone())
        self.register_buffer("velocity", torch.zeros_like(start))
        self.register_buffer("score", expected_score(self.references[0]).to(start.dtype))
        self.register_buffer("tracked", torch.ones_like(start[:, 0], dtype=torch.bool))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Only the device may change: poses stay float64 and pixels float32 whatever the rest of a model is cast to.
        device = fn(self.score).device
        super()._apply(lambda tensor: tensor.to(device), recurse)  # type: ignore[no-untyped-call]
        self.references = [reference.map(lambda tensor: tensor.to(device)) for reference in self.references]
        return self

    @torch.no_grad()
    def forward(self, frame: Tensor) -> Estimate:
        """Poses of all R templates in the next ``frame``, of the same size as the first: Estimate (R, ...).

        The frame is moved to the tracker's device. Raises ValueError for another shape, a wrong dtype, NaN.
        """
        gray = as_gray("track", "frame", frame, self.pose.device)
        if gray.shape != self.frame_shape:
            raise ValueError(f"track: frame must be {_words(self.frame_shape)} as the first, got {_words(gray.shape)}")
        images = [gray]
        estimate = self._solve(images, compose(self.pose, self.velocity), self.levels)
        missing = (estimate.status == Status.LOST) | (estimate.status == Status.OUT_OF_VIEW)
        lost = missing.nonzero()[:, 0]
        if len(lost) and self.search:
            estimate = self._search(images, estimate, lost)
        return self._advance(estimate)

    def track(self, frame: Tensor) -> Estimate:
        """Same as calling the tracker."""
        return self(frame)  # type: ignore[no-any-return]

    def track_sequence(self, frames: Iterable[Tensor]) -> Track:
        """Poses in every frame of a sequence: Track (F, R, ...).

        Raises SequenceError, with the track so far, at the first frame that does not fit.
        """
        estimates: list[Estimate] = []
        try:
            estimates.extend(map(self.track, frames))
        except ValueError as error:
            done = Track.stack(estimates) if estimates else None
            raise SequenceError(f"track_sequence: frame {len(estimates)}: {error}", done) from error
        if not estimates:
            raise ValueError("track_sequence: frames must hold at least one frame, got none")
        return Track.stack(estimates)

    def _solve(self, images: list[Tensor], pose: Tensor, levels: int, index: Tensor | None = None) -> Estimate:
        """Coarse to fine; ``images`` grows to as many levels as are needed. ``index``: only these templates."""
        references = self.references[:levels]
        if index is not None:
            references = [reference.select(index) for reference in references]
        while len(images) < len(references):
            images.append(halve(images[-1]))
        for level in range(len(references) - 1, 0, -1):
            image = images[level] if index is None or len(images[level]) == 1 else images[level][index]
            scale = pose.new_tensor((2.0**level, 2.0**level, 1.0))
            state = State.start(references[level], pose / scale)
            budget = self.settings.max_iterations
            pose = stage(references[level], image, state, "bilinear", COARSE_TOLERANCE, budget).pose * scale
        image = images[0] if index is None or len(images[0]) == 1 else images[0][index]
        return solve(references[0], image, pose, self.settings)

    def _search(self, images: list[Tensor], estimate: Estimate, lost: Tensor) -> Estimate:
        """Second attempt for the templates at ``lost``: at the best match around the last good pose, coarse to fine."""
        top = len(self.references) - 1
        while len(images) <= top:
            images.append(halve(images[-1]))
        image = images[top] if len(images[top]) == 1 else images[top][lost]
        scale = self.pose.new_tensor((2.0**top, 2.0**top, 1.0))
        start = best_match(self.references[top].select(lost), image, self.pose[lost] / scale) * scale
        found = self._solve(images, start, top + 1, lost)
        familiar = found.score >= FAMILIAR * self.score[lost]
        better = ((found.status == Status.CONVERGED) & familiar).nonzero()[:, 0]
        chosen = Estimate(*(f[better] for f in found))
        return Estimate(*(e.index_copy(0, lost[better], c) for e, c in zip(estimate, chosen, strict=True)))

    def _advance(self, estimate: Estimate) -> Estimate:
        good = Status.good(estimate.status)[:, None]
        pose = torch.where(good, estimate.pose, self.pose)
        if self.prediction == "velocity":
            # The last step in the template's own axes: exact for a constant turn about any point of the stage.
            self.velocity = torch.where(good & self.tracked[:, None], compose(inverse(self.pose), pose), 0.0)
        self.pose, self.tracked = pose, good[:, 0]
        self.score = torch.where(self.tracked, torch.lerp(self.score, estimate.score, MEMORY), self.score)
        return estimate._replace(pose=pose.clone(), displacement=pose - self.start)


def pyramid(frame: Tensor, patches: Patches, criterion: Criterion, levels: int) -> list[Reference]:
    """References of the templates at up to ``levels`` levels, while they keep texture enough; level l has 2^-l px."""
    references = [cut(frame, patches, criterion)]
    while len(references) < levels and min(patches.size) // 2 >= SMALLEST_COARSE:
        frame, patches = halve(frame), halve_patches(patches)
        if int((patches.mask > 0).sum((1, 2, 3)).min()) < SMALLEST_COARSE**2 // 2:
            break
        try:
            references.append(cut(frame, patches, criterion))
        except ValueError:  # texture finer than this level: one single grey level is left
            break
    return references


def search_levels(size: tuple[int, int]) -> int:
    """Levels after which the smaller side of a template (h, w) is at most SEARCHED px, three at least."""
    return max(3, math.ceil(math.log2(min(size) / SEARCHED)) + 1)


def expected_score(reference: Reference) -> Tensor:
    """The correlation (B,) of two images of the same template with the noise that the template seems to have."""
    _, norm = centred(reference.signal[:, 3], reference.weight)
    power = norm.square() / reference.weight.sum(-1)
    return (1 - reference.noise.square() / power).clamp(min=0.0)


def _check_levels(levels: int, size: tuple[int, int]) -> None:
    most = max((min(size) // SMALLEST_COARSE).bit_length(), 1)
    if not isinstance(levels, int) or not 1 <= levels <= most:
        raise ValueError(f"levels: expected 1 to {most} for templates of {size[1]}x{size[0]} px, got {levels}")


def _words(shape: tuple[int, ...]) -> str:
    return f"{shape[0]} image{'s' if shape[0] > 1 else ''} of {shape[3]}x{shape[2]} px"
