"""Error rates of the project's decisions on simulated studies, each with a control that must fail.

The functions of a report are called with a leading axis of studies. `test_planned_pairs` shows that
a table takes the same path. The tolerance for a rate p over S studies is 3.1 sqrt(p (1 - p) / S).
"""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from pfbench.stats.decision import FAILS, HOLDS, claim_word
from pfbench.stats.effects import (
    EffectEstimate,
    combine_conditions,
    estimate_in_new_world,
    estimate_in_these_worlds,
    moderated_p_values,
    trimmed_effects,
)
from pfbench.stats.pair_effects import PairEffects, QuestionEffect, location_effects, share_effects
from pfbench.stats.planned_pairs import correct_p_values, decide_family, stack_questions
from pfbench.stats.sequential_looks import LookPlan, decide_looks
from pfbench.stats.simulated_studies import SimulatedPairs, StudySetting, assess_pairs

pytestmark = pytest.mark.slow
MARGIN = math.log(1.05)
SEPARATE = StudySetting(regimes=4, runs=30, world_correlation=0.0)


def limit(p: float, studies: int) -> float:
    """Upper limit of a rate whose expectation is at most p."""
    return p + 3.1 * math.sqrt(p * (1 - p) / studies)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng([2024, seed])


def error_of(pairs, setting, *, shared_runs=True):
    """Effects of the error by the estimate of a setting."""
    return assess_pairs(pairs, setting.weights, shared_runs, setting.estimate)[1]


def p_of_cells(d) -> np.ndarray:
    """Control: conditions are taken for worlds."""
    cells = trimmed_effects(d).location.reshape(len(d), -1)
    return stats.ttest_1samp(cells, 0.0, axis=1).pvalue


def p_of_strata(d) -> np.ndarray:
    """Control: conditions are taken for independent."""
    studies, worlds, regimes, runs = d.shape
    separate = d.reshape(studies, worlds * regimes, 1, runs)
    effects = combine_conditions(trimmed_effects(separate), np.ones((worlds * regimes, 1)))
    return estimate_in_these_worlds(effects, shared_runs=False).p


@pytest.mark.parametrize("worlds", [2, 3, 6, 12])
def test_size_in_a_new_world(worlds):
    setting = replace(SEPARATE, worlds=worlds, regime_sd=0.15)
    pairs = setting.draw(rng(worlds), 2000)
    d, size = pairs.d, (error_of(pairs, setting).new_world.p <= 0.05).mean()
    # With two worlds the covariance over runs, which is never negative, makes the test conservative.
    least = 0.02 if worlds == 2 else 0.05 - 3.1 * math.sqrt(0.05 * 0.95 / 2000)
    assert least < size < limit(0.05, 2000)
    if worlds > 2:
        assert (p_of_cells(d) <= 0.05).mean() > 0.15


@pytest.mark.parametrize("correlation", [0.3, 1.0])
def test_size_in_a_new_world_if_worlds_share_runs_and_effects(correlation):
    """Without any SD between worlds, the error that worlds share is all there is."""
    setting = replace(SEPARATE, worlds=6, world_sd=0.0, regime_sd=0.0)
    setting = replace(setting, world_correlation=correlation * 0.5, regime_correlation=0.5)
    d = setting.draw(rng(20), 2000).d
    p = location_effects(d, setting.weights).new_world.p
    alone = location_effects(d, setting.weights, shared_runs=False).new_world.p
    assert (p <= 0.05).mean() < limit(0.05, 2000)
    assert (alone <= 0.05).mean() > 0.1


PLANNED = [(0, 1), (0, 2), (0, 3), (4, 5), (4, 6), (7, 8), (9, 10)]


def eleven_filters(studies, worlds):
    """Effects of eleven filters on worlds, with different SDs, [S, 11, W]."""
    generator = rng(30)
    sd = 0.18 * np.exp(0.6 * generator.standard_normal((studies, 11, 1)))
    filters = sd * generator.standard_normal((studies, 11, worlds))
    return filters + 0.05 * generator.standard_normal(filters.shape)


def test_family_of_pairs_in_a_new_world():
    """Seven pairs of eleven filters with different SDs share filters."""
    studies, worlds = 2000, 6
    filters, pairs = eleven_filters(studies, worlds), PLANNED
    effects = []
    for a, b in pairs:
        # one run of no variation per world: the values are those of the worlds
        d = np.repeat((filters[:, a] - filters[:, b])[..., None, None], 10, axis=-1)
        effects.append(location_effects(d, np.ones((worlds, 1))).new_world)
    family = stack_questions(effects)
    assert decide_family(family, 0.05).is_decided.any(axis=1).mean() < limit(0.05, studies)
    assert (family.p <= 0.05).any(axis=1).mean() > 0.2  # the control: no correction


