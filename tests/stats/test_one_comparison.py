"""All callers of the one comparison say the same of the same runs: page, table of pairs, first page, and looks."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from decision_cases import make_study

from pfbench.report.board.view import View, build_rows, describe_filters
from pfbench.report.overview.tables import WorldFacts, build_world, decide_cells
from pfbench.results.looks import PartName
from pfbench.stats.comparison import compare, decide
from pfbench.stats.court import Court
from pfbench.stats.pair_states import LookSchedule, decide_at_looks
from pfbench.stats.study_runs import arrange_runs, compare_filters, compute_losses


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
