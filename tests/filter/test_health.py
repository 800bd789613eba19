"""Health of runs: ok, or what a filter sees of its own failures, without the truth."""

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    EssResampler,
    GaussianFilter,
    GuidedNoiseProposal,
    LookAheadWeights,
    ParticleFilter,
    Systematic,
    TaylorLinearisation,
)
from pfbench.filter.health import HEALTH, HealthMonitor, fit_pareto_k
from pfbench.filter.loop import FilterPass, FilterResult, prepare_record, run_filter
from pfbench.model import LinearGaussian, UnivariateGrowth, linear_walk
from pfbench.noise import NominalNoise
from pfbench.ppl.pyro_program import simulate
from pfbench.results import status
from pfbench.scenario import ModelSimulation

RUNS, STEPS = 200, 60
KALMAN = GaussianFilter(TaylorLinearisation())
PARTICLES = ParticleFilter(300, EssResampler(Systematic(), 0.5))


def count_health(health):
    """Count the runs [R] of each health."""
    counts = torch.bincount(health.long(), minlength=len(HEALTH)).tolist()
    return dict(zip(HEALTH, counts, strict=True))


def walk(noise: float = 0.3, sd: float = 1.0) -> LinearGaussian:
    return linear_walk(step=1.0, noise=noise, measurement_sd=sd)


def measurements() -> Tensor:
    empty = Record(torch.zeros(RUNS, STEPS, 1, dtype=torch.float64))
    return simulate(walk(), empty, 3)[0].y


def filtered(method: object, y: Tensor, model: LinearGaussian | None = None) -> FilterResult:
    return run_filter(method, model or walk(), Record(y), PhiloxStream(4, torch.arange(len(y))))  # type: ignore[arg-type]


def test_a_filter_with_the_right_model_is_healthy_in_every_run() -> None:
    for method in (KALMAN, PARTICLES):
        assert count_health(filtered(method, measurements()).health)["ok"] == RUNS


def test_outliers_are_no_reason_to_call_a_filter_diverged() -> None:
    y = measurements()
    hit = torch.rand(y.shape, generator=torch.Generator().manual_seed(0)) < 0.1
    y = torch.where(
        hit, y + 10.0 * torch.randn(y.shape, generator=torch.Generator().manual_seed(1)), y
    )
    bad = RUNS - count_health(filtered(KALMAN, y).health)["ok"]
    assert bad <= 2  # 0.02 % are expected


def test_a_filter_that_does_not_follow_the_measurements_is_diverged() -> None:
    stiff = walk(noise=1e-4)
    health = count_health(
        filtered(KALMAN, measurements() + 3.0 * torch.arange(STEPS)[:, None] ** 1.3, stiff).health
    )
    assert health["diverged"] >= 0.9 * RUNS
    assert health["diverged"] + health["overconfident"] >= 0.98 * RUNS


def test_a_filter_with_too_small_a_measurement_noise_is_overconfident() -> None:
    """It follows the measurements, so that it does not diverge, but its innovations are too large."""
    health = count_health(filtered(KALMAN, measurements(), walk(noise=0.3, sd=0.05)).health)
    assert health["overconfident"] >= 0.8 * RUNS
    assert health["diverged"] == 0


def test_particles_without_spread_that_cannot_follow_are_collapsed() -> None:
    frozen = walk(noise=1e-30)
    y = measurements() + 50.0 * torch.arange(STEPS)[:, None]
    health = count_health(filtered(PARTICLES, y, frozen).health)
    assert health["collapsed"] + health["lost"] == RUNS
    assert health["collapsed"] > 0


def test_a_single_step_without_spread_and_with_an_impossible_measurement_is_a_collapse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    y = measurements()[:20]
    y[:10, 17] = 1e6  # between the checked steps
    result = filtered(PARTICLES, y)
    assert count_health(result.health)["collapsed"] == 10
    assert (result.health[10:] == HEALTH.index("ok")).all()
    assert (result.variance[:10, 17] == 0.0).all()  # the fault that is to be seen
    assert count_health(filtered(KALMAN, y).health)["collapsed"] == 0  # its spread is as before
    monkeypatch.setattr(HealthMonitor, "check_moments", lambda *_: None)
    assert count_health(filtered(PARTICLES, y).health)["ok"] == 20


