"""The interacting filter against the IMM of FilterPy, an independent package, on the same model and data."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    InteractingModelFilter,
    LinearisationRule,
    NoiseHypotheses,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.belief import StepInfo
from pfbench.model.linear_gaussian import LinearGaussian

kalman = pytest.importorskip(
    "filterpy.kalman", reason='needs FilterPy: pip install "pfbench[test]"'
)

# two axes of constant velocity, both positions seen
F = np.kron(np.eye(2), [[1.0, 0.5], [0.0, 1.0]])
G = np.kron(np.eye(2), [[0.125], [0.5]]) * 0.6
H = np.kron(np.eye(2), [[1.0, 0.0]])
SENSOR, START = np.array([0.7, 1.2]), np.array([2.0, 1.0, 2.0, 1.0])
CHAIN = np.array([[0.96, 0.04], [0.2, 0.8]])
PROCESS, MEASUREMENT = (1.0, 20.0), (1.0, 3.0)
STATIONARY = np.array([0.2, 0.04]) / 0.24
STEPS, RUNS = 60, 5


class ModeSeries(NamedTuple):
    """Results of a filter: mode probabilities [R, T, 2], means [R, T, 4], covariances [R, T, 4, 4]."""

    probability: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def draw_measurements() -> np.ndarray:
    """Measurements [R, T, 2] whose noises follow the chain."""
    rng = np.random.default_rng(8)
    y = np.empty((RUNS, STEPS, 2))
    for run in range(RUNS):
        x, mode = START * rng.normal(size=4), int(rng.random() > STATIONARY[0])
        for t in range(STEPS):
            x = F @ x + math.sqrt(PROCESS[mode]) * G @ rng.normal(size=2)
            y[run, t] = H @ x + math.sqrt(MEASUREMENT[mode]) * SENSOR * rng.normal(size=2)
            mode = int(rng.random() > CHAIN[mode, 0])
    return y


def run_filterpy(y: np.ndarray, chain: np.ndarray = CHAIN) -> ModeSeries:
    """Run FilterPy's estimator."""
    rows = []
    for series in y:
        filters = []
        for q, r in zip(PROCESS, MEASUREMENT, strict=True):
            single = kalman.KalmanFilter(dim_x=4, dim_z=2)
            single.x, single.P = np.zeros((4, 1)), np.diag(START**2)
            single.F, single.H = F, H
            single.Q, single.R = q * G @ G.T, r * np.diag(SENSOR**2)
            filters.append(single)
        bank = kalman.IMMEstimator(filters, STATIONARY, chain)
        for value in series:
            bank.predict()
            bank.update(value[:, None])
            rows.append((bank.mu.copy(), bank.x[:, 0].copy(), bank.P.copy()))
    values = [np.array(column) for column in zip(*rows, strict=True)]
    return ModeSeries(*(a.reshape(RUNS, STEPS, *a.shape[1:]) for a in values))


def run_package(y: np.ndarray, rule: LinearisationRule) -> ModeSeries:
    model = LinearGaussian(
        F.tolist(), G.tolist(), H.tolist(), SENSOR.tolist(), [0.0] * 4, START.tolist()
    )
    method = InteractingModelFilter(
        NoiseHypotheses(PROCESS, MEASUREMENT, CHAIN.tolist()), linearisation=rule
    )

    def watch(t: int, info: StepInfo) -> dict[str, torch.Tensor]:
        return {"covariance": info.covariance()}

    draws = PhiloxStream(1, torch.arange(RUNS))
    result = run_filter(method, model, Record(torch.from_numpy(y)), draws, watch)
    second = result.trace["hypothesis"].numpy()
    probability = np.stack([1.0 - second, second], -1)
    return ModeSeries(probability, result.mean.numpy(), result.trace["covariance"].numpy())


@pytest.mark.parametrize("rule", [TaylorLinearisation(), SigmaPointLinearisation(CubaturePoints())])
def test_the_interacting_filter_is_that_of_filterpy(rule: LinearisationRule) -> None:
    """Two modes of process and measurement noise: probabilities, means and covariances to 1e-8."""
    y = draw_measurements()
    result, reference = run_package(y, rule), run_filterpy(y)
    for name in ModeSeries._fields:
        value, expected = getattr(result, name), getattr(reference, name)
        np.testing.assert_allclose(value, expected, rtol=1e-8, atol=1e-8, err_msg=name)
    # the data visit both modes, and another chain has other probabilities
    assert reference.probability[..., 1].min() < 0.05
    assert reference.probability[..., 1].max() > 0.95
    other = run_filterpy(y, CHAIN[::-1, ::-1])
    assert np.abs(other.probability - result.probability).max() > 0.1
