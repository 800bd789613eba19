"""Planned looks against published boundaries, e-values, and the size of a study."""

import math

import numpy as np
import pytest
from scipy import stats

from pfbench.stats.effects import EffectEstimate
from pfbench.stats.rank_tests import (
    combine_e_values,
    confidence_sequence,
    least_count,
    log_e_value,
    sign_log_e_value,
)
from pfbench.stats.sequential_looks import (
    LookPlan,
    boundary_scores,
    repeated_interval,
    repeated_p_value,
)
from pfbench.stats.study_size import (
    TypicalSpread,
    detectable_effects,
    required_runs_per_condition,
    required_worlds,
    t_test_power,
)

EQUAL = (0.2, 0.4, 0.6, 0.8, 1.0)


def test_published_boundaries():
    """Lan and DeMets: O'Brien-Fleming-type, and Pocock-type with two looks."""
    expected = [4.877, 3.357, 2.680, 2.290, 2.031]
    assert boundary_scores(EQUAL, 0.05, "obrien_fleming") == pytest.approx(expected, abs=1e-3)
    assert boundary_scores(EQUAL, 0.05, "pocock") == pytest.approx(
        [2.438, 2.427, 2.410, 2.397, 2.386], abs=2e-3
    )
    assert boundary_scores((1.0,), 0.05, "pocock") == pytest.approx([1.95996], abs=1e-4)


@pytest.mark.parametrize("spending", ["pocock", "obrien_fleming"])
def test_boundaries_spend_the_error(spending):
    rng = np.random.default_rng(0)
    steps = rng.standard_normal((200_000, 5)) * np.sqrt(np.diff([0, *(2.0 ** np.arange(-4, 1))]))
    scores = np.abs(steps.cumsum(axis=1)) / np.sqrt(2.0 ** np.arange(-4, 1))
    limits = boundary_scores(tuple(2.0 ** np.arange(-4, 1)), 0.05, spending)
    crossed = (scores >= limits).any(axis=1).mean()
    assert abs(crossed - 0.05) < 4 * math.sqrt(0.05 * 0.95 / 200_000)


def test_plan_and_repeated_values():
    plan = LookPlan(comparisons=7)
    assert plan.levels[0] == pytest.approx(0.05 / 7 * math.log1p(math.expm1(1) / 16), rel=1e-6)
    for bad in ({"runs": (20, 20)}, {"alpha": 1.5}, {"comparisons": 0}):
        with pytest.raises(ValueError, match="must be"):
            LookPlan(**bad)
    plan = LookPlan()
    assert repeated_p_value([1.0, plan.levels[1] * 0.999], plan) == pytest.approx(0.05, rel=0.01)
    assert repeated_p_value([1.0], plan) == 1.0
    ends = [
        EffectEstimate(np.array(v), np.array(s), np.array(30.0))
        for v, s in ((0.2, 0.1), (0.1, 0.05))
    ]
    low, high = repeated_interval(ends, plan.levels)
    alone = ends[1].interval(plan.levels[1])
    assert low == max(alone[0], ends[0].interval(plan.levels[0])[0])
    assert high <= alone[1]


def test_e_values():
    """The e-value has mean 1 at a share of 1/2, and the interval consists of known order statistics."""
    for n in (5, 40):
        k = np.arange(n + 1)
        mean = (stats.binom.pmf(k, n, 0.5) * np.exp(log_e_value(k, n))).sum()
        assert mean == pytest.approx(1.0, rel=1e-9)
    assert [least_count(n, 0.05) for n in (20, 80, 320)] == [3, 27, 133]
    d = np.arange(20.0)
    assert confidence_sequence(d, 0.05) == (2.0, 17.0)
    assert confidence_sequence(d[:3], 0.05) == (-np.inf, np.inf)
    lost = np.array([-np.inf] * 18 + [1.0, 0.0])
    assert sign_log_e_value(lost) == log_e_value(18, 19)
    assert combine_e_values(np.array([2.0, 2.0]), 1)
    assert not combine_e_values(np.array([2.0, 2.0]), 7)


def test_confidence_sequence_covers_at_all_times():
    rng = np.random.default_rng(1)
    walks = rng.standard_t(2, (2000, 160))
    missed = np.zeros(2000, dtype=bool)
    peeked = np.zeros(2000, dtype=bool)
    for n in range(10, 161, 5):
        low, high = confidence_sequence(walks[:, :n], 0.05)
        missed |= (low > 0) | (high < 0)
        below = (walks[:, :n] < 0).sum(axis=1)
        peeked |= 2 * stats.binom.cdf(np.minimum(below, n - below), n, 0.5) <= 0.05
    assert missed.mean() < 0.05
    assert peeked.mean() > 0.1  # the control: a fixed-size sign test at every look


def test_required_worlds():
    """The table of the design, and its definition as the least number with power 0.8."""
    effects = (0.5, 0.75, 1, 1.5, 2, 3)
    assert [required_worlds(e) for e in effects] == [34, 16, 10, 6, 5, 4]
    assert [required_worlds(e, 7) for e in effects] == [54, 26, 17, 10, 7, 5]
    assert required_worlds(0.0) == math.inf
    assert t_test_power(0.0, 10, 0.05) == pytest.approx(0.05, rel=1e-6)


def test_required_runs_have_the_power():
    """A simulated study of the required size shows the effect in 80 % of the cases."""
    runs = int(required_runs_per_condition(0.5, 4))
    rng = np.random.default_rng(2)
    d = rng.standard_normal((3000, runs)) * 0.94 - 0.5  # the trimmed mean has SD 1.065 of the mean
    ordered = np.sort(d, axis=1)
    cut = int(0.2 * runs)
    middle = runs - 2 * cut
    clipped = np.clip(d, ordered[:, [cut]], ordered[:, [-cut - 1]])
    error = np.sqrt(clipped.var(axis=1) * runs / (middle * (middle - 1)))
    t = ordered[:, cut:-cut].mean(axis=1) / error
    power = (2 * stats.t.sf(np.abs(t), middle - 1) <= 0.05 / 4).mean()
    assert 0.74 < power < 0.88


def test_detectable_effects():
    spread = TypicalSpread()
    one = detectable_effects(30, 1, 7, spread)
    assert one.error_new == math.inf
    assert detectable_effects(5, 3, 7).error_same_worlds == math.inf
    six, twelve = (detectable_effects(30, w, 7) for w in (6, 12))
    assert twelve.error_new < six.error_new
    assert twelve.error_same_worlds < six.error_same_worlds < one.error_same_worlds
    many = detectable_effects(1000, 6, 7)
    assert many.error_same_worlds < six.error_same_worlds / 4
    assert many.error_new > six.error_new / 1.2  # more runs do not replace worlds
    with pytest.raises(ValueError, match="runs, worlds and pairs must be positive"):
        detectable_effects(0, 1, 1)
