"""Raw fix and dead reckoning, the two ends of any filter: the measurement alone, and the prediction alone."""

import math
from typing import Any

import pytest
import torch
from config_cases import composed, world
from filter_cases import method_of
from refusals import check_refused
from torch import Tensor

from pfbench import job
from pfbench.core import PhiloxStream, Record
from pfbench.filter import FilterResult, GaussianFilter, RawFix, TaylorLinearisation, run_filter
from pfbench.filter.exactness import has_covariance, has_evidence
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk
from pfbench.model.textbook import StochasticVolatility, TimeIndexInputs, UnivariateGrowth
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation
from pfbench.testing import filter_record

EKF = GaussianFilter(TaylorLinearisation())
F, H, SD = [[1.0, 0.5], [0.0, 0.9]], [[1.0, 0.0], [0.3, 1.0], [1.0, -1.0]], [1.0, 0.8, 2.0]
Y = torch.tensor(
    [[0.8, -1.0, 0.5], [1.9, 0.4, -0.3], [math.nan] * 3, [1.1, math.nan, 2.0], [1.6, 0.9, 0.0]],
    dtype=torch.float64,
)


def tracker(noise: float = 1.0, rows: int = 3) -> LinearGaussian:
    """Two states, each driven, by default seen by three sensors of unequal noise."""
    g = [[0.6 * noise, 0.0], [0.2 * noise, 0.5 * noise]]
    return LinearGaussian(F, g, H[:rows], SD[:rows], [0.3, -0.2], [1.5, 1.0])


def run(model: LinearGaussian, y: Tensor) -> FilterResult:
    return filter_record(RawFix(), model, y, runs=2)


# raw fix


def test_a_raw_fix_is_the_ekf_of_a_process_about_which_nothing_is_known() -> None:
    """Where a step is measured. Elsewhere the covariance would have no limit, but the means agree too."""
    model = tracker(noise=1e6)
    ours, kalman = run(model, Y), filter_record(EKF, model, Y, runs=2)
    torch.testing.assert_close(ours.mean, kalman.mean, rtol=0, atol=1e-6)
    assert float((filter_record(EKF, tracker(), Y, runs=2).mean - ours.mean).abs().max()) > 0.1


def test_on_a_linear_walk_the_error_is_that_of_the_sensor() -> None:
    """Its square has the mean r^2, and the standard error r^2 sqrt(2 / n) of n independent errors."""
    r, runs, steps = 1.7, 100, 100
    model, numbers = linear_walk(1.0, 0.5, r), torch.arange(runs)
    episode = ModelSimulation(model, steps).draw(NominalNoise(), numbers, 3)
    found = run_filter(RawFix(), model, episode.record, PhiloxStream(3, numbers))
    error = (found.mean - model.assemble(episode.truth))[..., 0]
    n = runs * steps
    assert abs(float(error.square().mean()) / r**2 - 1.0) < 4.0 * math.sqrt(2.0 / n)
    assert abs(float(error.mean())) < 4.0 * r / math.sqrt(n)


def test_what_is_not_measured_is_predicted_without_noise() -> None:
    f = torch.tensor(F, dtype=torch.float64)
    mean = run(tracker(), Y).mean[0]
    torch.testing.assert_close(mean[2], f @ mean[1])  # no measurement at all
    # the position alone is measured: the velocity keeps its prediction
    y = torch.tensor([[2.0], [math.nan], [5.0]], dtype=torch.float64)
    walk = linear_walk(1.0, 0.5, 1.0)
    walk.m0[:] = torch.tensor([0.0, 3.0])
    torch.testing.assert_close(
        run_filter(RawFix(), walk, Record(y[None]), PhiloxStream(1, torch.arange(1))).mean[0],
        torch.tensor([[2.0, 3.0], [5.0, 3.0], [5.0, 3.0]], dtype=torch.float64),
    )


def test_a_silent_sensor_is_as_if_it_were_not_there() -> None:
    y = Y.clone()
    y[:, 2] = torch.nan
    torch.testing.assert_close(run(tracker(), y).mean, run(tracker(rows=2), y[:, :2]).mean)


