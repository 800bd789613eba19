"""Copies of runs are found, correlated runs give an alarm, and independent runs give none at the stated level."""

from __future__ import annotations

import numpy as np
import pandas as pd
from decision_cases import make_study
from scipy.signal import lfilter

from pfbench.stats.run_dependence import (
    ALARM_LEVEL,
    describe_copies,
    describe_dependence,
    drop_runs,
    find_copied_runs,
    lag_p_values,
)

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
