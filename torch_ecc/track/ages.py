"""Where images of different ages of a surface that changes lie to each other: all of them at once, by likelihood.

Of two images alone only so much can be told: what is new in one could, by chance, look like a shift. Of several, what
is new in one is what the next one has already, and if they lie right nearly all of each is explained by the others.
Then their covariance over the pixels, C (n, n), has the least determinant: maximum likelihood of a Gaussian process
over time, whose covariance nobody knows. With x_i what image i shows, and G_i its slopes, the steps d_i by which they
are off fulfil

    sum over i of C^-1_ij <x_i, G_j>  =  sum over i of C^-1_ij <G_i, G_j> (d_i - d_j),

the adjustment of a network in which any two images hold each other by what they have in common beyond the others.

Coarse texture may change at other times than fine: C is that of a cell of few frequencies, and the equations of all
cells are added. How they disagree tells how exact the steps are.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.normal import LEAST
from torch_ecc.core.pose import pose_dtype
from torch_ecc.core.sampling import gradients

BAND = 8  # frequencies in x and in y of a cell
SMOOTH = 7  # frequencies in x and y over which a spectrum is averaged, to tell texture from noise
SHAPE = 31  # over which what is texture is, to have its shape alone: cells weigh themselves
DARKEST = 1e-4  # of a spectrum's largest value: no frequency counts as if there were less
EDGE = 9  # px: over so many what counts is averaged, so that it ends softly
FAINT = 0.05  # of full weight is what counts at least
POOR = 0.02  # of the mean power: cells with less tell nothing
OWN = 1e-5  # of what an image has in a cell no other explains


class Places(NamedTuple):
    """Of n images: the ``step`` (B, n, 3) by which each is off, px, px, rad in the template's axes, and its
    ``covariance`` (B, n, 3, 3), both zero for the first one, which is right, and without it; by how much any two are
    ``alike`` (B, n, n), a correlation."""

    step: Tensor
    covariance: Tensor
    alike: Tensor


class Cells(NamedTuple):
    """Of i by j cells with m values each: what n images show, ``x`` (B, i, j, n, m), their slopes, ``g``
    (B, i, j, 3 n, m), and how many of the values are independent, ``counts`` (B, i, j), 0 where they tell nothing."""

    x: Tensor
    g: Tensor
    counts: Tensor

    @staticmethod
    def of(spectra: Tensor, window: Tensor) -> Cells:
        """Of ``spectra`` (B, 4 n, h', w') of images in a ``window`` (B, 1, h, w); real and imaginary parts."""
        parts = spectra.unflatten(3, (-1, BAND)).unflatten(2, (-1, BAND)).permute(0, 2, 4, 1, 3, 5)
        values = torch.view_as_real(parts).flatten(4).to(pose_dtype(spectra.device))
        n = spectra.shape[1] // 4
        x, g = values.split((n, 3 * n), 3)
        power = x.square().sum((3, 4))
        independent = x.shape[4] * window.square().mean((1, 2, 3)).to(power)[:, None, None]
        return Cells(x, g, independent * (power > POOR * power.mean((1, 2), keepdim=True)))


def placed(images: Tensor, there: Tensor, noise: Tensor, counted: Tensor, centre: Tensor) -> Places:
    """``images`` (B, n, h, w), from the oldest to the newest, of which some are ``there`` (B, n) bool, with white
    ``noise`` of that variance (B,); ``counted`` (B, 1, h, w): by how much pixels count; ``centre`` (B, 2): what they
    turn about, from their middle.

    A step is right to first order, and too short where images are far off: put right, they are to be placed again.
    """
    window = inner(counted)
    shown, slopes = windowed(images, there, window, centre)
    power = noise * window.square().sum((1, 2, 3)) * there.sum(1)
    cells = Cells.of(whitened(shown, slopes, power), window)
    C = cells.x @ cells.x.mT
    step, covariance = adjusted(cells, C, there)
    total = C.sum((1, 2))
    scale = total.diagonal(dim1=1, dim2=2).clamp(min=LEAST).rsqrt()
    return Places(step, covariance, total * scale[:, :, None] * scale[:, None])


def inner(counted: Tensor) -> Tensor:
    """By how much pixels count (B, 1, h, w), less and less towards where they do not."""
    near = averaged(F.pad(counted, (EDGE // 2,) * 4), EDGE)
    return counted * (2 * near / near.amax((2, 3), keepdim=True).clamp(min=LEAST) - 1).clamp(min=FAINT)


def averaged(image: Tensor, side: int) -> Tensor:
    """Means of ``image`` (B, 1, h, w) over squares of a ``side``."""
    return F.avg_pool2d(F.avg_pool2d(image, (side, 1), 1), (1, side), 1)


def windowed(images: Tensor, there: Tensor, window: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """What ``images`` (B, n, h, w) show, and their slopes by x, y and theta, (B, 3 n, h, w), off planes and in a
    ``window`` (B, 1, h, w); zero for those that are not ``there``."""
    B, n, h, w = images.shape
    y, x = torch.meshgrid(*(torch.arange(k, device=images.device) - (k - 1) / 2 for k in (h, w)), indexing="ij")
    gx, gy = gradients(images.flatten(0, 1)[:, None]).unflatten(0, (B, n)).unbind(2)
    x_, y_ = (v - c[:, None, None, None].to(images) for v, c in zip((x, y), centre.unbind(1), strict=True))
    slopes = torch.stack((gx, gy, gx * y_ - gy * x_), 2).flatten(1, 2)
    values, weight = torch.cat((images, slopes), 1).flatten(2), window.flatten(2)
    planes = torch.stack((torch.ones_like(x), 2 * x / w, 2 * y / h)).flatten(1).expand(B, 3, -1)
    inverse, _ = safe_inverse((planes * weight) @ planes.mT)
    values = (values - (values * weight) @ planes.mT @ inverse @ planes) * weight
    kept = torch.cat((there, there.repeat_interleave(3, 1)), 1)
    shown, slopes = (values * kept[:, :, None]).unflatten(2, (h, w)).split((n, 3 * n), 1)
    return shown, slopes


def whitened(shown: Tensor, slopes: Tensor, noise: Tensor) -> Tensor:
    """The spectra of both (B, 4 n, h', w'), half a plane of whole cells, in which every frequency counts as much as it
    is texture, not ``noise``, of that power (B,)."""
    h, w = (-(-k // (2 * BAND)) * 2 * BAND for k in shown.shape[2:])
    power = torch.fft.fft2(shown, s=(h, w)).abs().square().sum(1, keepdim=True)
    near, shape = (averaged(F.pad(power, (side // 2,) * 4, mode="circular"), side) for side in (SMOOTH, SHAPE))
    floor = (DARKEST * near.amax((2, 3), keepdim=True)).clamp(min=LEAST)
    texture = (1 - noise.to(power)[:, None, None, None] / near.maximum(floor)).clamp(min=0)
    response = (texture / shape.maximum(floor)).sqrt()
    spectra: Tensor = torch.fft.rfft2(torch.cat((shown, slopes), 1), s=(h, w)) * response[..., : w // 2 + 1]
    return spectra[..., : w // 2]


def adjusted(cells: Cells, C: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Steps (B, n, 3) and covariances (B, n, 3, 3) of images, those that are ``there`` (B, n) bool, from ``cells`` and
    their covariances ``C`` (B, i, j, n, n)."""
    x, g, counts = cells
    n = x.shape[3]
    own = OWN * C.diagonal(dim1=3, dim2=4) + (~there[:, None, None] | (counts == 0)[..., None])
    hold = -torch.linalg.inv_ex(C + torch.diag_embed(own))[0] * counts[..., None, None]
    cross = (x @ g.mT).unflatten(4, (n, 3))
    cross = (cross - cross.transpose(3, 4)) / 2  # what the window cuts off is the same for both
    pull = -(hold[..., None] * cross).sum(3).flatten(3)  # (B, i, j, 3 n)
    edges = (g @ g.mT) * hold.repeat_interleave(3, 3).repeat_interleave(3, 4)
    edges = (edges + edges.mT) / 2
    free = (there & there[:, :1] & (torch.arange(n, device=x.device) > 0)).repeat_interleave(3, 1)
    both, one = free[:, :, None] & free[:, None], torch.eye(3 * n, dtype=x.dtype, device=x.device)
    inverse = torch.linalg.inv_ex(torch.where(both, network(edges.sum((1, 2))), one))[0]
    step = torch.where(free, (inverse @ pull.sum((1, 2))[:, :, None])[:, :, 0], 0.0)
    left = (pull - (network(edges) @ step[:, None, None, :, None])[..., 0]) * free[:, None, None]
    return step.unflatten(1, (n, 3)), spread(inverse * both, left)


