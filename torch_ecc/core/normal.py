"""The normal equations of a template: from sums over its pixels to what the loop and the covariance need of them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.criteria import safe_inverse
from torch_ecc.core.noise import errors_in_variables, largest_eigenvalue, noise_response


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
    """The normal equations of B templates: ``inverse`` (B, p, p) of Z W R^T, zero where it is singular; for the
    sandwich covariance, each (B, 3, 3), ``bread`` = Z W G^T and ``meat`` = Z W (Z W)^T off the other columns, and what
    white noise of unit variance in the template adds to them (errors in variables), ``bread_bias`` and ``meat_bias``;
    ``noise_share`` (B,): the largest part of the bread that such noise can be, in any direction; ``white`` (B, 3): the
    square sums of the first rows of K; ``total`` (B,) of the weights, and ``freedom`` (B,), the share of it that fitted
    columns leave; ``energy`` (B,) the weighted square sum of t off its mean; ``gram`` as in ``Moments``."""

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
    gram: Tensor


def normal_equations(sums: Moments) -> Normal:
    """What follows from the sums over the pixels that count."""
    inverse, regular = safe_inverse(sums.normal)
    others, _ = safe_inverse(sums.normal[:, 3:, 3:])
    one = torch.eye(3, dtype=inverse.dtype, device=inverse.device).expand(len(inverse), 3, 3)
    project = torch.cat((one, -sums.normal[:, :3, 3:] @ others), -1)
    bread = (project @ sums.normal)[:, :, :3] * regular[:, None, None]
    bread_bias, meat_bias = (
        errors_in_variables(q) * response for q, response in zip(sums.noise.unbind(1), noise_response(), strict=True)
    )
    total, along = sums.gram[:, 0, 0], sums.gram[:, 0, 3]
    columns = inverse.shape[-1]
    return Normal(
        inverse=inverse,
        bread=bread,
        meat=project @ sums.power @ project.mT,
        bread_bias=bread_bias,
        meat_bias=meat_bias,
        noise_share=largest_eigenvalue(bread, bread_bias),
        white=((inverse @ sums.power) * inverse).sum(-1)[:, :3].clamp(min=1e-30),
        total=total,
        freedom=(total * (sums.number - columns).clamp(min=1) / sums.number.clamp(min=1)).clamp(min=1e-30),
        energy=(sums.gram[:, 3, 3] - along * along / total.clamp(min=1e-30)).clamp(min=0),
        gram=sums.gram,
    )
