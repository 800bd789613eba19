"""Losses of filters in the conditions of a study: lost runs, weights, units, and error rates of verdicts."""

import math

import numpy as np
import pandas as pd
import pytest
from decision_cases import make_study
from row_oracle import arrange, decide_family, estimate, pair_losses, subtract
from scipy.signal import lfilter

from pfbench.stats.comparison import decide
from pfbench.stats.run_dependence import (
    ALARM_LEVEL,
    describe_copies,
    describe_dependence,
    drop_runs,
    find_copied_runs,
    lag_p_values,
)
from pfbench.stats.study_runs import (
    StudyRuns,
    arrange_runs,
    compare_filters,
    compute_losses,
    select_conditions,
    weigh_conditions,
)

EFFECTS = {"A": -0.4, "B": 0.0, "C": 0.05}
PAIRS = [("A", "B"), ("A", "C"), ("B", "C")]


def decide_pairs(runs: StudyRuns, metric: str = "rmse", unit: str = "run") -> list[tuple]:
    effects = compare_filters(runs, compute_losses(runs, metric), PAIRS, unit)
    return list(map(tuple, decide(effects)))


@pytest.mark.parametrize("lost", [0.0, 0.08])
def test_verdicts_are_those_of_the_independent_computation(lost: float) -> None:
    table = make_study(EFFECTS, worlds=3, regimes=2, runs=25, lost={"B": lost, "C": lost / 2})
    table = table[~((table["filter"] == "A") & (table["run"] == 7) & (table.regime == "regime_1"))]
    runs, wide = arrange_runs(table, tuple(EFFECTS)), arrange(table, "rmse")
    family = [pair_losses(wide, pair) for pair in PAIRS]
    assert [losses.shape[1] for losses in family] == [24, 24, 25]
    effects = compare_filters(runs, compute_losses(runs, "rmse"), PAIRS)
    for effect, losses in zip(effects, family, strict=True):
        np.testing.assert_allclose(effect.differences, subtract(losses), atol=1e-12)
    for verdict, wanted in zip(decide(effects), decide_family(family, math.log(1.05), 0.05), strict=True):  # fmt: skip
        assert (verdict.word, verdict.lost.word) == (wanted["word"], wanted["loses"])
        assert math.log(verdict.ratio) == pytest.approx(wanted["ratio"], nan_ok=True)
        assert verdict.p == pytest.approx(wanted["p"], rel=1e-6)
    assert estimate(subtract(family[0]), 0.05) == pytest.approx(effects[0].estimate(0.05))


def test_the_size_of_an_error_counts_while_the_run_is_kept_and_not_once_it_is_lost() -> None:
    table = make_study(EFFECTS, worlds=2, regimes=1, runs=20, lost={"B": 0.1})
    base = decide_pairs(arrange_runs(table, tuple(EFFECTS)))
    off = ~table["keeps_track"]
    for number in (1e-3, 1e9, math.nan):
        changed = table.assign(rmse=table["rmse"].mask(off, number))
        assert decide_pairs(arrange_runs(changed, tuple(EFFECTS))) == base
    larger = table.assign(rmse=table["rmse"].mask((table["run"] == 3) & ~off, 1e9))
    assert decide_pairs(arrange_runs(larger, tuple(EFFECTS))) != base


def test_a_run_of_several_conditions_is_lost_by_the_filter_that_loses_more_of_them() -> None:
    table = make_study({"A": 0.0, "B": 0.3}, worlds=2, regimes=2, runs=12)
    off = {("A", 0): 1, ("B", 1): 1, ("A", 2): 2, ("B", 2): 1, ("A", 3): 1, ("B", 3): 1}
    order = table.groupby(["filter", "run"]).cumcount()
    lost = [off.get(key, 0) > place for *key, place in zip(table["filter"], table["run"], order, strict=True) for key in [tuple(key)]]  # fmt: skip
    runs = arrange_runs(table.assign(keeps_track=~np.array(lost)), ("A", "B"))
    (effect,) = compare_filters(runs, compute_losses(runs, "rmse"), [("A", "B")])
    assert effect.differences[:4].tolist() == [math.inf, -math.inf, math.inf, 0.0]
    assert effect.lost == (2, 1, 1, "")
    assert np.isfinite(effect.differences[4:]).all()


