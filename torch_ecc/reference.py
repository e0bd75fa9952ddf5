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
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.criteria import Criterion, centred, make_criterion
from torch_ecc.frame import as_gray, as_mask, require_tensor
from torch_ecc.pose import pose_dtype
from torch_ecc.sampling import aliasing, blur, gradients, noise_level, pad

INSTRUMENT_BLUR = 0.9  # px; 0.7 to 1 serve alike
NEARBY = 4.0  # px: Gaussian window in which the texture of a template is told from its noise
CERTAIN = 1.3  # times the noise's power in that window: by chance alone it is not more
ALIASING = ("bilinear", "bspline3")  # samplers whose own error counts; that of bspline5 does not
MARGIN = 8  # px that a template is continued by before it is differentiated and blurred
LEAST_NOISE = 1e-3  # of the template's contrast: texture weaker than that fixes nothing, however clean the image
ENOUGH = 3000  # pixels of a template tell well where to go; the first iterations leave out others in x and y
SPARSEST = 4  # px between those that are kept
BLOCK = 6  # px: side of the blocks over which residuals are taken to cling together
SMALLEST = 5  # px: side of the smallest template


class Reference(NamedTuple):
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

    For the first iterations: ``sparse`` (n,), pixels on a coarser grid; ``K_sparse`` (B, p, n), made from them alone.
    """

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

    @property
    def lever(self) -> Tensor:
        """What turns an increment into px at the farthest pixel, (B, 3)."""
        one = torch.ones_like(self.radius)
        return torch.stack((one, one, self.radius), -1)

    @property
    def uv(self) -> Tensor:
        """Pixel positions about the centre over half the bounding box, (B, 2, N): the light columns' coordinates."""
        half = (self.box[:2, 2] - self.box[:2, 0]).clamp(min=1.0) / 2
        return (self.pixels[:2] - self.centre[:, :, None]) / half[:, None]

    @property
    def thin(self) -> Reference:
        """The same templates on their ``sparse`` pixels: all that it takes to come near."""
        if len(self.sparse) == self.K.shape[-1]:
            return self
        pixelwise = ("pixels", "block", "signal", "instrument", "trust", "weight")
        some = {name: getattr(self, name)[..., self.sparse] for name in pixelwise}
        return self._replace(**some, sparse=torch.arange(len(self.sparse), device=self.K.device), K=self.K_sparse)

    def select(self, index: Tensor) -> Reference:
        """The reference of the templates at ``index`` (n,)."""
        if len(index) == len(self.K):
            return self
        shared = {"criterion", "pixels", "box", "block", "block_sizes", "sparse"} | (
            {"weight"} if len(self.weight) == 1 else set()
        )
        return Reference(*(v if name in shared else v[index] for name, v in self._asdict().items()))

    def map(self, function: Callable[[Tensor], Tensor]) -> Reference:
        """``function`` applied to every tensor, ``lambda t: t.to(device)`` for instance."""
        return Reference(self.criterion, *(function(v) for v in self[1:]))


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
    wide = pad(gray, MARGIN)
    inner = (slice(None), slice(None), slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    soft, noise = blur(wide, INSTRUMENT_BLUR), template_noise(gray, kept)
    slopes = gradients(soft)
    images = torch.cat((gradients(wide), wide, slopes, soft, texture_share(slopes, noise)), 1)[inner]
    centre = gray.new_zeros(len(gray), 2) if centre is None else require_tensor("prepare", "centre", centre).to(gray)
    if centre.shape != (len(gray), 2):
        raise ValueError(f"prepare: centre must be ({len(gray)}, 2), got {tuple(centre.shape)}")
    reference = _assemble(chosen, images, noise, kept, centre)
    used = (kept > 0).any(0).flatten()
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


def template_noise(gray: Tensor, kept: Tensor) -> Tensor:
    """Upper estimate (B,) of the noise of templates (B, 1, h, w), grey levels, where ``kept`` > 0."""
    weight = kept.flatten(1)
    contrast = centred(gray.flatten(1), weight)[1] / weight.sum(-1).sqrt()
    return torch.maximum(noise_level(gray, kept), LEAST_NOISE * contrast)


def _assemble(criterion: Criterion, images: Tensor, noise: Tensor, kept: Tensor, centre: Tensor) -> Reference:
    """Reference from ``images`` (B, 7, h, w): d/dx, d/dy and t, the same blurred, and what of the blurred slopes is
    texture; the template's ``noise`` (B,) and weights (1 or B, 1, h, w)."""
    h, w = images.shape[-2:]
    used = (kept > 0).any(0).flatten()
    y, x = torch.meshgrid(*(torch.arange(n, device=images.device) - (n - 1) / 2 for n in (h, w)), indexing="ij")
    pixels = torch.stack((x.flatten()[used], y.flatten()[used], torch.ones_like(x.flatten()[used])))
    (left, top), (right, bottom) = pixels[:2].amin(-1).tolist(), pixels[:2].amax(-1).tolist()
    box = pixels.new_tensor([[left, right, right, left], [top, top, bottom, bottom], [1, 1, 1, 1]])
    weight = kept.flatten(1)[:, used]
    local = pixels[:2] - centre[:, :, None]
    sharp, soft, trust = images.flatten(2)[:, :, used].split((3, 3, 1), 1)
    signal, instrument = _steepest_descent(sharp, local), _steepest_descent(soft, local)
    instrument = torch.cat((instrument[:, :3] * trust, instrument[:, 3:]), 1)
    radius = (local.norm(dim=1) * (weight > 0)).amax(-1).to(pose_dtype(images.device))
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
    rest = (signal, nothing, nothing, nothing, nothing, radius, sparse, signal[:, :, sparse])
    reference = Reference(criterion, *constants, *rest)
    thin = reweigh(reference.thin, weight[:, sparse] > 0)
    return reweigh(reference._replace(K_sparse=thin.K), weight > 0)


def _steepest_descent(image: Tensor, local: Tensor) -> Tensor:
    """[G, t] (B, 4, N) from [d/dx, d/dy, t] (B, 3, N): eq. (8) at theta = 0 gives dW/dtheta = (y', -x')."""
    gx, gy, t = image.unbind(1)
    return torch.stack((gx, gy, gx * local[:, 1] - gy * local[:, 0], t), 1)


def texture_share(gradient: Tensor, noise: Tensor) -> Tensor:
    """How much of the blurred ``gradient`` (B, 2, h, w) is texture, not ``noise`` (B,), near each pixel: (B, 1, h, w).

    The factor S / (S + N / 2) that makes the scatter of two equally noisy images least, from the gradient's power
    nearby. Where a template is flat its gradient is all noise, which as an instrument would only add scatter.
    """
    floor = 2 * noise_response()[1] * noise.to(gradient.dtype).square()[:, None, None, None]
    power = (blur(gradient.square().sum(1, keepdim=True), NEARBY) - CERTAIN * floor).clamp(min=0)
    return power / (power + floor / 2).clamp(min=1e-30)


def reweigh(reference: Reference, seen: Tensor) -> Reference:
    """The reference of which only the pixels ``seen`` (1 or B, N), bool, count: new weight, K and covariance terms."""
    weight = reference.weight * seen
    uv = reference.uv
    R, Z = (reference.criterion.columns(v, uv) for v in (reference.signal, reference.instrument))
    ZW = Z * weight[:, None]
    dtype = reference.radius.dtype
    normal, power = (ZW @ R.mT).to(dtype), (ZW @ ZW.mT).to(dtype)
    inverse, regular = safe_inverse(normal)
    others, _ = safe_inverse(normal[:, 3:, 3:])
    project = torch.eye(3, dtype=dtype, device=weight.device).expand(len(R), 3, 3)
    project = torch.cat((project, -normal[:, :3, 3:] @ others), -1)
    slope = (project @ normal)[:, :, :3] * regular[:, None, None]
    inflation = _noise_slope(reference, weight * reference.trust) * noise_response()[0]
    return reference._replace(
        weight=weight,
        K=(inverse @ ZW.to(dtype)).to(R.dtype),
        slope=slope,
        spread=project @ power @ project.mT,
        inflation=inflation,
        spread_noise=_noise_slope(reference, (weight * reference.trust).square()) * noise_response()[1],
        noise_share=_largest_share(slope, inflation),
    )


def _largest_share(slope: Tensor, inflation: Tensor) -> Tensor:
    """Largest eigenvalue of slope^-1 inflation, (B,), infinite where the slope is singular.

    By a high power of the matrix, to 7 % from above, which an eigenvalue solver would not do without synchronising.
    """
    inverse, regular = safe_inverse(slope)
    share = inverse @ inflation
    scale = share.abs().amax((-2, -1), keepdim=True).clamp(min=1e-30)
    power = torch.linalg.matrix_power(share / scale, 16).diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.where(regular & (power > 0), power.clamp(min=0) ** (1 / 16) * scale[:, 0, 0], torch.inf)


def safe_inverse(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse (B, n, n), zero where ``matrix`` is singular to float32, and whether it is regular, (B,) bool.

    Rows and columns are brought to unit diagonal first: the columns' units differ by orders of magnitude.
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.abs().clamp(min=1e-30).rsqrt()
    unit = matrix * scale[:, :, None] * scale[:, None, :]
    inverse, _ = torch.linalg.inv_ex(unit)
    regular = (inverse.abs().sum((-2, -1)) < 1e6) & (diagonal > 0).all(-1)  # NaN and infinity compare as singular
    inverse = torch.where(regular[:, None, None], inverse, 0.0)
    return inverse * scale[:, :, None] * scale[:, None, :], regular


def _noise_slope(reference: Reference, weight: Tensor) -> Tensor:
    """Sum over the pixels of w (dW/dp)^T dW/dp, (B, 3, 3): the shape of Z W G^T when the gradients are white noise."""
    x, y = (reference.pixels[:2] - reference.centre[:, :, None]).unbind(1)
    moments = (weight.expand_as(x), weight * x, weight * y, weight * (x * x + y * y))
    n, wx, wy, wr = (moment.sum(-1).to(reference.radius.dtype) for moment in moments)
    zero = torch.zeros_like(n)
    return torch.stack((n, zero, wy, zero, n, -wx, wy, -wx, wr), -1).reshape(-1, 3, 3)


@lru_cache(maxsize=1)
def noise_response() -> tuple[float, float]:
    """Of the x derivative of white noise of unit variance: raw times blurred, and blurred squared, on average."""
    impulse = torch.zeros(1, 1, 33, 33)
    impulse[..., 16, 16] = 1.0
    raw, blurred = gradients(impulse)[:, 0], gradients(blur(impulse, INSTRUMENT_BLUR))[:, 0]
    return float((raw * blurred).sum()), float((blurred * blurred).sum())
