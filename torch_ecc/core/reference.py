"""Prepare once: everything about a template that stays constant while it is tracked (Algorithm 1, line 4).

The columns R of a criterion become one matrix by the oblique (instrumental-variable) pseudo-inverse

    K = (Z W R^T)^-1 Z W,        W the weights, Z the same columns made from the slightly blurred template.

The noise of a template is in its own gradients too. With Z = R (least squares) that inflates the Hessian and shortens
every step; blurred gradients are nearly independent of that noise and keep the step at its right length. Where the
gradients are noise alone they are left out of Z.

In an inverse compositional scheme the increment is always taken at the identity of the template's own coordinates, so
G at theta = 0 and with it K are exact for every theta of the target. (The paper calls the constant Hessian an
approximation that serves while the motion between frames is small; with eq. 10 as the update it is none.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import torch
from torch import Tensor

from torch_ecc.core.ambient import lasting, ordinary
from torch_ecc.core.blocks import Blocks, Parts, blocks_of, parts_of, patch_of
from torch_ecc.core.columns import Columns, columns_of
from torch_ecc.core.criteria import Criterion, make_criterion, safe_inverse
from torch_ecc.core.filters import pad
from torch_ecc.core.frame import as_gray, as_mask, require_tensor
from torch_ecc.core.grid import Grid, Place, grid_of, place_of
from torch_ecc.core.leverage import Leverage, leverage_of
from torch_ecc.core.noise import DIM_BLURS, INSTRUMENT_BLUR, NOISE_SHARE, Noise, blurred, template_noise
from torch_ecc.core.normal import Moments, Normal, normal_equations
from torch_ecc.core.pose import rotation
from torch_ecc.core.sampling import SAMPLERS, aliasing, gradients
from torch_ecc.core.strain import Strains, strains_of

if TYPE_CHECKING:
    from torch_ecc.core.native.packed import Packed
    from torch_ecc.core.verdict import Known

MARGIN = 8  # px that a template is continued by before it is differentiated and blurred
ENOUGH = 1500  # pixels of a template tell well where to go; the first iterations leave out others in x and y
SPARSEST = 4  # px between those that are kept
FAINT = 0.25  # px: by so much noise may move the farthest pixel in an iteration of them
PIXELS_AT_ONCE = 2**17  # of templates that are prepared together, each of which takes some 600 bytes on the way
NARROW = 8  # times the blur of its instruments: no template is as narrow
SMALLEST = 5  # px: side of the smallest template

Fields = TypeVar("Fields", bound=tuple[object, ...])


def kept(make: Callable[[Reference], Fields]) -> cached_property[Fields]:
    """What they ``make`` of a reference, once for as long as that lives; of ``copies`` it is that of the one."""

    def made(reference: Reference) -> Fields:
        return copied(once.__get__(reference.one), len(reference.K)) if reference.one else make(reference)

    once = cached_property(lasting(made))
    return once


class Sight(NamedTuple):
    """Where a camera has ``shown`` (H, W) the scene, not a mark of its own; ``clear`` (H, W), where none bears on a
    block of pixels, ``well_clear`` (H, W), nor a little off; the blocks' ``middles`` (3, blocks). See ``sight``."""

    shown: Tensor
    clear: Tensor
    well_clear: Tensor
    middles: Tensor


class _Groups(NamedTuple):
    criterion: Criterion
    grid: Grid
    place: Place
    columns: Columns
    K: Tensor
    normal: Normal
    noise: Noise
    coarse: Reference | None
    sight: Sight | None = None
    distortion: Tensor | None = None
    heed: Tensor | None = None


