"""Log likelihood of measurements without a state-space model: a model with a smaller one is worse than no model."""

from __future__ import annotations

import numpy as np

from pfbench.files.table_file import Array

_FEWEST = 3  # values of a component, for a mean, a variance and a factor


def likelihood_floor(y: Array) -> Array:
    """Compute the largest log likelihood of two simple models that are fitted to the measurements of each run.

    Each component has independent normal values, or is an autoregression of order 1 from one value that is observed to the next, as in
    the benchmarks of pypomp. Each component takes the better model. Both have their maximum likelihood about the mean.

    Args:
        y: Measurements, [R, T, K]; NaN where none is observed.

    Returns:
        Log likelihoods, [R]. NaN for a run with a component that is constant, or that has fewer than three values.
    """
    observed = np.isfinite(y)
    order = np.argsort(~observed, axis=1, kind="stable")  # observed values come first
    inside, count = np.take_along_axis(observed, order, 1), observed.sum(1)
    mean = np.where(observed, y, 0.0).sum(1) / np.maximum(count, 1)
    values = np.take_along_axis(np.where(observed, y - mean[:, None], 0.0), order, 1)
    before, after, pairs = values[:, :-1], values[:, 1:], np.maximum(count - 1, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = (values**2).sum(1) / count
        factor = (before * after).sum(1) / (before**2 * inside[:, 1:]).sum(1)
        rest = ((after - factor[:, None] * before * inside[:, 1:]) ** 2).sum(1) / pairs
        static = -0.5 * count * (np.log(2.0 * np.pi * variance) + 1.0)
        start = -0.5 * (np.log(2.0 * np.pi * variance) + values[:, 0] ** 2 / variance)
        moving = start - 0.5 * pairs * (np.log(2.0 * np.pi * rest) + 1.0)
    best = np.where((count >= _FEWEST) & (variance > 0.0), np.maximum(static, moving), np.nan)
    floor: Array = np.where(count == 0, 0.0, best).sum(1)
    return floor
