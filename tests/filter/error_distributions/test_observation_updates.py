"""Observation distributions in Gaussian filters: grids of one dimension, limits, missing values, angles, bad input."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from filter_cases import method_of
from refusals import check_refused
from scipy import optimize, stats
from torch import Tensor, distributions as dist

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    FilterResult,
    GaussianFilter,
    GuidedNoiseProposal,
    InnovationGate,
    MixtureObservationUpdate,
    SharedGuideProposal,
    StudentObservationUpdate,
    StudentUpdate,
    run_filter,
    smooth,
)
from pfbench.filter.exactness import has_evidence
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.noise import base as errors

STUDENT, MIXTURE = StudentObservationUpdate(), MixtureObservationUpdate()
RULES = ("ekf", "ukf", "ckf", "iplf", "iekf")
every_rule = pytest.mark.parametrize("rule", RULES)
Family = Callable[[Tensor], Any]


class Level(LinearGaussian):
    """A state x <- 0.9 x + 0.5 w seen by sensors of gains `h`, with errors of any distribution."""

    def __init__(self, family: Family, h: tuple[float, ...] = (1.0,), sd: float = 1.5) -> None:
        rows = [[gain] for gain in h]
        super().__init__([[0.9]], [[0.5]], rows, [1.0] * len(h), [0.0], [sd])
        self.family, self.linear = family, False

    def seen(self, x: Tensor) -> Tensor:
        return x @ self.h.mT

    def observation(self, x: Tensor, u: Any) -> Any:
        return self.family(self.seen(x))


class Curved(Level):
    """h(x) = x + 0.1 x^2 of each sensor."""

    def seen(self, x: Tensor) -> Tensor:
        seen = super().seen(x)
        return seen + 0.1 * seen.square()


def student(dof: float) -> Family:
    return lambda h: dist.Independent(dist.StudentT(h.new_tensor(dof), h, torch.ones_like(h)), 1)


def cauchy(h: Tensor) -> Any:
    return dist.Independent(dist.Cauchy(h, torch.ones_like(h)), 1)


def normal(h: Tensor) -> Any:
    return dist.Independent(dist.Normal(h, torch.ones_like(h)), 1)


WEIGHTS, OFFSETS, SDS = (0.7, 0.3), (0.0, 2.5), (0.8, 2.0)


def skewed(h: Tensor) -> Any:
    """Each sensor by itself: torch's mixture."""
    one = torch.ones_like(h).unsqueeze(-1)
    parts = dist.Normal(h.unsqueeze(-1) + one * h.new_tensor(OFFSETS), one * h.new_tensor(SDS))
    logits = (one * h.new_tensor(WEIGHTS)).log()
    return dist.Independent(dist.MixtureSameFamily(dist.Categorical(logits=logits), parts), 1)


def jointly_skewed(h: Tensor) -> Any:
    """All sensors from the same part: the mixture of the package."""
    parts = [
        dist.Independent(dist.Normal(h + a, s * torch.ones_like(h)), 1)
        for a, s in zip(OFFSETS, SDS, strict=True)
    ]
    return errors.MixtureDistribution(h.new_tensor(WEIGHTS).unbind(), parts)


def jointly_skewed_in_torch(h: Tensor) -> Any:
    root = h.new_tensor(SDS)[:, None, None] * torch.eye(h.shape[-1]).double()
    loc = h.unsqueeze(-2) + h.new_tensor(OFFSETS)[:, None]
    logits = h.new_tensor(WEIGHTS).log().expand(*h.shape[:-1], 2)
    parts = dist.MultivariateNormal(loc, scale_tril=root.expand(*loc.shape, h.shape[-1]))
    return dist.MixtureSameFamily(dist.Categorical(logits=logits), parts)


def run(method: GaussianFilter, model: LinearGaussian, y: Any) -> FilterResult:
    record = Record(torch.as_tensor(y, dtype=torch.float64))
    return run_filter(method, model, record, PhiloxStream(1, torch.arange(len(record.y))))


def with_update(rule: str, update: Any) -> GaussianFilter:
    return replace(method_of(rule), measurement_update=update)


def skewed_density(r: np.ndarray, is_joint: bool) -> np.ndarray:
    """Density of residuals [..., k], without code of the package."""
    parts = [stats.norm.pdf(r, a, s) for a, s in zip(OFFSETS, SDS, strict=True)]
    if is_joint:
        return sum(w * p.prod(-1) for w, p in zip(WEIGHTS, parts, strict=True))
    return sum(w * p for w, p in zip(WEIGHTS, parts, strict=True)).prod(-1)


# a step against a grid

GRID = np.linspace(-25.0, 25.0, 20001)


