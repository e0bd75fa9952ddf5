"""The loop, on one page: batched inverse compositional Gauss-Newton for x, y and theta (Algorithm 1, lines 7 to 10).

The whole solve in plain torch, on any device, for any criterion and sampler, inside the frame or across its border: the
reference that every other engine (``native``) is measured against. An engine answers with a ``Solution``; what it is
worth is judged in ``verdict``, once for all of them.
"""

from __future__ import annotations

from math import inf

import torch
from torch import Tensor

from torch_ecc.core.ambient import repeated
from torch_ecc.core.reference import Reference, each, restrict, reweigh
from torch_ecc.core.sampling import Sampler, inside, is_cpu, make_sampler
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Solution, Trust, counted_pixels, summed
from torch_ecc.core.step import State, advance

COARSE_TOLERANCE = 0.02  # px; the bilinear iterations only have to come near: their own bias is some 0.005 px
PIXELS_AT_ONCE = 2**18  # of templates that a CPU solves together, per thread, so that they stay in its cache


def solve(
    reference: Reference, image: Tensor, start: Tensor, settings: Settings, trust: Trust | None = None
) -> Solution:
    """Poses of B templates in (B or 1, 1, H, W) from ``start`` (B, 3) on, or of those that a ``trust`` is about; on a
    CPU in chunks that fit its cache."""
    image, blocks = image.to(reference.K.dtype), None if trust is None else trust.blocks
    if trust is not None and is_cpu(start.device):
        reference, start = reference.select(trust.which), start[trust.which]
        image = image if len(image) == 1 else image[trust.which]
    many = len(start)
    some = max(PIXELS_AT_ONCE * torch.get_num_threads() // reference.K.shape[-1], 1) if is_cpu(start.device) else many
    if many <= some:
        return solve_at_once(reference, image, start, settings, blocks)
    found = []
    for part in (slice(k, k + some) for k in range(0, many, some)):
        view, trusted = image if len(image) == 1 else image[part], None if blocks is None else blocks[part]
        found.append(solve_at_once(reference.select(part), view, start[part], settings, trusted))
    return each(lambda *values: torch.cat(values), *found)


def solve_at_once(
    reference: Reference, image: Tensor, start: Tensor, settings: Settings, trusted: Tensor | None = None
) -> Solution:
    """First bilinear on the coarser grid, to come near; then with the chosen sampler on all pixels, with the iterations
    that are left. ``trusted``: ``Trust.blocks``."""
    most, coarse, state = settings.max_iterations, reference.coarse or reference, State.start(start)
    if most > 1 and not (settings.interpolation == "bilinear" and coarse is reference):
        near = max(settings.tolerance, COARSE_TOLERANCE)
        state, _, _ = iterate(coarse, image, "bilinear", state, near, max(most * 2 // 3, 1), trusted)
    state, g, visible = iterate(reference, image, settings.interpolation, state, settings.tolerance, most, trusted)
    counted = counted_pixels(reference, visible, trusted)
    fitted = reference if counted is None else reweigh(reference, counted)
    seen = reference.weight if visible is None else reference.weight * visible
    return Solution(state.pose, state.error, state.iterations, *summed(fitted, g, seen, trusted), fitted.normal)


def iterate(
    reference: Reference,
    image: Tensor,
    interpolation: str,
    state: State,
    tolerance: float,
    most: int,
    trusted: Tensor | None = None,
) -> tuple[State, Tensor, Tensor | None]:
    """Gauss-Newton until every predicted error is below ``tolerance`` or ``most`` iterations are spent: the state, the
    last patches (B, N), and which of their pixels were in sight (B, N), None if the host knows that all were.

    An accelerator does them all, so that the host need not know: what has converged is masked.
    """
    on_cpu, warp = is_cpu(image.device), reference.warps(state.pose)
    state = state._replace(error=torch.full_like(state.error, inf))
    sample = make_sampler(interpolation, image, warp, reference.grid.box)
    g, visible = torch.zeros_like(reference.weight), None
    size = (image.shape[-2], image.shape[-1])
    if not on_cpu:

        def one_more(warp: Tensor, g: Tensor, seen: Tensor, *last: Tensor) -> tuple[Tensor, ...]:
            state = State(*last)
            busy = (state.error > tolerance) & (state.iterations < most)
            warp = torch.where(busy[:, None, None], reference.warps(state.pose), warp)  # else as it was last seen
            state, g, visible = iteration(reference, sample, state, warp, g, busy, trusted, size)
            return warp, g, torch.ones_like(seen) if visible is None else visible, *state

        _, g, visible, *last = repeated(one_more, (warp, g, g > 0, *state), most)
        return State(*last), g, visible
    for _ in range(most):
        busy = (state.error > tolerance) & (state.iterations < most)
        if not busy.any():
            break
        warp = torch.where(busy[:, None, None], reference.warps(state.pose), warp)
        sample = make_sampler(interpolation, image, warp, reference.grid.box, sample)
        state, g, visible = iteration(reference, sample, state, warp, g, busy, trusted, size)
    return state, g, visible


def iteration(
    reference: Reference,
    sample: Sampler,
    state: State,
    warp: Tensor,
    g: Tensor,
    busy: Tensor,
    trusted: Tensor | None,
    size: tuple[int, int],
) -> tuple[State, Tensor, Tensor | None]:
    """One of them, of templates that are ``busy`` (B,) and seen in the ``warp`` (B, 2, 3) of a frame of ``size``."""
    g = sample_patch(sample, warp, reference.grid.pixels, g, busy)  # I(W(p_k; x'))
    whole = is_cpu(warp.device) and inside(warp, reference.grid.box, size).all()
    visible = None if whole else inside(warp, reference.grid.pixels, size)
    counted = counted_pixels(reference, visible, trusted)
    seen = reference if counted is None else restrict(reference, counted)
    increment = seen.criterion.step(seen, g).to(state.pose.dtype)  # eq. (9)
    if counted is not None:
        increment = torch.where(seen.weight.any(1, keepdim=True), increment, torch.nan)  # nothing in sight: no step
    return advance(state, increment, reference.place.lever, busy), g, visible


def sample_patch(sample: Sampler, warp: Tensor, pixels: Tensor, last: Tensor, busy: Tensor) -> Tensor:
    """The patches (B, N) at ``warp`` (B, 2, 3); on a CPU those of templates not ``busy`` (B,) stay as they were."""
    if not is_cpu(warp.device) or busy.all():
        return sample(warp, pixels)
    index = busy.nonzero()[:, 0]
    return last.index_copy(0, index, sample.select(index)(warp[index], pixels))