class Reference(_Groups):
    """B prepared templates of N pixels under a criterion of p columns: ``K`` (B, p, N), and what else is constant.

    ``coarse``: the same templates on a coarser grid, with a K of their own, for the first iterations; None where all
    pixels are few enough. ``sight``: None where the camera has no marks. ``distortion`` D (B, 2, 2): the templates are
    seen at x = R(theta) (I + D) x' + t; None where they are seen as they are. ``heed`` (B,) bool: which of them
    the camera's marks bear on, None if they do on all.
    """

    @property
    def signal(self) -> Tensor:
        """[G, t], (B, 4, N)."""
        return self.columns.signal

    @property
    def weight(self) -> Tensor:
        """(B, N)."""
        return self.columns.weight

    @property
    def uv(self) -> Tensor:
        """The light columns' coordinates: pixel positions in ``Place.unit``, (B, 2, N)."""
        return self.place.unit @ self.grid.pixels

    @property
    def blocks(self) -> Blocks:
        """What the template has in each block, made once for as long as the reference lives."""
        return blocks_of(self) if torch.compiler.is_compiling() else self._kept_blocks

    @property
    def parts(self) -> Parts:
        """What each block adds to the normal equations: made once, if it is needed."""
        return parts_of(self) if torch.compiler.is_compiling() else self._kept_parts

    @property
    def strains(self) -> Strains:
        """What they leave if it is strained: made once, if it is needed."""
        return strains_of(self) if torch.compiler.is_compiling() else self._kept_strains

    @property
    def leverage(self) -> Leverage:
        """That of their blocks: made once, if it is needed."""
        if torch.compiler.is_compiling():
            return leverage_of(self.blocks, self.parts, self.normal)
        return self._kept_leverage

    @property
    def patch(self) -> Tensor:
        """Pixels (B,) that their texture is alike over: made once, if it is needed."""
        return patch_of(self) if torch.compiler.is_compiling() else self._kept_patch

    @cached_property
    def verdicts(self) -> dict[str, Known]:
        """What the verdict on them needs, by sampler: see ``verdict.known``."""
        return {}

    @property
    def one(self) -> Reference | None:
        """The template that these are ``copies`` of."""
        return self.__dict__.get("_one")

    _kept_blocks = kept(blocks_of)
    _kept_parts = kept(parts_of)
    _kept_strains = kept(strains_of)
    _kept_leverage = kept(lambda reference: leverage_of(reference.blocks, reference.parts, reference.normal))

    @cached_property
    @lasting
    def _kept_patch(self) -> Tensor:
        return patch_of(self) if self.one is None else self.one.patch.expand(len(self.K))

    @cached_property
    @lasting
    def packed(self) -> Packed:
        """The templates in 16 bits, for a compiled engine: made once for as long as the reference lives."""
        from torch_ecc.core.native.packed import pack  # which needs to know what a reference is

        return pack(self) if self.one is None else self.one.packed.copies(len(self.K))

    def warps(self, pose: Tensor) -> Tensor:
        """2x3 warps (B, 2, 3) that take the grid's pixels to the frame at poses (B, 3): eq. (2) about the centre."""
        turn = rotation(pose[:, 2])
        if self.distortion is not None:
            turn = turn + turn @ self.distortion.to(turn)
        return torch.cat((turn, pose[:, :2, None] - turn @ self.place.centre.to(pose.dtype)[:, :, None]), 2)

    def distorted(self, distortion: Tensor | None) -> Reference:
        """The same templates, seen with another ``distortion`` (B, 2, 2)."""
        return self._alike(coarse=self.coarse and self.coarse.distorted(distortion), distortion=distortion)

    def through(self, sight: Sight | None, heed: Tensor | None = None) -> Reference:
        """The same templates, through another camera."""
        return self._alike(sight=sight, heed=heed)

    def judged_by(self, normal: Normal) -> Reference:
        """The same templates with ``normal`` equations that have the same numbers, and gradients."""
        return self._alike(normal=normal)

    def _alike(self, **changes: object) -> Reference:
        """With ``changes`` that nothing that is made once depends on."""
        other: Reference = self._replace(**changes)  # type: ignore[arg-type]
        other.__dict__ = self.__dict__
        return other

    def select(self, index: Tensor | slice) -> Reference:
        """The reference of the templates at ``index`` (n,); of a slice without a copy."""
        if isinstance(index, Tensor) and index.tolist() == list(range(len(self.K))):
            return self
        return each(lambda v: v[index], self)

    def copies(self, count: int) -> Reference:
        """One template (B = 1) so many times, in the same memory; what is made once is made of the one."""
        if count == 1:
            return self
        many = copied(self, count)
        many.__dict__["_one"] = self
        return many

    def map(self, function: Callable[[Tensor], Tensor]) -> Reference:
        """``function`` applied to every tensor, ``lambda t: t.to(device)`` for instance."""
        return each(function, self, shared=True)


def each(function: Callable[..., Tensor], first: Fields, *others: Fields, shared: bool = False) -> Fields:
    """``function`` of the tensors at the same place in nested records; of what all share, a Grid or Sight, only if
    ``shared``: else it is that of the first, as is whatever is no tensor."""
    values: list[object] = []
    for value, *more in zip(first, *others, strict=True):
        if isinstance(value, Tensor):
            values.append(function(value, *more))
        elif isinstance(value, dict):
            values.append({name: function(v, *(m[name] for m in more)) for name, v in value.items()})
        elif isinstance(value, tuple) and hasattr(value, "_fields") and (shared or not isinstance(value, Grid | Sight)):
            values.append(each(function, value, *more, shared=shared))
        else:
            values.append(value)
    make: Callable[..., Fields] = type(first)
    return make(*values)


def copied(one: Fields, count: int) -> Fields:
    """So many times the tensors (1, ...) of a record, without copies."""
    return each(lambda value: value.expand(count, *value.shape[1:]), one)


