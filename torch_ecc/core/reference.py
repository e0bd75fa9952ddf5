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
from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import chain, repeat
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.criteria import Criterion, make_criterion, safe_inverse
from torch_ecc.core.frame import as_gray, as_mask, require_tensor
from torch_ecc.core.noise import (
    INSTRUMENT_BLUR,
    largest_share,
    noise_response,
    noise_slope,
    template_noise,
    texture_share,
)
from torch_ecc.core.pose import pose_dtype
from torch_ecc.core.sampling import aliasing, blur, gradients, on_host, pad

ALIASING = ("bilinear", "bspline3")  # samplers whose own error counts; that of bspline5 does not
MARGIN = 8  # px that a template is continued by before it is differentiated and blurred
ENOUGH = 1500  # pixels of a template tell well where to go; the first iterations leave out others in x and y
SPARSEST = 4  # px between those that are kept
BLOCK = 6  # px: side of the blocks over which residuals are taken to cling together
PIXELS_AT_ONCE = 2**17  # of templates that are prepared together, each of which takes some 600 bytes on the way
SMALLEST = 5  # px: side of the smallest template
PIXELWISE = ("pixels", "signal", "instrument", "trust", "weight")  # beside K; what the sparse pixels have too
NUMBERS = (  # what is not per pixel
    *("box", "centre", "radius", "noise", "alias", "slope", "spread", "inflation", "spread_noise", "noise_share"),
    *("moments", "reach"),
)
SHARED = ("criterion", "pixels", "box", "block", "block_sizes", "sparse", "pixels_sparse")  # by all templates


class _Fields(NamedTuple):
    criterion: Criterion
    pixels: Tensor
    box: Tensor
    block: Tensor
    block_sizes: Tensor
    centre: Tensor
    radius: Tensor
    noise: Tensor
    signal: Tensor
    instrument: Tensor
    trust: Tensor
    weight: Tensor
    alias: Tensor
    K: Tensor
    slope: Tensor
    spread: Tensor
    inflation: Tensor
    spread_noise: Tensor
    noise_share: Tensor
    sparse: Tensor
    K_sparse: Tensor
    pixels_sparse: Tensor
    signal_sparse: Tensor
    instrument_sparse: Tensor
    trust_sparse: Tensor
    weight_sparse: Tensor
    moments: Tensor
    unit: Tensor
    reach: Tensor


class Reference(_Fields):
    """B prepared templates of N pixels under a criterion of p columns.

    ``pixels`` (3, N) homogeneous pixel positions relative to the middle of the template array; ``box`` (3, 4) the
    corners of their bounding box; ``block`` (N,) the number of the block of neighbours that a pixel is in and
    ``block_sizes`` (blocks,) how many there are in each; ``centre`` (B, 2) the point x' = 0 in the pixels' coordinates;
    ``radius`` (B,) px from there to the farthest pixel; ``noise`` (B,) upper estimate of the template's noise, grey
    levels; ``signal`` and ``instrument`` (B, 4, N) = [G, t] raw and blurred, the blurred G times ``trust`` (B, N), see
    ``texture_share``; ``weight`` (1 or B, N); ``K`` (B, p, N).

    For the covariance: ``alias`` (B, 2, 3, 2), how far aliasing along the template's x and y shifts the pose at most,
    with the samplers ``ALIASING``; each (B, 3, 3) ``slope`` = Z W G^T and ``spread`` = Z W (Z W)^T, both off the other
    columns, ``inflation`` and ``spread_noise``, what white noise of unit variance in the template adds to each;
    ``noise_share`` (B,) is the largest part of ``slope`` that such noise can be, in any direction.

    For the first iterations: ``sparse`` (n,), pixels on a coarser grid; ``K_sparse`` (B, p, n), made from them alone,
    and what else ``PIXELWISE`` names, there. ``moments`` (B, 7): how many pixels count, the sum of their weights, their
    weighted mean, the weighted norm of what is left of them, and the square sums of the first rows of K. ``unit``
    (B, 2, 3) takes pixels to positions about the centre over half the bounding box; ``reach`` (B, 3): by how many px
    an increment of 1 in x, y, theta moves the farthest pixel.
    """

    @property
    def uv(self) -> Tensor:
        """The light columns' coordinates: pixel positions in ``unit``, (B, 2, N)."""
        return self.unit @ self.pixels

    @property
    def thin(self) -> Reference:
        """The same templates on their ``sparse`` pixels: all that it takes to come near."""
        return self if len(self.sparse) == self.K.shape[-1] else self._thin

    @property
    def at_hand(self) -> Reference:
        """The same with its ``NUMBERS`` in the poses' dtype, where the host may look at them as numpy arrays."""
        return self._at_hand if isinstance(self.radius, Tensor) else self

    @cached_property
    def _thin(self) -> Reference:
        return self._replace(**{name: getattr(self, f"{name}_sparse") for name in ("K", *PIXELWISE)})

    @cached_property
    def _at_hand(self) -> Reference:
        numbers = {name: getattr(self, name).to(self.radius.dtype) for name in NUMBERS}
        return self._replace(**{name: on_host(value) for name, value in numbers.items()})

    def select(self, index: Tensor | slice) -> Reference:
        """The reference of the templates at ``index`` (n,); of a slice without a copy."""
        if isinstance(index, Tensor) and index.tolist() == list(range(len(self.K))):
            return self
        shared = _shared(len(self.weight))
        return Reference(*(v if name in shared else v[index] for name, v in self._asdict().items()))

    def map(self, function: Callable[[Tensor], Tensor]) -> Reference:
        """``function`` applied to every tensor, ``lambda t: t.to(device)`` for instance."""
        return Reference(self.criterion, *(function(v) for v in self[1:]))


