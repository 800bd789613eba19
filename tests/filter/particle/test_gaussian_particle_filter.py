"""The Gaussian particle filter: the Kalman filter in the limit, faster on even points, and wrong where the law is not normal."""

import dataclasses
import math
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from filter_laws import check_lost_alone, check_own
from model_cases import Turning, measurements
from scipy import stats
from torch import Tensor

from pfbench.core import Chart, PhiloxStream, Record
from pfbench.filter import (
    FilterResult,
    GaussianPredictionProposal,
    GaussianResampler,
    HaltonPoints,
    IidPoints,
    LookAheadWeights,
    ParticleFilter,
    PointSet,
    SobolPoints,
    run_filter,
)
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.model import (
    LinearGaussian,
    Lorenz63,
    Pendulum,
    StateSpaceModel,
    UnivariateGrowth,
    linear_walk,
)

WALK = linear_walk(1.0, 0.5, 1.0)
STEPS = 20


def gpf(
    particles: int, points: PointSet | None = None, second_draw: bool = True, **more: Any
) -> ParticleFilter:
    p = points or IidPoints()
    return ParticleFilter(
        particles,
        GaussianResampler(p),
        proposal=GaussianPredictionProposal(p, second_draw),
        points=p,
        **more,
    )


VARIANTS = {
    "gpf": gpf(50), "gpf, one draw": gpf(50, None, False),
    "qmc": gpf(50, HaltonPoints()), "qmc, one draw": gpf(50, SobolPoints(), False),
}  # fmt: skip
every_variant = pytest.mark.parametrize("method", VARIANTS.values(), ids=VARIANTS.keys())


def plane() -> LinearGaussian:
    """Constant velocity in a plane, singular noise, position measured."""
    eye, zero = np.eye(2), np.zeros((2, 2))
    return LinearGaussian(
        np.block([[eye, eye], [zero, eye]]), 0.5 * np.vstack([0.5 * eye, eye]), np.hstack([eye, zero]), [1.0, 1.0],
        np.zeros(4), [2.0, 2.0, 1.0, 1.0],
    )  # fmt: skip


def exact(model: LinearGaussian, y: np.ndarray) -> oracles.Filtered:
    f, g, h, r, m0, root = (getattr(model, k).numpy() for k in ("f", "g", "h", "r", "m0", "l0"))
    return oracles.kalman(f, g @ g.T, h, np.diag(r**2), m0, root @ root.T, y)


def run(
    method: ParticleFilter, model: StateSpaceModel, y: Tensor, runs: int = 0, **options: Any
) -> FilterResult:
    y = y.expand(runs, -1, -1) if runs else y
    draws = PhiloxStream(1, torch.arange(len(y)), model.anchor.dtype)
    return run_filter(method, model, Record(y, start=options.pop("start", None)), draws, **options)


def distance(method: ParticleFilter, runs: int = 60) -> float:
    """E (m - m_KF)' P_KF^-1 (m - m_KF) at the last step, over runs of one record."""
    model, rng = plane(), np.random.default_rng(5)
    y = np.cumsum(rng.normal(size=(STEPS, 2)), 0) + rng.normal(size=(STEPS, 2))
    k = exact(model, y)
    e = run(method, model, torch.tensor(y), runs).mean[:, -1].numpy() - k.mean[-1]
    return float(np.einsum("ri,ij,rj->r", e, np.linalg.inv(k.covariance[-1]), e).mean())


@pytest.mark.slow
@pytest.mark.parametrize("second_draw", [True, False])
def test_the_limit_is_kalman_s_filter_and_even_points_come_nearer(second_draw: bool) -> None:
    """The mean square distance falls like 1/N or faster; a mean of 60 chi-squares of some 4 degrees is known to a tenth."""
    by_chance = [distance(gpf(n, IidPoints(), second_draw)) for n in (100, 900)]
    even = [distance(gpf(n, HaltonPoints(), second_draw)) for n in (100, 900)]
    assert by_chance[1] < 1.6 * by_chance[0] / 9
    assert even[1] < 1.6 * even[0] / 9
    assert even[0] < 0.8 * by_chance[0]
    assert even[1] < 0.5 * by_chance[1]


