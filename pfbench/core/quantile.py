"""Quantiles of univariate distributions, by numerical inversion where torch has none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import biject_to

_CHUNK, _LARGEST_COUNT = 256, 1_000_000  # search range of unbounded discrete distributions
_BISECTIONS = 64  # halve the largest bracket in the unconstrained value, 1400, to below 1e-15
_LARGEST_LOG = 700.0  # exp(700) is finite in float64


def quantile(distribution: Any, u: Tensor) -> Tensor:
    """Compute quantiles of a univariate distribution.

    Args:
        distribution: Distribution with `icdf`, `cdf` or, if it is discrete, `log_prob`.
        u: Cumulative probabilities, broadcast against the batch of the distribution.

    Returns:
        Quantiles.

    Raises:
        ValueError: If the distribution offers none of these methods, or its values are too large.
    """
    try:
        values = (
            _invert_pmf(distribution, u)
            if distribution.support.is_discrete
            else _invert_continuous(distribution, u)
        )
    except NotImplementedError:  # a method that the distribution does not define
        values = None
    if values is None:
        name = type(distribution).__name__
        raise ValueError(
            f"model: a distribution must have icdf, cdf or draw_from to be simulated, got {name}. "
            "Add a method draw_from(source) to its class (see CounterBasedDistribution)."
        )
    return values


def _invert_continuous(distribution: Any, u: Tensor) -> Tensor:
    try:
        values: Tensor = distribution.icdf(u)
    except NotImplementedError:
        return invert_cdf(distribution, u)
    return values


def _invert_pmf(distribution: Any, u: Tensor) -> Tensor | None:
    """Return the smallest value whose cumulative probability reaches u, None for bounded supports."""
    if distribution.has_enumerate_support:
        values = distribution.enumerate_support(expand=False)
        values = values.reshape(-1, *[1] * u.dim())
        cdf = distribution.log_prob(values).exp().cumsum(0)
        smallest: Tensor = values.flatten()[(cdf < u).sum(0).clamp(max=len(values) - 1)]
        return smallest
    if getattr(distribution.support, "upper_bound", None) is not None:
        return None
    count, total = torch.zeros_like(u), torch.zeros_like(u)
    for first in range(0, _LARGEST_COUNT, _CHUNK):
        values = torch.arange(first, first + _CHUNK, dtype=u.dtype, device=u.device)
        values = values.reshape(-1, *[1] * u.dim())
        cdf = total + distribution.log_prob(values).exp().cumsum(0)
        count, total = count + (cdf < u).sum(0), cdf[-1]
        if bool((total >= u).all()):
            return count
    raise ValueError(
        f"model: counts must be below {_LARGEST_COUNT} to be simulated, got "
        f"{type(distribution).__name__} with larger ones. Use a normal approximation."
    )


def invert_cdf(distribution: Any, u: Tensor) -> Tensor:
    """Invert a continuous cdf by bisection on the unconstrained real line.

    Args:
        distribution: Univariate distribution with `cdf`.
        u: Cumulative probabilities, broadcast against the batch of the distribution.

    Returns:
        Quantiles.
    """
    to_support = biject_to(distribution.support)
    sign = float(getattr(to_support, "sign", 1))

    def to_value(z: Tensor) -> Tensor:
        return to_support(sign * z)

    low, high = (_bracket(distribution.cdf, to_value, u, side) for side in (-1.0, 1.0))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        below = distribution.cdf(to_value(middle)) < u
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return to_value(0.5 * (low + high))


def _bracket(cdf: Any, to_value: Callable[[Tensor], Tensor], u: Tensor, side: float) -> Tensor:
    """Return unconstrained values on one side of the quantiles at u."""
    bound = torch.full_like(u, side)
    while float(bound.abs().max()) < _LARGEST_LOG:
        inside_mask = side * (cdf(to_value(bound)) - u) < 0.0
        if not bool(inside_mask.any()):
            break
        bound = (bound * torch.where(inside_mask, 2.0, 1.0)).clamp(-_LARGEST_LOG, _LARGEST_LOG)
    return bound
