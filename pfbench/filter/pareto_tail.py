"""Shape of the largest weights, the Pareto k-hat: how heavy their tail is.

The largest weights of a step are fitted by a generalised Pareto distribution. Above k = 0.5 the
variance of the weights is infinite, and above 0.7 the estimate is not reliable for any number of
particles at hand. A tail that no particle has reached is not seen.

References:
    Zhang and Stephens 2009, "A new and efficient estimation method for the generalized Pareto
        distribution".
    Vehtari, Simpson, Gelman, Yao and Gabry 2024, "Pareto smoothed importance sampling".
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

RELIABLE_K = 0.7  # largest k-hat of a reliable estimate [Vehtari et al.]

_FEWEST = 5  # weights in a tail
_PRIOR_K, _PRIOR_COUNT = 0.5, 10.0  # k-hat is shrunk as by ten weights of this shape
_PRIOR_SCALE = 3.0  # of the grid of the profile likelihood


def fit_pareto_k(log_w: Tensor) -> Tensor:
    """Estimate the shape of the tail of weights.

    The tail is the largest min(N / 5, 3 sqrt(N)) weights, less the next one.

    Args:
        log_w: Log weights, [R, N]. -inf marks an inactive slot.

    Returns:
        k-hat, float64 [R]. NaN if the tail has fewer than five weights, or a quarter of them are
        equal; infinite if a few weights are all there is.
    """
    n = log_w.shape[1]
    size = math.ceil(min(0.2 * n, 3.0 * math.sqrt(n)))
    if size < _FEWEST:
        return torch.full_like(log_w[:, 0], torch.nan, dtype=torch.float64)
    largest = log_w.double().topk(size + 1, 1).values.flip(1)  # ascending
    largest = largest - largest[:, -1:]
    w = torch.exp(largest)
    k = _fit_shape(w[:, 1:] - w[:, :1])
    quartile = largest[:, _quartile(size) + 1]
    k = torch.where(quartile > largest[:, 0], k, torch.nan)  # NaN if all are inactive, too
    return torch.where(quartile < math.log(torch.finfo(w.dtype).tiny), torch.inf, k)


def _quartile(size: int) -> int:
    """Return the index of the lower quartile of ascending numbers."""
    return int(size / 4 + 0.5) - 1


def _fit_shape(excess: Tensor) -> Tensor:
    """Return the shape of a generalised Pareto distribution [R] of ascending numbers [R, M]."""
    size = excess.shape[1]
    count = 30 + math.isqrt(size)
    rank = torch.arange(1, count + 1, dtype=excess.dtype, device=excess.device)
    quartile = excess[:, _quartile(size), None]
    grid = 1.0 / excess[:, -1:] + (1.0 - torch.sqrt(count / (rank - 0.5))) / (
        _PRIOR_SCALE * quartile
    )
    k = torch.log(1.0 - grid.unsqueeze(-1) * excess.unsqueeze(1)).mean(-1)
    profile = size * (torch.log(-grid / k) - k - 1.0)
    b = (torch.softmax(profile, 1) * grid).sum(1, keepdim=True)
    shape = torch.log1p(-b * excess).mean(1)
    return (size * shape + _PRIOR_COUNT * _PRIOR_K) / (size + _PRIOR_COUNT)
