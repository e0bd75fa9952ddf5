"""What a camera shows: where a mark fixed to it is seen, as an aperture, a stripe or dust, a template tells nothing.

Blocks of a template that come to lie under such a mark are out of sight, as those beyond the frame's border: they do
not count, and are no reason to doubt the others.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.frame import PIXEL_DTYPES, require_tensor
from torch_ecc.core.grid import BLOCK
from torch_ecc.core.reference import Reference, Sight, each
from torch_ecc.core.sampling import is_cpu
from torch_ecc.core.settings import Settings
from torch_ecc.core.solution import Engine, Solution, Trust

AROUND = 3  # px around a mark on which it bears by way of the sampler and the gradients
REACH = AROUND + BLOCK // 2  # px, in x and y each, from the middle of a block that it bears on
SLACK = 1  # px by which the expected place may be wrong without a second solve
FEW = 0.8  # of the blocks in sight: if so few of them have counted, there is a second one too


def as_frame_mask(where: str, mask: object, size: tuple[int, int]) -> Tensor:
    """Where a frame of ``size`` (H, W) shows the scene, (H, W) bool: True or > 0 in the ``mask``. ValueError if that is
    something else, or nowhere."""
    mask = require_tensor(where, "frame_mask", mask)
    if mask.shape != size:
        raise ValueError(f"{where}: frame_mask must be {size}, as the frame, got {tuple(mask.shape)}")
    if mask.dtype not in PIXEL_DTYPES:
        raise ValueError(f"{where}: frame_mask must be of bool, integers or float, got {mask.dtype}")
    if mask.is_floating_point() and not mask.isfinite().all():
        raise ValueError(f"{where}: frame_mask must be finite, got NaN or infinite values")
    shown = mask.bool() if mask.dtype == torch.bool else mask > 0
    if not shown.any():
        raise ValueError(f"{where}: frame_mask must show the scene somewhere, True or > 0, got nothing but 0")
    return shown.clone()


def eroded(shown: Tensor, reach: int = AROUND) -> Tensor:
    """Pixels (H, W) with nothing that is not ``shown`` (H, W) within ``reach`` px in x and y. Beyond the border nothing
    is known to hide anything."""
    clear = F.pad(shown, (reach,) * 4, value=True)
    for axis in (0, 1):
        done = 1
        while done < 2 * reach + 1:  # as many pixels side by side are known to be clear
            step, size = min(done, 2 * reach + 1 - done), clear.shape[axis]
            clear = clear.narrow(axis, 0, size - step) & clear.narrow(axis, step, size - step)
            done += step
    return clear


def filled(image: Tensor, shown: Tensor | None) -> Tensor:
    """An ``image`` (B, 1, H, W), float, that is as bright as on average where it is not ``shown`` (H, W): for searches,
    which compare all of it."""
    if shown is None:
        return image
    mean = (image * shown).sum((2, 3), keepdim=True) / shown.sum()
    return torch.where(shown, image, mean)


def seen_through(reference: Reference, shown: Tensor | None, heed: Tensor | None = None) -> Reference:
    """The ``reference`` as a camera sees it that shows the scene where ``shown`` (H, W), by default everywhere, to
    those templates that ``heed`` (B,), by default all."""
    if shown is None:
        return reference.through(None)
    grid = reference.grid
    row, column = (torch.arange(n, device=grid.box.device) * BLOCK + (BLOCK - 1) / 2 for n in grid.blocks)
    y, x = torch.meshgrid(row + grid.box[1, 0], column + grid.box[0, 0], indexing="ij")
    middles = torch.stack((x.flatten(), y.flatten(), torch.ones_like(x.flatten())))
    sight = Sight(shown, eroded(shown, REACH), eroded(shown, REACH + SLACK), middles)
    return reference.through(sight, heed)


def picked(clear: Tensor, warp: Tensor, points: Tensor) -> Tensor:
    """What ``clear`` (H, W) holds where the ``warp`` (B, 2, 3) puts ``points`` (3, n): (B, n). Outside, its border
    repeats."""
    h, w = clear.shape
    x, y = (warp @ points.to(warp.dtype)).nan_to_num(0.0, 0.0, 0.0).round().unbind(1)
    return clear[y.clamp(0, h - 1).long(), x.clamp(0, w - 1).long()]


def solve(
    engine: Engine, reference: Reference, image: Tensor, start: Tensor, settings: Settings, trust: Trust | None = None
) -> Solution:
    """What an ``engine`` answers with when those blocks count that are well in sight at ``start`` (B, 3); and again,
    from where that has led, of templates of which some of them are not in sight there, or many others are."""
    sight = reference.sight
    if sight is None:
        return engine(reference, image, start, settings, trust)
    which = torch.arange(len(start), device=start.device) if trust is None else trust.which
    counted = in_sight(reference, start, sight.well_clear, sight.middles)[which]
    found = without(engine(reference, image, start, settings, trusted(which, counted, trust)), counted)
    if settings.max_iterations == 1:
        return found
    there = start.index_copy(0, which, found.pose)
    clear = in_sight(reference, there, sight.clear, sight.middles)[which]
    right = (counted <= clear).all(1) & (counted.sum(1) >= FEW * clear.sum(1))
    if is_cpu(start.device) and bool(right.all()):
        return found
    clear = torch.where(right[:, None], counted, clear)
    again = without(engine(reference, image, there, settings, trusted(which, clear, trust)), clear)
    return each(lambda old, new: torch.where(right.view(-1, *[1] * (old.dim() - 1)), old, new), found, again)


def in_sight(reference: Reference, pose: Tensor, clear: Tensor, middles: Tensor) -> Tensor:
    """Which blocks with ``middles`` (3, blocks) of templates at ``pose`` (B, 3) see what is ``clear`` (H, W), or need
    not: (B, blocks)."""
    seen = picked(clear, reference.warps(pose), middles)
    return seen if reference.heed is None else seen | ~reference.heed[:, None]


def trusted(which: Tensor, clear: Tensor, trust: Trust | None) -> Trust | None:
    """The ``trust`` in the templates at ``which`` (n,) of which ``clear`` blocks (n, blocks) alone are in sight; None
    if the host knows that it is whole."""
    if trust is None and is_cpu(clear.device) and bool(clear.all()):
        return None
    trust = trust or Trust(which, None)
    return trust._replace(blocks=clear.float() if trust.blocks is None else trust.blocks * clear)


def without(found: Solution, clear: Tensor) -> Solution:
    """The solution with nothing in the sums of blocks that are not ``clear`` (n, blocks)."""
    return found._replace(sums=torch.where(clear[:, None], found.sums, 0.0))
