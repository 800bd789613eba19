"""Independent answers: plain NumPy, no code shared with pfbench.

Kalman filter with evidence (covariance form, one run at a time, seen components picked out), RTS smoother, one-dimensional
grid filter, and the closed form of the Benes filter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

Array = np.ndarray


class Filtered(NamedTuple):
    """Moments after each measurement, before it, and the log evidence of each step."""

    mean: Array  # [T, D]
    covariance: Array  # [T, D, D]
    predicted_mean: Array  # [T, D]
    predicted_covariance: Array  # [T, D, D]
    log_evidence: Array  # [T]


def kalman(
    f: Array, q: Array, h: Array, r: Array, m0: Array, p0: Array, y: Array, observes_initial: bool = False
) -> Filtered:
    """Kalman filter of one record y [T, Dy], NaN where unseen; q and r are covariances [D, D] and [Dy, Dy]."""
    m, p = np.array(m0, dtype=float), np.array(p0, dtype=float)
    rows: list[tuple] = []
    for t, seen_y in enumerate(y):
        if t > 0 or not observes_initial:
            m, p = f @ m, f @ p @ f.T + q
        before = m, p
        seen = ~np.isnan(seen_y)
        log_z = 0.0
        if seen.any():
            hs, rs = h[seen], r[np.ix_(seen, seen)]
            s = hs @ p @ hs.T + rs
            gain = np.linalg.solve(s, hs @ p).T
            e = seen_y[seen] - hs @ m
            left = np.eye(len(m)) - gain @ hs
            m, p = m + gain @ e, left @ p @ left.T + gain @ rs @ gain.T
            log_z = -0.5 * (e @ np.linalg.solve(s, e) + np.linalg.slogdet(2 * np.pi * s)[1])
        rows.append((m, p, *before, log_z))
    return Filtered(*(np.array(column) for column in zip(*rows, strict=True)))


def rts_smoother(f: Array, filtered: Filtered) -> tuple[Array, Array]:
    """Smoothed means [T, D] and covariances [T, D, D] [Rauch, Tung, Striebel 1965]."""
    mean, covariance = filtered.mean.copy(), filtered.covariance.copy()
    for t in range(len(mean) - 2, -1, -1):
        gain = np.linalg.solve(filtered.predicted_covariance[t + 1], f @ filtered.covariance[t]).T
        mean[t] += gain @ (mean[t + 1] - filtered.predicted_mean[t + 1])
        covariance[t] += gain @ (covariance[t + 1] - filtered.predicted_covariance[t + 1]) @ gain.T
    return mean, covariance


def grid_filter(
    grid: Array, prior: Array, transition: Callable[[int], Array], log_likelihood: Callable[[int], Array], steps: int
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
