"""The tracker: the only place with a state, the poses of R templates from frame to frame (Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from torch_ecc.core import native
from torch_ecc.core.align import settle, solve
from torch_ecc.core.criteria import Criterion, centred, make_criterion
from torch_ecc.core.estimate import Estimate, Status, Track
from torch_ecc.core.frame import as_device, as_gray, as_image
from torch_ecc.core.patches import Centers, Size, cut, locate_patches
from torch_ecc.core.pose import compose, inverse, library, unwrap
from torch_ecc.core.pyramid import SMALLEST_COARSE, pyramid
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import on_host
from torch_ecc.core.settings import Settings
from torch_ecc.core.solver import State, stage
from torch_ecc.search.locate import LEAST_VISIBLE, Located, Locator, detrended_zncc_at, image_pyramid, within_margin
from torch_ecc.search.nearby import Nearby

STATE = ("pose", "velocity", "start", "score", "tracked", "doubted")  # in the order of native.track
PREDICTIONS = ("hold", "velocity")
COARSE_TOLERANCE = 0.1  # px of a coarse level
FAMILIAR = 0.8  # share of its usual score that a template must have to count as found by a search
MEMORY = 0.05  # weight of the newest frame in the usual score
AT_ONCE = 8  # templates searched for in the whole of one frame; the others in turn
NEARBY_AT_ONCE = 64  # and near where they are expected
PATIENCE = 16  # frames in which a lost template is searched for at every chance; later ever more seldom
SELDOM = 16  # frames between two searches for what has been lost for long


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
    the frame's); ``min_score``: below it a template is lost; ``search``: look for a template that is lost, or looks
    less like itself than usual, near where it is expected and then in the whole frame at any angle: in every frame at
    first, and ever more seldom the longer it stays so (every 16th frame in the end); ``backend``: "auto", "torch" or
    "native", see settings.Settings.
    Raises ValueError for what does not fit.
    """

    pose: Tensor
    velocity: Tensor
    start: Tensor
    score: Tensor
    tracked: Tensor
    doubted: Tensor

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
        backend: str = "auto",
    ) -> None:
        super().__init__()
        if prediction not in PREDICTIONS:
            raise ValueError(f"prediction: expected one of {list(PREDICTIONS)}, got {prediction!r}")
        self.settings = Settings(interpolation, max_iterations, tolerance, min_score, backend=backend)
        self.prediction, self.search = prediction, search
        chosen = make_criterion(criterion, illumination)
        gray = as_gray("Tracker", "frame", frame, as_device("Tracker", device))
        self.frame_shape = tuple(gray.shape)
        with torch.no_grad():
            patches = locate_patches("Tracker", gray, centers, size, mask)
            _check_levels(levels, patches.size)
            self.references = pyramid(cut(gray, patches, chosen), levels)
        if len(self.references) < levels:
            raise ValueError(f"levels: expected at most {len(self.references)} for these templates, got {levels}")
        self.levels = levels
        start = torch.cat((patches.centers, torch.zeros_like(patches.centers[:, :1])), 1)
        self.register_buffer("start", start)
        self.register_buffer("pose", start.clone())
        self.register_buffer("velocity", torch.zeros_like(start))
        self.register_buffer("score", expected_score(self.references[0]).to(start.dtype))
        self.register_buffer("tracked", torch.ones_like(start[:, 0], dtype=torch.bool))
        self.register_buffer("doubted", torch.zeros_like(start[:, 0], dtype=torch.int64))  # frames in a row
        self._locators: dict[int, Locator] = {}  # of the templates last searched for
        self._nearby: tuple[list[int], Nearby] | None = None
        self._packed: tuple[native.Packed | None] | None = None  # once it is known whether the native path serves
        self._turn = 0  # whose turn it is if they are many

    @classmethod
    def find(
        cls, template: Tensor, frame: Tensor, *, near: Tensor | None = None, **options: Any
    ) -> tuple[Tracker, Located]:
        """A tracker of ``template`` (h, w), (C, h, w) or (R, C, h, w), cut from some other image, that starts where
        ``locate`` finds it in ``frame``, at any angle; and what it has found, to be judged by the caller.

        Of places that look alike the one nearest to ``near`` (R, 2 or 3) is taken. ``options``: the constructor's.
        theta counts from the template's own image; ``displacement`` from where it was found.
        """
        gray = as_gray("find", "template", template, as_device("find", options.get("device")))
        h, w = gray.shape[-2:]
        tracker = cls(gray, [((w - 1) / 2, (h - 1) / 2)] * len(gray), (h, w), **options)
        view = as_gray("find", "frame", frame, tracker.pose.device)
        settings = replace(tracker.settings, min_visible=LEAST_VISIBLE)
        located = Locator(tracker.references[0], (view.shape[-2], view.shape[-1]), settings)(view, near)
        tracker.frame_shape = tuple(view.shape)
        tracker.start, tracker.pose = located.pose.clone(), located.pose.clone()
        return tracker, located

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Only the device may change: poses stay float64 and pixels float32 whatever the rest of a model is cast to.
        device = fn(self.score).device
        super()._apply(lambda tensor: tensor.to(device), recurse)  # type: ignore[no-untyped-call]
        self.references = [reference.map(lambda tensor: tensor.to(device)) for reference in self.references]
        self._locators.clear()
        self._nearby = self._packed = None
        return self

    def __getstate__(self) -> dict[str, Any]:
        # Packed templates are of use to the native library of this process and this kind of CPU alone.
        return {**self.__dict__, "_packed": None}

    def forward(self, frame: Tensor) -> Estimate:
        """Poses of all R templates in the next ``frame``, of the same size as the first: Estimate (R, ...).

        The frame is moved to the tracker's device. Raises ValueError for another shape, a wrong dtype, NaN.
        """
        image = as_image("track", "frame", frame, self.pose.device)
        if image.shape != self.frame_shape:
            raise ValueError(f"track: frame must be {_words(self.frame_shape)} as the first, got {_words(image.shape)}")
        estimate, done = self._at_once(image)
        return estimate if estimate is not None and done else self._beyond(image, estimate)

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

    def _at_once(self, image: Tensor) -> tuple[Estimate | None, bool]:
        """Prediction, solve and update in one native call, and whether that is all that this frame needs; without the
        update if it is not, None where the native path does not serve."""
        if self._packed is None:
            self._packed = (native.packed(self.references[0], self.settings),)
        if self._packed[0] is None or self.levels > 1 or not native.takes(image):
            return None, False
        state: list[Any] = [self._buffers[name] for name in STATE]  # a module's attributes are slow
        hold = self.prediction == "hold"
        estimate, state = native.track(self._packed[0], image, state, hold=hold, search=self.search)
        self._buffers.update(zip(STATE, state, strict=False))  # none, if this is not all
        return estimate, bool(state)

    @torch.no_grad()
    def _beyond(self, image: Tensor, estimate: Estimate | None) -> Estimate:
        """What a frame needs more: the torch path if there is no ``estimate`` yet, and searches."""
        buffers: Any = self._buffers
        images, state = [image], {name: on_host(buffers[name]) for name in STATE}
        start = torch.as_tensor(compose(state["pose"], state["velocity"]))
        if estimate is None:
            estimate = self._solve(images, start)
        else:
            estimate = settle(self.references[0], image, start, self.settings, estimate)
        strange = _strange(estimate, state["score"])
        due = self._due(strange) if self.search else []
        if due:
            images[0] = images[0].float()
            estimate = self._look_near(images[0], estimate, start, sorted(due))
            strange = _strange(estimate, state["score"]).tolist()
            for r in [r for r in due if strange[r]][:AT_ONCE]:
                estimate = self._search(images, estimate, r)
            strange = _strange(estimate, state["score"])
        return self._advance(estimate, state, strange)

    def _solve(self, images: list[Tensor], pose: Tensor) -> Estimate:
        """Coarse to fine; ``images`` holds one frame and grows to as many levels as there are. What a level has found
        is kept only if it looks better to the next finer one than its start: fine texture is not there in a coarse
        level, which then leads anywhere."""
        images[:] = image_pyramid(images[0].float(), self.levels) if self.levels > 1 else images
        for level in range(self.levels - 1, 0, -1):
            scale, budget = pose.new_tensor((2.0**level, 2.0**level, 1.0)), self.settings.max_iterations
            state = State.start(self.references[level], pose / scale)
            state = stage(self.references[level], images[level], state, "bilinear", COARSE_TOLERANCE, budget)
            double, finer = pose.new_tensor((2.0, 2.0, 1.0)), (self.references[level - 1], images[level - 1])
            better = detrended_zncc_at(*finer, state.pose * double) > detrended_zncc_at(*finer, pose / scale * double)
            pose = torch.where(better[:, None], state.pose * scale, pose)
        return solve(self.references[0], images[0], pose, self.settings)

    def _due(self, strange: Any) -> list[int]:
        """Which of the ``strange`` templates (R,) to search for in this frame."""
        doubted = self.doubted.tolist() if bool(strange.any()) else []
        due = [r for r, n in enumerate(doubted) if strange[r] and n % min(2 ** (n // PATIENCE), SELDOM) == 0]
        if len(due) > AT_ONCE:
            self._turn = (self._turn + AT_ONCE) % len(due)
            due = due[self._turn :] + due[: self._turn]
        return due[:NEARBY_AT_ONCE]

    def _look_near(self, image: Tensor, estimate: Estimate, start: Tensor, due: list[int]) -> Estimate:
        """Second attempt for the templates ``due``: around their ``start`` (R, 3)."""
        index = torch.tensor(due, device=self.pose.device)
        if self._nearby is None or self._nearby[0] != due:
            self._nearby = due, Nearby.of(self.references[0].select(index))
        own = image if len(image) == 1 else image[index]
        found = self._nearby[1].find(self.references[0].select(index), own, start[index], self.settings)
        known = (found.status == Status.CONVERGED) & within_margin(found.score, self.score[index])
        return estimate.put(index[known], found.at(known))

    def _search(self, images: list[Tensor], estimate: Estimate, r: int) -> Estimate:
        """Third attempt for template ``r``: anywhere in the frame, of places that look alike the nearest."""
        locator = self._locators.get(r)
        if locator is None:
            if len(self._locators) >= AT_ONCE:
                del self._locators[next(iter(self._locators))]
            one = self.references[0].select(torch.tensor([r], device=self.pose.device))
            locator = Locator(
                one, (images[0].shape[-2], images[0].shape[-1]), replace(self.settings, min_visible=LEAST_VISIBLE)
            )
            self._locators[r] = locator
        images += image_pyramid(images[-1], locator.levels - len(images) + 1)[1:]
        own = [image if len(image) == 1 else image[r : r + 1] for image in images]
        found, score = locator.candidates(own, 0, self.pose[r])
        if found.status[0] != Status.CONVERGED or score[0] < FAMILIAR * self.score[r]:
            return estimate
        if Status.good(estimate.status[r]) and within_margin(estimate.score[r], found.score[0]):
            return estimate
        best = found._replace(pose=torch.cat((found.pose[:, :2], unwrap(found.pose[:, 2:], self.pose[r, 2])), -1))
        index = torch.tensor([r], device=self.pose.device)
        return estimate.put(index, best.at(index.new_zeros(1)))

    def _advance(self, estimate: Estimate, state: dict[str, Any], strange: Any) -> Estimate:
        """One frame on: the next state, and the ``estimate`` with the last good pose of what was not found."""
        last, score, good = state["pose"], state["score"], Status.good(on_host(estimate.status))
        xp, known = library(last), good[:, None]
        pose = xp.where(known, on_host(estimate.pose), last)
        if self.prediction == "velocity":
            # The last step in the template's own axes: exact for a constant turn about any point of the stage.
            state["velocity"] = xp.where(known & state["tracked"][:, None], compose(inverse(last), pose), 0.0)
        usual = xp.where(good, score + MEMORY * (on_host(estimate.score) - score), score)
        state |= {"pose": pose, "score": usual, "tracked": good, "doubted": xp.where(strange, state["doubted"] + 1, 0)}
        self._buffers.update({name: torch.as_tensor(value) for name, value in state.items()})
        kept, moved = torch.as_tensor(pose).clone(), torch.as_tensor(pose - state["start"])
        return estimate._replace(pose=kept, displacement=moved)


def _strange(estimate: Estimate, usual: Any) -> Any:
    """Templates that were not found, or look less like themselves than usual: perhaps a wrong place, (R,) bool."""
    return ~(Status.good(on_host(estimate.status)) & within_margin(on_host(estimate.score), usual))


def expected_score(reference: Reference) -> Tensor:
    """The correlation (B,) of two images of the same template with the noise that the template seems to have."""
    _, norm = centred(reference.signal[:, 3], reference.weight)
    return (1 - reference.noise.square() * reference.weight.sum(-1) / norm.square()).clamp(min=0.0)


def _check_levels(levels: int, size: tuple[int, int]) -> None:
    most = max((min(size) // SMALLEST_COARSE).bit_length(), 1)
    if not isinstance(levels, int) or not 1 <= levels <= most:
        raise ValueError(f"levels: expected 1 to {most} for templates of {size[1]}x{size[0]} px, got {levels}")


def _words(shape: tuple[int, ...]) -> str:
    return f"{shape[0]} image{'s' if shape[0] > 1 else ''} of {shape[3]}x{shape[2]} px"
