"""Effects of pairs and verdicts of families, held against scipy and against their error rates."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest
from decision_cases import make_study
from pfbench.experiments.study_parts import crossed_mean_interval
from scipy import stats

from pfbench.report.board.view import View, build_rows, describe_filters
from pfbench.report.overview.tables import WorldFacts, build_world, decide_cells
from pfbench.results.looks import PartName
from pfbench.stats.comparison import (
    EQUAL_KEPT,
    EQUAL_WORD,
    EQUALITY_MARGIN,
    NO_DECISION,
    SAME_RUNS,
    WORSE_THAN,
    compare,
    compare_all,
    decide,
    find_largest_p,
    flip,
)
from pfbench.stats.court import Court
from pfbench.stats.pair_states import LookSchedule, decide_at_looks
from pfbench.stats.rank_tests import holm
from pfbench.stats.study_runs import arrange_runs, compare_filters, compute_losses


def pair(d: np.ndarray) -> tuple[tuple[str, np.ndarray], tuple[str, np.ndarray]]:
    return ("a", d), ("b", np.zeros(len(d)))


@pytest.mark.parametrize("n", [10, 23, 50, 80])
def test_p_values_and_intervals_are_those_of_scipy(n: int) -> None:
    rng = np.random.default_rng(n)
    d = rng.standard_t(3, n) * 0.3 - 0.1
    effect = compare(*pair(d))
    assert effect.p == pytest.approx(stats.wilcoxon(d).pvalue, rel=1e-9 if n <= 50 else 2e-2)
    i, j = np.triu_indices(n)
    assert effect.location == np.median((d[i] + d[j]) / 2)
    for shift in (-effect.location - 1e-9, -effect.location + 1e-9, 0.0):
        moved_effect = effect._replace(differences=d + shift)
        assert moved_effect.is_smaller == (moved_effect.location < 0)
    _, low, high = effect.estimate(0.05)
    for end, side in ((low, -1), (high, 1)):  # inversion of the test: just inside and just outside
        inside, outside = (stats.wilcoxon(d - end + s * 1e-9).pvalue for s in (side, -side))
        assert min(inside, outside) < 0.05 < max(inside, outside) or n > 50
    yuen = stats.ttest_ind(
        d, np.zeros(n), equal_var=False, trim=0.2
    )  # all of its error is that of d
    assert effect.p_trimmed == pytest.approx(yuen.pvalue, rel=1e-6)


def test_a_lost_run_is_worse_than_every_kept_one_and_two_tie() -> None:
    """No number stands for it: any error larger than all others gives the same tests, ratio and finite ends."""
    rng = np.random.default_rng(8)
    a, b = rng.normal(-0.3, 0.2, 40), rng.normal(0.0, 0.2, 40)
    a[1], b[1:5] = math.inf, math.inf
    effect = compare(("a", a), ("b", b))
    assert effect.lost[:3] == (0, 3, 1)
    assert effect.differences[1] == 0.0
    for number in (30.0, 600.0):
        other = compare(("a", np.minimum(a, number)), ("b", np.minimum(b, number)))
        assert effect.p_sign == other.p_sign
        assert effect.p == pytest.approx(other.p, rel=0.2)  # lost runs tie, numbers do not
        assert effect.location == other.location
        wide, same = effect.estimate(1e-7), other.estimate(1e-7)
        assert [x if math.isfinite(x) else None for x in wide] == [
            x if abs(x) < 10 else None for x in same
        ]
    assert effect.estimate(1e-7)[1] == -math.inf
    assert np.isfinite(effect.estimate(0.05)).all()


def test_beyond_a_fifth_of_lost_pairs_there_is_no_ratio_but_a_word() -> None:
    rng = np.random.default_rng(9)
    a, b = rng.normal(0, 0.2, 20), rng.normal(0, 0.2, 20)
    b[:4] = math.inf
    fifth, (more,) = decide([compare(("a", a), ("b", b))])[0], decide([compare(("a", a), ("b", np.where(np.arange(20) < 5, math.inf, b)))])  # fmt: skip
    assert fifth.ratio > 0
    assert math.isnan(more.ratio)
    assert more.reason == "a loses 0 and b 5 of 20 runs"
    (most,) = decide([compare(("a", a), ("b", np.where(np.arange(20) < 18, math.inf, b)))])
    assert (most.word, most.lost) == ("better", (0, 18, 0, "loses fewer"))
    (every,) = decide([compare(("a", np.full(20, math.inf)), ("b", np.full(20, math.inf)))])
    assert (every.word, every.reason) == (NO_DECISION, "both lose track in all 20 runs")


@pytest.mark.parametrize(("n", "lost", "word"), [(28, 0, EQUAL_WORD), (28, 1, EQUAL_KEPT), (70, 2, EQUAL_WORD), (70, 4, EQUAL_KEPT)])  # fmt: skip
def test_equal_needs_a_bound_on_the_runs_that_one_loses_alone(n: int, lost: int, word: str) -> None:
    """Where a run is lost: the bound of Clopper and Pearson is below 0.1; 4 of 70 may be 13 %."""
    rng = np.random.default_rng(10)
    b = rng.normal(size=n)
    a = b + 0.002 * rng.normal(size=n)
    a[:lost] = math.inf
    bound = stats.binomtest(lost, n).proportion_ci(0.9, "exact").high
    assert (bound < 0.1 or not lost) == (word == EQUAL_WORD)
    assert decide([compare(("a", a), ("b", b))])[0].word == word


def test_a_filter_that_loses_more_runs_has_a_word_for_it() -> None:
    """McNemar's exact test with Holm's correction; the word on errors is another one."""
    rng = np.random.default_rng(11)
    b = rng.normal(size=100)
    a = b - 0.2 + 0.05 * rng.normal(size=100)
    a[:12], b[98:] = math.inf, math.inf
    found = decide([compare(("a", a), ("b", b)), compare(("b", b), ("a", a))])
    assert (found[0].word, found[0].lost.word) == ("better", "loses more")
    p = stats.binomtest(12, 14).pvalue
    assert found[0].evidence.p_lost == pytest.approx(2 * p)
    assert found[1].lost == (2, 12, 0, "loses fewer")
    turned = flip(found[0])
    assert (turned.a, turned.word, turned.lost) == ("b", "worse", found[1].lost)
    assert turned[3:6] == pytest.approx(found[1][3:6])
    assert turned.evidence == pytest.approx(found[1].evidence)


def test_better_needs_the_sign_test_and_says_where_the_mean_error_is_larger() -> None:
    """Half of the runs smaller: the other two tests reject far too often."""
    rng = np.random.default_rng(12)
    d = np.exp(rng.normal(size=(400, 200))) - 1.0  # of median 0
    verdicts = [decide([compare(*pair(row))])[0] for row in d]
    words = [v.word in ("better", WORSE_THAN) for v in verdicts]
    others = [v.p < 0.05 and v.evidence.p_trimmed < 0.05 for v in verdicts]
    error = math.sqrt(0.05 * 0.95 / 400)
    assert np.mean(words) <= 0.05 + 2.5 * error
    assert np.mean(others) > 0.1
    a = np.where(np.arange(40) < 36, -0.5, 5.0) + 0.01 * rng.normal(size=40)
    (better,) = decide([compare(*pair(a))])
    assert (better.word, better.reason) == ("better", "the mean error of a over the kept runs is larger than that of b")  # fmt: skip


def test_better_needs_the_trimmed_mean() -> None:
    """Ranks and signs agree, and the middle of the runs does not differ from zero."""
    d = np.repeat([-10.0, -0.01, 4.0], [35, 35, 30])
    (verdict,) = decide([compare(*pair(d))])
    assert max(stats.wilcoxon(d).pvalue, stats.binomtest(30, 100).pvalue) < 0.001
    middle = np.sort(d)[20:80]
    error = np.clip(d, middle[0], middle[-1]).std(ddof=1) / (0.6 * 10)  # Tukey and McLaughlin
    assert abs(middle.mean() / error) < stats.t.ppf(0.975, 59)
    assert (verdict.word, verdict.reason) == (NO_DECISION, "the trimmed mean does not agree")


def test_words_of_clear_cases() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=60)
    half, same = x + 0.1 * rng.normal(size=60) - 0.7, x + 0.004 * rng.normal(size=60)
    names = {"x": x, "half": half, "same": same, "twin": x}
    pairs = [("half", "x"), ("x", "half"), ("same", "x"), ("twin", "x")]
    verdicts = decide(compare_all([((a, names[a]), (b, names[b])) for a, b in pairs]))
    assert [v.word for v in verdicts] == ["better", "worse", EQUAL_WORD, SAME_RUNS]
    assert verdicts[0].ratio == pytest.approx(0.5, abs=0.02)
    assert verdicts[0].low < verdicts[0].ratio < verdicts[0].high < 1
    few = decide([compare(("a", half[:9]), ("b", x[:9]))])[0]
    assert (few.word, few.reason) == (NO_DECISION, "9 runs, 10 are required")
    constant = decide([compare(("a", x - 1), ("b", x))])[0]
    assert (constant.word, constant.reason) == (NO_DECISION, "no variation")
    assert decide([compare(("a", x[:0]), ("b", x[:0]))])[0].reason == "no common runs"
    assert decide([]) == []
    with pytest.raises(ValueError, match="a and b must have losses of the same runs"):
        compare(("a", x), ("b", x[:3]))


def test_a_verdict_depends_on_other_pairs_by_the_size_of_the_family_only() -> None:
    rng = np.random.default_rng(3)
    effects = [compare(*pair(rng.normal(-0.2, 0.3, 40))) for _ in range(5)]
    alone, more = decide(effects[:1])[0], decide(effects)[0]
    assert (alone.ratio, alone.n) == (more.ratio, more.n)
    assert more.low < alone.low < alone.high < more.high
    assert [v.p for v in decide(effects)] == pytest.approx(holm([e.p for e in effects]))


def test_the_first_filter_beats_all_others_only_if_it_beats_each() -> None:
    rng = np.random.default_rng(5)
    best = rng.normal(size=50)
    worse = [best + rng.normal(0.5, 0.3, 50) for _ in range(3)]
    pairs = [(best, other) for other in worse]
    assert find_largest_p(pairs) < 1e-4
    assert find_largest_p([*pairs, (best, best + rng.normal(0, 0.3, 50))]) > 0.01
    assert find_largest_p([]) == find_largest_p([(best, best)]) == 1.0
    fewer = (
        best[:20],
        worse[0][:20],
    )  # a baseline with fewer runs does not take those of the others
    assert find_largest_p([*pairs, fewer]) == max(find_largest_p(pairs), find_largest_p([fewer]))
    # outliers that are trimmed, but ranked
    outliers = np.hstack([rng.normal(-0.7, 0.5, (3, 26)), np.full((3, 4), 5.0)])
    signed = max(stats.wilcoxon(d, alternative="less").pvalue for d in outliers)
    assert find_largest_p([(d, 0 * d) for d in outliers]) == pytest.approx(signed)


def test_filters_that_differ_by_the_margin_are_called_equal_at_the_level() -> None:
    studies, rng = 300, np.random.default_rng(7)
    d = EQUALITY_MARGIN + 0.03 * rng.standard_t(3, (studies, 100))
    words = [decide([compare(*pair(row))])[0].word for row in d]
    assert words.count(EQUAL_WORD) / studies <= 0.05 + 2.5 * math.sqrt(0.05 * 0.95 / studies)
    assert decide([compare(*pair(rng.normal(0, 0.1, 300)))])[0].word == EQUAL_WORD  # and it can


def test_signed_ranks_of_all_pairs_are_antisymmetric() -> None:
    rng = np.random.default_rng(6)
    losses = {name: rng.normal(size=30) for name in "abc"}
    for a, b in itertools.combinations(losses, 2):
        one = compare((a, losses[a]), (b, losses[b]))
        other = compare((b, losses[b]), (a, losses[a]))
        assert (one.p, one.p_trimmed) == pytest.approx((other.p, other.p_trimmed))
        value, low, high = other.estimate(0.1)
        assert one.estimate(0.1) == pytest.approx((-value, -high, -low))


# interval of a mean over two crossed samples, against scipy and by its coverage


def test_one_row_has_the_interval_of_student() -> None:
    values = np.random.default_rng(1).normal(2.0, 3.0, (1, 12))
    mean, half = crossed_mean_interval(values, 0.9)
    low, high = stats.t.interval(0.9, 11, values.mean(), stats.sem(values[0]))
    assert (mean - half, mean + half) == pytest.approx((low, high))
    assert crossed_mean_interval(np.full((3, 4), 2.0)) == (2.0, 0.0)


def test_the_interval_covers_the_mean_of_both_populations() -> None:
    """Rows alone, as in an interval over columns that forgets the rows, cover far too rarely."""
    rng, studies, rows, columns = np.random.default_rng(2), 2000, 4, 30
    inside, forgets = 0, 0
    for _ in range(studies):
        values = rng.normal(0, 1, (rows, 1)) + rng.normal(0, 1, (1, columns)) + rng.normal(0, 0.3, (rows, columns))  # fmt: skip
        mean, half = crossed_mean_interval(values)
        inside += abs(mean) < half
        forgets += abs(mean) < crossed_mean_interval(values.mean(0, keepdims=True))[1]
    assert inside / studies == pytest.approx(0.95, abs=4 * (0.95 * 0.05 / studies) ** 0.5 + 0.01)
    assert forgets / studies < 0.8


def page_verdict(table: pd.DataFrame) -> tuple[str, float]:
    blank = dict.fromkeys(("coverage_90", "nees_ratio", "ms"), 1.0)
    runs = arrange_runs(table.assign(**blank), ("A", "B"))
    court = Court(runs, [("A", "B")])
    view = View(court, np.ones(1, dtype=bool), "rmse", "m", describe_filters(runs), [{}], True)
    row = next(row for row in build_rows(view, "B") if row["filter"] == "A")
    return row["words"].partition(" within")[0].partition(", ")[0], row["ratio"]


@pytest.mark.parametrize("effect", [-0.6, -0.2, -0.05, 0.0, 0.02, 0.3])
@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_all_callers_agree(effect: float, lost: float) -> None:
    table = make_study({"A": effect, "B": 0.0}, 1, 1, 40, lost={"A": lost, "B": 0.05}, seed=4)
    runs = arrange_runs(table, ("A", "B"))
    losses = compute_losses(runs, "rmse")
    (pair,) = decide(compare_filters(runs, losses, [("A", "B")]))
    (direct,) = decide([compare(("A", losses[0, 0]), ("B", losses[1, 0]))])
    facts, part = WorldFacts("B", None), PartName(table["scenario"].iloc[0], "", "")
    world = build_world(
        part, facts, Court(runs, [("A", "B")]), table["regime"].iloc[0], {"A": "A", "B": "B"}
    )
    (cell,) = decide_cells([world], ["A"])
    method = world.find("A", "B")
    (state,) = decide_at_looks(runs, [("A", "B")], LookSchedule(40))
    (single,) = decide_at_looks(runs, [("A", "B")], LookSchedule(20))
    word, ratio = page_verdict(table)
    assert {direct.word, pair.word, cell.verdict.word, method.word, word} == {pair.word}
    for value in (direct.ratio, cell.verdict.ratio, method.ratio, ratio):
        assert value == pytest.approx(pair.ratio)
    opposite = {"better": "worse", "worse": "better"}
    for looks in (state.word, single.word):  # their levels are smaller
        assert looks != opposite.get(pair.word)