@pytest.mark.parametrize("worlds", [3, 6])
def test_family_with_moderated_variances(worlds):
    filters, everything = eleven_filters(1500, worlds), list(combinations(range(11), 2))
    d = np.stack([filters[:, a] - filters[:, b] for a, b in everything], axis=1)
    p = moderated_p_values(d.mean(axis=-1), d.std(axis=-1, ddof=1), worlds)
    planned = p[:, [everything.index(pair) for pair in PLANNED]]
    assert (correct_p_values(planned) <= 0.05).any(axis=1).mean() < limit(0.055, 1500)
    assert (planned <= 0.05).any(axis=1).mean() > 0.12  # the control: no correction


@pytest.mark.parametrize("estimate", ["levels", "paired"])
@pytest.mark.parametrize("correlation", [0.0, 0.3])
def test_size_in_these_worlds(correlation, estimate):
    setting = StudySetting(
        3, 2, 20, 0.0, 0.0, regime_correlation=0.5, world_correlation=correlation, estimate=estimate
    )
    pairs = setting.draw(rng(40), 2000, fixed_worlds=True)
    d, size = pairs.d, (error_of(pairs, setting).same_worlds.p <= 0.05).mean()
    assert 0.025 < size < limit(0.05, 2000)
    assert (p_of_strata(d) <= 0.05).mean() > 0.08


def test_size_in_these_worlds_with_many_worlds_that_share_runs():
    setting = StudySetting(8, 2, 30, world_correlation=0.2)
    pairs = setting.draw(rng(41), 1500, fixed_worlds=True)
    size = (error_of(pairs, setting).same_worlds.p <= 0.05).mean()
    alone = error_of(pairs, setting, shared_runs=False).same_worlds.p
    assert 0.025 < size < limit(0.05, 1500)
    assert (alone <= 0.05).mean() > 0.15  # the control: Welch and Satterthwaite over worlds


@pytest.mark.parametrize("estimate", ["levels", "paired"])
@pytest.mark.parametrize("noise", ["t3", "exponential"])
def test_mixed_effects_that_average_to_zero(noise, estimate):
    """With skewed noise each estimate has an effect of its own, which averages to zero here."""
    setting = StudySetting(3, 4, 20, regime_correlation=0.5, noise=noise, estimate=estimate)
    pairs = setting.draw(rng(50), 1000, fixed_worlds=True)
    d, size = pairs.d, (error_of(pairs, setting).same_worlds.p <= 0.05).mean()
    assert 0.02 < size < limit(0.05, 1000)
    if noise == "exponential":  # the control: the effect of the other estimate is not zero
        other = replace(setting, estimate={"levels": "paired", "paired": "levels"}[estimate])
        assert (error_of(pairs, other).same_worlds.p <= 0.05).mean() > size
    assert (p_of_strata(d) <= 0.05).mean() > 0.1


def test_track_if_regimes_share_draws():
    setting = StudySetting(3, 4, 20, regime_correlation=0.8, lost_a=0.1, lost_b=0.1)
    pairs = setting.draw(rng(60), 1500)
    d = pairs.keeps_b.astype(float) - pairs.keeps_a
    p = share_effects(d, setting.weights).same_worlds.p
    assert 0.005 < (np.nan_to_num(p, nan=1.0) <= 0.05).mean() < limit(0.05, 1500)
    gains, losses = ((sign * d > 0).sum(axis=(1, 2, 3)) for sign in (1, -1))
    trials = gains + losses
    mcnemar = 2 * stats.binom.cdf(np.minimum(gains, losses), trials, 0.5)
    mcnemar -= stats.binom.pmf(np.minimum(gains, losses), trials, 0.5)  # mid-p
    assert (mcnemar <= 0.05).mean() > 0.09


def family_of(pairs, weights):
    track, error = assess_pairs(pairs, weights)
    members = [track.same_worlds, error.same_worlds]
    return decide_family(stack_questions(members), 0.05), error


@pytest.mark.parametrize("shape", [(1, 1, 50), (3, 4, 20)])
def test_track_and_error_with_many_lost_runs(shape):
    setting = StudySetting(*shape, lost_a=0.4, lost_b=0.4)
    tests, error = family_of(setting.draw(rng(70), 800, fixed_worlds=True), setting.weights)
    assert tests.is_decided.any(axis=1).mean() < limit(0.05, 800)
    assert error.by_runs_won.mean() > 0.05


