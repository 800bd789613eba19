"""Learned measurement noise: recursions in NumPy, the true variance in the long run, limits, missing values, bad input."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from filter_cases import method_of
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.exactness import has_evidence
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import NoiseAdaptation
from pfbench.filter.gaussian.linearisation_rules import TaylorLinearisation
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.filter.robust.noise_learning import (
    SageHusaAdaptation,
    VariationalCovarianceAdaptation,
    VariationalNoiseAdaptation,
    WindowedNoiseAdaptation,
)
from pfbench.model.linear_gaussian import LinearGaussian

Q, R0 = 0.25, 2.0


def level_measurements(runs: int, steps: int, r: float = R0) -> Tensor:
    rng = np.random.default_rng(5)
    x = rng.normal(size=(runs, 1)) + np.cumsum(math.sqrt(Q) * rng.normal(size=(runs, steps)), 1)
    return torch.tensor(x + math.sqrt(r) * rng.normal(size=x.shape)).unsqueeze(-1)


def run(y: Tensor, *adaptations: NoiseAdaptation) -> FilterResult:
    model = LinearGaussian([[1.0]], [[math.sqrt(Q)]], [[1.0]], [math.sqrt(R0)], [0.0], [1.0])
    method = GaussianFilter(TaylorLinearisation(), adaptations)
    return run_filter(method, model, Record(y), PhiloxStream(0, torch.arange(len(y))))


def sage_husa(y: np.ndarray) -> tuple[list[float], list[float]]:
    m, p, r, rows, count = 0.0, 1.0, R0, [], 0
    for value in y:
        p += Q
        if not np.isnan(value):
            gain = min((1 - 0.9) / (1 - 0.9 ** (count + 1)), 0.2)
            r = np.clip((1 - gain) * r + gain * ((value - m) ** 2 - p), 0.5 * R0, 100 * R0)
            count += 1
            m, p = m + p / (p + r) * (value - m), p * r / (p + r)
        rows.append((m, p))
    return [row[0] for row in rows], [row[1] for row in rows]


def variational(y: np.ndarray) -> tuple[list[float], list[float]]:
    m, p, alpha, beta, rows = 0.0, 1.0, 5.0, 5.0 * R0, []
    for value in y:
        p += Q
        if not np.isnan(value):
            prior_beta, alpha = 0.9 * beta, 0.9 * alpha + 0.5
            r, after = beta / ((alpha - 0.5) / 0.9), (m, p)
            for _ in range(3):
                after = m + p / (p + r) * (value - m), p * r / (p + r)
                beta = prior_beta + 0.5 * ((value - after[0]) ** 2 + after[1])
                r = beta / alpha
            m, p = m + p / (p + r) * (value - m), p * r / (p + r)
        rows.append((m, p))
    return [row[0] for row in rows], [row[1] for row in rows]


def windowed(y: np.ndarray) -> tuple[list[float], list[float]]:
    m, p, squares, rows = 0.0, 1.0, [], []
    for value in y:
        p += Q
        if not np.isnan(value):
            squares = [*squares, (value - m) ** 2][-5:]
            r = np.clip(np.mean(squares) - p, 0.5 * R0, 100 * R0) if len(squares) == 5 else R0
            m, p = m + p / (p + r) * (value - m), p * r / (p + r)
        rows.append((m, p))
    return [row[0] for row in rows], [row[1] for row in rows]


def variational_both(y: np.ndarray) -> tuple[list[float], list[float]]:
    """In the coordinates of the state, with inverse Wishart means U / u and P."""
    m, p, u, scale, rows = 0.0, 1.0, 10.0, 10.0 * R0, []
    for value in y:
        p += Q
        if not np.isnan(value):
            u, scale, r, widened = 0.9 * u, 0.9 * scale, scale / u, p
            for _ in range(3):
                gain = widened / (widened + r)
                after = m + gain * (value - m), (1 - gain) * widened
                r = (scale + (value - after[0]) ** 2 + after[1]) / (u + 1)
                widened = (4.0 * p + (after[0] - m) ** 2 + after[1]) / 5.0
            u, scale = u + 1, r * (u + 1)
            gain = widened / (widened + r)
            m, p = m + gain * (value - m), (1 - gain) * widened
        rows.append((m, p))
    return [row[0] for row in rows], [row[1] for row in rows]


CASES: dict[str, tuple[NoiseAdaptation, Any]] = {
    "sage_husa": (SageHusaAdaptation(0.9, 0.2), sage_husa),
    "iae": (WindowedNoiseAdaptation(5), windowed),
    "vb_pr": (VariationalCovarianceAdaptation(0.9, 10.0, 4.0, 3), variational_both),
    "vb_r": (VariationalNoiseAdaptation(0.9, 10.0, 3), variational),
}
every_case = pytest.mark.parametrize(("adaptation", "reference"), CASES.values(), ids=CASES.keys())


@every_case
def test_the_recursion_is_that_of_numpy(adaptation: NoiseAdaptation, reference: Any) -> None:
    y = level_measurements(3, 25, 4.0 * R0)
    y[0, 5:9], y[1, 12] = torch.nan, 40.0
    result = run(y, adaptation)
    for i in range(3):
        mean, variance = reference(y[i, :, 0].numpy())
        np.testing.assert_allclose(result.mean[i, :, 0].numpy(), mean, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(result.variance[i, :, 0].numpy(), variance, rtol=1e-10)


@pytest.mark.parametrize("adaptation", [SageHusaAdaptation(), VariationalNoiseAdaptation()])
@pytest.mark.parametrize("true_factor", [1.0, 4.0])
def test_the_learned_variance_tends_to_the_true_variance(
    adaptation: NoiseAdaptation, true_factor: float
) -> None:
    factor = run(level_measurements(60, 250, true_factor * R0), adaptation).trace["noise_factor"]
    by_run = factor[:, 150:].mean(1) / true_factor
    error = float(by_run.std()) / math.sqrt(60)
    assert abs(float(by_run.mean()) - 1.0) < 0.05 + 3 * error


@pytest.mark.parametrize(
    "adaptation",
    [
        SageHusaAdaptation(min_factor=1.0, max_factor=1.0),
        WindowedNoiseAdaptation(5, 1.0, 1.0),
        VariationalNoiseAdaptation(0.999999, 1e15),
        VariationalCovarianceAdaptation(0.999999, 1e15, math.inf),
    ],
)
def test_the_limit_of_the_parameters_is_the_kalman_filter(adaptation: NoiseAdaptation) -> None:
    y = level_measurements(3, 20, 9.0)
    torch.testing.assert_close(run(y, adaptation).mean, run(y).mean, rtol=1e-9, atol=1e-9)


def test_learned_noise_has_no_evidence() -> None:
    for name in ("sage_husa", "iae", "vb_r", "vb_pr"):
        assert not has_evidence(method_of(name))


def test_the_whole_covariance_is_that_of_numpy() -> None:
    """Two sensors; where one is missing, its error has the distribution given the other."""
    f, q, h = (
        np.array([[1.0, 0.5], [0.0, 0.9]]),
        np.diag([0.3, 0.2]),
        np.array([[1.0, 0.2], [0.3, 1.0]]),
    )
    y = np.random.default_rng(3).normal(size=(12, 2)) * 3.0
    y[6, 1] = math.nan
    model = LinearGaussian(
        f.tolist(), np.sqrt(q).tolist(), h.tolist(), [1.0, 0.8], [0.0, 0.0], [1.5, 1.0]
    )
    method = GaussianFilter(
        TaylorLinearisation(), [VariationalCovarianceAdaptation(0.9, 10.0, 4.0, 3)]
    )
    found = run_filter(
        method, model, Record(torch.tensor(y)[None]), PhiloxStream(0, torch.arange(1))
    )
    m, p, u = np.zeros(2), np.diag([2.25, 1.0]), 10.0
    r = np.diag([1.0, 0.64])
    for t, value in enumerate(y):
        m, p = f @ m, f @ p @ f.T + q
        mask = ~np.isnan(value)
        old, wide, weight = r, p, 0.9 * u
        for k in range(4):
            hm, rm = h[mask], r[np.ix_(mask, mask)]
            gain = wide @ hm.T @ np.linalg.inv(hm @ wide @ hm.T + rm)
            after = m + gain @ (value - h @ m)[mask], wide - gain @ hm @ wide
            if k == 3:
                break
            e = (value - h @ after[0])[mask]
            fill = old[:, mask] @ np.linalg.inv(old[np.ix_(mask, mask)])
            rest = old - fill @ old[mask]
            moment = np.outer(e, e) + hm @ after[1] @ hm.T
            r = (weight * old + fill @ moment @ fill.T + rest) / (weight + 1)
            wide = (4.0 * p + np.outer(after[0] - m, after[0] - m) + after[1]) / 5.0
        u = weight + 1
        m, p = after
        np.testing.assert_allclose(found.mean[0, t], m, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.variance[0, t], np.diag(p), rtol=1e-9)