@pytest.mark.parametrize(("initial_sd", "expected"), [(1.0, "collapsed"), (0.0, "ok")])
def test_a_point_that_agrees_with_the_measurement_is_a_collapse_unless_the_state_was_known(
    initial_sd: float, expected: str
) -> None:
    model = LinearGaussian([[1.0]], [[0.3]], [[1.0]], [1.0], [0.0], [[initial_sd]])
    record = Record(measurements()[:2, :20])
    mean, variance = record.y.clone(), torch.ones_like(record.y)
    variance[0, 17] = 0.0  # in one run and one step
    monitor = HealthMonitor(record)
    monitor.check_moments(model, record, mean, variance)
    health = monitor.classify(torch.zeros(2, dtype=torch.bool))
    assert [HEALTH[value] for value in health.tolist()] == [expected, "ok"]


def test_a_state_that_is_known_exactly_is_no_collapse() -> None:
    exact = LinearGaussian([[1.0]], [[0.0]], [[1.0]], [1.0], [2.0], [[0.0]])
    y = simulate(exact, Record(torch.zeros(RUNS, STEPS, 1, dtype=torch.float64)), 3)[0].y
    for method in (KALMAN, PARTICLES):
        result = filtered(method, y, exact)
        assert (result.variance < 1e-28).all()  # rounding of the mean of equal particles
        assert count_health(result.health)["ok"] == RUNS


