"""Robust weights of particles against the same recursion on a grid, against NumPy, and at their limits."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from filter_cases import method_of
from scipy import integrate, stats
from torch import Tensor
from torch.distributions import Distribution, Laplace, MultivariateNormal

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CorrentropyUpdate,
    FilterResult,
    HuberUpdate,
    InnovationGate,
    ParticleFilter,
    RobustWeightUpdate,
    StudentUpdate,
    WeightedLikelihoodUpdate,
    run_filter,
)
from pfbench.filter.exactness import has_evidence
from pfbench.filter.robust.robust_update import huber_log_density, student_log_density
from pfbench.model.linear_gaussian import LinearGaussian

Q, DOF = 0.25, 3.0
GRID = np.arange(-25.0, 25.0, 0.05)


def level() -> LinearGaussian:
    """Return a level with steps of variance 0.25 and errors of variance 1."""
    eye = [[1.0]]
    return LinearGaussian(eye, [[math.sqrt(Q)]], eye, [1.0], [0.0], [1.0])


def level_series(series: int = 10, steps: int = 20) -> np.ndarray:
    rng = np.random.default_rng(7)
    x = rng.normal(size=(series, 1)) + np.cumsum(0.5 * rng.normal(size=(series, steps)), 1)
    return np.asarray(x + rng.standard_t(DOF, size=x.shape))


def run(update: Any, y: np.ndarray, seed: int = 0, particles: int = 1000) -> FilterResult:
    method = ParticleFilter(particles, weight_update=RobustWeightUpdate(update))
    draws = PhiloxStream(seed, torch.arange(len(y)))
    return run_filter(method, level(), Record(torch.tensor(y).unsqueeze(-1)), draws)


# one dimension against a grid

Factor = Callable[[np.ndarray, float, float], np.ndarray]


def gate_factor(e: np.ndarray, r: float, s: float) -> np.ndarray:
    return np.zeros_like(e) if r * r / s > stats.chi2.ppf(0.99, 1) else stats.norm.logpdf(e)


def huber_factor(e: np.ndarray, r: float, s: float) -> np.ndarray:
    constant = math.sqrt(2 * math.pi) * math.erf(1.5 / math.sqrt(2)) + 2 / 1.5 * math.exp(-1.125)
    loss = np.where(np.abs(e) < 1.5, e * e / 2, 1.5 * np.abs(e) - 1.125)
    return -loss - math.log(constant)


LAWS: dict[str, tuple[Any, Factor]] = {
    "gate": (InnovationGate(0.99, patience=0), gate_factor),
    "huber": (HuberUpdate(1.5), huber_factor),
    "student": (StudentUpdate(DOF), lambda e, r, s: stats.t.logpdf(e, DOF)),
    "correntropy": (CorrentropyUpdate(2.0), lambda e, r, s: -4.0 * (1 - np.exp(-e * e / 8))),
    "wolf": (
        WeightedLikelihoodUpdate(threshold=2.0),
        lambda e, r, s: stats.norm.logpdf(e) / (1.0 + r * r / 4.0),
    ),
}


def grid_filter(y: np.ndarray, factor: Factor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, variance [R, T] and log evidence [R] of the level by NumPy; r and s are of the prediction."""
    kernel = stats.norm.pdf(GRID[:, None] - GRID, scale=math.sqrt(Q))
    kernel /= kernel.sum(1, keepdims=True)
    density, log_z = np.tile(stats.norm.pdf(GRID), (len(y), 1)), np.zeros(len(y))
    density /= density.sum(1, keepdims=True)
    means, variances = [], []
    for t in range(y.shape[1]):
        density = density @ kernel
        mean = density @ GRID
        s = density @ GRID**2 - mean**2 + 1.0
        e = y[:, t, None] - GRID
        density *= np.exp([factor(*a) for a in zip(e, y[:, t] - mean, s, strict=True)])
        total = density.sum(1, keepdims=True)
        log_z, density = log_z + np.log(total[:, 0]), density / total
        means.append(density @ GRID)
        variances.append(density @ GRID**2 - means[-1] ** 2)
    return np.stack(means, 1), np.stack(variances, 1), log_z


@pytest.mark.parametrize("name", LAWS)
def test_particles_converge_to_the_same_recursion_on_a_grid(name: str) -> None:
    y, (update, factor) = level_series(), LAWS[name]
    mean, variance, log_z = grid_filter(y, factor)
    first, second = (run(update, y, seed) for seed in (0, 1))
    both = np.stack([a.mean[..., 0].numpy() for a in (first, second)])
    spread = np.median(np.abs(both[0] - both[1])) / math.sqrt(2)  # of one estimate
    assert spread < 0.05
    assert np.median(np.abs(both[0] - mean)) < 1.5 * spread
    ratio = np.median(first.variance[..., 0].numpy() / variance)
    assert ratio == pytest.approx(1.0, abs=0.03)
    if has_evidence(ParticleFilter(9, weight_update=RobustWeightUpdate(update))):
        differences = np.concatenate([a.log_evidence.numpy() - log_z for a in (first, second)])
        error = differences.std() / math.sqrt(len(differences))
        assert abs(differences.mean()) < 4 * error + 0.5 * differences.var()