def test_another_filter_changes_no_number_of_a_pair() -> None:
    """It changes the size of a family alone, and the effects of a pair are the same."""
    table = make_study({**EFFECTS, "D": 3.0}, worlds=2, runs=20, lost={"D": 0.9, "B": 0.1})
    small = table[table["filter"] != "D"]
    sides = [arrange_runs(t, sorted(set(t["filter"]))) for t in (table, small)]
    first, second = (compare_filters(runs, compute_losses(runs, "rmse"), PAIRS) for runs in sides)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.differences, b.differences)
        assert (a.p, a.p_trimmed, a.lost) == (b.p, b.p_trimmed, b.lost)


def test_worlds_scenarios_and_regimes_have_equal_weight() -> None:
    conditions = pd.DataFrame({
        "family": ["a", "a", "a", "b"], "scenario": ["a1", "a1", "a2", "b1"], "regime": ["x", "y", "x", "x"],
    })  # fmt: skip
    np.testing.assert_allclose(weigh_conditions(conditions), [1 / 8, 1 / 8, 1 / 4, 1 / 2])


def test_runs_of_worlds_with_their_own_seeds_are_paired_by_their_number() -> None:
    table = make_study(EFFECTS, worlds=2, regimes=1, runs=15)
    shifted = table.assign(seed=table["seed"] + 5 * (table["scenario"] == "scenario_1"))
    first, second = (arrange_runs(t, tuple(EFFECTS)) for t in (table, shifted))
    assert decide_pairs(first) == decide_pairs(second)
    two_seeds = pd.concat([table, table.assign(seed=9, rmse=table["rmse"] * 1.1)])
    assert arrange_runs(two_seeds, tuple(EFFECTS)).present.shape == (3, 2, 30)
    with pytest.raises(ValueError, match=r"runs must be unique .* run=0 twice"):
        arrange_runs(pd.concat([table, table]), tuple(EFFECTS))


def test_worlds_as_units_need_ten_of_them() -> None:
    table = make_study(EFFECTS, worlds=12, regimes=1, runs=5, world_sd=0.02, run_sd=0.02)
    runs = arrange_runs(table, tuple(EFFECTS))
    words = [verdict[2] for verdict in decide_pairs(runs, unit="world")]
    assert words[:2] == ["better", "better"]
    few = arrange_runs(
        table[table["family"].isin([f"scenario_{k}" for k in range(9)])], tuple(EFFECTS)
    )
    verdict = decide_pairs(few, unit="world")[0]
    assert (verdict[2], verdict[-1]) == ("not decided", "9 worlds, 10 are required")


def test_a_log_score_is_better_where_it_is_larger() -> None:
    table = make_study(EFFECTS, worlds=1, regimes=1, runs=20)
    runs = arrange_runs(table.assign(log_score=-np.log(table["rmse"])), tuple(EFFECTS))
    assert decide_pairs(runs, "log_score")[0][2] == "better"


def test_the_selection_of_conditions_keeps_as_many_results_as_possible() -> None:
    present = np.ones((4, 6), dtype=bool)
    assert select_conditions(present).all()
    present[0, 1] = False  # 4 filters in 5 conditions rather than 3 filters in 6
    assert select_conditions(present).tolist() == [True, False, True, True, True, True]
    present[0] = [True, False, False, False, False, False]  # 3 in 6 rather than 4 in 1
    assert select_conditions(present).all()
    assert not select_conditions(np.eye(2, dtype=bool)).any()


