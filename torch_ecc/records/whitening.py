"""What residuals of successive frames have to do with each other: an autoregression, and its filter that undoes it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

ORDERS = 30  # of the autoregression, at most; and a tenth of the samples


def highest_order(count: int) -> int:
    """The highest order for ``count`` samples."""
    return max(1, min(ORDERS, count // 10))


def autoregression(residual: Tensor) -> Tensor:
    """Coefficients (p,) with residual_t = sum_k a_k residual_(t-k) + innovation_t of a series (V,) about its mean.

    Burg's recursion, which is always stable; p from 0 to ``highest_order(V)`` by the Bayesian information criterion.
    """
    x = residual - residual.mean()
    forward, backward, a = x, x, x[:0]
    variance, count = float(x @ x), len(x)
    least, best = count * math.log(variance + 1e-300), a
    for p in range(1, highest_order(count) + 1):
        ahead, behind = forward[1:], backward[:-1]
        energy = ahead @ ahead + behind @ behind
        k = 2 * (ahead @ behind) / energy.clamp(min=1e-300)
        forward, backward = ahead - k * behind, behind - k * ahead
        a = torch.cat((a - k * a.flip(0), k[None]))
        variance *= max(1 - float(k) ** 2, 1e-15)
        criterion = count * math.log(variance + 1e-300) + p * math.log(count)
        if criterion < least:
            least, best = criterion, a
    return best


def whiten(series: Tensor, coefficients: Tensor, drop: int) -> Tensor:
    """Innovations (V - drop, ...) of series (V, ...) under an autoregression of an order of at most ``drop``."""
    count = len(series)
    white = series[drop:].clone()
    for k, a in enumerate(coefficients.tolist(), 1):
        white -= a * series[drop - k : count - k]
    return white
