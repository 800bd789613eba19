"""Verdicts by blocks of time: the variance of dependent blocks, and the rates of words for equal programs."""

import math
import re

import judge_rates as rates
import numpy as np
import pytest
from judge_rates import ROWS, Row, draw_studies, judge_studies, judge_study
from scipy.signal import lfilter

from pfbench.logs.judge.pair_verdicts import remove_nuisance
from pfbench.stats.comparison import compare
from pfbench.stats.time_blocks import (
    block_losses,
    compare_blocks,
    count_blocks,
    remove_drift,
    variance_ratio,
)


def markov(rng: np.random.Generator, rho: float, n: int) -> np.ndarray:
    return lfilter([math.sqrt(1 - rho * rho)], [1, -rho], rng.normal(size=n + 1000))[1000:]


def expected_ratio(first: float, second: float, third: float) -> tuple[float, float]:
    """Return what both scales show, from the correlations of neighbours, second and third neighbours."""
    pair_variance = (1 + first) / 2
    pair_rho = (first + 2 * second + third) / 4 / pair_variance
    return (1 + first) / (1 - first), 2 * pair_variance * (1 + pair_rho) / (1 - pair_rho)


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.7])
def test_the_variance_of_a_markov_process_is_its_own(rho: float) -> None:
    """The mean of n values has (1 + rho) / (1 - rho) times the variance of independent ones."""
    n = 200_000
    ratio = float(variance_ratio(markov(np.random.default_rng(1), rho, n)))
    single, pairs = expected_ratio(rho, rho**2, rho**3)
    error = 2 * math.sqrt((1 - rho * rho) / n) / (1 - rho) ** 2  # of the ratio, from that of rho
    assert single == (1 + rho) / (1 - rho)
    assert ratio == pytest.approx(max(single, pairs), abs=6 * error)


def test_pairs_of_blocks_see_a_slow_part_that_neighbours_hide() -> None:
    """White of variance 0.7 and a Markov process of 0.3 with rho 0.9."""
    n, share, rho = 400_000, 0.3, 0.9
    rng = np.random.default_rng(2)
    d = math.sqrt(1 - share) * rng.normal(size=n) + math.sqrt(share) * markov(rng, rho, n)
    single, pairs = expected_ratio(*(share * rho**k for k in (1, 2, 3)))
    assert pairs > 1.4 * single
    assert float(variance_ratio(d)) == pytest.approx(pairs, rel=0.02)
    assert pairs < 1 + 2 * share * rho / (
        1 - rho
    )  # not all of it: errors without their drift are compared, too


def test_dependent_blocks_have_a_wider_interval_around_the_same_location() -> None:
    d = 0.2 + 0.1 * markov(np.random.default_rng(3), 0.6, 30)
    zero = np.zeros(30)
    plain, blocks = compare(("a", d), ("b", zero), "block"), compare_blocks(("a", d), ("b", zero))
    ratio = float(variance_ratio(d))
    assert ratio > 1.5
    assert blocks.effective == pytest.approx(30 / ratio)
    assert blocks.effect.location == pytest.approx(plain.location)
    (_, low, high), (_, wide_low, wide_high) = plain.estimate(0.05), blocks.effect.estimate(0.05)
    assert wide_high - wide_low == pytest.approx(math.sqrt(ratio) * (high - low))
    assert blocks.effect.p >= plain.p
    same = compare_blocks(("a", d), ("b", d))
    assert not same.effect.differences.any()
    assert same.effective == 30


def test_mean_and_drift_of_each_run_are_removed_and_nothing_else() -> None:
    rng = np.random.default_rng(4)
    error, time = rng.normal(size=(2, 50, 3)), np.arange(50.0)
    moved = error + rng.normal(size=(2, 1, 3)) + time[:, None] * rng.normal(size=(2, 1, 3))
    np.testing.assert_allclose(remove_drift(moved), remove_drift(error), atol=1e-9)
    for axis in range(3):
        slope, mean = np.polyfit(time, error[0, :, axis], 1)
        np.testing.assert_allclose(
            remove_drift(error)[0, :, axis], error[0, :, axis] - slope * time - mean
        )