def test_an_impossible_measurement_never_leaves_a_run_ok() -> None:
    y = measurements()
    y[:, STEPS // 2 :] = 1e200
    for method in (KALMAN, PARTICLES):
        result = filtered(method, y)
        assert count_health(result.health)["ok"] == 0


def test_a_run_without_measurements_is_ok_and_a_lost_run_is_lost() -> None:
    y = torch.full((3, STEPS, 1), torch.nan)
    assert count_health(filtered(KALMAN, y).health) == dict.fromkeys(HEALTH, 0) | {"ok": 3}
    y = measurements()[:2]
    y[0, -1] = 1e300
    result = filtered(PARTICLES, y)
    assert result.lost.tolist() == [True, False]
    assert result.health.tolist() == [HEALTH.index("lost"), HEALTH.index("ok")]


def test_one_run_alone_and_in_batches_has_the_same_health() -> None:
    y = measurements()[:6].clone()
    y[3, 20:] += 1e3
    whole = filtered(KALMAN, y)
    batches = run_filter(KALMAN, walk(), Record(y), PhiloxStream(4, torch.arange(6)), run_batch=2)
    assert whole.health.tolist() == batches.health.tolist()


def test_results_name_a_collapsed_run_as_the_filter_does() -> None:
    assert HEALTH[status.COLLAPSED] == "collapsed"


def test_results_name_the_marks_as_the_filter_does() -> None:
    assert {
        HEALTH.index(name): name for name in status.HEALTH_MARKS.values()
    } == status.HEALTH_MARKS
    assert set(status.HINTS) == set(status.HEALTH_MARKS.values())


UNBOUNDED = LookAheadWeights(defensive_fraction=0.0)


def growth(method: object, steps: int = 30, runs: int = 20) -> FilterResult:
    """Filter y = x^2 / 20, where look-ahead and guides miss one of two modes."""
    model, numbers = UnivariateGrowth(), torch.arange(runs)
    episode = ModelSimulation(model, steps).draw(NominalNoise(), numbers, seed=3)
    return run_filter(method, model, episode.record, PhiloxStream(1, numbers))  # type: ignore[arg-type]


def test_weights_without_a_bound_are_marked_where_their_tails_are_heavy() -> None:
    """k-hat is the second largest of the checked steps; a filter with a bound is not judged."""
    published = growth(ParticleFilter(1000, auxiliary_weights=UNBOUNDED))
    heavy = published.health == HEALTH.index("heavy-tailed")
    assert (heavy == (published.pareto_k > 0.7)).all()
    assert int(heavy.sum()) >= 14
    for method in (
        ParticleFilter(1000),
        ParticleFilter(1000, auxiliary_weights=LookAheadWeights()),
    ):
        mixed = growth(method)
        assert mixed.pareto_k.isnan().all()
        assert (mixed.health == HEALTH.index("ok")).all()
    assert growth(GaussianFilter(TaylorLinearisation()), 10, 2).pareto_k.isnan().all()


def test_light_tails_are_healthy_without_a_stated_bound() -> None:
    """On a linear model a guide is optimal: its weights are densities of the measurement."""
    guide = GuidedNoiseProposal(KALMAN, defensive_fraction=0.0)
    result = filtered(ParticleFilter(300, proposal=guide), measurements()[:50])
    assert result.pareto_k.isfinite().all()
    assert (result.health == HEALTH.index("ok")).double().mean() >= 0.95


def test_k_hat_is_the_second_largest_of_the_checked_steps() -> None:
    """And the same for runs in batches."""
    method = ParticleFilter(200, auxiliary_weights=UNBOUNDED)
    model, y = UnivariateGrowth(), torch.full((5, 12, 1), 3.0).double()
    draws = PhiloxStream(1, torch.arange(5))
    run = FilterPass(method, model, prepare_record(model, Record(y)), draws)
    steps = HealthMonitor(Record(y)).steps
    k = [fit_pareto_k(run.belief.log_w) for step in run if step.t in steps]
    expected = torch.stack(k).nan_to_num(nan=-torch.inf).sort(0).values[-2]
    for batch in (None, 2):
        result = run_filter(method, model, Record(y), draws, run_batch=batch)
        torch.testing.assert_close(result.pareto_k, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("method", [KALMAN, PARTICLES], ids=["ekf", "sir"])
@pytest.mark.parametrize("all_steps", [False, True])
def test_measurements_a_million_sd_away_are_named(method: object, all_steps: bool) -> None:
    """Once, or always: the run is not ok, though all its numbers are finite."""
    y = measurements()[:6].clone()
    y[3:, :, 0][:, slice(None) if all_steps else 30] += 1e6
    result = filtered(method, y)
    names = [HEALTH[value] for value in result.health.tolist()]
    assert names[:3] == ["ok"] * 3
    assert set(names[3:]) <= {"implausible", "collapsed", "diverged"}


class Undefined(LinearGaussian):
    """Its log likelihood is NaN for positive states."""

    where = 0.0

    def log_likelihood(self, y: Tensor, x: Tensor, u: object) -> Tensor:
        value = super().log_likelihood(y, x, u)
        return torch.where(x[..., 0] > self.where, torch.nan, value)


def test_a_likelihood_of_nan_is_named() -> None:
    """It counts as impossible, so that the numbers are those of another model."""
    model = Undefined([[1.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0])
    y = torch.zeros(8, STEPS, 1, dtype=torch.float64)
    result = filtered(PARTICLES, y, model)
    assert {HEALTH[value] for value in result.health.tolist()} == {"undefined"}
    model.where = torch.inf
    assert (filtered(PARTICLES, y, model).health == 0).all()
    model.where = -torch.inf
    with pytest.raises(ValueError, match=r"Undefined\.log_likelihood must be a number or -inf"):
        filtered(PARTICLES, y, model)


class Singular(LinearGaussian):
    """Two sensors with the same error."""

    validates: bool | None = None

    def observation(self, x: Tensor, u: object) -> Distribution:
        r = torch.ones(2, 2, dtype=x.dtype).expand(*x.shape[:2], 2, 2)
        mean = x @ self.h.mT
        return MultivariateNormal(mean, covariance_matrix=r, validate_args=self.validates)


@pytest.mark.parametrize("validates", [None, False])
def test_a_singular_noise_is_refused_before_the_first_step(validates: bool | None) -> None:
    model = Singular([[1.0]], [[1.0]], [[1.0], [1.0]], [1.0, 1.0], [0.0], [1.0])
    model.validates = validates
    for method in (KALMAN, PARTICLES):
        with pytest.raises(ValueError, match=r"Singular\.\w+ must .*copies of each other"):
            filtered(method, measurements()[:2].expand(-1, -1, 2), model)
