"""Bank of filters: the mixture that it starts from, NumPy's bank on a linear model, one filter alone, bad input."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from pfbench.core import PhiloxStream, Record
from pfbench.filter import FilterBank, FilterResult, GaussianFilter, TaylorLinearisation, run_filter
from pfbench.filter.marginal.filter_bank import split_normal
from pfbench.model.linear_gaussian import LinearGaussian

F = np.array([[1.0, 1.0], [0.0, 1.0]])
G = np.array([[0.5], [1.0]]) * 0.4
H = np.array([[1.0, 0.0]])
Y = np.array([0.4, 1.1, math.nan, 2.7, 9.5, 5.8])
P0 = np.diag([2.25, 1.0])
Groups = dict[str, tuple[int, ...]]


def model() -> LinearGaussian:
    return LinearGaussian(F.tolist(), G.tolist(), H.tolist(), [0.8], [0.0, 0.0], [1.5, 1.0])


def run(method: FilterBank | GaussianFilter, groups: Groups | None = None) -> FilterResult:
    record = Record(torch.tensor(np.tile(Y, (2, 1)))[..., None])
    described = model()
    described.groups = groups or described.groups
    return run_filter(method, described, record, PhiloxStream(1, torch.arange(2)))


@pytest.mark.parametrize("points", [2, 3, 4, 5, 9, 20])
def test_the_mixture_is_close_to_the_normal_distribution_and_has_its_moments(points: int) -> None:
    node, log_w, sd = (a.numpy() for a in split_normal(points, torch.zeros(1, dtype=torch.float64)))
    w = np.exp(log_w)
    assert w.sum() == pytest.approx(1.0)
    assert w @ node == pytest.approx(0.0, abs=1e-12)
    assert w @ node**2 + sd**2 == pytest.approx(1.0)
    assert sd < 1.0
    x = np.linspace(-6.0, 6.0, 2001)
    density = stats.norm.pdf(x[:, None], node, sd) @ w
    assert np.trapezoid(np.abs(density - stats.norm.pdf(x)), x) / 2 < 0.02


def distance(points: int) -> tuple[float, float]:
    """Kullback-Leibler divergence from the normal distribution, and the spread of a component."""
    node, log_w, sd = (a.numpy() for a in split_normal(points, torch.zeros(1, dtype=torch.float64)))
    x = np.linspace(-8.0, 8.0, 4001)
    normal, mixture = stats.norm.pdf(x), stats.norm.pdf(x[:, None], node, sd) @ np.exp(log_w)
    return float(np.trapezoid(normal * np.log(normal / mixture), x)), float(sd)


def test_a_denser_bank_is_closer_and_has_narrower_components() -> None:
    """81 filters on two axes are 9 points, 400 are 20. From 4 points on, each one more is closer."""
    distances, widths = zip(*map(distance, range(4, 41)), strict=True)
    assert (np.diff(distances) < 0.0).all()
    assert (np.diff(widths) < 0.0).all()
    assert distance(20)[0] < 0.1 * distance(9)[0] < 1e-5


def numpy_bank(points: int, axes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, float]:
    """Kalman filters from the components, weighed by their evidence, with loops."""
    node, log_w, sd = (a.numpy() for a in split_normal(points, torch.zeros(1, dtype=torch.float64)))
    states = []
    for index in np.ndindex(*[points] * len(axes)):
        x, scale, log = np.zeros(2), np.ones(2), 0.0
        for axis, i in zip(axes, index, strict=True):
            x[axis], scale[axis] = P0[axis, axis] ** 0.5 * node[i], float(sd)
            log += log_w[i]
        states.append([x, P0 * np.outer(scale, scale), log])
    means, variances = [], []
    for y in Y:
        for state in states:
            x, p = F @ state[0], F @ state[1] @ F.T + G @ G.T
            if not math.isnan(y):
                s = (H @ p @ H.T)[0, 0] + 0.64
                k = p @ H.T / s
                state[2] += stats.norm.logpdf(y, (H @ x)[0], math.sqrt(s))
                x, p = x + k[:, 0] * (y - (H @ x)[0]), p - k @ H @ p
            state[:2] = [x, p]
        logs = np.array([state[2] for state in states])
        w = np.exp(logs - np.logaddexp.reduce(logs))
        xs = np.array([state[0] for state in states])
        mean = w @ xs
        inner = np.array([np.diag(state[1]) for state in states])
        means.append(mean)
        variances.append(w @ (inner + (xs - mean) ** 2))
    return np.array(means), np.array(variances), float(np.logaddexp.reduce(logs))


@pytest.mark.parametrize("points", [2, 5])
def test_the_bank_is_that_of_numpy(points: int) -> None:
    """Both states are split. A number of filters between two squares is rounded down."""
    mean, variance, log_z = numpy_bank(points, (0, 1))
    result = run(FilterBank(branches=points**2 + 1))
    for r in range(2):
        np.testing.assert_allclose(result.mean[r], mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(result.variance[r], variance, rtol=1e-9)
        assert float(result.log_evidence[r]) == pytest.approx(log_z, rel=1e-9)


@pytest.mark.parametrize(("group", "axes"), [("place", (0,)), ("rate", (1,)), (None, (0,))])
def test_a_group_of_states_is_split_alone(group: str | None, axes: tuple[int, ...]) -> None:
    mean, _, log_z = numpy_bank(7, axes)
    result = run(FilterBank(branches=7, group=group), groups={"place": (0,), "rate": (1,)})
    np.testing.assert_allclose(result.mean[0], mean, rtol=1e-9, atol=1e-9)
    assert float(result.log_evidence[0]) == pytest.approx(log_z, rel=1e-9)


def test_a_correlated_start_keeps_its_moments() -> None:
    """The mixture along the axes of the Cholesky factor has the mean and covariance of the start."""
    spread = torch.tensor([[2.0, 0.0], [-1.5, 0.7]], dtype=torch.float64).expand(1, 2, 2)
    start = torch.tensor([[3.0, -4.0]], dtype=torch.float64)
    stream = PhiloxStream(1, torch.arange(1))
    memory = FilterBank(branches=25).init(model(), 1, stream, start, spread).memory
    w, offset = memory["branch_log_weight"][0].exp(), memory["branch_offset"][0]
    moments = (
        w[:, None, None] * (memory["branch_covariance"][0] + offset[:, :, None] * offset[:, None])
    ).sum(0)
    torch.testing.assert_close(w @ offset, torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(moments, spread[0] @ spread[0].mT)


@pytest.mark.parametrize(("sd", "is_finite"), [(1.0, True), (0.0, True), (math.nan, False)])
def test_a_singular_start_is_split_and_one_that_is_no_number_loses_the_run(
    sd: float, is_finite: bool
) -> None:
    spread = torch.diag(torch.tensor([1.5, sd], dtype=torch.float64)).repeat(2, 1, 1)
    draws, zero = PhiloxStream(1, torch.arange(2)), torch.zeros(2, 2, dtype=torch.float64)
    covariance = (
        FilterBank(branches=9).init(model(), 2, draws, zero, spread).memory["branch_covariance"]
    )
    assert torch.isfinite(covariance).all() == is_finite
    if is_finite:
        assert bool((covariance[..., 1, 1] > 0).all()) == (sd > 0)
        assert bool((covariance[..., 0, 0] > 0).all())


def test_a_bank_of_one_filter_is_that_filter() -> None:
    single, bank = run(GaussianFilter(TaylorLinearisation())), run(FilterBank(branches=1))
    torch.testing.assert_close(bank.mean, single.mean)
    torch.testing.assert_close(bank.variance, single.variance)
    torch.testing.assert_close(bank.log_evidence, single.log_evidence)


def test_a_group_that_the_model_lacks_is_refused() -> None:
    with pytest.raises(ValueError, match=r"filter\.group must be of .*, got wheel\. Choose"):
        run(FilterBank(group="wheel"))