def _shared(weights: int) -> tuple[str, ...]:
    """The names of the fields that all templates have in common; the weights too if there is but one set of them."""
    return SHARED if weights > 1 else (*SHARED, "weight", "weight_sparse")


@torch.no_grad()
def prepare(
    template: Tensor,
    *,
    criterion: str | Criterion = "ecc",
    illumination: str = "linear",
    mask: Tensor | None = None,
    centre: Tensor | None = None,
) -> Reference:
    """Everything constant of B templates: (B, 1, h, w), (C, h, w) or (h, w) -> Reference (eqs. 7, 8).

    ``mask``: (h, w) or (B, h, w), True or a weight > 0 where the template counts. ``centre`` (B, 2): the point that
    poses speak of, px from the middle of the array (default: the middle). Raises ValueError for bad shapes, dtypes,
    NaN, unknown options and for templates of one single grey level.
    """
    chosen = make_criterion(criterion, illumination)
    gray = as_gray("prepare", "template", template)
    size = (gray.shape[-2], gray.shape[-1])
    if min(size) < SMALLEST:
        raise ValueError(f"prepare: template must be at least {SMALLEST}x{SMALLEST} px, got {size[0]}x{size[1]}")
    kept = gray.new_ones(1, 1, *size) if mask is None else as_mask("prepare", mask, len(gray), size).to(gray.device)
    _refuse_flat(gray, kept)
    centre = gray.new_zeros(len(gray), 2) if centre is None else require_tensor("prepare", "centre", centre).to(gray)
    if centre.shape != (len(gray), 2):
        raise ValueError(f"prepare: centre must be ({len(gray)}, 2), got {tuple(centre.shape)}")
    some, used = max(PIXELS_AT_ONCE // gray[0].numel(), 1), (kept > 0).any(0).flatten()
    parts = zip(gray.split(some), kept.split(some) if len(kept) > 1 else repeat(kept), centre.split(some), strict=False)
    return _joined((_prepared(chosen, *part, used) for part in parts), len(gray), _shared(len(kept)))


def _joined(parts: Iterator[Reference], count: int, shared: tuple[str, ...]) -> Reference:
    """One reference of ``count`` templates from those of some after the other, of which never more than one is there;
    the names of the fields that they have in common."""
    first, done = next(parts), 0
    if len(first.K) == count:
        return first
    own = {name: v.new_empty(count, *v.shape[1:]) for name, v in first._asdict().items() if name not in shared}
    for part in chain([first], parts):
        for name, values in own.items():
            values[done : done + len(part.K)] = getattr(part, name)
        done += len(part.K)
    return first._replace(**own)


def _prepared(criterion: Criterion, gray: Tensor, kept: Tensor, centre: Tensor, used: Tensor) -> Reference:
    """``prepare`` of grey templates (B, 1, h, w) with weights (1 or B, 1, h, w), of which the pixels ``used`` (h w,)
    count in any template, about ``centre`` (B, 2)."""
    wide = pad(gray, MARGIN)
    inner = (slice(None), slice(None), slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    soft, noise = blur(wide, INSTRUMENT_BLUR), template_noise(gray, kept)
    slopes = gradients(soft)
    images = torch.cat((gradients(wide), wide, slopes, soft, texture_share(slopes, noise)), 1)[inner]
    reference = _assemble(criterion, images, noise, kept, centre, used)
    wrong = torch.cat([aliasing(wide, name) for name in ALIASING], 1)[inner].flatten(2)[:, :, used]
    wrong = wrong.unflatten(1, (len(ALIASING), 2))
    return reference._replace(alias=(reference.K[:, None, :3] @ wrong.mT).to(reference.radius.dtype))


def _refuse_flat(gray: Tensor, kept: Tensor) -> None:
    infinity = gray.new_tensor(float("inf"))
    highest = torch.where(kept > 0, gray, -infinity).amax((1, 2, 3))
    lowest = torch.where(kept > 0, gray, infinity).amin((1, 2, 3))
    flat = (highest <= lowest).nonzero().flatten().tolist()
    if flat:
        raise ValueError(f"prepare: template must have texture, got one single grey level in template {flat}")


def _assemble(
    criterion: Criterion, images: Tensor, noise: Tensor, kept: Tensor, centre: Tensor, used: Tensor
) -> Reference:
    """Reference from ``images`` (B, 7, h, w): d/dx, d/dy and t, the same blurred, and what of the blurred slopes is
    texture; the template's ``noise`` (B,) and weights (1 or B, 1, h, w)."""
    h, w = images.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(n, device=images.device) - (n - 1) / 2 for n in (h, w)), indexing="ij")
    pixels = torch.stack((x.flatten()[used], y.flatten()[used], torch.ones_like(x.flatten()[used])))
    (left, top), (right, bottom) = pixels[:2].amin(-1).tolist(), pixels[:2].amax(-1).tolist()
    box = pixels.new_tensor([[left, right, right, left], [top, top, bottom, bottom], [1, 1, 1, 1]])
    weight = kept.flatten(1)[:, used]
    local = pixels[:2] - centre[:, :, None]
    sharp, soft, trust = images.flatten(2)[:, :, used].split((3, 3, 1), 1)
    signal, instrument = _steepest_descent(sharp, local), _steepest_descent(soft, local)
    instrument = torch.cat((instrument[:, :3] * trust, instrument[:, 3:]), 1)
    radius = (local.square().sum(1) * (weight > 0)).amax(-1).sqrt().to(pose_dtype(images.device))
    nothing, no_alias = radius.new_zeros(len(images), 3, 3), radius.new_zeros(len(images), len(ALIASING), 3, 2)
    column, row = ((pixels[:2] - box[:2, :1]) / BLOCK).long()
    _, block, block_sizes = torch.unique(row * w + column, return_inverse=True, return_counts=True)
    constants = (
        pixels,
        box,
        block,
        block_sizes,
        centre,
        radius,
        noise,
        signal,
        instrument,
        trust[:, 0],
        weight,
        no_alias,
    )
    column, row = (pixels[:2] - box[:2, :1]).long()
    step = min(max(math.isqrt(pixels.shape[1] // ENOUGH), 1), SPARSEST)
    sparse = ((column % step == 0) & (row % step == 0)).nonzero()[:, 0]
    kept_here = sparse if step > 1 else sparse[:0]  # all of them are the template itself
    few = [v[..., kept_here] for v in (pixels, signal, instrument, trust[:, 0], weight)]
    half = (box[:2, 2] - box[:2, 0]).clamp(min=1.0)[:, None] / 2
    unit = torch.cat((torch.eye(2).to(half).expand(len(images), 2, 2), -centre[:, :, None]), -1) / half
    reach = torch.stack((torch.ones_like(radius), torch.ones_like(radius), radius), -1)
    rest = (signal, nothing, nothing, nothing, nothing, radius, sparse, signal, *few, radius, unit, reach)
    reference = reweigh(Reference(criterion, *constants, *rest), weight > 0)
    thin = reference.thin
    return reference._replace(K_sparse=reference.K if thin is reference else reweigh(thin, thin.weight > 0).K)


def _steepest_descent(image: Tensor, local: Tensor) -> Tensor:
    """[G, t] (B, 4, N) from [d/dx, d/dy, t] (B, 3, N): eq. (8) at theta = 0 gives dW/dtheta = (y', -x')."""
    gx, gy, t = image.unbind(1)
    return torch.stack((gx, gy, gx * local[:, 1] - gy * local[:, 0], t), 1)


def reweigh(reference: Reference, seen: Tensor) -> Reference:
    """The reference of which only the pixels ``seen`` (1 or B, N), bool, count: new weight, K and covariance terms."""
    weight = reference.weight * seen
    uv = reference.uv
    R, Z = (reference.criterion.columns(v, uv) for v in (reference.signal, reference.instrument))
    ZW = Z * weight[:, None]
    t, dtype = reference.signal[:, 3], reference.radius.dtype
    total = weight.sum(-1, keepdim=True)
    level = (t * weight).sum(-1, keepdim=True) / total.clamp(min=1e-30)
    count, spread = (weight > 0).sum(-1, keepdim=True), (weight * (t - level) ** 2).sum(-1, keepdim=True).sqrt()
    normal, power = (ZW @ R.mT).to(dtype), (ZW @ ZW.mT).to(dtype)
    inverse, regular = safe_inverse(normal)
    others, _ = safe_inverse(normal[:, 3:, 3:])
    project = torch.eye(3, dtype=dtype, device=weight.device).expand(len(R), 3, 3)
    project = torch.cat((project, -normal[:, :3, 3:] @ others), -1)
    slope = (project @ normal)[:, :, :3] * regular[:, None, None]
    local = reference.pixels[:2] - reference.centre[:, :, None]
    inflation = noise_slope(local, weight * reference.trust).to(dtype) * noise_response()[0]
    K = (inverse @ ZW.to(dtype)).to(R.dtype)
    moments = [v.expand_as(level).to(dtype) for v in (count, total, level, spread)]
    return reference._replace(
        weight=weight,
        K=K,
        slope=slope,
        spread=project @ power @ project.mT,
        inflation=inflation,
        spread_noise=noise_slope(local, (weight * reference.trust).square()).to(dtype) * noise_response()[1],
        noise_share=largest_share(slope, inflation),
        moments=torch.cat([*moments, K[:, :3].square().sum(-1).to(dtype)], 1),
    )
