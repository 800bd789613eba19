"""Orders of filters that lack conditions, and the one word of a pair."""

from __future__ import annotations

import pandas as pd
from decision_cases import make_study

from pfbench.stats.filter_sets import order_filters
from pfbench.stats.main_metrics import select_common_runs
from pfbench.stats.planned_pairs import decide_planned_pairs

FILTERS = {"A": 0.0, "B": 0.0, "C": 0.0, "D": 0.0}


def drop(table: pd.DataFrame, label: str, scenario: str, regime: str) -> pd.DataFrame:
    mask = (table["filter"] == label) & (table.scenario == scenario) & (table.regime == regime)
    return table[~mask]


def test_the_order_keeps_as_many_results_as_possible() -> None:
    table = make_study(FILTERS, worlds=3, regimes=2, runs=3)
    assert len(select_common_runs(table)) == len(table)
    # one missing result of 24: 4 filters in 5 conditions rather than 3 filters in 6
    common = select_common_runs(drop(table, "A", "scenario_0", "regime_1"))
    assert len(common) == 4 * 5 * 3
    # D has one condition alone: 3 filters in 6 conditions rather than 4 filters in 1
    only = table[(table["filter"] != "D") | (table.scenario + table.regime == "scenario_0regime_0")]
    common = select_common_runs(only)
    assert set(common["filter"]) == {"A", "B", "C"}
    assert len(common) == 3 * 6 * 3
    separate = table[
        ((table["filter"] == "A") & (table.scenario == "scenario_0"))
        | ((table["filter"] == "B") & (table.scenario == "scenario_1"))
    ]
    assert len(select_common_runs(separate)) == 0
    assert len(select_common_runs(table[table["filter"] == "A"])) == 0


def test_the_planned_word_of_a_pair_is_its_only_word() -> None:
    """An effect that the family of one pair shows and that of all pairs does not."""
    filters = {"A": -0.12, "B": 0.0, **{f"filter_{k}": 0.0 for k in range(10)}}
    table = make_study(filters, worlds=1, regimes=1, runs=30, world_sd=0.0, run_sd=0.15, seed=2)
    planned = decide_planned_pairs(table, [("B", "A")])
    words = {d.question: d.word for d in planned if d.metric == "error"}
    alone, _ = order_filters(table)
    (record,) = (d for d in alone.decisions if {d.a, d.b} == {"A", "B"})
    assert (words["a"], record.word) == ("worse", "inconclusive")  # the control: two words
    joint, new = order_filters(table, planned=planned)
    for order, question in ((joint, "a"), (new, "b")):
        (record,) = (d for d in order.decisions if {d.a, d.b} == {"A", "B"})
        assert record.word == words[question]
        assert len(order.decisions) == len(alone.decisions)
    assert joint.ranks["A"][1] == alone.ranks["A"][1] - 1
    assert joint.ranks["B"][0] == alone.ranks["B"][0] + 1
    assert "B" not in joint.top_group