@every_rule
@pytest.mark.parametrize("family", [skewed, jointly_skewed, jointly_skewed_in_torch])
@pytest.mark.parametrize("missing", [(), (1,)])
def test_a_step_with_a_mixture_has_the_moments_of_the_posterior(
    rule: str, family: Family, missing: tuple[int, ...]
) -> None:
    """For a linear h mean, variance and evidence are those of the posterior on a grid."""
    gains = (1.0, 0.5, -0.7)
    y = np.array([4.0, -1.0, 0.6])
    y[list(missing)] = math.nan
    result = run(with_update(rule, MIXTURE), Level(family, gains), y[None, None])
    observed = ~np.isnan(y)
    r = y[observed] - GRID[:, None] * np.array(gains)[observed]
    prior = stats.norm.pdf(GRID, scale=math.sqrt(0.9**2 * 1.5**2 + 0.5**2))
    joint = prior * skewed_density(r, family is not skewed)
    evidence = np.trapezoid(joint, GRID)
    mean = np.trapezoid(joint * GRID, GRID) / evidence
    variance = np.trapezoid(joint * (GRID - mean) ** 2, GRID) / evidence
    assert float(result.mean[0, 0, 0]) == pytest.approx(mean, abs=1e-8)
    assert float(result.variance[0, 0, 0]) == pytest.approx(variance, rel=1e-8)
    assert float(result.log_evidence[0]) == pytest.approx(math.log(evidence), abs=1e-8)


@pytest.mark.parametrize("rule", ["ekf", "iplf"])
def test_the_evidence_of_a_mixture_is_a_density(rule: str) -> None:
    y = np.linspace(-60.0, 60.0, 4001)
    result = run(with_update(rule, MIXTURE), Level(skewed), y[:, None, None])
    assert np.trapezoid(result.log_evidence.exp().numpy(), y) == pytest.approx(1.0, abs=1e-8)
    assert has_evidence(with_update(rule, MIXTURE))
    assert not has_evidence(with_update(rule, STUDENT))


# whole series against a grid filter

STATES = np.arange(-30.0, 30.0, 0.05)