def test_normal_weights_are_far_from_the_posterior_of_student_errors() -> None:
    """The power of the test above: the particle filter without the loss is ten times as far."""
    y = level_series()
    mean, _, _ = grid_filter(y, LAWS["student"][1])
    distance = {
        name: math.sqrt(np.square(run(update, y).mean[..., 0].numpy() - mean).mean())
        for name, update in (("student", StudentUpdate(DOF)), ("normal", StudentUpdate(math.inf)))
    }
    assert 5 * distance["student"] < distance["normal"]


# losses


@pytest.mark.parametrize("k", [1, 2, 3, 6])
def test_losses_are_densities(k: int) -> None:
    sphere = 2 * math.pi ** (k / 2) / math.gamma(k / 2)
    size = torch.tensor(float(k), dtype=torch.float64)

    def total(log_density: Callable[[Tensor], Tensor]) -> float:
        def shell(d: float) -> float:
            value = log_density(torch.tensor(d * d, dtype=torch.float64))
            return sphere * d ** (k - 1) * math.exp(float(value))

        return sum(integrate.quad(shell, *ends)[0] for ends in ((0, 1.3), (1.3, 60), (60, 1e4)))

    c = torch.tensor(1.3, dtype=torch.float64)
    assert total(lambda d2: huber_log_density(d2, size, c)) == pytest.approx(1.0, abs=1e-6)
    assert total(lambda d2: student_log_density(d2, size, 4.0)) == pytest.approx(1.0, abs=1e-6)
    value = float(student_log_density(torch.tensor(2.0), size, 4.0))
    point = np.r_[math.sqrt(2.0), np.zeros(k - 1)]
    assert value == pytest.approx(stats.multivariate_t.logpdf(point, np.zeros(k), np.eye(k), 4.0))


# several components


class Correlated(LinearGaussian):
    """Two states and three sensors with correlated errors."""

    covariance = torch.tensor([[1.0, 0.4, 0.1], [0.4, 0.7, 0.0], [0.1, 0.0, 0.5]])

    def observation(self, x: Tensor, u: object) -> Distribution:
        return MultivariateNormal(
            x @ self.h.mT, self.covariance.to(x).expand(len(x), x.shape[1], 3, 3)
        )


MATRICES: Any = ([[1.0, 0.5], [0.0, 0.9]], [[0.6, 0.0], [0.2, 0.5]])
SENSORS: Any = [[1.0, 0.0], [0.3, 1.0], [0.5, -0.5]]
TRACKER = LinearGaussian(*MATRICES, SENSORS, [1.0, 0.8, 0.8], [0.0, 0.0], [1.5, 1.0])
CORRELATED = Correlated(*MATRICES, SENSORS, [1.0, 0.8, 0.8], [0.0, 0.0], [1.5, 1.0])
PARTS: dict[str, list[list[int]]] = {
    "all": [[0, 1, 2]],
    "sensor": [[0], [1, 2]],
    "component": [[0], [1], [2]],
}


def a_cloud() -> tuple[Tensor, Tensor, Tensor]:
    """Three runs: states [3, 5, 2], log weights [3, 5], and y [3, 3] with missing components."""
    rng = np.random.default_rng(2)
    y = 2.5 * rng.normal(size=(3, 3))
    y[1, 1], y[2] = np.nan, np.nan
    log_w = np.log(rng.dirichlet(np.ones(5), size=3))
    return torch.tensor(rng.normal(size=(3, 5, 2))), torch.tensor(log_w), torch.tensor(y)


def expected_weights(name: str, parts: list[list[int]], covariance: np.ndarray) -> np.ndarray:
    """Log weights of the cloud by NumPy, one group after the other."""
    x, log_w, y = (a.numpy() for a in a_cloud())
    h, result = np.array(SENSORS), log_w.copy()
    for i in range(3):
        w = np.exp(log_w[i])
        z = x[i] @ h.T
        mean = w @ z
        s = (w[:, None] * (z - mean)).T @ (z - mean) + covariance
        for part in parts:
            g = [j for j in part if not np.isnan(y[i, j])]
            if not g:
                continue
            r, e = (y[i] - mean)[g], (y[i] - z)[:, g]
            cov, inner = covariance[np.ix_(g, g)], np.linalg.inv(covariance[np.ix_(g, g)])
            normal = stats.multivariate_normal.logpdf(e, np.zeros(len(g)), cov).reshape(5)
            d = np.sqrt(np.einsum("nk,kl,nl->n", e, inner, e))
            if name == "gate":
                inside = r @ np.linalg.inv(s[np.ix_(g, g)]) @ r < stats.chi2.ppf(0.9, len(g))
                result[i] += normal if inside else 0.0
            elif name == "wolf":
                result[i] += normal / (1.0 + r @ inner @ r / 4.0)
            elif name == "huber":
                result[i] += normal + d * d / 2 - np.where(d < 1.2, d * d / 2, 1.2 * d - 0.72)
            elif name == "correntropy":
                result[i] += normal + d * d / 2 - 1.44 * (1 - np.exp(-d * d / 2.88))
            else:
                law = stats.multivariate_t(np.zeros(len(g)), cov, 4.0)
                result[i] += law.logpdf(e).reshape(5)
    return result


