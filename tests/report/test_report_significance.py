"""The verdicts: against other implementations, by counting, and by how often they are wrong."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from pfbench.results.comparison import pairwise_results, pairwise_tests
from pfbench.results.statistics import effect_sizes, intervals, signed_rank


def table(losses, group="position", seed=1):
    """Rows as `frame` makes them from per-run losses by label; infinite is lost."""
    parts = [
        pd.DataFrame(
            {
                "label": label,
                "run": np.arange(len(values)),
                "value": np.asarray(values, dtype=float),
            }
        )
        for label, values in losses.items()
    ]
    rows = pd.concat(parts, ignore_index=True)
    cell = {
        "scenario": "s",
        "noise": "n",
        "model": "m",
        "seed": seed,
        "group": group,
        "component": "norm",
    }
    return rows.assign(**cell, metric="rmse", unit="m", lost=np.isinf(rows.value))


def one(a, b, alpha=0.05):
    (verdict,) = pairwise_tests.compare_pairs(table({"a": a, "b": b}), alpha)
    return verdict


def skill(rng, runs, factor):
    """Losses of two filters with common worlds, the second `factor` times the first but for its own scatter."""
    world = np.exp(0.5 * rng.standard_normal(runs))
    a, b = world * np.exp(0.2 * rng.standard_normal((2, runs)))
    return a, factor * b


def _winners_alone(monkeypatch):
    """Intervals, equivalence and the runs that are needed take most of the time and no part in the decision."""
    none = intervals.ConfidenceInterval(0.0, 0.0, "none")
    monkeypatch.setattr(pairwise_tests, "bootstrap_median_interval", lambda *_: none)
    monkeypatch.setattr(
        pairwise_tests,
        "equivalence_samples",
        lambda differences, _: np.full(len(differences), np.nan),
    )
    monkeypatch.setattr(pairwise_tests, "_sample_sizes", lambda *_: (np.nan, np.nan))


def families(losses, alpha=0.05):
    """The verdicts of many studies, losses [studies, runs] by label: each is a cell of one table, which is made once."""
    n, runs = next(iter(losses.values())).shape
    rows = table({name: values.ravel() for name, values in losses.items()})
    rows = rows.assign(noise=rows.run // runs, run=rows.run % runs)
    found = pairwise_tests.compare_pairs(rows, alpha)
    size = len(found) // n
    family = [found[k : k + size] for k in range(0, len(found), size)]
    assert [{v.noise for v in own} for own in family] == [{str(k)} for k in range(n)]
    return family


def test_p_is_that_of_scipy_on_log_ratios():
    a, b = skill(np.random.default_rng(0), 30, 1.1)
    found = one(a, b)
    expected = stats.wilcoxon(np.log(a), np.log(b), zero_method="zsplit")
    assert found.p == pytest.approx(expected.pvalue)
    assert found.statistic == expected.statistic


def test_demsar_example():
    # Demsar 2006, table 2: AUC of C4.5 and C4.5+m on 14 data sets; T = 12 with the rank of the tie split.
    plain = [
        0.763,
        0.599,
        0.954,
        0.628,
        0.882,
        0.936,
        0.661,
        0.583,
        0.775,
        1.000,
        0.940,
        0.619,
        0.972,
        0.957,
    ]
    other = [
        0.768,
        0.591,
        0.971,
        0.661,
        0.888,
        0.931,
        0.668,
        0.583,
        0.838,
        1.000,
        0.962,
        0.666,
        0.981,
        0.978,
    ]
    statistic, _ = signed_rank.wilcoxon_signed_rank(np.round(np.array(plain) - np.array(other), 3))
    assert statistic == 12.0


def test_holm_is_that_of_statsmodels_over_the_family():
    rng = np.random.default_rng(1)
    losses = {
        name: np.exp(rng.normal(shift, 0.5, 25))
        for name, shift in zip("abcd", (0, 0.1, 0.3, 0.35), strict=True)
    }
    found = pairwise_tests.compare_pairs(table(losses))
    assert [(v.a, v.b) for v in found] == [
        ("a", "b"),
        ("a", "c"),
        ("a", "d"),
        ("b", "c"),
        ("b", "d"),
        ("c", "d"),
    ]
    np.testing.assert_allclose(
        [v.p_holm for v in found], multipletests([v.p for v in found], method="holm")[1]
    )
    assert {v.family for v in found} == {6}


def test_families_are_cells_and_groups():
    a, b = skill(np.random.default_rng(2), 20, 1.2)
    two = pd.concat([table({"a": a, "b": b}), table({"a": b, "b": a}, group="velocity")])
    found = pairwise_tests.compare_pairs(two)
    assert [(v.group, v.family) for v in found] == [("position", 1), ("velocity", 1)]
    assert found[0].effect == -found[1].effect


@pytest.mark.parametrize("seed", range(5))
def test_rank_biserial_by_counting_walsh_averages(seed):
    rng = np.random.default_rng(seed)
    d = rng.normal(0.3, 1, 12)
    # The positive rank sum is the number of Walsh averages (i <= j) above zero [Tukey 1949].
    walsh = np.add.outer(d, d)[np.triu_indices(d.size)]
    assert effect_sizes.rank_biserial(d) == pytest.approx(
        ((walsh < 0).sum() - (walsh > 0).sum()) / walsh.size
    )


def test_sign_convention():
    a = np.linspace(1, 2, 15)
    better = one(a, 2 * a)
    assert better.effect == 1.0
    assert better.ratio == pytest.approx(0.5)
    assert better.winner == "a"
    worse = one(2 * a, a)
    assert worse.effect == -1.0
    assert worse.ratio == pytest.approx(2.0)
    assert worse.winner == "b"


def test_swapping_the_filters_mirrors_the_verdict():
    a, b = skill(np.random.default_rng(4), 30, 1.15)
    forth, back = one(a, b), one(b, a)
    assert forth.p == pytest.approx(back.p)
    assert forth.effect == pytest.approx(-back.effect)
    assert forth.ratio == pytest.approx(1 / back.ratio)
    assert (forth.winner, back.winner) in {("a", "b"), (pairwise_results.INCONCLUSIVE,) * 2}


def test_a_filter_does_not_beat_itself():
    a, _ = skill(np.random.default_rng(5), 20, 1)
    found = one(a, a)
    assert (found.p, found.effect, found.ratio, found.low, found.high) == (1.0, 0.0, 1.0, 1.0, 1.0)
    assert found.winner == pairwise_results.INCONCLUSIVE
    assert found.interval == "percentile"  # the bootstrap of a constant has no BCa, and says so


def test_constant_ratio_has_a_point_for_an_interval():
    a = np.linspace(1, 2, 12)
    found = one(a, a / 0.8)
    assert found.ratio == pytest.approx(0.8)
    assert (found.low, found.high) == pytest.approx((0.8, 0.8))


def test_units_do_not_matter():
    a, b = skill(np.random.default_rng(6), 25, 1.2)
    here, there = one(a, b), one(60 * a, 60 * b)
    for name in ("p", "effect", "ratio", "low", "high"):
        assert getattr(here, name) == pytest.approx(getattr(there, name))


def test_losing_runs_moves_the_verdict_against_the_loser():
    a, b = skill(np.random.default_rng(7), 40, 1.0)
    effects, winners = [], []
    for lost in (0, 10, 20, 30, 40):
        hurt = a.copy()
        hurt[:lost] = np.inf
        found = one(hurt, b)
        assert (found.lost_a, found.lost_b, found.pairs) == (lost, 0, 40)
        effects.append(found.effect)
        winners.append(found.winner)
    assert effects == sorted(effects, reverse=True)
    assert len(set(effects)) == 5
    assert winners[0] == pairwise_results.INCONCLUSIVE
    assert winners[-1] == "b"


def test_a_lost_run_outranks_any_other():
    a, b = np.ones(9), np.full(9, 1e6)
    a[0], b[0] = np.inf, 1.0
    # a wins 8 pairs by a factor of a million and loses one run: that pair holds the largest rank, 9 of 45.
    assert one(a, b).effect == pytest.approx((45 - 9 - 9) / 45)


def test_two_lost_runs_are_a_tie():
    a, b = (
        np.array([1.0, 2.0, np.inf, 4.0, 5.0, 6.0]),
        np.array([2.0, 4.0, np.inf, 8.0, 10.0, 12.0]),
    )
    d = effect_sizes.log_ratio(a, b)
    assert d[2] == 0
    assert one(a, b).effect == pytest.approx(20 / 21)  # the tie holds rank 1, split evenly


def test_rounding_decides_nothing():
    a = np.linspace(1, 2, 30)
    found = one(
        a, a * (1 + 1e-7)
    )  # in every run the same way, but less than single precision tells
    assert (found.p, found.effect, found.winner) == (1.0, 0.0, pairwise_results.INCONCLUSIVE)
    assert one(a, a * (1 + 1e-5)).winner == "a"


def test_ratio_of_mostly_lost_runs_is_infinite():
    b = np.linspace(1, 2, 10)
    a = b.copy()
    a[:8] = np.inf
    found = one(a, b)
    assert found.ratio == np.inf
    assert one(b, a).ratio == 0.0
    assert found.high == np.inf


def test_runs_without_truth_and_unpaired_runs_are_left_out():
    a, b = skill(np.random.default_rng(8), 20, 1.3)
    holed = a.copy()
    holed[4] = np.nan
    assert one(holed, b).pairs == 19
    assert one(a[:15], b).pairs == 15
    assert one(a[:15], b).p == one(a[:15], b[:15]).p
    apart = pd.concat([table({"a": a}, seed=1), table({"b": b}, seed=2)])
    assert pairwise_tests.compare_pairs(apart) == []


def test_a_single_run_decides_nothing():
    found = one([1.0], [2.0])
    assert found.winner == pairwise_results.INCONCLUSIVE
    assert found.interval == "none"


def test_interval_holds_the_median_ratio_as_often_as_it_says():
    rng = np.random.default_rng(9)
    hits, n = 0, 300
    for _ in range(n):
        interval = intervals.bootstrap_median_interval(rng.normal(0.2, 1, 25), 0.9, 3)
        hits += interval.low <= 0.2 <= interval.high
    # Medians are discrete: the bootstrap of 25 points is within a few per cent of its level [Efron, Tibshirani 1993].
    assert hits / n == pytest.approx(0.9, abs=0.04 + 3 * np.sqrt(0.09 / n))


def test_same_table_same_verdicts_in_any_order_of_rows():
    a, b = skill(np.random.default_rng(10), 20, 1.3)
    rows = table({"a": a, "b": b})
    shuffled = pd.concat([part.sample(frac=1, random_state=1) for _, part in rows.groupby("label")])
    assert pairwise_tests.compare_pairs(rows) == pairwise_tests.compare_pairs(shuffled)


@pytest.mark.slow
def test_false_winners_are_as_rare_as_alpha(monkeypatch):
    _winners_alone(monkeypatch)
    rng, n, alpha = np.random.default_rng(11), 1000, 0.05
    world = np.exp(0.5 * rng.standard_normal((n, 30)))
    losses = {name: world * np.exp(0.2 * rng.standard_normal((n, 30))) for name in "abc"}
    found = families(losses, alpha)
    won = np.mean(
        [any(v.winner != pairwise_results.INCONCLUSIVE for v in family) for family in found]
    )
    first = np.mean([family[0].p <= alpha for family in found])
    error = 4 * np.sqrt(alpha * (1 - alpha) / n)
    assert first == pytest.approx(alpha, abs=error)
    assert won <= alpha + error
    assert won >= alpha / 3  # a test that never rejects would pass the line above


@pytest.mark.slow
def test_a_planted_difference_is_found(monkeypatch):
    _winners_alone(monkeypatch)
    rng, n = np.random.default_rng(12), 200
    a, b = (
        np.stack(values) for values in zip(*(skill(rng, 40, 1.2) for _ in range(n)), strict=True)
    )
    winners = [v.winner for (v,) in families({"a": a, "b": b})]
    # log 1.2 is 0.64 standard deviations of the paired difference; the t-test has power 0.97 with 40 pairs, and the
    # signed-rank test loses at most a few per cent of its sample to it [Hodges, Lehmann 1956].
    assert winners.count("a") / n > 0.9
    assert winners.count("b") == 0


@pytest.mark.parametrize("n", [2, 7, 30, 101])
def test_the_interval_of_the_median_is_scipys_of_the_same_draws(n):
    d = np.random.default_rng(n).gamma(2, 1, n)
    found = intervals.bootstrap_median_interval(d, 0.9)
    drawn = SimpleNamespace(bootstrap_distribution=intervals._bootstrap_medians(np.sort(d), 0))
    expected = stats.bootstrap(
        (d,), np.median, n_resamples=0, confidence_level=0.9, method="BCa", bootstrap_result=drawn
    )
    assert found.method == "BCa"
    assert found[:2] == pytest.approx(tuple(expected.confidence_interval), rel=1e-12)
    left = np.array(
        [np.median(np.delete(d, i)) for i in range(n)]
    )  # the interval hardly sees it, for medians are few
    assert intervals._acceleration(np.sort(d)) == pytest.approx(
        stats.skew(left.mean() - left) / (6 * np.sqrt(n)), abs=1e-12
    )
    plain = stats.bootstrap(
        (d,),
        np.median,
        n_resamples=9999,
        confidence_level=0.9,
        method="BCa",
        rng=np.random.default_rng(1),
    )
    width = found.high - found.low
    assert np.allclose(
        found[:2], tuple(plain.confidence_interval), atol=0.15 * width
    )  # other draws