def chosen(better: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Of B templates the ``new`` values (B, ...) where they are ``better`` (B,)."""
    return torch.where(better.view(-1, *[1] * (old.dim() - 1)), new, old)


@ordinary
def prepare(
    template: Tensor,
    *,
    criterion: str | Criterion = "ecc",
    illumination: str = "linear",
    mask: Tensor | None = None,
    centre: Tensor | None = None,
    noise: Tensor | None = None,
) -> Reference:
    """Everything constant of B templates: (B, 1, h, w), (C, h, w) or (h, w) -> Reference (eqs. 7, 8).

    ``mask``: (h, w) or (B, h, w), True or a weight > 0 where the template counts. ``centre`` (B, 2): the point that
    poses speak of, px from the middle of the array (default: the middle). ``noise`` (B,): the templates' own, grey
    levels (default: estimated, where fine texture counts as noise). Templates and masks may require grad. Raises
    ValueError for bad shapes, dtypes, NaN, unknown options and for templates of one single grey level.
    """
    criterion = make_criterion(criterion, illumination)
    gray = as_gray("prepare", "template", template)
    size = (gray.shape[-2], gray.shape[-1])
    if min(size) < SMALLEST:
        raise ValueError(f"prepare: template must be at least {SMALLEST}x{SMALLEST} px, got {size[0]}x{size[1]}")
    kept = gray.new_ones(1, 1, *size) if mask is None else as_mask("prepare", mask, len(gray), size).to(gray.device)
    _refuse_flat(gray, kept)
    centre = gray.new_zeros(len(gray), 2) if centre is None else require_tensor("prepare", "centre", centre)
    if centre.shape != (len(gray), 2):
        raise ValueError(f"prepare: centre must be ({len(gray)}, 2), got {tuple(centre.shape)}")
    centre = centre.detach().to(gray, copy=True)  # what is prepared keeps it
    noise = template_noise(gray.detach(), kept.detach(), noise)
    some, used = max(PIXELS_AT_ONCE // gray[0].numel(), 1), (kept > 0).any(0).flatten()
    given = (value.split(some) for value in (gray, kept.expand(len(gray), -1, -1, -1), centre, noise))
    whole = _joined((_prepared(criterion, part, used) for part in zip(*given, strict=True)), len(gray))
    return whole._replace(coarse=_coarser(whole))


def _joined(parts: Iterator[Reference], count: int) -> Reference:
    """One reference of ``count`` templates from those of some after the others, one part at a time."""
    first, done = next(parts), 0
    if len(first.K) == count:
        return first
    whole = each(lambda v: v.new_empty(count, *v.shape[1:]), first)
    for part in chain([first], parts):
        here = slice(done, done + len(part.K))
        each(lambda w, p, here=here: w[here].copy_(p), whole, part)
        done = here.stop
    return whole


def _refuse_flat(gray: Tensor, kept: Tensor) -> None:
    highest = torch.where(kept > 0, gray, -torch.inf).amax((1, 2, 3))
    lowest = torch.where(kept > 0, gray, torch.inf).amin((1, 2, 3))
    flat = (highest <= lowest).nonzero().flatten().tolist()
    if flat:
        raise ValueError(f"prepare: template must have texture, got one single grey level in template {flat}")


def _prepared(criterion: Criterion, given: Sequence[Tensor], used: Tensor) -> Reference:
    """``prepare`` of what is ``given``, grey templates (B, 1, h, w) with weights (B, 1, h, w), ``centre`` (B, 2) and
    noise (B,), of which the pixels ``used`` (h w,) count in any template."""
    gray, reference = given[0], _instrumented(criterion, given, used, INSTRUMENT_BLUR)
    for wider in (blur for blur in DIM_BLURS if NARROW * blur < min(gray.shape[2:])):
        share = reference.normal.noise_share * reference.noise.power
        if bool((share <= NOISE_SHARE).all()):
            break
        other = _instrumented(criterion, given, used, wider)
        better = (share > NOISE_SHARE) & (other.normal.noise_share * other.noise.power < share)
        reference = each(partial(chosen, better), other, reference)
    return reference


def _instrumented(criterion: Criterion, given: Sequence[Tensor], used: Tensor, instrument_blur: float) -> Reference:
    """The same with instruments of some blur, without a coarser one."""
    gray, kept, centre, noise = given

    def counted(images: Tensor) -> Tensor:  # (B, k, h, w) to (B, k, N)
        return images[:, :, MARGIN:-MARGIN, MARGIN:-MARGIN].flatten(2)[:, :, used]

    grid, wide = grid_of(used, gray), pad(gray, MARGIN)
    soft, slopes, wiener = blurred(wide, MARGIN, noise, instrument_blur)
    wiener = counted(wiener)
    weight = kept.flatten(1)[:, used]
    place = place_of(grid, centre, weight)
    images = (
        torch.cat((counted(slopes) * wiener, counted(soft)), 1),
        torch.cat((counted(gradients(wide)), counted(wide)), 1),
    )
    columns = columns_of(grid.pixels[:2] - centre[:, :, None], images, wiener[:, 0], weight)
    reference = _solved(criterion, grid, place, columns, Noise.of(noise, instrument_blur))
    for name, kernel in SAMPLERS.items():
        if kernel.aliases:
            shift = reference.K[:, :3] @ counted(aliasing(wide, name)).mT
            reference.noise.alias[name] = shift.to(place.radius.dtype) / 2**0.5
    return reference


def _coarser(reference: Reference) -> Reference | None:
    """The pixels on a grid coarser by a whole number, as many as tell well where to go; None if that is all of them."""
    grid, columns = reference.grid, reference.columns
    step = min(max(math.isqrt(grid.pixels.shape[1] // ENOUGH), 1), _sparsest(reference))
    if step == 1:
        return None
    column, row = (grid.pixels[:2] - grid.box[:2, :1]).long()
    kept = ((column % step == 0) & (row % step == 0)).nonzero()[:, 0]
    grid = grid._replace(pixels=grid.pixels[:, kept], block=grid.block[kept])
    signal, instrument, wiener, weight = (v[..., kept] for v in columns[:4])
    columns = Columns(signal, instrument, wiener, weight, columns.unit, columns.level)
    return _solved(reference.criterion, grid, reference.place, columns, reference.noise)


def _sparsest(reference: Reference) -> int:
    """Px between pixels of which so few still tell where to go: noise moves the farthest one by as many times more."""
    white = reference.normal.white.detach()
    shift = (2 * reference.noise.power * (white * reference.place.lever2).sum(1)).sqrt()
    most = float(torch.where(shift <= FAINT, shift, 0.0).max())  # what is not found with all pixels does not count
    return SPARSEST if most * SPARSEST <= FAINT else int(FAINT / most)


def _solved(criterion: Criterion, grid: Grid, place: Place, columns: Columns, noise: Noise) -> Reference:
    """A reference with its normal equations."""
    K, normal = _normal_equations(criterion, grid, place, columns, noise.response)
    return Reference(criterion, grid, place, columns, K, normal, noise, None)


def reweigh(reference: Reference, counted: Tensor) -> Reference:
    """The reference whose pixels count as ``counted`` (B, N), 0 to 1 or bool: new weight, K and normal equations."""
    columns = reference.columns._replace(weight=reference.columns.weight * counted)
    K, normal = _normal_equations(*reference[:3], columns, reference.noise.response)
    return reference._replace(columns=columns, K=K, normal=normal)


def restrict(reference: Reference, counted: Tensor) -> Reference:
    """``reweigh`` for the loop alone, which needs no more than K and the weights (``normal`` stays that of all pixels:
    nothing to judge by): with V by how much pixels are ``counted`` (B, N) and N = Z W R^T of all, Z W V = N (K V), so
    that K' = (N (K V) R^T)^-1 N (K V).
    """
    columns, KV = reference.columns._replace(weight=reference.weight * counted), reference.K * counted[:, None]
    R = reference.criterion.columns(reference.signal, reference.uv)
    inverse, _ = safe_inverse(reference.normal.matrix @ (KV @ R.mT).to(reference.place.radius.dtype))
    return reference._replace(columns=columns, K=(inverse @ reference.normal.matrix).to(KV.dtype) @ KV)


def _normal_equations(
    criterion: Criterion, grid: Grid, place: Place, columns: Columns, response: Tensor
) -> tuple[Tensor, Normal]:
    """K (B, p, N) and the normal equations under the columns' weights; ``response`` (B, 2): see ``Noise``."""
    weight, dtype, uv = columns.weight[:, None], place.radius.dtype, place.unit @ grid.pixels
    R, Z = (criterion.columns(v, uv) for v in (columns.signal, columns.instrument))
    ZW, t = Z * weight, columns.signal[:, 3:]
    shape = torch.cat((torch.ones_like(t), uv, t - t.mean(-1, keepdim=True)), 1).to(dtype)
    local = grid.pixels[:2] - place.centre[:, :, None]
    arms = torch.cat((torch.ones_like(t), local, local.square().sum(1, keepdim=True)), 1)
    q = weight * columns.wiener[:, None]
    sums = Moments(
        (columns.weight > 0).sum(-1).to(dtype),
        (ZW @ R.mT).to(dtype),
        (ZW @ ZW.mT).to(dtype),
        (shape * weight) @ shape.mT,
        (torch.cat((q, q * q), 1) @ arms.mT).to(dtype),
    )
    normal = normal_equations(sums, response)
    return (normal.inverse @ ZW.to(dtype)).to(R.dtype), normal
