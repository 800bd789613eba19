"""Verdicts of a report from results: all pairs, worlds, thresholds, and what happens without enough data."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic

from pfbench.report import read_stored_study, study_report
from pfbench.results import store
from pfbench.results.paper_block import plan_installed_pairs
from pfbench.stats.study_runs import arrange_runs, compare_filters, compute_losses

PAIRS = [("mcmc_rpf", "sir"), ("mcmc_rpf", "rpf")]


def write_scenario(
    folder: Path, name: str, size: float, scenario: str, paper: dict[str, Any], runs: int = 12
) -> None:
    """Write a result of a scenario that states these values under `paper`."""
    path = synthetic.write(
        folder, synthetic.Method(name, size), runs=runs, steps=6, config={"world": scenario}
    )
    meta, arrays = store.read_result(path)
    meta["choices"]["scenario"] = scenario
    meta["config"]["scenario"] = {"paper": paper}
    store.write_result(path, meta, arrays)


def report(folder: Path, study: str) -> Path:
    return study_report.write_report(study, folder, folder / "reports").parent


def test_planned_pairs_of_a_study() -> None:
    assert plan_installed_pairs(["mcmc_rpf", "rpf", "sir"]) == PAIRS
    assert plan_installed_pairs(["ckf", "ukf"]) == [("ckf", "ukf")]
    many = [f"filter_{k}" for k in range(6)]
    assert plan_installed_pairs([*many, "ekf", "sir"]) == [
        (label, "ekf") for label in [*many, "sir"]
    ]
    assert plan_installed_pairs([*many, "sir"]) == [(label, "sir") for label in many]
    assert plan_installed_pairs(many) == []


def test_a_filter_that_gives_up_in_its_worst_runs_is_not_better(tmp_path: Path) -> None:
    """Without the runs that it lost, the filter would be called better."""
    rng = np.random.default_rng(2)
    log = rng.normal(0, 0.3, (2, 60))
    worst = np.argsort(log[0] - log[1])[-12:]
    table = pd.DataFrame({
        "filter": np.repeat(["rpf", "sir"], 60), "scenario": "s", "family": "s", "regime": "r", "seed": 1,
        "run": np.tile(np.arange(60), 2), "rmse": np.exp(log.ravel()), "keeps_track": True,
    })  # fmt: skip
    off = table["filter"].eq("rpf") & table["run"].isin(worst)
    words = []
    for data in (table[~table["run"].isin(worst)], table.assign(keeps_track=~off)):
        runs = arrange_runs(data, ("rpf", "sir"))
        (effect,) = compare_filters(runs, compute_losses(runs, "rmse"), [("rpf", "sir")])
        words.append(effect.p < 0.05 and effect.location < 0)
    assert words == [True, False]


def test_a_limit_of_the_scenario_says_which_runs_are_lost(tmp_path: Path) -> None:
    """With the limit all runs of the bad filter are lost, and there is no ratio; without one it is that of the errors."""
    ratio = {}
    for scenario, paper in (("free", {}), ("bounded", {"divergence_threshold": 500.0})):
        for name, size in (("ekf", 1.0), ("sir", 1000.0)):
            write_scenario(tmp_path / scenario, name, size, scenario, paper)
        rows = pd.read_csv(report(tmp_path, scenario) / "verdicts.csv")
        row = rows.query("filter == 'sir' and baseline == 'ekf' and metric == 'rmse'").iloc[0]
        ratio[scenario] = row["ratio"]
        assert row["verdict"] == ("worse" if scenario == "free" else "loses track")
    assert ratio["free"] > 300
    assert np.isnan(ratio["bounded"])


@pytest.mark.parametrize(("family", "worlds"), [({"family": "orbit"}, 1), ({}, 2)])
def test_scenarios_of_one_family_are_one_world(
    family: dict[str, Any], worlds: int, tmp_path: Path
) -> None:
    for scenario, name in product(("short", "long"), ("ekf", "sir")):
        write_scenario(tmp_path / "demo", name, 1.0, scenario, family)
    folder = report(tmp_path, "demo")
    text = "2 scenarios of 1 world" if worlds == 1 else "2 scenarios,"
    assert text in next(iter(read_stored_study(folder).pack["views"].values()))["small_print"]


def test_pairs_are_decided_where_the_page_compares(tmp_path: Path) -> None:
    """A filter that lacks a condition takes it from all pairs, as on the page, whose words are those of the table."""
    words = []
    for study, missing in (("whole", ()), ("part", ("short",))):
        for scenario, (k, name) in product(("short", "long"), enumerate(("ekf", "sir", "ukf"))):
            if name != "ukf" or scenario not in missing:
                write_scenario(tmp_path / study, name, 1.0 + 0.2 * k, scenario, {})
        words.append(pd.read_csv(report(tmp_path, study) / "decisions.csv").set_index(["a", "b"]))
    tables = [table[table["world"] == "all"] for table in words]
    views = [pd.read_csv(tmp_path / "reports" / s / "verdicts.csv") for s in ("whole", "part")]
    for table, view in zip(tables, views, strict=True):
        rows = view[
            (view["world"] == "all") & (view["regime"] == "all") & (view["metric"] == "rmse")
        ]
        row = rows[(rows["filter"] == "sir") & (rows["baseline"] == "ekf")].iloc[0]
        assert 1 / table.loc[("ekf", "sir"), "ratio"] == pytest.approx(row["ratio"], rel=1e-3)
    assert tables[0].loc[("ekf", "ukf"), "ratio"] != tables[1].loc[("ekf", "ukf"), "ratio"]
    assert set(words[1]["n"]) == {12}


@pytest.mark.parametrize("case", ["one run", "all lost", "identical"])
def test_a_page_without_enough_data_states_why(case: str, tmp_path: Path) -> None:
    runs = 1 if case == "one run" else 12
    lost = tuple(range(runs)) if case == "all lost" else ()
    first: dict[str, np.ndarray] = {}
    for name in ("ekf", "ukf"):
        path = synthetic.write(
            tmp_path / "demo", synthetic.Method(name, 1.0, lost=lost), runs=runs, steps=6
        )
        meta, arrays = store.read_result(path)
        if case == "identical":
            first = first or arrays
            store.write_result(path, meta, first)
    folder = report(tmp_path, "demo")
    words = set(pd.read_csv(folder / "decisions.csv")["word"])
    text = (folder / "report.md").read_text()
    assert words == {"identical" if case == "identical" else "not decided"}
    shown = {"one run": "not decided, 1 run, 10 are required", "all lost": "loses runs in 100 % of runs", "identical": "identical, all runs agree"}  # fmt: skip
    assert shown[case] in text
    assert "nan" not in text.replace("provenance", "")
