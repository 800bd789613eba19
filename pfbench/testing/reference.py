"""Reference solutions of linear-Gaussian models in NumPy.

They share no code with the filters.

The Kalman filter uses the covariance form and picks out the observed components of one run.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor
from torch.distributions import Distribution, Independent, Uniform
from typing_extensions import override

from pfbench.files.table_file import Array
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk


class KalmanResult(NamedTuple):
    """Moments of a Kalman filter at each step.

    Attributes:
        mean: After the measurement update, [T, D].
        covariance: After the measurement update, [T, D, D].
        predicted_mean: Before the measurement update, [T, D].
        predicted_covariance: Before the measurement update, [T, D, D].
        log_evidence: log p(y_t | y_1:t-1), [T].
    """

    mean: Array
    covariance: Array
    predicted_mean: Array
    predicted_covariance: Array
    log_evidence: Array


class FilterMoments(NamedTuple):
    """Exact answer after the last measurement.

    Attributes:
        mean: E[x_T | y_1:T], [D].
        square: E[x_T^2 | y_1:T] per component, [D].
        log_evidence: log p(y_1:T).
    """

    mean: Array
    square: Array
    log_evidence: float


def kalman_filter(
    f: Array,
    q: Array,
    h: Array,
    r: Array,
    m0: Array,
    p0: Array,
    y: Array,
    observes_initial: bool = False,
) -> KalmanResult:
    """Run a Kalman filter over one record.

    Args:
        f: Transition matrix, [D, D].
        q: Process noise covariance, [D, D].
        h: Measurement matrix, [Dy, D].
        r: Measurement noise covariance, [Dy, Dy].
        m0: Initial mean, [D].
        p0: Initial covariance, [D, D].
        y: Measurements, [T, Dy]; NaN marks a missing component.
        observes_initial: Whether the first measurement is of x_0 itself.

    Returns:
        Moments and evidence of each step.
    """
    m, p = np.array(m0, dtype=float), np.array(p0, dtype=float)
    rows: list[tuple[Any, ...]] = []
    for t, y_t in enumerate(y):
        if t > 0 or not observes_initial:
            m, p = f @ m, f @ p @ f.T + q
        predicted = m, p
        observed_mask = ~np.isnan(y_t)
        log_evidence = 0.0
        if observed_mask.any():
            hs, rs = h[observed_mask], r[np.ix_(observed_mask, observed_mask)]
            s = hs @ p @ hs.T + rs
            gain = np.linalg.solve(s, hs @ p).T
            e = y_t[observed_mask] - hs @ m
            factor = np.eye(len(m)) - gain @ hs
            m, p = m + gain @ e, factor @ p @ factor.T + gain @ rs @ gain.T
            log_evidence = -0.5 * (e @ np.linalg.solve(s, e) + np.linalg.slogdet(2 * np.pi * s)[1])
        rows.append((m, p, *predicted, log_evidence))
    return KalmanResult(*(np.array(column) for column in zip(*rows, strict=True)))


def rts_smoother(f: Array, filtered: KalmanResult) -> tuple[Array, Array]:
    """Smooth the result of a Kalman filter [Rauch, Tung, Striebel 1965].

    Args:
        f: Transition matrix, [D, D].
        filtered: Result of `kalman_filter`.

    Returns:
        Smoothed means [T, D] and covariances [T, D, D].
    """
    mean, covariance = filtered.mean.copy(), filtered.covariance.copy()
    for t in range(len(mean) - 2, -1, -1):
        gain = np.linalg.solve(filtered.predicted_covariance[t + 1], f @ filtered.covariance[t]).T
        mean[t] += gain @ (mean[t + 1] - filtered.predicted_mean[t + 1])
        covariance[t] += gain @ (covariance[t + 1] - filtered.predicted_covariance[t + 1]) @ gain.T
    return mean, covariance


def run_kalman_filter(model: LinearGaussian, y: Tensor) -> KalmanResult:
    """Run the Kalman filter of a model over one record.

    Args:
        model: Linear-Gaussian model.
        y: Measurements, [T, Dy]; NaN marks a missing component.

    Returns:
        Moments and evidence of each step.
    """
    f, g, h, r, m0, root = (
        getattr(model, name).detach().cpu().double().numpy()
        for name in ("f", "g", "h", "r", "m0", "l0")
    )
    return kalman_filter(
        f, g @ g.T, h, np.diag(r**2), m0, root @ root.T, y.numpy(), model.observes_initial
    )


def reference_moments(model: LinearGaussian, y: Tensor) -> FilterMoments:
    """Return the exact answer for one record.

    Args:
        model: Linear-Gaussian model.
        y: Measurements, [T, Dy]; NaN marks a missing component.

    Returns:
        Moments after the last measurement, and the log evidence of all.
    """
    result = run_kalman_filter(model, y)
    mean = result.mean[-1]
    return FilterMoments(
        mean, np.diagonal(result.covariance[-1]) + mean**2, float(result.log_evidence.sum())
    )


class BoundedErrors(LinearGaussian):
    """The model x_1 = x_0 + w, y = x_1 + v with v uniform on [-0.5, 0.5], one state.

    A parent whose noise-free prediction is farther than 0.5 from y may have a child that is not.
    """

    linear = False
    half_width = 0.5

    def __init__(self) -> None:
        super().__init__([[1.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0])

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        low, high = x - self.half_width, x + self.half_width
        return Independent(Uniform(low, high, validate_args=False), 1)


def bounded_case() -> tuple[BoundedErrors, Tensor, FilterMoments]:
    """Return a model with measurement errors of bounded support, one measurement, and the exact answer."""
    model, y, sd = BoundedErrors(), 1.5, math.sqrt(2.0)
    ends = [(y - model.half_width) / sd, (y + model.half_width) / sd]
    posterior = stats.truncnorm(*ends, scale=sd)
    mean, mass = posterior.mean(), stats.norm.cdf(ends[1]) - stats.norm.cdf(ends[0])
    answer = FilterMoments(
        np.array([mean]),
        np.array([posterior.var() + mean**2]),
        float(np.log(mass / (2.0 * model.half_width))),
    )
    return model, torch.tensor([[y]], dtype=torch.float64), answer


def case_or_default(
    model: StateSpaceModel | None, y: Tensor | None
) -> tuple[StateSpaceModel, Tensor]:
    """Return a given model with its records, or a default case.

    The default is a walk with constant velocity and a record [6, 1] with a missing measurement.
    """
    if model is None and y is None:
        record = [[0.8], [2.9], [1.2], [np.nan], [3.0], [6.5]]
        return linear_walk(1.0, 0.5, 1.0), torch.tensor(record, dtype=torch.float64)
    if model is None or y is None:
        raise ValueError("check: model and y must be given together, got one. Give both or none.")
    return model, y
