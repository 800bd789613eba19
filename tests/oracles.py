"""Independent answers: plain NumPy, no code shared with the filters.

One-dimensional grid filter and the closed form of the Benes filter. The Kalman filter and the RTS smoother are those of
pfbench.testing, which share no code with the filters.
"""

from collections.abc import Callable

import numpy as np

from pfbench.testing import KalmanResult as Filtered, kalman_filter as kalman, rts_smoother

__all__ = ["Filtered", "benes", "grid_filter", "kalman", "normal_density", "rts_smoother"]

Array = np.ndarray


def grid_filter(
    grid: Array,
    prior: Array,
    transition: Callable[[int], Array],
    log_likelihood: Callable[[int], Array],
    steps: int,
) -> tuple[Array, Array, float]:
    """Filter on an even grid: means [T], variances [T] and log evidence.

    `prior` is the density of x_0 on the grid, `transition(t)` the matrix of densities p(grid[i] | grid[j]) [i, j].
    """
    dx = grid[1] - grid[0]
    p = prior / (prior.sum() * dx)
    means, variances, log_z = [], [], 0.0
    for t in range(steps):
        p = transition(t) @ p * dx
        ll = log_likelihood(t)
        top = ll.max()
        p = p * np.exp(ll - top)
        total = p.sum() * dx
        p, log_z = p / total, log_z + np.log(total) + top
        mean = (grid * p).sum() * dx
        means.append(mean)
        variances.append(((grid - mean) ** 2 * p).sum() * dx)
    return np.array(means), np.array(variances), log_z


def normal_density(x: Array, mean: Array, sd: Array | float) -> Array:
    """N(x; mean, sd^2), broadcast."""
    return np.exp(-0.5 * ((x - mean) / sd) ** 2) / (np.sqrt(2 * np.pi) * sd)


def benes(y: Array, step: float, variance: float) -> tuple[Array, Array, float]:
    """Exact filter of dx = tanh(x) dt + dW from x_0 = 0, y [T] seen every `step` with noise `variance` [Benes 1981].

    The density is proportional to cosh(x) N(x; m, P), with (m, P) from the linear recursion with F = 1, Q = step.
    """
    m, p, log_z = 0.0, 0.0, 0.0
    means, variances = [], []
    for value in y:
        level = np.log(np.cosh(m)) + p / 2
        p_before = p + step
        s = p_before + variance
        log_z += -step / 2 - 0.5 * (np.log(2 * np.pi * s) + (value - m) ** 2 / s) - level
        gain = p_before / s
        m, p = m + gain * (value - m), (1 - gain) * p_before
        log_z += np.log(np.cosh(m)) + p / 2
        means.append(m + p * np.tanh(m))
        variances.append(p + p**2 / np.cosh(m) ** 2)
    return np.array(means), np.array(variances), log_z
