"""Several hypotheses: NumPy's IMM, the exact mixture over all sequences, evidence, limits, angles, bad input."""

import math
from itertools import product
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
    NoiseHypotheses,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.robust.multiple_models import (
    GaussianSumFilter,
    InteractingModelFilter,
    MixtureKalmanFilter,
    select_unbiased,
)
from pfbench.model.linear_gaussian import LinearGaussian

F = np.array([[1.0, 1.0], [0.0, 1.0]])
G = np.array([[0.5], [1.0]]) * 0.4
Q = G @ G.T
H = np.array([[1.0, 0.0]])
R = np.array([[0.64]])
P0 = np.diag([2.25, 1.0])
CHAIN = np.array([[0.95, 0.05], [0.3, 0.7]])
QF, RF = (1.0, 25.0), (1.0, 4.0)
LAW = np.array([0.3, 0.05]) / 0.35  # stationary
Y = np.array([0.4, 1.1, 2.9, 2.7, 9.5, 5.8, 6.6, 7.1])


def model() -> LinearGaussian:
    return LinearGaussian(F.tolist(), G.tolist(), H.tolist(), [0.8], [0.0, 0.0], [1.5, 1.0])


def run(method: Any, y: np.ndarray = Y) -> FilterResult:
    record = Record(torch.tensor(np.atleast_2d(y))[..., None])
    return run_filter(method, model(), record, PhiloxStream(1, torch.arange(len(record.y))))


def kalman(x: np.ndarray, p: np.ndarray, y: float, qf: float, rf: float) -> tuple[Any, ...]:
    """A Kalman step by the textbook: mean, covariance, log evidence."""
    x, p = F @ x, F @ p @ F.T + qf * Q
    if math.isnan(y):
        return x, p, 0.0
    s = (H @ p @ H.T + rf * R)[0, 0]
    k, e = p @ H.T / s, y - (H @ x)[0]
    return x + k[:, 0] * e, p - k @ H @ p, -0.5 * (e * e / s + math.log(2 * math.pi * s))


def numpy_imm(
    y: np.ndarray, chain: np.ndarray, qf: Any, rf: Any, law: np.ndarray
) -> tuple[Any, ...]:
    """Blom and Bar-Shalom's recursion, with loops over hypotheses."""
    m = len(law)
    xs, ps, mu = [np.zeros(2)] * m, [P0] * m, law
    means, variances, log_z = [], [], 0.0
    for value in y:
        c = mu @ chain
        x0, p0 = [], []
        for j in range(m):
            w = mu * chain[:, j] / c[j]
            centre = sum(w[i] * xs[i] for i in range(m))
            x0.append(centre)
            p0.append(
                sum(w[i] * (ps[i] + np.outer(xs[i] - centre, xs[i] - centre)) for i in range(m))
            )
        new = [kalman(x0[j], p0[j], value, qf[j], rf[j]) for j in range(m)]
        xs, ps = [a[0] for a in new], [a[1] for a in new]
        joint = c * np.exp([a[2] for a in new])
        log_z += math.log(joint.sum())
        mu = joint / joint.sum()
        mean = sum(mu[j] * xs[j] for j in range(m))
        means.append(mean)
        variances.append(
            np.diag(sum(mu[j] * (ps[j] + np.outer(xs[j] - mean, xs[j] - mean)) for j in range(m)))
        )
    return np.array(means), np.array(variances), log_z


def exact_mixture(y: np.ndarray) -> tuple[Any, ...]:
    """Moments at the last step and the evidence, from all sequences of hypotheses."""
    logs, xs, ps = [], [], []
    for sequence in product(range(2), repeat=len(y)):
        x, p, log = np.zeros(2), P0, math.log(LAW[sequence[0]])
        for t, j in enumerate(sequence):
            log += math.log(CHAIN[sequence[t - 1], j]) if t else 0.0
            x, p, step = kalman(x, p, y[t], QF[j], RF[j])
            log += step
        logs.append(log), xs.append(x), ps.append(p)
    top = max(logs)
    w = np.exp(np.array(logs) - top)
    log_z = top + math.log(w.sum())
    w /= w.sum()
    mean = w @ np.array(xs)
    p = sum(a * (b + np.outer(c - mean, c - mean)) for a, b, c in zip(w, ps, xs, strict=True))
    return mean, np.diag(p), log_z