def test_a_raw_fix_is_linearised_about_its_own_prediction() -> None:
    """The growth model, y = x^2 / 20 + v: one Newton step from the prediction, from the measurement alone."""
    y = torch.tensor([3.0, 1.2, 6.0], dtype=torch.float64)
    x, expected = 0.0, []
    for t, value in enumerate(y.tolist(), 1):
        x = x / 2 + 25 * x / (1 + x**2) + 8 * math.cos(1.2 * t)
        x += (value - x**2 / 20) / (x / 10)
        expected.append(x)
    clock = TimeIndexInputs(torch.arange(1.0, 4.0, dtype=torch.float64)[None])
    found = filter_record(RawFix(), UnivariateGrowth(), y[:, None], runs=2, u=clock).mean[0, :, 0]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def test_a_raw_fix_states_no_covariance_and_no_evidence() -> None:
    method, result = RawFix(), run(tracker(), Y)
    assert not any((method.is_exact, has_covariance(method), has_evidence(method)))
    assert bool(result.variance.isnan().all())
    assert not bool(result.lost.any())


def test_a_run_without_a_finite_state_is_lost_alone() -> None:
    start = torch.tensor([[0.0, 0.0], [math.nan, 0.0]], dtype=torch.float64)
    record = Record(Y.expand(2, -1, -1), start=start)
    result = run_filter(RawFix(), tracker(), record, PhiloxStream(1, torch.arange(2)))
    assert result.lost.tolist() == [False, True]
    assert bool(result.mean[0].isfinite().all())


def no_step(*_: Any) -> dict[str, Tensor]:
    raise AssertionError("a step was taken")


BEARING = LinearGaussian(  # a line through two coordinates
    torch.eye(2), torch.eye(2), [[0.6, -0.8]], [0.1], [0.0, 0.0], [10.0, 10.0], ("x", "y"), ("m", "m")
)  # fmt: skip


@pytest.mark.parametrize(
    ("model", "y", "words"),
    [
        (BEARING, [[0.3]], "determine x, y, .* LinearGaussian that see 50 %"),
        (StochasticVolatility(-1.0, 0.95, 0.3), [[0.3]], "determine log_volatility, .* see 0 %"),
        (tracker(), [[math.nan] * 3], "determine x0, x1, .* see 0 %"),
    ],
    ids=["one bearing", "volatility", "no measurement"],
)
def test_a_raw_fix_refuses_measurements_that_give_none(model: Any, y: Any, words: str) -> None:
    record = Record(torch.tensor(y, dtype=torch.float64).expand(2, 4, -1))
    draws = PhiloxStream(1, torch.arange(2))
    text = rf"^filter=raw_fix must have measurements that {words}.*\. Choose filter=dead_reckoning"
    check_refused(
        [(text, lambda: run_filter(RawFix(), model, record, draws, no_step))], remedy=False
    )


def test_a_later_step_that_determines_the_state_is_enough() -> None:
    """Not that with the most components: here one sensor comes three times, and the two others after it."""
    nan = math.nan
    h = [[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    model = LinearGaussian(F, torch.eye(2), h, [1.0] * 5, [0.0, 0.0], [1.0, 1.0])
    y = torch.tensor([[0.8, 0.7, 0.9, nan, nan], [nan, nan, nan, 1.0, 4.0]], dtype=torch.float64)
    mean = run(model, y).mean[0]
    torch.testing.assert_close(mean[1], torch.tensor([3.0, 1.0], dtype=torch.float64))
    check_refused([("see 50 % of their initial variance", lambda: run(model, y[:1]))], remedy=False)


# dead reckoning


@pytest.mark.parametrize("scenario", ["linear_walk", "flight_300s"])
def test_no_measurement_changes_dead_reckoning(scenario: str) -> None:
    """Measurements that are wrong by a kilometre, or missing, give the same numbers."""
    model, record = job.instantiate(composed(f"scenario={scenario}").model), world(scenario).record
    draws, method = PhiloxStream(1, torch.arange(len(record.y))), method_of("dead_reckoning")
    own, shifted, blind = (
        run_filter(method, model, record._replace(y=y), draws)
        for y in (record.y, record.y + 1000.0, torch.full_like(record.y, torch.nan))
    )
    assert not bool(own.lost.any())
    for other in (shifted, blind):
        for name in ("mean", "variance"):
            torch.testing.assert_close(
                getattr(other, name), getattr(own, name), rtol=1e-12, atol=1e-15
            )
    kalman = run_filter(EKF, model, record, draws)
    assert float((kalman.mean - own.mean).abs().max()) > 1e-3