@pytest.mark.parametrize("lost", [0.0, 0.02])
def test_equal_filters_are_called_different_at_the_level(lost: float) -> None:
    """Any false word in a study of three pairs: at most 5 % of 300 studies, and two standard errors."""
    studies, wrong, found, rng = 300, 0, 0, np.random.default_rng(4)
    table = make_study(dict.fromkeys("ABC", 0.0), 2, 2, 20)
    arranged = arrange_runs(table, ("A", "B", "C"))
    for study in range(studies):
        errors = np.exp(0.3 * rng.standard_normal(arranged.keeps.shape))
        keeps = rng.random(errors.shape) >= lost
        runs = arranged._replace(values={"rmse": errors}, keeps=keeps)
        wrong += any(v[2] in ("better", "worse") for v in decide_pairs(runs))
        if study % 3 == 0:
            moved = errors * np.array([1.3, 1.0, 1.0])[:, None, None]
            found += decide_pairs(runs._replace(values={"rmse": moved}))[0][2] == "worse"
    assert wrong / studies <= 0.05 + 2 * math.sqrt(0.05 * 0.95 / studies)
    assert found > 0.1 * studies  # the control, of each third study: an effect of 30 % is seen


RUN = ["run"]


def test_copies_are_found_and_left_out() -> None:
    table = make_study({"a": 0.0, "b": 0.1}, runs=20)
    assert find_copied_runs(table, "rmse", RUN) == {}
    copies = table[table.run < 5].assign(run=lambda rows: rows.run + 20)
    joined = pd.concat([table, copies])
    found = find_copied_runs(joined, "rmse", RUN)
    assert found == {k + 20: k for k in range(5)}
    assert drop_runs(joined, found, RUN).equals(table)
    assert "5 runs have the errors of another run (run 20 is equal to run 0)" in describe_copies(
        found
    )


def test_one_filter_with_copied_data_is_enough_and_one_without_random_data_is_not() -> None:
    table = make_study({"a": 0.0, "b": 0.1}, runs=12)
    values = table.set_index(["filter", "scenario", "regime", "run"]).rmse
    keys = [key for key in values.index if key[0] == "a" and key[3] == 11]
    for key in keys:
        values[key] = values[(*key[:3], 4)]
    assert find_copied_runs(values.reset_index(), "rmse", RUN) == {11: 4}
    values[keys[0]] *= 1 + 1e-12  # one digit in one condition: another run
    assert find_copied_runs(values.reset_index(), "rmse", RUN) == {}
    constant = table.assign(rmse=table.rmse.where(table["filter"] != "a", 1.0))
    assert find_copied_runs(constant, "rmse", RUN) == {}


def test_size_and_power_of_the_test_of_neighbours() -> None:
    rng = np.random.default_rng(1)
    studies = 20_000
    for runs in (10, 20, 100):
        for level in (0.05, 0.01):
            share = (lag_p_values(rng.standard_t(3, (studies, runs))) < level).mean()
            assert share < 1.15 * level + 3 * np.sqrt(level / studies)
    shares = {}
    for correlation in (0.5, 0.8):
        white = rng.normal(size=(2000, 200))
        series = lfilter([1.0], [1, -correlation], white, axis=1)[:, -50:]
        shares[correlation] = (lag_p_values(series) < ALARM_LEVEL).mean()
    assert shares[0.5] > 0.5
    assert shares[0.8] > 0.98


def test_groups_of_runs_with_a_common_error_give_an_alarm() -> None:
    table = make_study({"a": 0.0, "b": 0.1}, runs=40)
    assert describe_dependence(table, "rmse", RUN) == ""
    common = np.exp(0.6 * np.random.default_rng(2).standard_normal(10))[table.run // 4]
    text = describe_dependence(table.assign(rmse=table.rmse * common), "rmse", RUN)
    assert "the runs are not independent" in text
    assert "2 of 2 filters" in text


def test_conditions_of_different_numbers_of_runs_give_no_alarm() -> None:
    study = make_study({"a": 0.0, "b": 0.1}, runs=100)
    first, *_ = study["scenario"].unique()
    easy = study["scenario"] == first
    table = study.assign(rmse=study.rmse.where(~easy, study.rmse * 1e-3))
    table = table[~easy | (table.run < 50)]  # the later runs lack the easy scenario
    assert table["scenario"].nunique() > 1
    assert describe_dependence(table, "rmse", RUN) == ""