def test_a_filter_that_gives_up_early_gains_nothing():
    """Filter b stops its worst 20 % of runs, and is else like a."""
    generator, studies = rng(80), 1000
    hard = generator.standard_normal((studies, 1, 1, 50))
    log_a, log_b = (0.4 * (hard + generator.standard_normal(hard.shape)) for _ in range(2))
    stops = log_b >= np.quantile(log_b, 0.8, axis=-1, keepdims=True)
    keeps_a, keeps_b = np.ones(stops.shape, dtype=bool), ~stops
    pairs = SimulatedPairs(log_a - log_b, (log_a + log_b) / 2, keeps_a, keeps_b)
    tests, _ = family_of(pairs, np.ones((1, 1)))
    decides = tests.is_decided & (tests.low >= 0)  # for b, by track and by error
    assert decides.mean(axis=0).max() < limit(0.025, studies)  # as for two equal filters
    is_worse = tests.is_decided[:, 0] & (tests.high[:, 0] <= 0)
    assert is_worse.mean() > 0.9
    assert (decides.any(axis=1) & ~is_worse).mean() < limit(0.001, studies)  # the pair: b better
    survivors = location_effects(np.where(stops, np.nan, log_a - log_b), np.ones((1, 1)))
    rewarded = (survivors.same_worlds.p <= 0.05) & (survivors.same_worlds.value > 0)
    assert rewarded.mean() > 0.15  # the control: runs that both keep


def looks_of(d, plan):
    """Effects at each look of differences [S, N]."""
    results = []
    for n in plan.runs:
        estimate = estimate_in_these_worlds(
            combine_conditions(trimmed_effects(d[:, None, None, :n]), np.ones((1, 1)))
        )
        question = QuestionEffect(estimate.value, estimate, estimate.p)
        flags = np.zeros(len(d), dtype=bool)
        results.append(PairEffects(question, question, None, flags, flags, flags))
    return results


@pytest.mark.parametrize("spending", ["pocock", "obrien_fleming"])
def test_planned_looks(spending):
    plan = LookPlan(runs=(20, 40, 80, 160), spending=spending)
    d = StudySetting(1, 1, 160, 0.0, 0.0).draw(rng(90), 2000).d.reshape(2000, 160)
    effects = looks_of(d, plan)
    tests = decide_looks(effects, plan)
    assert tests.is_decided.mean() < limit(0.055, 2000)
    outside = (tests.low > 0) | (tests.high < 0)
    assert np.array_equal(outside, tests.is_decided & outside)
    peeking = np.any([e.same_worlds.p <= 0.05 for e in effects], axis=0)
    assert peeking.mean() > 0.1


@pytest.mark.parametrize("noise", ["t3", "normal"])
@pytest.mark.parametrize(("effect", "wrong"), [(0.0, HOLDS), (-MARGIN, FAILS)])
def test_claims_at_their_edges(noise, effect, wrong):
    plan = LookPlan(runs=(20, 40, 80, 160, 320))
    setting = StudySetting(1, 1, 320, 0.0, 0.0, noise=noise)
    d = setting.draw(rng(100), 1500, effect=effect).d.reshape(1500, 320)
    effects = looks_of(d, plan)
    tests = decide_looks(effects, plan)
    verdicts = [
        claim_word(float(low), float(high), bool(decided), MARGIN, states_size=False)
        for low, high, decided in zip(tests.low, tests.high, tests.is_decided, strict=True)
    ]
    assert verdicts.count(wrong) / 1500 < limit(0.025, 1500)
    ends = [e.same_worlds.estimate.interval(0.05) for e in effects]
    uncorrected = [low > -MARGIN if wrong == FAILS else high < 0 for low, high in ends]
    assert np.any(uncorrected, axis=0).mean() > 0.05


def test_power_in_a_new_world():
    setting = replace(SEPARATE, worlds=8)
    effect = error_of(setting.draw(rng(110), 2000, effect=-0.3), setting).new_world
    assert (effect.p <= 0.05).mean() > 0.74
    silent = EffectEstimate(effect.value, np.full(2000, np.inf), effect.estimate.df)
    assert not (silent.p <= 0.05).any()  # the control: a rule that never decides has no power


def test_power_in_these_worlds():
    """The cost of shared runs: at most a few points of power when worlds share nothing."""
    setting = StudySetting(3, 4, 20, world_correlation=0.0)
    pairs = setting.draw(rng(120), 1000, effect=-0.1, fixed_worlds=True)
    shared, separate = (
        (error_of(pairs, setting, shared_runs=flag).same_worlds.p <= 0.05).mean()
        for flag in (True, False)
    )
    assert shared > 0.5
    assert separate - 0.12 < shared < separate + 0.02


def test_coverage_of_the_new_world_interval():
    setting = replace(SEPARATE, worlds=5)
    d = setting.draw(rng(130), 2000, effect=-0.2).d
    effects = combine_conditions(trimmed_effects(d), setting.weights)
    low, high = estimate_in_new_world(effects).interval(0.05)
    covered = ((low <= -0.2) & (high >= -0.2)).mean()
    assert abs(covered - 0.95) < 3.1 * math.sqrt(0.05 * 0.95 / 2000)
