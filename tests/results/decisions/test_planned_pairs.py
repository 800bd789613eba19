"""Decisions of a table: the path of a report, families, invariance and the order of filters."""

import json
import math
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from decision_cases import make_study
from scipy import stats
from statsmodels.stats.multitest import multipletests

from pfbench.stats.decision import DecisionOptions, MetricRule
from pfbench.stats.effects import EffectEstimate
from pfbench.stats.filter_sets import order_filters
from pfbench.stats.pair_effects import QuestionEffect, location_effects, share_effects
from pfbench.stats.planned_pairs import (
    correct_p_values,
    decide_family,
    decide_planned_pairs,
    decide_secondary_metrics,
    decision_frame,
    stack_questions,
)
from pfbench.stats.sentences import describe_pair
from pfbench.stats.sequential_looks import LookPlan, decide_at_looks, is_complete
from pfbench.stats.simulated_studies import StudySetting, assess_pairs
from pfbench.stats.study_runs import select_pair, tidy_runs, to_study_runs

PAIR = [("A", "B")]


def select(decisions, question, metric="error"):
    return [d for d in decisions if d.question == question and d.metric == metric]


def table_of(pairs, study):
    """Write one simulated study as a table."""
    keeps = {"A": pairs.keeps_a[study], "B": pairs.keeps_b[study]}
    mean, half = pairs.mean[study], pairs.d[study] / 2
    value = {"A": np.exp(mean + half), "B": np.exp(mean - half)}
    rows = [
        {"filter": f, "scenario": f"s{w:02d}", "family": f"s{w:02d}", "regime": r, "run": n,
         "value": value[f][w, r, n], "keeps_track": keeps[f][w, r, n]}
        for f in ("A", "B") for w, r, n in np.ndindex(*pairs.d.shape[1:])
    ]  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.parametrize("estimate", ["levels", "paired"])
@pytest.mark.parametrize("lost", [0.0, 0.15, 0.4])
def test_a_table_takes_the_path_of_the_simulations(lost, estimate):
    setting = StudySetting(3, 2, 20, lost_a=lost, lost_b=lost)
    pairs = setting.draw(np.random.default_rng(1), 4)
    track, error = assess_pairs(pairs, setting.weights, estimate=estimate)
    options = DecisionOptions(estimate=estimate)
    for question, name in (("a", "same_worlds"), ("b", "new_world")):
        members = [getattr(effects, name) for effects in (track, error)]
        tests = decide_family(stack_questions(members), 0.05)
        for s in range(4):
            decisions = decide_planned_pairs(table_of(pairs, s), PAIR, None, options)
            for k, metric in enumerate(("keeps track", "error")):
                (record,) = select(decisions, question, metric)
                assert record.estimate == pytest.approx(members[k].value[s], abs=1e-12)
                assert record.p == pytest.approx(members[k].p[s], rel=1e-9, nan_ok=True)
                if record.word not in ("identical", "not tested"):
                    ends = np.array([tests.low[s, k], tests.high[s, k]])
                    if record.scale in ("share", "runs won"):
                        ends = ends.clip(-1.0, 1.0)
                    assert (record.low, record.high) == pytest.approx(ends, rel=1e-9, abs=1e-12)
                    assert (record.word in ("better", "worse")) == tests.is_decided[s, k]


def test_another_filter_changes_nothing_of_a_pair():
    """Twenty more filters change neither the p-value nor the interval of the pair alone."""
    few = make_study({"A": -0.15, "B": 0.0}, lost={"A": 0.1, "B": 0.15})
    more = make_study(
        {"A": -0.15, "B": 0.0, **{f"filter_{k}": 0.1 * k for k in range(20)}},
        lost={"A": 0.1, "B": 0.15},
    )
    names = ["p", "plain_low", "plain_high", "estimate", "low", "high", "p_corrected", "word"]
    first, second = (decision_frame(decide_planned_pairs(t, PAIR))[names] for t in (few, more))
    pd.testing.assert_frame_equal(first, second)
    in_family = decide_planned_pairs(more, [*PAIR, ("A", "filter_3"), ("filter_1", "filter_2")])
    for d in decide_planned_pairs(few, PAIR):
        (same,) = [e for e in select(in_family, d.question, d.metric) if (e.a, e.b) == PAIR[0]]
        assert (same.p, same.plain_low, same.plain_high) == (d.p, d.plain_low, d.plain_high)
        assert same.family_size > d.family_size


