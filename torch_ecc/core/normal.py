"""The normal equations of a template: from sums over its pixels to what the loop and the covariance need of them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.criteria import inverse_where, safe_inverse
from torch_ecc.core.noise import errors_in_variables, largest_eigenvalue

LEAST = 1e-30  # what is divided by is at least so much


class Moments(NamedTuple):
    """Sums over the pixels that count, of which all else that depends on the weights is made: their ``number`` (B,),
    ``normal`` = Z W R^T and ``power`` = Z W (Z W)^T (B, p, p), ``gram`` (B, 4, 4) of {1, u, v, t less its mean} under
    W, and ``noise`` (B, 2, 4) of q {1, x, y, x^2 + y^2} for q the weights times ``wiener``, and for q^2."""

    number: Tensor
    normal: Tensor
    power: Tensor
    gram: Tensor
    noise: Tensor


class Normal(NamedTuple):
    """The normal equations of B templates: ``matrix`` = Z W R^T (B, p, p) and its ``inverse``, zero where it is
    singular; for the sandwich covariance, each (B, 3, 3), ``bread`` = Z W G^T and ``meat`` = Z W (Z W)^T off the other
    columns, and what white noise of unit variance in the template adds to them (errors in variables), ``bread_bias``
    and ``meat_bias``; ``noise_share`` (B,): the largest part of the bread that such noise can be, in any direction;
    ``white`` (B, 3): the square sums of the first rows of K; ``total`` (B,) of the weights, and ``freedom`` (B,), the
    share of it that fitted columns leave; ``energy`` (B,) the weighted square sum of t off its mean, and ``contrast``
    (B,), its mean; ``gram`` as in ``Moments``."""

    matrix: Tensor
    inverse: Tensor
    bread: Tensor
    meat: Tensor
    bread_bias: Tensor
    meat_bias: Tensor
    noise_share: Tensor
    white: Tensor
    total: Tensor
    freedom: Tensor
    energy: Tensor
    contrast: Tensor
    gram: Tensor


def normal_equations(sums: Moments, response: Tensor) -> Normal:
    """What follows from the sums over the pixels that count; ``response`` (B, 2): see ``noise.Noise``.

    The first rows k of the inverse are those of K by Z W, so that k P k^T is what white noise makes of an increment;
    their first block is the inverse of the bread, the Schur complement of the other columns.
    """
    inverse, regular = safe_inverse(sums.normal)
    rows, block = inverse[:, :3], inverse[:, :3, :3]
    spread = rows @ sums.power @ rows.mT
    even = (block + block.mT) / 2  # as it is but for noise, which alone may have complex eigenvalues
    bread = torch.where(regular[:, None, None], inverse_where(regular, block), 0.0)
    biases = errors_in_variables(sums.noise.flatten(0, 1)).view(-1, 2, 3, 3)
    bread_bias, meat_bias = (biases * response[:, :, None, None]).unbind(1)
    total, along, count = sums.gram[:, 0, 0], sums.gram[:, 0, 3], sums.number.clamp(min=1)
    energy = (sums.gram[:, 3, 3] - along * along / total.clamp(min=LEAST)).clamp(min=0)
    return Normal(
        matrix=sums.normal,
        inverse=inverse,
        bread=bread,
        meat=bread @ spread @ bread.mT,
        bread_bias=bread_bias,
        meat_bias=meat_bias,
        noise_share=torch.where(regular, largest_eigenvalue(even @ bread_bias), torch.inf),
        white=spread.diagonal(dim1=1, dim2=2).clamp(min=LEAST),
        total=total,
        freedom=(total * (count - inverse.shape[-1]).clamp(min=1) / count).clamp(min=LEAST),
        energy=energy,
        contrast=energy / total.clamp(min=LEAST),
        gram=sums.gram,
    )