@pytest.mark.parametrize("grouping", PARTS)
@pytest.mark.parametrize("name", LAWS)
def test_weights_by_group_and_missing_components(name: str, grouping: str) -> None:
    update: Any = {
        "gate": InnovationGate(0.9, grouping=grouping),
        "wolf": WeightedLikelihoodUpdate(threshold=2.0, grouping=grouping),
        "huber": HuberUpdate(1.2, grouping=grouping),
        "correntropy": CorrentropyUpdate(1.2, grouping=grouping),
        "student": StudentUpdate(4.0, grouping=grouping),
    }[name]
    x, log_w, y = a_cloud()
    diagonal = np.diag([1.0, 0.64, 0.64])
    for model, covariance in ((TRACKER, diagonal), (CORRELATED, CORRELATED.covariance.numpy())):
        if model is CORRELATED and grouping != "all":
            continue  # correlations between groups are ignored
        result = RobustWeightUpdate(update).update_weights(
            model, log_w, x, torch.zeros_like(log_w), Record(y), {}
        )
        expected = expected_weights(name, PARTS[grouping], np.asarray(covariance, float))
        log_ratio = result.log_w.numpy() - expected  # equal for all particles of a run
        np.testing.assert_allclose(log_ratio - log_ratio[:, :1], 0.0, atol=1e-6)
        if name in ("gate", "wolf", "student"):
            np.testing.assert_allclose(log_ratio, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "update",
    [
        InnovationGate(1.0),
        HuberUpdate(math.inf),
        StudentUpdate(math.inf),
        CorrentropyUpdate(1e7),
        WeightedLikelihoodUpdate(threshold=1e9),
    ],
    ids=lambda update: type(update).__name__,
)
def test_the_limit_of_each_update_is_sir(update: Any) -> None:
    y = torch.tensor(np.random.default_rng(4).normal(size=(3, 12, 3)))
    y[0, 4, 1], y[1, 5] = torch.nan, torch.nan
    draws = PhiloxStream(0, torch.arange(3))
    sir = run_filter(ParticleFilter(60), TRACKER, Record(y), draws)
    method = ParticleFilter(60, weight_update=RobustWeightUpdate(update))
    robust = run_filter(method, TRACKER, Record(y), draws)
    torch.testing.assert_close(robust.mean, sir.mean, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(robust.log_evidence, sir.log_evidence, rtol=1e-8, atol=1e-6)


# memory and counts


def test_a_gate_of_particles_that_rejects_for_long_opens_again() -> None:
    y = np.zeros((4, 30))
    y[:, 10:] += 60.0
    for patience, opens in ((0, False), (5, True)):
        rejected = run(InnovationGate(patience=patience), y, particles=100).trace["rejected"]
        assert bool((rejected[:, 10:15] == 1.0).all())
        assert bool((rejected[:, 15] == 0.0).all()) == opens
        assert bool((rejected[:, :10] == 0.0).all())


@pytest.mark.parametrize("name", LAWS)
def test_outliers_are_counted(name: str) -> None:
    y = 0.3 * np.random.default_rng(5).normal(size=(10, 28))
    y[:, 6::7] += 25.0
    trace = run(LAWS[name][0], y, particles=200).trace
    counts = trace["rejected" if name == "gate" else "downweighted"].numpy()
    assert counts[:, 6::7].mean() > 0.95
    assert np.delete(counts, np.s_[6::7], 1).mean() < 0.1


def test_which_particle_filters_have_an_evidence() -> None:
    """Huber's and Student's weights are densities of y. The others depend on y in other ways."""
    evidence = {f"{name}_pf": has_evidence(method_of(f"{name}_pf")) for name in LAWS}
    assert [name for name, has in evidence.items() if has] == ["huber_pf", "student_pf"]
    assert not any(method_of(name).is_exact for name in evidence)


# bad input


class Skewed(LinearGaussian):
    """A level with Laplace errors."""

    def observation(self, x: Tensor, u: object) -> Distribution:
        return torch.distributions.Independent(Laplace(x, torch.ones_like(x)), 1)


def with_laplace_errors() -> None:
    eye: Any = [[1.0]]
    model = Skewed(eye, eye, eye, [1.0], [0.0], [1.0])
    method = ParticleFilter(9, weight_update=RobustWeightUpdate(HuberUpdate()))
    run_filter(method, model, Record(torch.zeros(1, 2, 1)), PhiloxStream(0, torch.arange(1)))


def test_errors_that_are_not_normal_are_refused() -> None:
    message = r"Skewed.observation must be normal .*, got Laplace.*\. [A-Z]"
    with pytest.raises(ValueError, match=message):
        with_laplace_errors()