def test_order_of_a_pair_is_a_sign():
    table = make_study({"A": -0.2, "B": 0.0}, lost={"A": 0.1, "B": 0.1})
    for d, e in zip(
        decide_planned_pairs(table, PAIR), decide_planned_pairs(table, [("B", "A")]), strict=True
    ):
        assert d.estimate == pytest.approx(-e.estimate)
        assert (d.low, d.high) == pytest.approx((-e.high, -e.low))
        assert d.p == pytest.approx(e.p, nan_ok=True)


def test_holm_against_statsmodels_and_absent_tests():
    p = np.random.default_rng(0).uniform(0, 0.1, (5, 9))
    expected = [multipletests(row, method="holm")[1] for row in p]
    assert correct_p_values(p) == pytest.approx(np.array(expected))
    p[:, 4] = np.nan
    corrected = correct_p_values(p)
    assert np.isnan(corrected[:, 4]).all()
    assert corrected[0, :4] == pytest.approx(
        multipletests(np.delete(p[0], 4), method="holm")[1][:4]
    )


def test_intervals_agree_with_the_test():
    """A decision whose Bonferroni interval includes 0 has the end 0 [Guilbaud 2008]."""
    value = np.array([-1.0, -0.255, 0.1])
    estimate = EffectEstimate(value, np.full(3, 0.1), np.full(3, 20.0))
    tests = decide_family(QuestionEffect(value, estimate, estimate.p), 0.05)
    assert tests.is_decided.tolist() == [True, True, False]
    low, high = estimate.interval(0.05 / 3)
    assert high[1] > 0
    assert tests.high[1] == 0.0
    assert (tests.low[0], tests.high[0]) == (low[0], high[0])
    assert tests.low[2] < 0 < tests.high[2]
    flips = QuestionEffect(value, estimate, np.full(3, 0.5))  # a test that does not decide
    assert (decide_family(flips, 0.05).high >= 0).all()


def test_families_of_scenarios_are_worlds():
    families = {f"scenario_{k}": f"family_{k // 2}" for k in range(4)}
    table = make_study({"A": -0.2, "B": 0.0}, worlds=4, families=families)
    (record,) = select(decide_planned_pairs(table, PAIR), "b")
    assert record.worlds == 2
    single = make_study({"A": -0.2, "B": 0.0}, worlds=4)
    (separate,) = select(decide_planned_pairs(single, PAIR), "b")
    assert separate.worlds == 4
    assert separate.estimate == pytest.approx(record.estimate)
    pair = select_pair(to_study_runs(table), "A", "B")
    assert pair.weights.sum(axis=1) == pytest.approx([1.0, 1.0])
    unbalanced = table[(table.scenario != "scenario_1") | (table.regime == "regime_0")]
    weights = select_pair(to_study_runs(unbalanced), "A", "B").weights
    assert sorted(weights[0][weights[0] > 0]) == pytest.approx([0.25, 0.25, 0.5])


def test_regimes_with_different_runs():
    table = make_study({"A": -0.2, "B": 0.0}, worlds=1)
    shifted = table.copy()
    second = shifted.regime == "regime_1"
    shifted.loc[second, "run"] += 1000
    same, other = (select(decide_planned_pairs(t, PAIR), "a")[0] for t in (table, shifted))
    assert same.estimate == pytest.approx(other.estimate)
    assert same.p != other.p


def test_too_few_runs_one_world_and_identical_filters():
    few = decide_planned_pairs(make_study({"A": -1.0, "B": 0.0}, runs=5), PAIR)
    (here,), (new,) = select(few, "a"), select(few, "b")
    assert here.word == here.pair_word == "not tested"
    assert here.reason == "5 runs per condition, 10 are required"
    assert new.word == "better"  # worlds are the unit of question (b)
    single = decide_planned_pairs(make_study({"A": -1.0, "B": 0.0}, worlds=1), PAIR)
    assert select(single, "a")[0].word == "better"
    assert (select(single, "b")[0].word, select(single, "b")[0].reason) == (
        "not tested",
        "one world",
    )
    table = make_study({"A": 0.0})
    equal = pd.concat([table, table.assign(filter="B", value=table.value * (1 + 1e-8))])
    assert {d.word for d in decide_planned_pairs(equal, PAIR)} == {"identical"}


def test_lost_track_decides():
    table = make_study({"A": 0.0, "B": 0.0}, lost={"B": 0.6}, runs=40)
    error = select(decide_planned_pairs(table, PAIR), "a")[0]
    assert (error.reason, error.scale, error.word) == (
        "share of runs won in place of the error",
        "runs won",
        "better",
    )
    assert (error.share_a, error.size) == (1.0, "")
    assert error.share_b == pytest.approx(0.4, abs=0.1)
    both = make_study({"A": 0.0, "B": 0.0}, lost={"A": 0.7, "B": 0.7}, runs=40)
    assert select(decide_planned_pairs(both, PAIR), "a")[0].word == "inconclusive"


