"""Verdicts of a report from results: all pairs, worlds, thresholds, and what happens without enough data."""

import math
import os
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic

from pfbench.report import ReportOptions, StudyFacts, provenance, read_stored_study, study_report
from pfbench.report.board.pack import build_pack, decide_parts, read_study
from pfbench.results import store
from pfbench.results.conditions import load_conditions
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
    shown = {"one run": "not decided, 1 run, 10 are required", "all lost": "loses 100 % of runs", "identical": "identical, all runs agree"}  # fmt: skip
    assert shown[case] in text
    assert "nan" not in text.replace("provenance", "")


NOISES = ("nominal", "surge", "heavy", "outage", "jam")
METHODS = synthetic.METHODS[1:]


def study(folder: Path, turn: int = 0) -> Path:
    """The same jobs, written in another order, by other workers, at other times."""
    jobs = [(noise, method) for noise in NOISES for method in METHODS]
    for k, (noise, method) in enumerate(jobs[turn:] + jobs[:turn]):
        path = synthetic.write(folder, method, noise=noise, runs=16, steps=8)
        if turn:
            meta, arrays = store.read_result(path)
            meta |= {
                "host": f"worker {k % 5}",
                "threads": 1 + k % 3,
                "created": f"2027-01-{1 + k:02}T00:00:00+00:00",
            }
            store.write_result(path, meta, arrays)
            os.utime(path, (10**9 - k, 10**9 - k))
    return folder


Stored = tuple[dict[str, object], pd.DataFrame]


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    """Pack and runs of a study."""
    conditions = load_conditions("demo", study(tmp_path_factory.mktemp("results") / "demo").parent)
    options = ReportOptions()
    data = read_study(conditions, options)
    return build_pack("demo", conditions, options, data), data.table


def decide(stored: Stored, table: pd.DataFrame) -> pd.DataFrame:
    parts = decide_parts(table, StudyFacts.from_pack(stored[0]))
    return pd.DataFrame(parts["decisions"]).set_index(["a", "b"])


def test_the_order_of_rows_changes_no_verdict(stored: Stored) -> None:
    mixed, first = (decide(stored, table) for table in (stored[1].sample(frac=1, random_state=1), stored[1]))  # fmt: skip
    pd.testing.assert_frame_equal(mixed, first, check_exact=False, rtol=1e-9)


def test_the_numbers_of_the_runs_change_no_verdict(stored: Stored) -> None:
    """The same runs made in another order: each has another number, the same for all filters."""
    table, number = stored[1], np.random.default_rng(4).permutation(16)
    renamed = table.assign(run=number[table["run"].to_numpy()])
    first = decide(stored, table)
    pd.testing.assert_frame_equal(decide(stored, renamed), first, check_exact=False, rtol=1e-9)
    one = table["run"].where(table["filter"] != "ukf", renamed["run"])
    apart = decide(stored, table.assign(run=one))  # they are paired by it
    widths = [math.log(t.loc[("cofm_amssrcpf", "ukf"), "high"] / t.loc[("cofm_amssrcpf", "ukf"), "low"]) for t in (first, apart)]  # fmt: skip
    assert widths[1] > 1.2 * widths[0]


@pytest.mark.slow
def test_order_of_files_and_workers_change_no_verdict(tmp_path: Path) -> None:
    said = []
    for turn in (0, 7):
        folder = study(tmp_path / f"results{turn}" / "demo", turn)
        made = study_report.write_report("demo", folder.parent, tmp_path / f"reports{turn}")
        said.append([(made.parent / f"{name}.csv").read_text() for name in ("decisions", "consistency", "metrics", "verdicts")])  # fmt: skip
        assert ("worker 3" in made.read_text()) is bool(turn)
    assert said[0] == said[1]
    assert len(said[0][0].splitlines()) == 4  # all pairs of three filters


def test_a_budget_that_was_not_kept_is_not_claimed():
    def job(particles, per_step=1e-3, **config):
        return {
            "key": "k",
            "particles": particles,
            "seconds": {"per_step": per_step},
            "config": config,
        }

    def said(*jobs):
        return provenance.format_budget(jobs).removeprefix("Budget: ")

    assert said(job(100), job(None)) == "particles (100 particles in each particle filter)."
    more = job(400) | {"label": "more"}
    assert "not met by more (4 times the target) (100 to 400 part" in said(job(100), job(100), more)
    used = [{"least": low, "mean": mean, "most": 200} for low, mean in ((100, 120.0), (110, 140.0))]
    changing = [{**job(200), "label": "grows", "particles_used": one} for one in used]
    assert "grows (1.2 to 1.4 times the target)" in said(*[job(100)] * 3, *changing)
    kind = "time"
    alike = [job(100, budget=kind), job(100, 1.05e-3, budget=kind), job(9, 1.1e-3, budget=kind)]
    deterministic = job(None, 1e-5, budget=kind)  # no number of particles to keep it by
    assert said(*alike, deterministic) == f"{kind} (1 to 1.1 ms per step in each particle filter)."
    dear = job(9, 5e-3, budget=kind) | {"label": "dear"}
    assert f"{kind} not met by dear (4.7 times the target) (1 to 5 ms" in said(*alike, dear)
    priced = [{**one, "budget_allocation": {"price": 1e-3}} for one in alike]
    slow = [
        {**job(9, k * 1e-2, budget=kind), "budget_allocation": {"price": 1e-2}} for k in (1, 1.1)
    ]  # a cell where SIR takes longer
    assert "not met" not in said(*priced, *slow)
    twice = [{**dear, "budget_allocation": {"price": price}} for price in (1e-3, 2e-3)]
    assert "not met by dear (2.5 to 5 times the target)" in said(*priced, *twice)
    counted = [
        {**job(n, budget=store.BUDGETS[2]), "likelihoods_per_step": n * k}
        for n, k in ((100, 1.0), (10, 11.0))
    ]
    assert (
        said(*counted) == "likelihoods (100 to 110 likelihoods per step in each particle filter)."
    )
    assert "do not count them" in said(*counted, job(1, budget=store.BUDGETS[2]))
    assert "differs between jobs" in said(job(100), job(100, budget=kind))
    with pytest.raises(ValueError, match=r"must be one of .* got fair"):
        said(job(1, budget="fair"))
