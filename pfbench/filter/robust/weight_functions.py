"""Weights of standardised distances, and their thresholds for an efficiency at the normal law.

A weight w(d) multiplies the information of a measurement at the distance d. Its asymptotic
efficiency in k components with normal errors is A^2 / B with A = E[w d^2] / k and
B = E[w^2 d^2] / k, d ~ chi_k [Huber and Ronchetti 2009]. A follows from Stein's lemma, so it
holds for rejection too.

A loss is the log density of a group of components at a squared distance. Huber's and Student's have
the constant with which they integrate to 1. Welsch's is bounded and has the constant of the normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from scipy import special
from torch import Tensor
from torch.special import gammainc, gammaincc, gammaln

from pfbench.filter.whitening import LOG_2PI

_NODES = 4000  # of the quadrature over the distance
_HALVINGS = 40
_SMALLEST = 1e-3  # smallest threshold


def huber_weight(squared: Tensor, threshold: Tensor) -> Tensor:
    """Compute min(1, c / d).

    Args:
        squared: Squared distances d^2.
        threshold: Thresholds c.
    """
    return (threshold / squared.clamp(min=1e-300).sqrt()).clamp(max=1.0)


def cauchy_weight(squared: Tensor, threshold: Tensor) -> Tensor:
    """Compute 1 / (1 + d^2 / c^2).

    Args:
        squared: Squared distances d^2.
        threshold: Thresholds c.
    """
    return 1.0 / (1.0 + squared / threshold.square())


def welsch_weight(squared: Tensor, threshold: Tensor) -> Tensor:
    """Compute exp(-d^2 / (2 c^2)).

    Args:
        squared: Squared distances d^2.
        threshold: Thresholds c.
    """
    return torch.exp(-0.5 * squared / threshold.square())


def huber_log_density(squared: Tensor, size: Tensor, threshold: Tensor) -> Tensor:
    """Compute the log density exp(-d^2 / 2) up to c and exp(-c d + c^2 / 2) beyond, normalised.

    Args:
        squared: Squared distances d^2.
        size: Number of components k.
        threshold: Thresholds c.
    """
    c, half = threshold, 0.5 * size.clamp(min=1.0)
    distance = squared.clamp(min=0.0).sqrt()
    loss = torch.where(distance <= c, 0.5 * squared, c * distance - 0.5 * c.square())
    log_sphere = math.log(2.0) + half * math.log(math.pi) - gammaln(half)
    log_inside = (half - 1.0) * math.log(2.0) + gammaln(half) + gammainc(half, 0.5 * c**2).log()
    tail = gammaincc(2.0 * half, c.square())
    log_outside = 0.5 * c.square() - 2.0 * half * c.log() + gammaln(2.0 * half) + tail.log()
    log_outside = torch.where(tail > 0.0, log_outside, -torch.inf)  # an infinite threshold
    return -loss - log_sphere - torch.logaddexp(log_inside, log_outside)


def student_log_density(squared: Tensor, size: Tensor, dof: float) -> Tensor:
    """Compute the log density of Student's t in k components; normal for infinite dof.

    Args:
        squared: Squared distances d^2.
        size: Number of components k.
        dof: Degrees of freedom nu.
    """
    if math.isinf(dof):
        return -0.5 * squared - 0.5 * size * LOG_2PI
    half = 0.5 * (dof + size)
    constant = gammaln(half) - math.lgamma(0.5 * dof) - 0.5 * size * math.log(dof * math.pi)
    return constant - half * torch.log1p(squared / dof)


def welsch_log_loss(squared: Tensor, size: Tensor, threshold: Tensor) -> Tensor:
    """Compute -c^2 (1 - exp(-d^2 / (2 c^2))), with the constant of the normal density.

    Args:
        squared: Squared distances d^2.
        size: Number of components k.
        threshold: Thresholds c.
    """
    c2 = threshold.square()
    return c2 * torch.expm1(-0.5 * squared / c2) - 0.5 * size * LOG_2PI


WeightFunction = Callable[[Tensor, Tensor], Tensor]


def compute_efficiency(weight: WeightFunction, threshold: float, k: int) -> float:
    """Compute the asymptotic efficiency of a weight at the normal law.

    Args:
        weight: Function of squared distances and thresholds.
        threshold: Threshold c.
        k: Number of components.

    Returns:
        Variance of the optimal estimate divided by that of the weighted one, at most 1.
    """
    squared, probability = _chi_nodes(k)
    values = weight(squared, torch.tensor(threshold, dtype=torch.float64))
    a = (values * squared * probability).sum() / k
    b = (values.square() * squared * probability).sum() / k
    return float(a * a / b)


@lru_cache(maxsize=64)
def _chi_nodes(k: int) -> tuple[Tensor, Tensor]:
    """Return squared distances and their probabilities for d ~ chi_k."""
    d = np.linspace(0.0, math.sqrt(k) + 12.0, _NODES + 1)[1:]
    probability = np.exp(
        (k - 1) * np.log(d) - d * d / 2 - (k / 2 - 1) * math.log(2.0) - special.gammaln(k / 2)
    )
    probability *= d[1] - d[0]
    return torch.from_numpy(d * d), torch.from_numpy(probability)


@lru_cache(maxsize=256)
def threshold_for_efficiency(weight: WeightFunction, efficiency: float, k: int) -> float:
    """Compute the threshold c at which a weight has an efficiency.

    Args:
        weight: Function of squared distances and thresholds, increasing in c.
        efficiency: Efficiency in (0, 1).
        k: Number of components.

    Returns:
        The threshold. NaN if every threshold has a larger efficiency: Huber's weight of small
        thresholds has an efficiency of (E d)^2 / k, 0.64 for k = 1 and 0.95 for k = 10.
    """
    low, high = _SMALLEST, 1.0 / _SMALLEST
    if compute_efficiency(weight, low, k) > efficiency:
        return math.nan
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        is_above = compute_efficiency(weight, middle, k) > efficiency
        low, high = (low, middle) if is_above else (middle, high)
    return math.sqrt(low * high)


def threshold_table(
    weight: WeightFunction, threshold: float | None, efficiency: float, count: Tensor
) -> Tensor:
    """Return the threshold of each group, [R, k].

    Args:
        weight: Function of squared distances and thresholds.
        threshold: Threshold of all groups; None for that of the efficiency.
        efficiency: Efficiency in (0, 1).
        count: Number of observed components of the group, [R, k].

    Raises:
        ValueError: If every threshold of a group has a larger efficiency.
    """
    if threshold is not None:
        return torch.full_like(count, threshold)
    values = [threshold_for_efficiency(weight, efficiency, n) for n in _counts(count)]
    table = _look_up(values, count)
    if any(map(math.isnan, values)) and not torch.compiler.is_compiling():
        _check_efficiency_reached(weight, table, efficiency, count)
    return table


def _check_efficiency_reached(
    weight: WeightFunction, table: Tensor, efficiency: float, count: Tensor
) -> None:
    """Raise an error if a group lacks a threshold."""
    missing = table.isnan()
    if bool(missing.any()):
        k = int(count[missing].max())
        least = compute_efficiency(weight, _SMALLEST, k)
        raise ValueError(
            f"efficiency must be at least {math.ceil(1e3 * least) / 1e3:g} for a group with k = {k} "
            f"measured components, got {efficiency:g}. Increase it, set a threshold, or use "
            "grouping=component."
        )


def quantile_table(probability: float, count: Tensor) -> Tensor:
    """Return the quantile of chi-square for the size of each group, [R, k].

    Args:
        probability: Probability of a smaller value.
        count: Degrees of freedom, [R, k].
    """
    return _look_up([float(special.chdtri(n, 1.0 - probability)) for n in _counts(count)], count)


def _counts(count: Tensor) -> range:
    """Return all possible numbers of components of a group, from 1."""
    return range(1, count.shape[-1] + 1)


def _look_up(values: list[float], count: Tensor) -> Tensor:
    """Gather values for 1, 2, ... components; an empty group takes the first."""
    table = torch.tensor(values, dtype=count.dtype, device=count.device)
    return table[(count.long() - 1).clamp(min=0)]