def test_filters_that_never_keep_track_are_not_called_identical():
    table = make_study({"A": 0.0, "B": 0.3}, lost={"A": 1.0, "B": 1.0}, runs=40)
    decisions = decide_planned_pairs(table, PAIR)
    (error,), (track,) = select(decisions, "a"), select(decisions, "a", "keeps track")
    assert (error.word, error.reason) == ("not tested", "no run of either filter keeps track")
    assert track.word == "identical"
    assert "A and B are not compared: no run of either" in describe_pair(track, error)


def test_trade_off():
    table = make_study({"A": 0.0, "B": -0.3}, lost={"B": 0.15}, runs=60)
    decisions = decide_planned_pairs(table, PAIR)
    track, error = select(decisions, "a", "keeps track")[0], select(decisions, "a")[0]
    assert track.estimate < -0.05
    assert error.both_keep > 0.1
    assert track.pair_word == error.pair_word == "trade-off"
    plain = make_study({"A": 0.0, "B": -0.3}, lost={"A": 0.15}, runs=60)
    assert select(decide_planned_pairs(plain, PAIR), "a")[0].pair_word == "worse"


def test_new_world_values():
    table = make_study({"A": -0.3, "B": 0.0}, worlds=4)
    (record,) = select(decide_planned_pairs(table, PAIR), "b")
    assert record.posterior_low < record.estimate < record.posterior_high
    assert record.new_low < record.plain_low
    assert math.isnan(record.p_moderated)
    filters = {f"filter_{k}": 0.1 * k for k in range(8)}
    moderated = decide_planned_pairs(make_study(filters, worlds=4), [("filter_0", "filter_7")])
    assert 0 < select(moderated, "b")[0].p_moderated < 1
    assert math.isnan(select(moderated, "b", "keeps track")[0].p_moderated)


def test_order_of_filters():
    filters = {"A": -0.8, "B": -0.8, "C": 0.0, "D": 0.8}
    here, new = order_filters(make_study(filters, worlds=3, runs=40, world_sd=0.0, run_sd=0.1))
    assert here.top_group == ("A", "B")
    assert here.ranks["C"] == (3, 3)
    assert here.ranks["D"] == (4, 4)
    assert {first for first, _ in new.ranks.values()} <= {1, 2, 3, 4}
    assert len(here.decisions) == len(list(combinations(filters, 2)))


def test_planned_looks_of_a_table():
    table = make_study({"A": -0.3, "B": 0.0, "C": 0.001}, runs=80, world_sd=0.0)
    first = decide_at_looks(table[table.run < 30], PAIR, LookPlan())
    later = decide_at_looks(table, PAIR, LookPlan())
    assert (first[1].looks, later[1].looks) == (1, 3)
    assert later[1].low >= first[1].low
    assert later[1].high <= first[1].high
    assert later[1].word == "better"
    assert is_complete(later)
    assert not is_complete(decide_at_looks(table, [("B", "C")], LookPlan()))
    with pytest.raises(ValueError, match="runs must be at least 20, got 12"):
        decide_at_looks(table[table.run < 12], PAIR, LookPlan())


def test_secondary_metrics():
    table = make_study({"A": 0.0, "B": 0.0}, runs=40)
    rng = np.random.default_rng(9)
    score = table.assign(value=rng.standard_normal(len(table)) + (table["filter"] == "A"))
    share = table.assign(
        value=(rng.random(len(table)) < 0.3 + 0.5 * (table["filter"] == "B")) * 1.0
    )
    rules = [
        MetricRule("log score", "difference", higher_is_better=True, margin=0.1),
        MetricRule("overconfident", "share", margin=0.05),
        MetricRule("mean score", "mean difference", margin=0.1),
    ]
    tables = {"log score": score, "overconfident": share, "mean score": score}
    decisions = decide_secondary_metrics(tables, PAIR, rules)
    words = {d.metric: d.word for d in decisions if d.question == "a"}
    assert words == {"log score": "better", "overconfident": "better", "mean score": "worse"}
    assert {d.family_size for d in decisions} == {3}
    mean = next(d for d in decisions if d.metric == "mean score")
    by_filter = score.groupby("filter").value.mean()
    assert mean.estimate == pytest.approx(by_filter["A"] - by_filter["B"])


