"""The stationary bootstrap against resampling, and its share of false alarms for equal programs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from pfbench.judge.block_bootstrap import (
    MIN_BLOCKS,
    bootstrap_variance,
    choose_block_length,
    compare_along_run,
)


def markov(rng: np.random.Generator, steps: int, correlation: float, series: int) -> np.ndarray:
    a = np.exp(-1 / correlation)
    white = rng.normal(size=(series, steps + int(10 * correlation)))
    return lfilter([np.sqrt(1 - a * a)], [1, -a], white, axis=1)[:, -steps:]


def test_the_variance_is_that_of_resamples() -> None:
    """2000 resamples with geometric blocks on a circle (Politis and Romano 1994)."""
    rng = np.random.default_rng(1)
    values = markov(rng, 300, 8.0, 1)[0]
    length, resamples = 20.0, 2000
    position = rng.integers(0, 300, resamples)
    total = np.zeros(resamples)
    for _ in range(300):
        total += values[position]
        jump = rng.random(resamples) < 1 / length
        position = np.where(jump, rng.integers(0, 300, resamples), (position + 1) % 300)
    resampled = np.var(total / 300, ddof=1)
    assert abs(resampled / bootstrap_variance(values, length) - 1) < 4 * np.sqrt(2 / resamples)


def test_independent_values_have_short_blocks() -> None:
    rng = np.random.default_rng(2)
    lengths = [choose_block_length(rng.normal(size=1000)) for _ in range(20)]
    assert max(lengths) < 20
    correlated = [choose_block_length(markov(rng, 1000, 20.0, 1)[0]) for _ in range(20)]
    assert min(correlated) > 60


def alarms(steps: int, correlation: float, studies: int) -> tuple[float, float]:
    """Share of studies that call two equal programs different: by blocks, and by epochs."""
    rng = np.random.default_rng(round(steps + correlation))
    by_blocks = by_epochs = 0
    for _ in range(studies):
        errors = markov(rng, steps, correlation, 4) ** 2
        first, second = errors[:2].sum(0), errors[2:].sum(0)
        by_blocks += compare_along_run(first, second).p < 0.05
        by_epochs += abs((first - second).mean()) > 1.96 * (first - second).std() / np.sqrt(steps)
    return by_blocks / studies, by_epochs / studies


@pytest.mark.parametrize(("steps", "correlation"), [(400, 10.0), (1600, 40.0)])
def test_false_alarms(steps: int, correlation: float) -> None:
    """At most 5 %, plus 3.1 standard errors; single epochs as samples fail."""
    by_blocks, by_epochs = alarms(steps, correlation, 300)
    assert by_blocks <= 0.05 + 3.1 * np.sqrt(0.05 * 0.95 / 300)
    assert by_epochs > 0.4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "correlation"), [(400, 10.0), (400, 40.0), (1600, 10.0), (1600, 40.0), (6400, 40.0)]
)
def test_false_alarms_of_the_design(steps: int, correlation: float) -> None:
    by_blocks, _ = alarms(steps, correlation, 2000)
    assert by_blocks <= 0.05 + 3.1 * np.sqrt(0.05 * 0.95 / 2000)


@pytest.mark.parametrize("time", [10.0, 40.0])
def test_the_variance_of_a_long_run_is_that_of_its_correlation(time: float) -> None:
    """Sums of two squares of a Markov process: correlation exp(-2/time) per epoch, variance 4.

    The length is the least one, 8 correlation times of the squares.
    """
    steps = 300_000
    squares = markov(np.random.default_rng(8), steps, time, 4) ** 2
    result = compare_along_run(squares[:2].sum(0), squares[2:].sum(0), length=4 * time)
    rho = np.exp(-2 / time)
    ratio = result.estimate.standard_error**2 / (0.5 * (1 + rho) / (1 - rho) / steps)
    error = np.sqrt(2 / result.blocks)
    assert 1 - 3 * error < ratio < 1.1 + 3 * error


def test_power_and_direction() -> None:
    """An error that is 30 % smaller is shown in most runs of 1600 s, with the right sign."""
    rng = np.random.default_rng(5)
    decided = 0
    for _ in range(40):
        errors = markov(rng, 1600, 10.0, 4) ** 2
        first, second = 0.49 * errors[:2].sum(0), errors[2:].sum(0)
        result = compare_along_run(first, second)
        rmse = np.sqrt([first.mean(), second.mean()])
        assert result.estimate.value == pytest.approx(np.log(rmse[0] / rmse[1]))
        assert result.estimate.value < 0
        decided += result.p < 0.05
        low, high = result.estimate.interval(0.05)
        assert low < result.estimate.value < high
    assert decided >= 30


def test_short_runs_are_not_tested() -> None:
    errors = markov(np.random.default_rng(6), 200, 60.0, 2) ** 2
    result = compare_along_run(errors[0], errors[1], length=50.0)
    assert result.blocks < MIN_BLOCKS
    assert np.isnan(result.p)
    assert np.isfinite(result.estimate.value)