@every_variant
def test_spread_and_evidence_are_kalman_s(method: ParticleFilter) -> None:
    model, rng = plane(), np.random.default_rng(6)
    y = np.cumsum(rng.normal(size=(6, 2)), 0)
    y[2, 0] = y[4] = math.nan
    k = exact(model, y)
    estimate = run(dataclasses.replace(method, particles=2000), model, torch.tensor(y), 60)
    ratio = torch.exp(estimate.log_evidence - k.log_evidence.sum())
    assert abs(float(ratio.mean()) - 1.0) < 4.5 * float(ratio.std()) / math.sqrt(60) + 2 / 2000
    spread = estimate.variance[:, -1].mean(0).numpy() / np.diagonal(k.covariance[-1])
    assert (
        np.abs(spread - 1.0).max() < 0.03
    )  # 1/sqrt(60 2000) = 0.003, and a bias of the order of 10/N
    assert np.abs(estimate.mean[:, -1].mean(0).numpy() - k.mean[-1]).max() < 0.03


@every_variant
def test_it_says_that_it_is_not_exact_and_is_right(method: ParticleFilter) -> None:
    """The square of the growth model leaves two modes, of which a normal law is the wrong summary whatever N."""
    assert not method.is_exact
    model = UnivariateGrowth(measurement_sd=1.0)
    y = torch.tensor([[10.0], [5.0], [8.0]], dtype=torch.float64)
    grid = np.linspace(-60, 60, 2001)

    def transition(t: int) -> np.ndarray:
        centre = grid / 2 + 25 * grid / (1 + grid**2) + 8 * np.cos(1.2 * (t + 1))
        return oracles.normal_density(grid[:, None], centre[None], math.sqrt(10.0))

    def log_likelihood(t: int) -> np.ndarray:
        return -0.5 * (y[t].item() - grid**2 / 20) ** 2 - 0.5 * math.log(2 * math.pi)

    log_z = oracles.grid_filter(
        grid, oracles.normal_density(grid, 0, math.sqrt(2)), transition, log_likelihood, 3
    )[2]
    found = run(dataclasses.replace(method, particles=4000), model, y, 40).log_evidence
    sir = run(ParticleFilter(4000), model, y, 40).log_evidence
    assert abs(float(sir.mean()) - log_z) < 0.05
    assert abs(float(found.mean()) - log_z) > 0.1


# the refresh


def weighted(runs: int, n: int, chart: Chart | None = None) -> tuple[ParticleBelief, Tensor]:
    """One cloud, the same in all runs: correlated particles of different units and uneven weights; and numbers wanted."""
    draws = PhiloxStream(4, torch.arange(1))
    z = draws.normal("x", n, 2)
    x = torch.stack([3.0 + z[..., 0], 1e-3 * (z[..., 1] + 0.8 * z[..., 0])], -1)
    log_w = (1.0 * draws.normal("w", n, 1)[..., 0]).log_softmax(-1)
    cloud = ParticleBelief(
        x.expand(runs, -1, -1), log_w.expand(runs, -1), torch.zeros(runs, dtype=torch.float64)
    )
    return cloud, torch.full((runs, 1), float(n), dtype=torch.float64)


@pytest.mark.parametrize(
    "points", [IidPoints(), HaltonPoints(), SobolPoints()], ids=lambda p: type(p).__name__
)
def test_the_refresh_draws_from_the_cloud_s_normal_law(points: PointSet) -> None:
    cloud, n = weighted(400, 100)
    mean, covariance = weighted_mean_cov(WALK.chart, cloud)
    after, hit = GaussianResampler(points)(
        WALK, cloud, cloud.log_w, n, PhiloxStream(1, torch.arange(400))
    )
    assert bool(hit.all())
    assert torch.allclose(after.log_w, torch.full_like(after.log_w, -math.log(100)))
    z = torch.linalg.solve_triangular(
        torch.linalg.cholesky(covariance), (after.x - mean.unsqueeze(1)).mT, upper=False
    ).mT
    second = (z.mT @ z / 100).flatten(1)
    for value in (z.mean(1), second - torch.eye(2, dtype=torch.float64).flatten()):
        assert torch.all(value.mean(0).abs() < 4.5 * value.std(0) / math.sqrt(400))
    assert stats.kstest(z[:, 0].flatten().numpy(), "norm").pvalue > 1e-4