def hypotheses(**changes: Any) -> NoiseHypotheses:
    return NoiseHypotheses(**{"process_factors": QF, "measurement_factors": RF, "transition": CHAIN.tolist(), **changes})  # fmt: skip


@pytest.mark.parametrize("missing", [(), (2, 4)])
def test_the_interacting_filter_is_that_of_the_textbook(missing: tuple[int, ...]) -> None:
    y = Y.copy()
    y[list(missing)] = math.nan
    mean, variance, log_z = numpy_imm(y, CHAIN, QF, RF, LAW)
    found = run(InteractingModelFilter(hypotheses()), y)
    np.testing.assert_allclose(found.mean[0], mean, rtol=1e-11)
    np.testing.assert_allclose(found.variance[0], variance, rtol=1e-11)
    assert float(found.log_evidence[0]) == pytest.approx(log_z, rel=1e-11)


def test_three_hypotheses_with_impossible_transitions() -> None:
    chain = np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.5, 0.0, 0.5]])
    law = np.linalg.matrix_power(chain, 500)[0]
    qf, rf = (1.0, 9.0, 1.0), (1.0, 1.0, 50.0)
    mean, variance, log_z = numpy_imm(Y, chain, qf, rf, law)
    found = run(InteractingModelFilter(NoiseHypotheses(qf, rf, chain.tolist())))
    np.testing.assert_allclose(found.mean[0], mean, rtol=1e-10)
    np.testing.assert_allclose(found.variance[0], variance, rtol=1e-10)
    assert float(found.log_evidence[0]) == pytest.approx(log_z, rel=1e-10)


@pytest.mark.parametrize("method", [GaussianSumFilter, MixtureKalmanFilter])
def test_a_gaussian_sum_of_all_sequences_is_exact(method: Any) -> None:
    mean, variance, log_z = exact_mixture(Y)
    found = run(method(hypotheses(), branches=2 ** len(Y)))
    np.testing.assert_allclose(found.mean[0, -1], mean, rtol=1e-10)
    np.testing.assert_allclose(found.variance[0, -1], variance, rtol=1e-10)
    assert float(found.log_evidence[0]) == pytest.approx(log_z, abs=1e-10)


def test_few_branches_and_merging_are_near_the_exact_mixture() -> None:
    """Orders of the design: eight branches within 0.05 sd, one merged branch within 0.5 sd."""
    mean, variance, log_z = exact_mixture(Y)

    def distance(method: Any) -> tuple[float, float]:
        found = run(method)
        apart = (found.mean[0, -1].numpy() - mean) / np.sqrt(variance)
        return float(np.abs(apart).max()), abs(float(found.log_evidence[0]) - log_z)

    eight, merged = (
        distance(GaussianSumFilter(hypotheses(), branches=8)),
        distance(InteractingModelFilter(hypotheses())),
    )
    assert eight[0] < 0.05
    assert eight[1] < 0.1
    assert 1e-6 < merged[0] < 0.5
    assert merged[1] < 0.6


def test_few_sequences_of_a_discrete_state_have_the_evidence_of_all() -> None:
    """E Z = Z over 1500 runs of the same measurements; the heaviest sequences alone fall short."""
    _, _, log_z = exact_mixture(Y)
    y = np.tile(Y, (1500, 1))
    ratio = (run(MixtureKalmanFilter(hypotheses(), branches=3), y).log_evidence - log_z).exp()
    error = float(ratio.std()) / math.sqrt(len(ratio))
    heaviest = float(run(GaussianSumFilter(hypotheses(), branches=3)).log_evidence[0])
    assert abs(float(ratio.mean()) - 1.0) < 4 * error
    assert abs(math.exp(heaviest - log_z) - 1.0) > 8 * error