def test_slow_oscillations_and_the_forms_of_a_path_are_removed_and_white_noise_is_not() -> None:
    """A sine slower than two blocks, a turn and a stretch of the path, of any size; the noise keeps its level."""
    rng, steps = np.random.default_rng(5), rates.STEPS
    path = rates.PATH + 30.0 * np.sin(
        2 * np.pi * np.linspace(0.0, 1.0, steps)[:, None] * [60.0, 71.0, 0.0]
    )
    noise, share = rng.normal(size=(2, steps, 3)), np.linspace(0.0, 1.0, steps)
    sine = np.sin(2 * np.pi * rng.uniform(0.3, 12.0, (2, 1, 3)) * share[:, None] + 1.0)
    form = 0.02 * path[:, [1, 0, 2]] * [-1.0, 1.0, 0.0] + 0.03 * path
    left = remove_nuisance(noise + 5.0 * sine + form, path) - remove_nuisance(noise, path)
    assert np.sqrt(np.square(left).mean()) < 0.01 * 5.0
    assert np.square(remove_nuisance(noise, path)).mean() == pytest.approx(1 - 33 / steps, rel=0.03)
    assert remove_nuisance(noise[:, :9], path[:9]).shape == (2, 9, 3)
    assert np.isfinite(remove_nuisance(noise[:, :1], path[:1])).all()


def test_blocks_hold_the_epochs_of_a_sequence_in_order() -> None:
    error = np.sqrt(np.arange(1.0, 13.0))[None, :, None]
    np.testing.assert_allclose(np.exp(2 * block_losses(error, 3, 100.0)), [2.5, 6.5, 10.5])
    np.testing.assert_allclose(np.exp(2 * block_losses(error, 3, 2.0)), [2.5, 4.0, 4.0])
    assert block_losses(error, 30, 100.0).shape == (12,)
    assert count_blocks([100.0, 200.0]) == [10, 20]
    assert count_blocks([100.0, 1.0], 10.0) == [10, 1]


@pytest.mark.parametrize(
    "row",
    [Row("white plus 25 % slow, 20 %"), Row("correlation time 10 %", 1, 0.1), Row("outages at other times", 3), Row("heavy tails", 10, 0.4), Row("correlation time 5 %", 10)],
)  # fmt: skip
def test_many_studies_at_once_have_the_words_of_the_product(row: Row) -> None:
    signs = {"better": -1, "worse": 1}
    for error, lost in draw_studies(row, 12):
        for ratio in (1.0, 0.7):
            scaled = rates.scale_first(error, ratio)
            words = judge_studies(scaled, lost)
            one = [judge_study(*study) for study in zip(scaled, lost, strict=True)]
            assert [signs.get(pair.verdict.word, 0) for pair in one] == words.sign.tolist()
            assert [pair.verdict.word == "equal" for pair in one] == words.equal.tolist()
            for pair, effective in zip(one, words.effective, strict=True):
                assert pair.effective in (0.0, pytest.approx(effective))


def test_a_word_that_rests_on_one_draw_names_it_and_the_sequences_that_would_decide() -> None:
    assert sum(
        re.search("rests on offset, drift, .* of the run.*; 9 further sequences would decide$", judge_study(*study).verdict.reason) is not None
        for error, lost in draw_studies(Row("bias of the run"), 12) for study in zip(error, lost, strict=True)
    ) >= 3  # fmt: skip


def bound(studies: int, errors: float) -> float:
    return 0.05 + errors * math.sqrt(0.05 * 0.95 / studies)


SHORT = (Row("white"), Row("correlation time 5 %"), Row("white plus 25 % slow, 20 %"), Row("random walk"), Row("white plus drift"), Row("bias of the run"), Row("recorded residuals"), Row("sine of T / 8"), Row("yaw of 0.01 rad"), Row("white plus 25 % slow, 20 %", 3), Row("random walk", 10))  # fmt: skip


@pytest.mark.parametrize("row", SHORT, ids=str)
def test_equal_programs_are_called_different_at_the_level(row: Row) -> None:
    """At most 5 % and 2.5 standard errors. With an effect, or with plain blocks, the rate is too large."""
    studies = 200
    found = rates.rates(row, studies)
    assert found.different <= bound(studies, 2.5)
    assert found.equal <= bound(studies, 2.5)
    assert max(found.decided, rates.naive_alarms(row, studies)) > bound(studies, 2.5)


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_rates_of_the_table(row: Row) -> None:
    """Each row within two standard errors of 2000 studies, but for one that the page states."""
    studies = 2000
    found = rates.rates(row, studies)
    if row.law == rates.NOT_HELD:
        assert found.different > bound(studies, 2.0)
        return
    assert found.different <= bound(studies, 2.0)
    assert found.equal <= bound(studies, 2.0)
    assert max(found.decided, rates.naive_alarms(row, studies)) > bound(studies, 2.0)