def test_empty_slots_take_no_part_and_stay_empty() -> None:
    cloud, n = weighted(3, 100)
    log_w = cloud.log_w.clone()
    log_w[:, 60:] = -torch.inf
    x = cloud.x.clone()
    x[:, 60:] = 1e9
    before = cloud._replace(x=x, log_w=log_w.log_softmax(-1))
    after, _ = GaussianResampler()(
        WALK, before, before.log_w, 0.0 * n + 70, PhiloxStream(1, torch.arange(3))
    )
    assert torch.all(after.log_w[:, 70:] == -torch.inf)
    assert torch.allclose(after.log_w.logsumexp(1), torch.zeros(3, dtype=torch.float64), atol=1e-12)
    assert float(after.x.abs().max()) < 100.0


def test_it_draws_in_the_chart() -> None:
    model = Turning(np.eye(2), np.eye(2), np.eye(2), [1.0, 1.0], [0.0, 0.0], [1.0, 1.0])
    top = torch.tensor([math.pi, 0.0], dtype=torch.float64)
    x = model.chart.add(top, 0.1 * PhiloxStream(1, torch.arange(1)).normal("x", 500, 2))
    before = ParticleBelief(
        x,
        torch.full((1, 500), -math.log(500), dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )
    n = torch.full((1, 1), 500.0, dtype=torch.float64)
    after, _ = GaussianResampler()(model, before, before.log_w, n, PhiloxStream(1, torch.arange(1)))
    assert float(after.x[..., 0].abs().max()) <= math.pi
    assert float(model.chart.subtract(after.x, top)[..., 0].std()) == pytest.approx(0.1, rel=0.15)


def test_particles_with_a_past_are_refused() -> None:
    cloud, n = weighted(2, 20)
    draws = PhiloxStream(1, torch.arange(2))
    for past in (
        cloud._replace(window={"states": cloud.x}),
        cloud._replace(memory={"states": cloud.x}),
    ):
        with pytest.raises(ValueError, match="states"):
            GaussianResampler()(WALK, past, past.log_w, n, draws)
    shared = cloud._replace(memory={"scale": cloud.x[:, :1]})
    GaussianResampler()(WALK, shared, shared.log_w, n, draws)


def test_a_preference_changes_nothing() -> None:
    y = torch.tensor([[0.8], [2.9], [1.2]], dtype=torch.float64)
    plain, preferred = (
        run(gpf(100, auxiliary_weights=p), WALK, y, 5)
        for p in (LookAheadWeights(), LookAheadWeights(0.5))
    )
    assert torch.equal(plain.mean, preferred.mean)


# every run by itself


@every_variant
@pytest.mark.parametrize(
    "model", [WALK, UnivariateGrowth(), Pendulum(), Lorenz63()], ids=lambda m: type(m).__name__
)
def test_no_future_no_neighbours_no_nan(method: ParticleFilter, model: StateSpaceModel) -> None:
    check_own(method, model, measurements(model), 1e-12)


class Fragile(LinearGaussian):
    """A walk whose mechanisation fails far out."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return torch.where(x[..., :1] > 2.5, torch.nan, super().propagate(x, u, w))


@every_variant
def test_a_particle_that_is_nan_does_not_spoil_the_others(method: ParticleFilter) -> None:
    model = Fragile(*(getattr(WALK, k) for k in ("f", "g", "h", "r", "m0", "l0")))
    estimate = run(method, model, torch.zeros(6, 1, dtype=torch.float64), 40)
    assert not bool(estimate.lost.any())
    assert bool(torch.isfinite(estimate.mean).all())


@every_variant
def test_an_impossible_measurement_loses_its_run_alone(method: ParticleFilter) -> None:
    check_lost_alone(method, WALK, measurements(WALK))


def test_a_cloud_without_a_square_root_is_lost_and_not_repaired() -> None:
    cloud, n = weighted(2, 20)
    x = cloud.x.clone()
    x[1, 3, 0] = math.inf
    after, _ = GaussianResampler()(
        WALK, cloud._replace(x=x), cloud.log_w, n, PhiloxStream(1, torch.arange(2))
    )
    assert bool(torch.isfinite(after.log_w[0]).all())
    assert bool((after.log_w[1] == -torch.inf).all())


def test_single_precision_is_close_to_double() -> None:
    y = torch.tensor([[0.8], [2.9], [1.2]], dtype=torch.float64)
    double = run(gpf(500, HaltonPoints()), WALK, y, 20)
    single = run(gpf(500, HaltonPoints()), WALK.float(), y, 20)
    WALK.double()
    assert single.mean.dtype == torch.float32
    assert torch.allclose(single.mean.double(), double.mean, atol=1e-3)