def test_sequences_are_drawn_with_their_weights() -> None:
    """Expected weights are the weights, heavy ones stay, none is drawn twice."""
    rng = np.random.default_rng(3)
    w = rng.dirichlet(0.3 * np.ones(12))
    levels = (torch.arange(4000, dtype=torch.float64)[:, None] + 0.5) / 4000
    log_w = torch.tensor(w).log().expand(4000, -1)
    index, kept = select_unbiased(log_w, 5, levels)
    assert all(len(set(row)) == 5 for row in index[:500].tolist())
    drawn = torch.zeros_like(log_w).scatter_add_(1, index, kept.exp()).numpy()
    np.testing.assert_allclose(drawn.mean(0), w, atol=2e-4)  # an integral over the level
    assert (drawn[:, w > w.sum() / 5] == w[w > w.sum() / 5]).all()
    few = torch.tensor([[0.7, 0.3, 0.0, 0.0]]).log()
    index, kept = select_unbiased(few, 3, torch.tensor([[0.4]]))
    assert index[0, :2].tolist() == [0, 1]
    assert kept[0].exp().tolist() == pytest.approx([0.7, 0.3, 0.0])


@pytest.mark.parametrize("name", ["imm", "gpb1", "gaussian_sum", "rbpf_discrete"])
def test_the_evidence_is_a_density(name: str) -> None:
    """It integrates to 1 over the second measurement, given the first."""
    grid = np.linspace(-60.0, 60.0, 2001)
    first = float(run(method_of(name), np.array([0.7])).log_evidence[0])
    both = run(method_of(name), np.stack([np.full_like(grid, 0.7), grid], 1)).log_evidence
    assert np.trapezoid(np.exp(both.numpy() - first), grid) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("method", [InteractingModelFilter, GaussianSumFilter, MixtureKalmanFilter])
def test_equal_hypotheses_are_the_kalman_filter(method: Any) -> None:
    same = hypotheses(process_factors=(1.0, 1.0), measurement_factors=(1.0, 1.0))
    found, plain = run(method(same)), run(GaussianFilter(TaylorLinearisation()))
    torch.testing.assert_close(found.mean, plain.mean, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found.variance, plain.variance, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found.log_evidence, plain.log_evidence, rtol=1e-10, atol=1e-10)


def test_an_outlier_moves_the_estimate_to_a_limit_only() -> None:
    def estimate(value: float) -> Tensor:
        y = Y.copy()
        y[-1] = value
        return run(method_of("gpb1"), y).mean[0, -1, 0]

    near, far, farther = (float(estimate(v)) for v in (7.1, 1e2, 2e2))
    plain = float(run(method_of("ekf"), np.append(Y[:-1], 1e2)).mean[0, -1, 0])
    assert abs(far - near) < 0.2 * abs(plain - near)
    assert far < farther  # R x 100 is a limit of the slope, not of the influence


def test_the_trace_names_the_outlier() -> None:
    y = np.array([0.1, 0.2, 0.3, 15.0, 0.5])
    trace = run(method_of("gpb1"), y).trace["hypothesis"][0]
    assert float(trace[3]) > 0.99
    assert float(trace[[0, 1, 2, 4]].max()) < 0.1


def test_the_nis_is_of_the_predicted_mixture() -> None:
    method, first = InteractingModelFilter(hypotheses()), Record(torch.tensor([[Y[0]]]))
    draws = PhiloxStream(1, torch.arange(1)).at_step(0)
    _, info = method.step(model(), method.init(model(), 1, draws), first, draws)
    s = sum(
        w * ((H @ (F @ P0 @ F.T + qf * Q) @ H.T)[0, 0] + rf * R[0, 0])
        for w, qf, rf in zip(LAW, QF, RF, strict=True)
    )
    assert info.nis is not None
    nis, count = info.nis()
    assert float(nis[0]) == pytest.approx(Y[0] ** 2 / s, rel=1e-10)
    assert int(count[0]) == 1