def test_zero_spread_is_a_fact_or_decided_by_runs_won():
    d = np.full((1, 1, 20), -0.1)
    fact = location_effects(d, np.ones((1, 1)))
    assert fact.same_worlds.p == 0
    assert not fact.by_runs_won
    ties = np.where(np.arange(20) < 3, -1.0, 0.0)[None, None]
    assert location_effects(ties, np.ones((1, 1))).by_runs_won
    shares = share_effects(np.ones((1, 1, 20)), np.ones((1, 1)))
    assert shares.same_worlds.p == pytest.approx(2.0**-19)
    assert shares.same_worlds.estimate.interval(0.05)[0] < 1.0


def test_alike_worlds_do_not_prove_a_share():
    """Two worlds with the same small difference have no SD; the error over runs remains."""
    d = np.zeros((2, 1, 20))
    d[:, 0, 0] = 1.0
    assert share_effects(d, np.ones((2, 1))).new_world.p > 0.1


def test_invalid_input():
    table = make_study({"A": 0.0, "B": 0.0})
    for bad, pairs, message in (
        (table.drop(columns="family"), PAIR, "table must have the columns"),
        (pd.concat([table, table]), PAIR, "runs must be unique"),
        (table, [("A", "Z")], "pairs must be two different filters"),
        (table, [*PAIR, ("B", "A")], "pairs must be at least one pair"),
        (table[(table["filter"] == "A") | (table.run > 99)], PAIR, "pairs must be two different"),
    ):
        with pytest.raises(ValueError, match=message):
            decide_planned_pairs(bad, pairs)
    for bad in ({"alpha": 0.0}, {"margin": -1.0}):
        with pytest.raises(ValueError, match="must be"):
            DecisionOptions(**bad)


def test_records_are_json():
    text = json.dumps(
        [
            d.to_dict()
            for d in decide_planned_pairs(make_study({"A": 0.0, "B": 0.0}, worlds=1), PAIR)
        ]
    )
    assert json.loads(text)[1]["scale"] == "log ratio"
    assert '"inf"' in text


def test_tidy_runs_of_a_loaded_frame():
    frame = pd.DataFrame(
        {
            "metric": ["rmse"] * 4 + ["nees"], "group": "position", "component": ["norm"] * 4 + [""],
            "scenario": "flight", "noise": ["nominal", "outliers"] * 2 + ["nominal"], "model": "ins",
            "label": ["ekf", "ekf", "sir", "sir", "ekf"], "seed": 1, "run": 3,
            "lost": [False, False, True, False, False], "family": "flights",
            "keeps_track": [True, True, False, True, True], "value": [1.0, 2.0, np.inf, 3.0, 4.0],
        }
    )  # fmt: skip
    tidy = tidy_runs(frame)
    assert tidy["value"].tolist() == [1.0, 2.0, np.inf, 3.0]
    assert tidy["keeps_track"].tolist() == [True, True, False, True]
    assert set(tidy["family"]) == {"flights"}
    with pytest.raises(ValueError, match="metric and group must have results"):
        tidy_runs(frame, metric="crps")


@pytest.mark.slow
def test_error_rate_of_the_function_of_a_report():
    """Three filters in 4 worlds and 2 regimes: decisions of (b) through tables and records."""
    wrong, cells = 0, 0
    for seed in range(80):
        table = make_study(
            {"A": 0.0, "B": 0.0, "C": 0.0}, 4, 2, 20, seed=seed, world_sd=0.3, run_sd=0.2
        )
        pairs = list(combinations("ABC", 2))
        decisions = select(decide_planned_pairs(table, pairs), "b")
        wrong += any(d.word in ("better", "worse") for d in decisions)
        logs = np.log(
            table.pivot_table(index=["scenario", "regime"], columns="filter", values="value")
        )
        p = [stats.ttest_rel(logs[a], logs[b]).pvalue for a, b in pairs]
        cells += min(p) <= 0.05 / len(pairs)
    assert wrong / 80 <= 0.13
    assert cells / 80 > 0.2  # the control: conditions are taken for worlds


def test_a_difference_of_shares_stays_within_one():
    """One filter keeps track in all runs of three worlds, the other in none."""
    setting = StudySetting(3, 1, 20)
    pairs = setting.draw(np.random.default_rng(3), 1)
    none = np.zeros_like(pairs.keeps_a)
    decisions = decide_planned_pairs(table_of(pairs._replace(keeps_a=~none, keeps_b=none), 0), PAIR)
    for record in decisions:
        assert record.estimate == pytest.approx(-1.0)
        assert -1.0 <= record.low < record.high <= 1.0
        assert -1.0 <= record.plain_low < record.plain_high <= 1.0
    assert decisions[0].word == "better"
