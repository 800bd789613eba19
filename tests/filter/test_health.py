"""Health of runs: ok, lost, collapsed, diverged or overconfident, without the truth."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter import (
    EssResampler,
    GaussianFilter,
    ParticleFilter,
    Systematic,
    TaylorLinearisation,
)
from pfbench.filter.health import HEALTH, HealthMonitor, count_health
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.model import LinearGaussian, linear_walk
from pfbench.ppl.prior_predictive import simulate
from pfbench.results import status

RUNS, STEPS = 200, 60
KALMAN = GaussianFilter(TaylorLinearisation())
PARTICLES = ParticleFilter(300, EssResampler(Systematic(), 0.5))


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
