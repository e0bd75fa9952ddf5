"""Where images of different ages of a surface that changes lie to each other: all of them at once, by likelihood.

Of two images alone only so much can be told: what is new in one could, by chance, look like a shift. Of several, what
is new in one is what the next one has already, and if they lie right nearly all of each is explained by the others.
Then their covariance over the pixels, C (n, n), has the least determinant: maximum likelihood of a Gaussian process
over time, whose covariance nobody knows. With x_i what image i shows, and G_i its slopes, the steps d_i by which they
are off fulfil

    sum over i of C^-1_ij <x_i, G_j>  =  sum over i of C^-1_ij <G_i, G_j> (d_i - d_j),

the adjustment of a network in which any two images hold each other by what they have in common beyond the others.

Coarse texture may change at other times than fine: C is that of a cell of few frequencies, all of them counting alike,
and the equations of all cells are added. Or all of it changes evenly: then C is one, of the images as they are, and
what noise alone fills of it tells most, once there are enough of them. Both steps are taken, each as far as it is exact
(``averaged_by``), which is told by how cells, or squares of the images, disagree.

Cells take it for even over the whole image. Where one place changes after the other they take a drift for that, and all
alike: where squares have ever changed more unlike each other than chance lets them, cells are not asked any more.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.normal import LEAST
from torch_ecc.core.pose import pose_dtype
from torch_ecc.core.sampling import gradients

BAND = 8  # frequencies in x and in y of a cell
SQUARES = 4  # along an image, of which each has its own part in what all of it tells
SMOOTH = 7  # frequencies in x and y over which a spectrum is averaged, to tell texture from noise
SHAPE = 31  # over which what is texture is, to have its shape alone: cells weigh themselves
DARKEST = 1e-4  # of a spectrum's largest value: no frequency counts as if there were less
EDGE = 9  # px: over so many what counts is averaged, so that it ends softly
FAINT = 0.05  # of full weight is what counts at least
POOR = 0.02  # of the mean power: cells with less tell nothing
GUESSED = 0.5  # of its values count for a cell, whose C is known from a few of them
OWN = 1e-5  # of what an image has in a cell no other explains
UNEVEN = 6.0  # times as unevenly as what there is is what changes spread over squares: not by chance
UNASKED = 1e12  # times its covariance a step has that is none


class Places(NamedTuple):
    """Of n images: the ``step`` (B, n, 3) by which each is off, px, px, rad in the template's axes, and its
    ``covariance`` (B, n, 3, 3), both zero for the first one, which is right, and without it; by how much any two are
    ``alike`` (B, n, n), a correlation; how ``uneven`` (B,) at most what has changed of them has been, see there."""

    step: Tensor
    covariance: Tensor
    alike: Tensor
    uneven: Tensor


class Cells(NamedTuple):
    """Of i by j squares with m values each: what n images show, ``x`` (B, i, j, n, m), and their slopes, ``g``
    (B, i, j, 3 n, m); of spectra real and imaginary parts in turn."""

    x: Tensor
    g: Tensor

    @staticmethod
    def of(values: Tensor, side: int) -> Cells:
        """Of spectra or images (B, 4 n, h, w), by squares of a ``side``."""
        padded = F.pad(values, (0, -values.shape[3] % side, 0, -values.shape[2] % side))
        parts = padded.unflatten(3, (-1, side)).unflatten(2, (-1, side)).permute(0, 2, 4, 1, 3, 5)
        return Cells(*numbers(parts).flatten(4).tensor_split((values.shape[1] // 4,), 3))

    def rich(self) -> Cells:
        """Those alone that tell something."""
        power = self.x.square().sum((3, 4), keepdim=True)
        return self._replace(x=self.x * (power > POOR * power.mean((1, 2), keepdim=True)))


def numbers(values: Tensor) -> Tensor:
    """As real ones, exactly."""
    real = torch.view_as_real(values.contiguous()) if values.is_complex() else values.contiguous()
    return real.to(pose_dtype(values.device))


def hold(x: Tensor, there: Tensor, share: Tensor) -> Tensor:
    """By how much any two of n images that show ``x`` (B, i, j, n, m) hold each other, -C^-1 (B, i, j, n, n) of those
    that are ``there`` (B, n), each of its directions times how many values tell it: not more than carry it, and a
    ``share`` (B,) of these."""
    C = (x @ x.mT).nan_to_num(0.0, 0.0, 0.0)
    power = C.diagonal(dim1=3, dim2=4)
    own = OWN * power + (~there[:, None, None] | (power.sum(3, keepdim=True) == 0))
    # On the host: not every device has it, and the matrices are small.
    value, vector = (part.to(C) for part in torch.linalg.eigh((C + torch.diag_embed(own)).cpu()))
    carried = (vector.mT @ x).square().unflatten(4, (-1, 2)).sum(5)
    # Complex values of chance have E |z|^4 = 2 (E |z|^2)^2, and two parts each.
    count = 4 * carried.sum(4).square() / carried.square().sum(4).clamp(min=LEAST)
    weight = count * share.to(count)[:, None, None, None] / value
    held: Tensor = -(vector * weight[..., None, :]) @ vector.mT
    return held


def placed(images: Tensor, there: Tensor, noise: Tensor, counted: Tensor, centre: Tensor, before: Tensor) -> Places:
    """``images`` (B, n, h, w), from the oldest to the newest, of which some are ``there`` (B, n) bool, with white
    ``noise`` of that variance (B,); ``counted`` (B, 1, h, w): by how much pixels count; ``centre`` (B, 2): what they
    turn about, from their middle; ``before`` (B,): how uneven changes have been.

    A step is right to first order, and too short where images are far off: put right, they are to be placed again.
    """
    window, n = inner(counted), images.shape[1]
    shown = windowed(images, there, window, centre)
    h, w = (-(-k // (2 * BAND)) * 2 * BAND for k in shown.shape[2:])
    spectra = torch.fft.rfft2(shown, s=(h, w))[..., :-1]
    power = noise * window.square().sum((1, 2, 3)) * there.sum(1)
    even = Cells.of(spectra * response(shown[:, :n], power, (h, w)), BAND).rich()
    side = -(-max(shown.shape[2:]) // SQUARES)
    squares, seen = (Cells.of(values, side) for values in (shown, window.expand(-1, 4, -1, -1)))
    whole = numbers(spectra[:, :n]).flatten(2)[:, None, None] * math.sqrt(2 / (h * w))  # Parseval, of half a plane
    share = window.square().mean((1, 2, 3))
    uneven = torch.maximum(before, unevenness(squares.x, seen.x, there))
    asked = torch.where(uneven > UNEVEN, UNASKED, 1.0)[:, None, None, None]
    steps, covariances = adjusted(even, hold(even.x, there, GUESSED * share), there)
    step, covariance = averaged_by((steps, covariances * asked), adjusted(squares, hold(whole, there, share), there))
    total = (even.x @ even.x.mT).sum((1, 2))
    scale = total.diagonal(dim1=1, dim2=2).clamp(min=LEAST).rsqrt()
    return Places(step, covariance, total * scale[:, :, None] * scale[:, None], uneven)


def unevenness(x: Tensor, window: Tensor, there: Tensor) -> Tensor:
    """How many times as unevenly (B,) as what n images show is spread over squares, ``x`` (B, i, j, n, m), what one has
    not kept of another is, at most; seen in a ``window`` (B, i, j, 1, m). Of those that are ``there`` (B, n)."""
    gram = x @ x.mT
    power = gram.diagonal(dim1=3, dim2=4)
    all_of_it = power.sum((1, 2))[:, None, None].clamp(min=LEAST)
    kept = gram.sum((1, 2), keepdim=True) / all_of_it[..., None]
    changed = (power[..., None, :] - 2 * kept * gram + kept.square() * power[..., None]).clamp(min=0)
    changed = changed + OWN * power[..., None, :]  # where nothing has changed it is as even as what there is
    seen = window.square().sum(4)
    of_all, of_changed = (variation(value, seen) for value in (power, changed.flatten(3)))
    some = there.to(x)
    usual = (of_all * some).sum(1, keepdim=True) / some.sum(1, keepdim=True).clamp(min=1)
    pairs = (some[:, :, None] * some[:, None]).triu(1).flatten(1)
    return (of_changed * pairs / usual.clamp(min=LEAST)).nan_to_num(0.0, 0.0, 0.0).amax(1)


def variation(power: Tensor, seen: Tensor) -> Tensor:
    """The variance (B, n) over squares of the ``power`` (B, i, j, n) per pixel that is ``seen`` (B, i, j, 1), over the
    square of its mean."""
    share = seen / seen.sum((1, 2), keepdim=True).clamp(min=LEAST)
    each = power / seen.clamp(min=LEAST)
    mean = (each * share).sum((1, 2), keepdim=True).clamp(min=LEAST)
    return ((each / mean - 1).square() * share).sum((1, 2))


def averaged_by(*found: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The mean of steps (B, n, 3) by their covariances (B, n, 3, 3), and its own; the first one where none is known."""
    steps, covariances = (torch.stack(values) for values in zip(*found, strict=True))
    weight, known = safe_inverse(covariances.flatten(0, 2))
    weight, known = weight.view_as(covariances), known.view(steps.shape[:3])[..., None]
    inverse, regular = safe_inverse(weight.sum(0).flatten(0, 1))
    inverse, regular = inverse.view_as(covariances[0]), regular.view(steps.shape[1:3])[..., None]
    mean = (inverse @ (weight @ torch.where(known, steps, 0.0)[..., None]).sum(0))[..., 0]
    return torch.where(regular, mean, steps[0]), torch.where(regular[..., None], inverse, covariances[0])


