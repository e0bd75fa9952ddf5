"""Align templates with images: the whole solve as one pure function."""

from __future__ import annotations

from functools import partial
from operator import attrgetter

import torch
from torch import Tensor

from torch_ecc.core import fused, implicit, robust, sight, solver
from torch_ecc.core.ambient import plain, threads_for
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.frame import as_image, require_tensor
from torch_ecc.core.native import engine as native
from torch_ecc.core.pushed import Push
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Engine, Solution
from torch_ecc.core.verdict import judge


@plain
def align(
    reference: Reference,
    image: Tensor,
    pose: Tensor,
    **options: str | float | bool,
) -> Estimate:
    """Poses of B prepared templates in their images: (B or 1, 1, H, W), start (B, 3) px, px, rad -> Estimate.

    One image serves all templates without copies. ``displacement`` counts from the start pose, which failed elements
    keep. ``options``: ``interpolation``, ``max_iterations``, ``tolerance``, ``min_score`` ... as in settings.Settings.
    Of images, templates or starts that require grad, poses, scores, covariances and residuals carry gradients
    (``core.implicit``). Raises ValueError for bad shapes, dtypes, devices, NaN and unknown options.
    """
    if not isinstance(reference, Reference):
        raise ValueError(f"align: reference must come from prepare, got {type(reference).__name__}")
    settings: Settings = settings_of("align", options)
    if torch.compiler.is_compiling():
        return _align(reference, image, pose, settings)
    with threads_for(len(reference.K) * reference.K.shape[2]):
        return _align(reference, image, pose, settings)


def _align(reference: Reference, image: Tensor, pose: Tensor, settings: Settings) -> Estimate:
    gray = as_image("align", "image", image)
    pose = require_tensor("align", "pose", pose)
    b, device = len(reference.K), reference.K.device
    if pose.shape != (b, 3):
        raise ValueError(f"align: pose must be ({b}, 3), one per template, got {tuple(pose.shape)}")
    if len(gray) not in (1, b):
        raise ValueError(f"align: image must be one or one per template ({b}), got a batch of {len(gray)}")
    for name, value in (("image", gray), ("pose", pose)):
        if value.device != device:
            raise ValueError(f"align: {name} must be on the reference's device {device}, got {value.device}")
    if not (pose.is_floating_point() and (torch.compiler.is_compiling() or bool(pose.isfinite().all()))):
        raise ValueError(f"align: pose must hold finite floating-point numbers, got {pose.dtype} {pose.tolist()}")
    return solve(reference, gray, pose.to(reference.place.radius.dtype), settings)


def settings_of(where: str, options: dict[str, str | float | bool]) -> Settings:
    """A function's settings, a constant to torch.compile."""
    return Settings.of(where, options)


# All that torch.compiler.assume_constant_result does; but that imports torch.compile first, which takes half a second.
settings_of._dynamo_marked_constant = True  # type: ignore[attr-defined]


def solve(
    reference: Reference,
    image: Tensor,
    pose: Tensor,
    settings: Settings,
    origin: Tensor | None = None,
) -> Estimate:
    """``align`` without its checks: an image of ``as_image``, poses (B, 3) of the reference's pose dtype; ``origin``:
    what displacements count from, by default the ``pose``."""
    return solve_again(reference, image, pose, settings, origin)[0]


def solve_again(
    reference: Reference,
    image: Tensor,
    pose: Tensor,
    settings: Settings,
    origin: Tensor | None = None,
    memory: robust.Memory | None = None,
) -> tuple[Estimate, Solution]:
    """The same with a ``memory`` of the frames before; and what it is judged from."""
    push = None  # which would make half as much again of a graph
    if not torch.compiler.is_compiling():
        engine = partial(engine_for, reference, image, settings)
        push = Push(engine, reference, image, settings, None if memory is None else memory.answered)
    if not implicit.wanted(reference, image, pose):
        there = found(reference, image, pose, settings, memory)
        return judge(reference, there, pose, settings, origin, push), there
    with torch.no_grad():
        there = found(reference, image.detach(), pose.detach(), settings, memory)
    seen, attached = implicit.attached(reference, image, pose, there, settings)
    estimate = judge(seen, attached, pose, settings, origin, push)
    return without_gradients(estimate, seen, attached, pose, settings), there


def without_gradients(
    estimate: Estimate, reference: Reference, found: Solution, pose: Tensor, settings: Settings
) -> Estimate:
    """The ``estimate``, in which templates whose patch has shown nothing have no part in a gradient: it would be 0, but
    by way of infinity times 0. An accelerator goes that way, unless torch looks out for such, since it cannot wait."""
    there = implicit.shown(found)
    if not (is_cpu(pose.device) or torch.is_anomaly_enabled()) or bool(there.all()):
        return estimate
    some, names = there.nonzero()[:, 0], ("score", "covariance", "residual_rms")
    none = found.gain[some[:0]].sum()  # 0, with a gradient: so it is if nothing has shown anything
    values = [value.detach() + none for value in attrgetter(*names)(estimate)]
    if len(some):
        of_some = judge(reference.select(some), each(lambda value: value[some], found), pose[some], settings)
        pairs = zip(values, attrgetter(*names)(of_some), strict=True)
        values = [value.index_copy(0, some, more) for value, more in pairs]
    return estimate._replace(**dict(zip(names, values, strict=True)))


def found(
    reference: Reference, image: Tensor, pose: Tensor, settings: Settings, memory: robust.Memory | None = None
) -> Solution:
    """What the engine for these B templates finds."""
    return robust.solve(engine_for(reference, image, settings), reference, image, pose, settings, memory)


def engine_for(reference: Reference, image: Tensor, settings: Settings) -> Engine:
    """The one that solves this, and sees what the camera shows."""
    fit = (engine.solve for engine in (native, fused) if engine.takes(reference, image, settings))
    engine = next(fit, solver.solve)
    return engine if reference.sight is None else partial(sight.solve, engine)
