"""Learned measurement noise: recursions in NumPy, the true variance in the long run, limits, missing values, bad input."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from filter_cases import method_of
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    FilterResult,
    GaussianFilter,
    NoiseAdaptation,
    SageHusaAdaptation,
    TaylorLinearisation,
    VariationalNoiseAdaptation,
    run_filter,
)
from pfbench.filter.exactness import has_evidence
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


CASES: dict[str, tuple[NoiseAdaptation, Any]] = {
    "sage_husa": (SageHusaAdaptation(0.9, 0.2), sage_husa),
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
        VariationalNoiseAdaptation(0.999999, 1e15),
    ],
)
def test_the_limit_of_the_parameters_is_the_kalman_filter(adaptation: NoiseAdaptation) -> None:
    y = level_measurements(3, 20, 9.0)
    torch.testing.assert_close(run(y, adaptation).mean, run(y).mean, rtol=1e-9, atol=1e-9)


def test_learned_noise_has_no_evidence() -> None:
    for name in ("sage_husa", "vb_r"):
        assert not has_evidence(method_of(name))
