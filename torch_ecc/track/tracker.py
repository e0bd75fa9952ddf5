"""The tracker: the only place with a state, the poses of R templates from frame to frame (Algorithm 1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from torch_ecc.core.ambient import lasting, plain, threads_for, unrecorded
from torch_ecc.core.criteria import Criterion, make_criterion, named
from torch_ecc.core.estimate import Estimate, Origin, Track
from torch_ecc.core.frame import as_device, as_gray, as_image, require_as_first, require_tensor
from torch_ecc.core.patches import Centers, Crop, Patches, Size, crop, locate_patches, unmarked
from torch_ecc.core.pyramid import check_levels, pyramid
from torch_ecc.core.reference import MARGIN, Reference, prepare
from torch_ecc.core.robust import Memory
from torch_ecc.core.settings import Settings
from torch_ecc.core.sight import filled, seen_through
from torch_ecc.search.locate import LEAST_VISIBLE, Located, Locator
from torch_ecc.track.advance import advanced, advanced_in_doubt, beginning, check_prediction, skipped
from torch_ecc.track.budget import DOUBTED, Budget, income
from torch_ecc.track.crowd import Crowd
from torch_ecc.track.doubt import Past, disbelieved, hopeful, suspect
from torch_ecc.track.gone import searched_first
from torch_ecc.track.lessons import Lessons, Teacher, as_rounds, begun, noise_left, renewed, told, with_new_parts
from torch_ecc.track.light import told_of_light
from torch_ecc.track.look import Look
from torch_ecc.track.lookahead import Frames, Lookahead
from torch_ecc.track.max_step import MaxStep
from torch_ecc.track.recover import Recovery, from_rest
from torch_ecc.track.sensor import dead_in, kept, shown
from torch_ecc.track.sequence import tracked
from torch_ecc.track.shutter import Shutter
from torch_ecc.track.textureless import warn_of_textureless
from torch_ecc.track.watch import Marks, Watch

DERIVED = ("references", "_unmarked", "_look", "_ahead", "_marks", "_recovery", "_crowd", "_teacher", "_version")


class Tracker(nn.Module):
    """Track x, y and theta of R templates of one frame, or of one template in each of R streams.

    ``frame``: (H, W), (C, H, W) or (1 or R, C, H, W), integers or float, with the templates at ``centers`` (R, 2) as
    (x, y) px, of ``size`` px (one number or (h, w)). ``criterion``: "ecc", "ecc_paper", "ssd" or an object
    (criteria.Criterion); ``illumination`` of "ecc": "gain" (the paper's), "linear", "quadratic"; ``interpolation``:
    "bilinear", "bspline3", "bspline5"; ``tolerance``: px at the template's corner; ``levels``: pyramid levels;
    ``prediction``: start each frame where the last one ended ("hold") or one step further ("velocity"); ``mask``: (h,
    w) or (R, h, w), True or a weight > 0 where the template counts; ``frame_mask``: (H, W), True or > 0 where the
    camera shows the scene, and not a mark of its own (aperture, stripe, dust): what of a template is there, or within
    some 3 to 6 px, is out of sight, as beyond the frame's border, or "find": what stays where it was in the first frame
    while the templates move is taken for such marks (``track.still``; a sheen that stays may be, too), which by default
    add to sigma alone unless they lead elsewhere (``track.watch``); ``device``: where everything lives (default: the
    frame's); ``min_score``: below it a template is lost; ``min_visible``: with less of its weight in sight it is out of
    view; ``robust``: blocks of pixels that do not fit, as of what covers a part of a template, count less
    (``core.robust``); ``search``: look for a template that is lost, or looks less like itself than usual, near where it
    is expected, or was last, and, if it has no plausible place, in the whole frame at any angle: in every frame at
    first, and ever more seldom the longer it stays so (every 16th frame in the end); ``search_share``: of the time,
    what searches may take at most in the long run (1: no bound); ``max_step``: (px, deg), how far a template's centre
    moves, and how far it turns, from one frame to the next at most: nothing farther is believed, nor looked at;
    ``backend``: "auto", "torch", "native" or "fused", see settings.Settings. ``average``: the templates become the mean
    of so many frames, the first one among them: less noise in dim pictures. ``renew``: they become the mean of the last
    so many frames, again and again, for surfaces that change; anchored to the first such mean, so that nothing adds up,
    and sigma tells what the anchor is still worth. Nothing is learned from frames that are not CONVERGED or are
    covered, nor where something is suddenly another. ``line_time``: seconds from the exposure of one row to the next,
    of a camera with a rolling shutter that takes ``fps`` frames per second: poses are those of the instant at which the
    row of the template's centre is exposed (``track.shutter``); in the first frame it is at rest.

    What it is, templates and poses, is in its ``state_dict``: a tracker that loads one goes on as if it were the other,
    with its own options. A state comes whole or not at all; what does not fit is refused before anything is changed.
    Every part of it keeps its identity: it is written in place, in each frame and when it is assigned to. Copies and
    pickles hold the state and make the rest anew. Raises ValueError for what does not fit.
    """

    _buffers: dict[str, Tensor]  # type: ignore[assignment]  # none of them is ever None
    template: Tensor
    mask: Tensor
    centre: Tensor
    first: Tensor
    start: Tensor
    pose: Tensor
    velocity: Tensor
    score: Tensor
    trust: Tensor
    since: Tensor
    found: Tensor
    suspect_frames: Tensor
    turn: Tensor
    credit: Tensor

    @lasting
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
        frame_mask: Tensor | str | None = None,
        device: torch.device | str | None = None,
        min_score: float = 0.5,
        min_visible: float = 0.25,
        robust: bool = True,
        search: bool = True,
        search_share: float = 0.5,
        max_step: tuple[float, float] | None = None,
        backend: str = "auto",
        average: int = 1,
        renew: int | None = None,
        line_time: float | None = None,
        fps: float | None = None,
    ) -> None:
        super().__init__()
        check_prediction(prediction)
        self.rounds, self.shutter = as_rounds(average, renew), Shutter.of(line_time, fps)
        self.settings = Settings(interpolation, max_iterations, tolerance, min_score, min_visible, robust, backend)
        self.prediction, self.search, self.criterion = prediction, search, make_criterion(criterion, illumination)
        self.max_step, self.income = MaxStep.of(max_step), income(search_share)
        gray = as_gray("Tracker", "frame", frame, as_device("Tracker", device))
        self.frame_shape, self.levels = tuple(gray.shape), levels
        self.shutter.check(gray.shape[2])
        self.dead = dead_in("Tracker", gray)
        gray = gray if self.dead is None else self.dead.repair(gray)
        self.frame_mask, self.finds_marks = shown("Tracker", frame_mask, gray), isinstance(frame_mask, str)
        patches = unmarked("Tracker", locate_patches("Tracker", gray, centers, size, mask), self.frame_mask)
        check_levels(levels, patches.size)
        self._begin(gray, patches)

    def _begin(self, gray: Tensor, patches: Patches) -> None:
        """The state before the first frame that is tracked."""
        templates, start = crop(gray, patches), torch.nn.functional.pad(patches.centers, (0, 1))
        first = kept(filled(gray, self.frame_mask))  # frame: what else in it looks like them?
        past = {**self.shutter.beginning(start), **Watch.begin(gray, start)._asdict()}
        for name, value in {**templates._asdict(), "first": first, **beginning(start), **past}.items():
            self.register_buffer(name, value)
        self._use(self._prepared(self._buffers))
        for name, value in Memory.none(self.references[0]).kept().items():
            self.register_buffer(name, value)  # score (R,), the usual one, and trust (R, blocks)
        if self.learns:
            for name, value in Lessons.begin(self.template, self.references[0].noise.level, start).items():
                self.register_buffer(name, value)
            self._use([told(self._unmarked[0], self._buffers), *self._unmarked[1:]])
        warn_of_textureless(self._recovery.textureless)

    @classmethod
    @plain
    def find(
        cls, template: Tensor, frame: Tensor, *, near: Tensor | None = None, **options: Any
    ) -> tuple[Tracker, Located]:
        """A tracker of ``template`` (h, w), (C, h, w) or (R, C, h, w), cut from some other image, that starts where
        ``locate`` finds it in ``frame``, at any angle; and what it has found, to be judged by the caller.

        Of places that look alike the one nearest to ``near`` (R, 2 or 3) is taken. ``options``: the constructor's.
        theta counts from the template's own image; ``displacement`` from where it was found.
        """
        frame_mask = options.pop("frame_mask", None)
        gray = as_gray("find", "template", template, as_device("find", options.get("device")))
        h, w = gray.shape[-2:]
        tracker = cls(gray, [((w - 1) / 2, (h - 1) / 2)] * len(gray), (h, w), **options)
        view = as_gray("find", "frame", frame, tracker.pose.device)
        tracker.dead = dead_in("find", view)
        view = view if tracker.dead is None else tracker.dead.repair(view)
        tracker.frame_mask, tracker.frame_shape = shown("find", frame_mask, view), tuple(view.shape)
        tracker.finds_marks = isinstance(frame_mask, str)
        tracker.shutter.check(view.shape[2])
        reference = seen_through(tracker._unmarked[0], tracker.frame_mask)
        settings = replace(tracker.settings, min_visible=LEAST_VISIBLE)
        located = Locator(reference, (view.shape[-2], view.shape[-1]), settings)(view, near)
        begun(tracker._buffers, located.pose)
        first = kept(filled(view, tracker.frame_mask))
        for name, value in {"first": first, **Watch.begin(view, tracker.start)._asdict()}.items():
            tracker.register_buffer(name, value)
        tracker._use(tracker._unmarked)
        return tracker, located

    @property
    def learns(self) -> bool:
        """Whether its templates may become others."""
        return self.rounds != (1, 0)

    @property
    def watches(self) -> bool:
        """Whether it looks for marks of its camera, ``track.watch``: one that exposes all rows at once."""
        return self.frame_mask is None and self.settings.robust and self.frame_shape[0] == 1 and self.shutter.line == 0

    def _prepared(self, state: Mapping[str, Tensor]) -> list[Reference]:
        """Every level of the templates in a ``state``."""
        template, mask, centre = (state[name] for name in Crop._fields)
        reference = prepare(template, criterion=self.criterion, mask=mask, centre=centre, noise=noise_left(state))
        references = pyramid(told(reference, state), self.levels)
        if len(references) < self.levels:
            raise ValueError(f"levels: expected at most {len(references)} for these templates, got {self.levels}")
        return references

    def _use(self, references: list[Reference]) -> None:
        """Goes on with ``references``, in what the camera shows."""
        self._unmarked, first, marks = references, seen_through(references[0], self.frame_mask), self.finds_marks
        self._marks = Marks.of(first, self.settings, self._buffers, marks) if self.watches else None
        self.references = [self._marks.reference if self._marks else first, *references[1:]]
        pixels, textured = math.prod(self.frame_shape), self.template.numel()
        budget = Budget(self.credit, self.turn, pixels, textured, self.income)
        self._recovery = Recovery(self.references[0], self.settings, budget, self.max_step)
        moving = self.prediction == "velocity"
        self._look = Look(self.references, self.settings, self.shutter, self._buffers, moving, self.frame_mask)
        alone = len(self.start) == 1 or self.frame_shape[0] > 1
        self._crowd = None if alone else Crowd(self.start[:, :2])
        self._ahead = Lookahead(self._look, self._viewed, self.learns, self.__dict__.get("_ahead"))
        sight = self.references[0].sight
        if self.learns:
            self._teacher = Teacher(self.criterion, self.settings.interpolation, self.rounds, sight and sight.shown)
            self._version = self.template._version

    def _learned(self, image: Tensor, estimate: Estimate, suspects: list[bool]) -> Estimate:
        """The ``estimate`` of an ``image``, from which the templates have learned."""
        state = self._buffers
        if self.learns:
            distortion = self.shutter.distortion(estimate.pose, state)
            warp = self.references[0].distorted(distortion).warps(estimate.pose)
            with torch.no_grad():
                new = self._teacher(image, warp, estimate, suspects, state)
                if len(new) > 0:
                    self._use(renewed(self._unmarked, new, state, self._prepared))
        self.shutter.remember(state, estimate)
        return estimate

    def __setattr__(self, name: str, value: Any) -> None:
        """What is assigned to a part of the state, ``tracker.pose = pose``, is written into it."""
        part = self.__dict__.get("_buffers", {}).get(name)
        if part is None:
            super().__setattr__(name, value)
        elif require_tensor("Tracker", name, value).shape != part.shape:
            raise ValueError(f"Tracker: {name} must be {tuple(part.shape)}, got {tuple(value.shape)}")
        else:
            part.copy_(value.detach())

    @lasting
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Only the device may change: poses stay float64 and pixels float32 whatever the rest of a model is cast to.
        device = fn(self.score).device
        super()._apply(lambda tensor: tensor.to(device), recurse)  # type: ignore[no-untyped-call]
        self.frame_mask = None if self.frame_mask is None else self.frame_mask.to(device)
        self.dead = None if self.dead is None else self.dead.to(device)
        self._use([reference.map(lambda tensor: tensor.to(device)) for reference in self._unmarked])
        return self

    def __getstate__(self) -> dict[str, Any]:
        """Of copies and pickles: without what follows from the state."""
        return {name: value for name, value in self.__dict__.items() if name not in DERIVED}

    @lasting
    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._buffers = {name: part.clone() if part.is_inference() else part for name, part in self._buffers.items()}
        self._use(self._prepared(self._buffers))

    def get_extra_state(self) -> dict[str, Any]:
        """What a state is of, beside its tensors: a part of ``state_dict``."""
        size = [n - 2 * MARGIN for n in self.template.shape[2:]]
        given = {"templates": len(self.template), "size": size, "frame": list(self.frame_shape), "levels": self.levels}
        return {**given, "average": self.rounds[0], "renew": self.rounds[1], "criterion": named(self.criterion)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Refuses the state of another kind of tracker."""
        for name, value in self.get_extra_state().items():
            if state.get(name) != value:
                raise ValueError(f"load_state_dict: {name} must be {value}, as this tracker's, got {state.get(name)}")

    @lasting
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        with_new_parts(state_dict, prefix)
        state = {name: state_dict.get(prefix + name) for name in (*self._buffers, "_extra_state")}
        references = self._unmarked if all(value is None for value in state.values()) else self._fitting(state)
        super()._load_from_state_dict(state_dict, prefix, *rest)
        self._use(references)

    def _fitting(self, state: dict[str, Any]) -> list[Reference]:
        """The templates of a ``state``, prepared. ValueError if it is not whole or does not fit."""
        self.set_extra_state(state["_extra_state"] or self.get_extra_state())
        missing = [name for name, value in state.items() if value is None]
        if missing:
            raise ValueError(f"load_state_dict: a tracker's state must be whole, got one without {', '.join(missing)}")
        for name, part in self._buffers.items():
            value = require_tensor("load_state_dict", name, state[name])
            if value.shape != part.shape:
                raise ValueError(f"load_state_dict: {name} must be {tuple(part.shape)}, got {tuple(value.shape)}")
            if not bool(value.isfinite().all()):
                raise ValueError(f"load_state_dict: {name} must be finite")
        return self._prepared({name: state[name].to(part) for name, part in self._buffers.items()})

    @plain
    def forward(self, frame: Tensor) -> Estimate:
        """Poses of all R templates in the next ``frame``, of the same size as the first: Estimate (R, ...).

        The frame is moved to the tracker's device. Of one that requires grad poses carry gradients (``core.implicit``),
        but for those that a search has found; the tracker's state does not. Raises ValueError for another shape, a
        wrong dtype, NaN.
        """
        follow = self._forward if self._look.own or getattr(frame, "requires_grad", True) else unrecorded(self._forward)
        with threads_for(self.template.numel()):
            return follow(frame)

    def _forward(self, frame: Tensor) -> Estimate:
        state: Any = self._buffers  # a module's attributes are slow
        seen = self._ahead(frame)
        image = self._viewed(frame) if seen is None else seen.step.image
        if self.learns and self.template._version != self._version:  # by another handle of the same state
            self._use(self._prepared(self._buffers))
        images = [image.detach()]
        self._recovery.budget.earn()
        first = self.search and not image.requires_grad and self._recovery.comes_first(state["since"])
        start, estimate, odd, gone = self._look(image, images, first, seen)
        view, past = images[0], Past.of(state)
        if gone is not None and odd is not None:
            doubted = sum(suspect(estimate, state["score"]))
            self._recovery.budget.earn(DOUBTED * doubted / len(start))
            estimate = self.max_step.kept(estimate, state)
            estimate = searched_first(self._recovery, images, estimate, start, gone, state)
            odd = odd & ~(gone & (estimate.origin != Origin.TRACKED))
        strange = None if odd is None else start.new_tensor(suspect(estimate, state["score"])) > 0
        estimate = self._past_marks(view, estimate, start, odd, None if strange is None else ~strange)
        estimate = self.max_step.kept(estimate, state)
        if self.search:
            estimate = self._recovery.not_misled(view, estimate, start, past)
        suspects = suspect(estimate, state["score"])
        if doubted := hopeful(suspects, self._recovery.hopeless, estimate):
            reference = self.references[0].distorted(self.shutter.distortion(past.pose, state))
            estimate = self.max_step.kept(from_rest(reference, images[0], estimate, past, self.settings), state)
            if self.search and gone is None:
                self._recovery.budget.earn(DOUBTED * doubted / len(start))
                estimate = self.max_step.kept(self._recovery(images, estimate, start, past), state)
            if strange is not None:  # what is strange is searched for first: it has no marks in most frames
                strange &= start.new_tensor(suspect(estimate, state["score"])) > 0
                estimate = self.max_step.kept(self._past_marks(view, estimate, start, odd, strange), state)
                estimate = self._recovery.not_misled(view, estimate, start, past, strange) if self.search else estimate
            if self.search:
                estimate = disbelieved(estimate, suspect(estimate, state["score"]), start, past, reference, images[0])
        apart = estimate if self._crowd is None else self._crowd.apart(estimate, start)
        if gone is None and not any(suspects) and apart is estimate:
            return self._learned(image, advanced(state, estimate), [False] * len(start))
        suspects = suspect(apart, state["score"])
        apart = told_of_light(apart, images[0], state, self.references[0].grid.sides)
        return self._learned(image, advanced_in_doubt(state, apart, suspects), suspects)

    def _viewed(self, frame: Tensor) -> Tensor:
        """A ``frame`` as an image. ValueError if it is none like the first one."""
        image = as_image("track", "frame", frame, self._buffers["pose"].device)
        require_as_first("track", image, self.frame_shape)
        return image if self.dead is None else self.dead.repair(image)

    def _past_marks(self, image: Tensor, estimate: Estimate, start: Tensor, *which: Tensor | None) -> Estimate:
        """The ``estimate`` without marks of the camera: see ``Marks``."""
        if self._marks is None:
            return estimate
        estimate, new = self._marks(image, estimate, start, *which)
        if new:
            self._use(self._unmarked)
        return estimate

    def track(self, frame: Tensor) -> Estimate:
        """Same as calling the tracker."""
        return self(frame)  # type: ignore[no-any-return]

    def look_ahead(self, frames: Frames) -> None:
        """The next ``frames`` (F, ...), as those of a file are there before it is their turn: one template is then
        tracked in 0.6 of the time, on a CPU. They stay as they are until the tracker is called with each of them; no
        result depends on it. Raises ValueError for such that are not there yet, as from a generator."""
        self._ahead.expect(frames)

    @torch.no_grad()
    def skip(self) -> Estimate:
        """The record (R, ...) of a frame that cannot be looked at: the last good poses, and Status.DAMAGED."""
        self.shutter.wait(self._buffers)
        return skipped(self._buffers)

    @torch.no_grad()
    def expect(self, pose: Tensor, step: Tensor, which: Tensor) -> None:
        """The templates ``which`` (R,) bool are at ``pose`` (R, 3) and have moved by ``step`` (R, 3) since the frame
        before, as something else knows: there they are looked for next, and this is their last good pose."""
        state: Any = self._buffers
        for name, value in (("pose", pose), ("velocity", step)):
            state[name].copy_(torch.where(which[:, None], value, state[name]))

    def track_sequence(self, frames: Iterable[Tensor | None], *, stop_at_damage: bool = False) -> Track:
        """Poses in every frame of a sequence: Track (F, R, ...).

        A frame that is missing (None), damaged (NaN) or of another size is Status.DAMAGED, and the track goes on; with
        ``stop_at_damage`` it ends by SequenceError, with the track so far, and so it does where ``frames`` itself
        raises a ValueError or brings something else than tensors.
        """
        return tracked(self.track, self.skip, self.look_ahead, frames, stop_at_damage)