def draw_series(draw: Callable[..., np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """States and measurements of 20 series of 40 steps."""
    rng = np.random.default_rng(5)
    x, rows = 1.5 * rng.normal(size=20), []
    for _ in range(40):
        x = 0.9 * x + 0.5 * rng.normal(size=20)
        rows.append(x)
    truth = np.stack(rows, 1)
    return truth, truth + draw(rng, truth.shape)


def grid_filter(
    y: np.ndarray, density: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, variances and log evidence on a grid, by NumPy alone."""
    kernel = stats.norm.pdf(STATES - 0.9 * STATES[:, None], scale=0.5)
    kernel = kernel / kernel.sum(1, keepdims=True)
    weight = np.tile(stats.norm.pdf(STATES, scale=1.5), (len(y), 1))
    weight /= weight.sum(1, keepdims=True)
    means, variances, log_z = [], [], np.zeros(len(y))
    for t in range(y.shape[1]):
        weight = (weight @ kernel) * density(y[:, t, None] - STATES)
        total = weight.sum(1, keepdims=True)
        log_z, weight = log_z + np.log(total[:, 0]), weight / total
        means.append(weight @ STATES)
        variances.append(weight @ STATES**2 - means[-1] ** 2)
    return np.stack(means, 1), np.stack(variances, 1), log_z


def draw_skewed(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    part = (rng.random(shape) > WEIGHTS[0]).astype(int)
    return np.array(OFFSETS)[part] + np.array(SDS)[part] * rng.normal(size=shape)


@cache
def skewed_series() -> tuple[np.ndarray, Any]:
    """Measurements, and their grid filter, which takes as long as the filter under test."""
    _, y = draw_series(draw_skewed)
    return y, grid_filter(y, lambda r: skewed_density(r[..., None], False))


@cache
def student_series(dof: float) -> tuple[np.ndarray, np.ndarray, Any]:
    """States, measurements, and their grid filter."""
    truth, y = draw_series(lambda rng, shape: rng.standard_t(dof, shape))
    return truth, y, grid_filter(y, lambda r: stats.t.pdf(r, dof))


def compare(result: FilterResult, grid: Any) -> Any:
    """Rms distance of the mean to the grid's in posterior standard deviations, ratio of the variances."""
    distance = np.square(result.mean[..., 0].numpy() - grid[0]) / grid[1]
    ratio = float((result.variance[..., 0].numpy() / grid[1]).mean())
    return math.sqrt(distance.mean()), ratio, (result.log_evidence.numpy() - grid[2]).mean()


@every_rule
def test_a_mixture_over_many_steps_is_near_the_posterior(rule: str) -> None:
    """Order of the design for merged hypotheses: mean within 0.1 sd, variance within 5 %, log evidence within 0.6.

    The mean and variance of the distribution alone, which a filter without the update uses, are outside.
    """
    y, grid = skewed_series()
    rms, ratio, log_z = compare(run(with_update(rule, MIXTURE), Level(skewed), y[..., None]), grid)
    assert rms < 0.1, rms
    assert 0.95 < ratio < 1.05, ratio
    assert abs(log_z) < 0.6, log_z
    rms, _, log_z = compare(run(method_of(rule), Level(skewed), y[..., None]), grid)
    assert rms > 0.3, rms
    assert log_z < -2.0, log_z


@every_rule
@pytest.mark.parametrize(("dof", "narrow"), [(3.0, 0.68), (1.0, 0.55)])
def test_student_and_cauchy_errors_are_near_the_posterior(
    rule: str, dof: float, narrow: float
) -> None:
    """Bounds of the design: three degrees of freedom 0.16 of sd 0.78 with variance ratio 0.68 to 0.85, Cauchy RMSE within 15 %."""
    truth, y, grid = student_series(dof)
    family = student(dof) if dof > 1.0 else cauchy
    result = run(with_update(rule, STUDENT), Level(family), y[..., None])
    rms, ratio, _ = compare(result, grid)
    assert narrow < ratio < 0.85, ratio  # the mean field is too narrow
    error = math.sqrt(np.square(result.mean[..., 0].numpy() - truth).mean())
    best = math.sqrt(np.square(grid[0] - truth).mean())
    assert error < 1.15 * best, (error, best)
    assert rms < (0.21 if dof == 3.0 else 0.3), rms
    plain = run(method_of(rule), Level(normal), y[..., None])
    assert math.sqrt(np.square(plain.mean[..., 0].numpy() - truth).mean()) > 1.15 * best


# fixed points, limits, influence


def test_the_scale_solves_its_equation() -> None:
    """One sensor, 60 iterations: lambda = (nu + 1) / (nu + e^2 + P+) by bisection."""
    y, dof, p = 6.0, 2.5, 0.9**2 * 1.5**2 + 0.5**2

    def posterior(lam: float) -> tuple[float, float]:
        gain = p / (p + 1.0 / lam)
        return gain * y, (1.0 - gain) * p

    def gap(lam: float) -> float:
        mean, variance = posterior(lam)
        return lam - (dof + 1.0) / (dof + (y - mean) ** 2 + variance)

    lam = optimize.brentq(gap, 1e-6, 2.0, xtol=1e-14)
    result = run(with_update("ekf", StudentObservationUpdate(60)), Level(student(dof)), [[[y]]])
    mean, variance = posterior(lam)
    assert float(result.mean[0, 0, 0]) == pytest.approx(mean, rel=1e-10)
    assert float(result.variance[0, 0, 0]) == pytest.approx(variance, rel=1e-10)


@pytest.mark.parametrize("level", [Level, Curved])
@every_rule
def test_the_law_of_the_model_is_the_update_of_the_filter(rule: str, level: Any) -> None:
    """The same scales as of a robust update with R as the scale, for rules with one update."""
    y = np.random.default_rng(2).standard_t(3.0, (4, 20, 2)) * 2.0
    y[0, 3, 1] = math.nan
    updated = run(with_update(rule, STUDENT), level(student(3.0), (1.0, 0.5)), y)
    if method_of(rule).iterations > 1:
        assert torch.isfinite(updated.mean).all()
        return
    robust = replace(method_of(rule), noise_adaptations=(StudentUpdate(3.0),))
    result = run(robust, level(normal, (1.0, 0.5)), y)
    torch.testing.assert_close(updated.mean, result.mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(updated.variance, result.variance, rtol=1e-12, atol=1e-12)
    assert torch.equal(updated.trace["downweighted"], result.trace["downweighted"])


@pytest.mark.parametrize("level", [Level, Curved])
@every_rule
def test_normal_errors_are_a_limit_of_both_updates(rule: str, level: Any) -> None:
    y = 2.0 * np.random.default_rng(2).normal(size=(4, 10, 2))
    y[0, 3, 1] = math.nan
    plain = run(method_of(rule), level(normal, (1.0, 0.5)), y)
    limits = [(STUDENT, normal, 1e-12), (MIXTURE, normal, 1e-12), (STUDENT, student(1e9), 1e-6)]
    for update, family, tolerance in limits:
        updated = run(with_update(rule, update), level(family, (1.0, 0.5)), y)
        for name in ("mean", "variance", "log_evidence"):
            torch.testing.assert_close(
                getattr(updated, name), getattr(plain, name), rtol=tolerance, atol=tolerance
            )


@every_rule
def test_an_outlier_of_a_million_moves_the_estimate_by_less_than_its_sd(rule: str) -> None:
    for family in (student(3.0), cauchy):
        y = np.zeros((2, 5, 1))
        y[1, -1] = 1e6
        result = run(with_update(rule, STUDENT), Level(family), y)
        shift = float((result.mean[1, -1] - result.mean[0, -1]).abs())
        assert shift < float(result.variance[0, -1].sqrt())
        assert result.trace["downweighted"][:, -1].tolist() == [0.0, 1.0]


@every_rule
def test_a_curved_measurement_of_a_mixture_is_near_the_posterior(rule: str) -> None:
    """A step of h(x) = x + 0.1 x^2: mean within 0.1 sd of the grid, closer than with the moments alone."""
    y = np.array([5.0, -2.0, 1.0])
    prior = stats.norm.pdf(GRID, scale=math.sqrt(0.9**2 * 0.5**2 + 0.5**2))
    h = GRID + 0.1 * GRID**2
    joint = prior * skewed_density((y[:, None] - h)[..., None], False)
    mean = (joint @ GRID) / joint.sum(1)
    sd = np.sqrt(joint @ GRID**2 / joint.sum(1) - mean**2)
    model = Curved(skewed, sd=0.5)
    updated, plain = (
        np.abs(run(m, model, y[:, None, None]).mean[:, 0, 0].numpy() - mean) / sd
        for m in (with_update(rule, MIXTURE), method_of(rule))
    )
    assert updated.max() < 0.1, updated
    assert plain.max() > 2 * updated.max(), plain


def test_angles_of_parts_wrap() -> None:
    """A measured angle near half a turn: the same as at zero."""

    class Turning(Level):
        has_residual = True

        def __init__(self, shift: float) -> None:
            super().__init__(skewed, sd=0.5)
            self.shift = shift

        def seen(self, x: Tensor) -> Tensor:
            return self.residual(super().seen(x) + self.shift, torch.zeros_like(x))

        def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
            return torch.remainder(y - y_hat + math.pi, 2 * math.pi) - math.pi

    for rule in RULES:
        zero, half = (
            run(with_update(rule, MIXTURE), Turning(shift), [[[value]]])
            for shift, value in ((0.0, 0.4), (3.1, 3.5 - 2 * math.pi))
        )
        torch.testing.assert_close(zero.mean, half.mean, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(zero.variance, half.variance, rtol=1e-9, atol=1e-9)


# bad input


def laplace(h: Tensor) -> Any:
    return dist.Independent(dist.Laplace(h, torch.ones_like(h)), 1)


@pytest.mark.parametrize(
    ("update", "family", "message"),
    [
        (
            None,
            cauchy,
            "finite mean and variance .* got Cauchy. Use an EKF, UKF or CKF with measurement_update=StudentObs",
        ),
        (STUDENT, laplace, "must return Student's t, Cauchy or normal .* got Laplace. Use another"),
        (STUDENT, skewed, "must return Student's t, .* got MixtureSameFamily. Use another"),
        (MIXTURE, laplace, "must return a mixture of normal distributions .* got Laplace. Use"),
        (MIXTURE, cauchy, "must return a mixture of normal distributions .* got Cauchy. Use"),
    ],
)
@every_rule
def test_a_distribution_without_an_update_is_refused(
    rule: str, update: Any, family: Family, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        run(with_update(rule, update), Level(family), [[[0.0]]])


def test_parts_that_do_not_fit_are_refused() -> None:
    check_refused([
        (r"at most 256 parts .* got 2\^9 for 9 components", lambda: run(with_update("ekf", MIXTURE), Level(skewed, (1.0,) * 9), np.zeros((1, 1, 9)))),
        ("must be empty with measurement_update, got Innovation", lambda: with_update("gate", STUDENT)),
        ("filter.measurement_update must be an update", lambda: with_update("ekf", InnovationGate())),
        ("filter.measurement_update must be an update", lambda: with_update("ekf", StudentObservationUpdate)),
        ("StudentObservationUpdate.iterations must be", lambda: StudentObservationUpdate(0)),
        ("guide_filter.measurement_update must be null", lambda: GuidedNoiseProposal(with_update("ckf", MIXTURE))),
        ("guide_filter.measurement_update must be null", lambda: SharedGuideProposal(with_update("ckf", MIXTURE))),
        ("smooth: method must use the model's noise", lambda: smooth(with_update("ekf", STUDENT), Level(normal), Record(torch.zeros(1, 2, 1)))),
    ])  # fmt: skip