def network(edges: Tensor) -> Tensor:
    """The matrix (..., 3 n, 3 n) of equations of a network with ``edges`` (..., 3 n, 3 n), blocks of 3 by 3 by which
    two images hold each other."""
    n = edges.shape[-1] // 3
    same = torch.eye(n, dtype=torch.bool, device=edges.device).repeat_interleave(3, 0).repeat_interleave(3, 1)
    edges = edges.masked_fill(same, 0.0)
    own = edges.unflatten(-1, (n, 3)).sum(-2)
    matrix: Tensor = torch.cat([own] * n, -1) * same - edges
    return matrix


def spread(inverse: Tensor, left: Tensor) -> Tensor:
    """Covariances (B, n, 3, 3) of steps: the ``inverse`` (B, 3 n, 3 n) of the equations, or, of a component in which
    that makes more, by what is ``left`` (B, i, j, 3 n) of those of cells, or rows or columns of them: an edge has
    frequencies along a line."""
    plain = blocks(inverse)
    most = plain.diagonal(dim1=2, dim2=3)
    for own in (left.flatten(1, 2), left.sum(1), left.sum(2)):
        count = (own != 0).any(2).sum(1).clamp(min=2).to(own)[:, None, None]
        robust = blocks(inverse @ (own.mT @ own) @ inverse) * (count / (count - 1))[..., None]
        most = torch.maximum(most, robust.diagonal(dim1=2, dim2=3))
    wider = (most / plain.diagonal(dim1=2, dim2=3).clamp(min=LEAST)).sqrt()
    return plain * wider[..., None] * wider[..., None, :]


def blocks(matrix: Tensor) -> Tensor:
    """Those (B, n, 3, 3) on the diagonal of a ``matrix`` (B, 3 n, 3 n)."""
    n = matrix.shape[1] // 3
    parts: Tensor = matrix.unflatten(2, (n, 3)).unflatten(1, (n, 3)).diagonal(dim1=1, dim2=3)
    return parts.permute(0, 3, 1, 2)