def inner(counted: Tensor) -> Tensor:
    """By how much pixels count (B, 1, h, w), less and less towards where they do not."""
    near = averaged(F.pad(counted, (EDGE // 2,) * 4), EDGE)
    return counted * (2 * near / near.amax((2, 3), keepdim=True).clamp(min=LEAST) - 1).clamp(min=FAINT)


def averaged(image: Tensor, side: int) -> Tensor:
    """Means of ``image`` (B, 1, h, w) over squares of a ``side``."""
    return F.avg_pool2d(F.avg_pool2d(image, (side, 1), 1), (1, side), 1)


def windowed(images: Tensor, there: Tensor, window: Tensor, centre: Tensor) -> Tensor:
    """What ``images`` (B, n, h, w) show, and their slopes by x, y and theta, (B, 4 n, h, w), off planes and in a
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
    shown: Tensor = (values * kept[:, :, None]).unflatten(2, (h, w))
    return shown


def response(shown: Tensor, noise: Tensor, size: tuple[int, int]) -> Tensor:
    """By how much a frequency counts (B, 1, h', w'), half a plane of ``size``, if each is to count by how much of it is
    texture that images (B, n, h, w) have ``shown``, not ``noise``, of that power (B,)."""
    power = torch.fft.fft2(shown, s=size).abs().square().sum(1, keepdim=True)
    near, shape = (averaged(F.pad(power, (side // 2,) * 4, mode="circular"), side) for side in (SMOOTH, SHAPE))
    floor = (DARKEST * near.amax((2, 3), keepdim=True)).clamp(min=LEAST)
    texture = (1 - noise.to(power)[:, None, None, None] / near.maximum(floor)).clamp(min=0)
    half: Tensor = (texture / shape.maximum(floor)).sqrt()[..., : size[1] // 2]
    return half


def adjusted(cells: Cells, held: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Steps (B, n, 3) and covariances (B, n, 3, 3) of images, those that are ``there`` (B, n) bool, from ``cells`` in
    which any two are ``held`` (B, i, j, n, n) together (``hold``)."""
    x, g = cells
    n = x.shape[3]
    cross = (x @ g.mT).unflatten(4, (n, 3))
    cross = (cross - cross.transpose(3, 4)) / 2  # what the window cuts off is the same for both
    pull = -(held[..., None] * cross).sum(3).flatten(3)  # (B, i, j, 3 n)
    edges = (g @ g.mT) * held.repeat_interleave(3, 3).repeat_interleave(3, 4)
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
