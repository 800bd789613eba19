"""Decisions of a report: planned pairs, their words, and what happens without enough data."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic

from pfbench.config.paper_files import plan_installed_pairs
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import page
from pfbench.report.decision_section import write_decisions
from pfbench.report.options import ReportContext, ReportOptions
from pfbench.report.plots.decision_plots import plot_planned_pairs
from pfbench.report.plots.plotting import line_styles
from pfbench.results import frame, store
from pfbench.results.decisions.planned_pairs import decide_planned_pairs
from pfbench.results.decisions.tidy_table import tidy_runs

EFFECTS = {"sir": 0.4, "rpf": 0.2, "mcmc_rpf": 0.0}
PAIRS = [("mcmc_rpf", "sir"), ("mcmc_rpf", "rpf")]
QUICK = ReportOptions(figure_formats=("svg",), groups=("position",), show_all=False)


def rows(
    effects: dict[str, float] | None = None,
    worlds: tuple[str, ...] = ("flight",),
    regimes: tuple[str, ...] = ("nominal",),
    runs: int = 20,
) -> pd.DataFrame:
    """Errors of filters by their log effects; the noise of a filter depends on its name alone."""
    parts = []
    for (world, noise), (label, effect) in product(
        product(worlds, regimes), (effects or EFFECTS).items()
    ):
        rng = np.random.default_rng([*world.encode(), *noise.encode(), *label.encode()])
        parts.append(pd.DataFrame({
            "scenario": world, "family": world, "noise": noise, "model": "m", "label": label, "seed": 1,
            "run": np.arange(runs), "lost": False, "keeps_track": True, "group": "position",
            "component": "norm", "unit": "m", "metric": "rmse",
            "value": np.exp(effect + 0.1 * rng.standard_normal(runs)),
        }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def decide(table: pd.DataFrame, path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Write the section; return its variables and the records of decisions.json."""
    labels = sorted(set(table.label))
    with RecordedFolder(path) as folder:
        context = ReportContext(["position"], line_styles(labels), folder, QUICK, False)
        made = write_decisions(table, "position", context, "Budget.")
    return made, json.loads((path / "decisions.json").read_text())


def main_rows(table: pd.DataFrame) -> pd.DataFrame:
    return table[(table.group == "position") & (table.component == "norm")]


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


def test_planned_pairs_of_a_study() -> None:
    assert plan_installed_pairs(sorted(EFFECTS)) == PAIRS
    assert plan_installed_pairs(["ckf", "ukf"]) == [("ckf", "ukf")]
    many = [f"filter_{k}" for k in range(6)]
    assert plan_installed_pairs([*many, "ekf", "sir"]) == [
        (label, "ekf") for label in [*many, "sir"]
    ]
    assert plan_installed_pairs([*many, "sir"]) == [(label, "sir") for label in many]
    assert plan_installed_pairs(many) == []


@pytest.mark.parametrize("worlds", [("flight",), ("drive", "flight", "walk")])
def test_planned_pairs_of_one_and_many_conditions_are_printed(
    worlds: tuple[str, ...], tmp_path: Path
) -> None:
    regimes = ("nominal", "outliers") if len(worlds) > 1 else ("nominal",)
    made, _ = decide(rows(worlds=worlds, regimes=regimes), tmp_path)
    planned = made["planned"]
    for question, metric in product(
        ("in these worlds", "in a new world"), ("keeps track", "position error")
    ):
        part = planned[(planned.question == question) & (planned.metric == metric)]
        assert list(zip(part.a, part.b, strict=True)) == PAIRS
        assert set(part.worlds) == {len(worlds)}
    errors = planned[planned.metric == "position error"].set_index(["question", "a", "b"])
    for pair in PAIRS:
        assert errors.loc[("in these worlds", *pair), "decision on the pair"] == "better"
        new = errors.loc[("in a new world", *pair), "decision on the pair"]
        assert (new == "not tested") == (len(worlds) == 1)
    assert made["sentences"][0].startswith("2 planned pairs: 2 decided in these worlds")
    none = "One world: this study supports no statement about another world."
    assert (none in made["sentences"]) == (len(worlds) == 1)


def test_another_filter_changes_neither_p_nor_interval_of_a_pair(tmp_path: Path) -> None:
    worlds = ("drive", "flight", "walk")
    more = {"gpf": 0.0, "qmc_polymerised": -3.0, **EFFECTS}
    few, many = (
        decide(rows(effects, worlds), tmp_path / str(len(effects)))[1]
        for effects in (EFFECTS, more)
    )
    key = ("question", "a", "b", "metric", "family")
    other = {tuple(r[name] for name in key): r for r in many}
    planned = [r for r in few if r["family"].startswith("planned")]
    assert len(planned) == 8
    for record in planned:
        same = other[tuple(record[name] for name in key)]
        for name in ("p", "plain_low", "plain_high", "estimate"):
            assert same[name] == record[name]
    assert {r["family_size"] for r in planned if r["question"] == "a"} == {2}
    sizes = {r["family_size"] for r in many if r["question"] == "a" and r["a"] == "mcmc_rpf"}
    assert min(sizes) > 2


def test_a_filter_that_gives_up_in_its_worst_runs_is_not_better(tmp_path: Path) -> None:
    """Without the runs that it lost, the filter would be called better."""
    table = rows({"rpf": 0.0, "sir": 0.0}, runs=60)
    value = table.set_index(["label", "run"])["value"]
    ratio = value["rpf"] / value["sir"]
    worst = ratio.index[ratio >= ratio.quantile(0.8)]
    gives_up = (table.label == "rpf") & table.run.isin(worst)
    assert gives_up.sum() == 12
    left_out, _ = decide(table[~table.run.isin(worst)], tmp_path / "left_out")
    assert left_out["planned"]["decision on the pair"].iloc[0] == "better"
    lost = table.assign(
        value=table.value.where(~gives_up, np.inf), lost=gives_up, keeps_track=~gives_up
    )
    made, records = decide(lost, tmp_path / "lost")
    assert "better" not in set(made["planned"]["decision on the pair"])
    assert "better" not in {r["word"] for r in records if r["a"] == "rpf"}
    assert made["ranks"].set_index("filter").loc["rpf", "track kept [%]"] == pytest.approx(80)


def test_track_is_kept_below_the_divergence_threshold_of_the_scenario(tmp_path: Path) -> None:
    for name, size in (("ekf", 1.0), ("sir", 1000.0)):
        for scenario, paper in (("free", {}), ("bounded", {"divergence_threshold": 500.0})):
            write_scenario(tmp_path / scenario, name, size, scenario, paper)
    shares = {}
    for scenario in ("free", "bounded"):
        made, _ = decide(
            main_rows(frame.load_frame(scenario, tmp_path)), tmp_path / f"out_{scenario}"
        )
        shares[scenario] = made["ranks"].set_index("filter")["track kept [%]"].to_dict()
        if scenario == "bounded":
            row = made["planned"].iloc[0]
            assert (row["track kept a [%]"], row["track kept b [%]"]) == (100, 0)
            assert (row["metric"], row["decision on the metric"]) == ("keeps track", "better")
    assert shares == {"free": {"ekf": 100, "sir": 100}, "bounded": {"ekf": 100, "sir": 0}}


@pytest.mark.parametrize(("family", "worlds"), [({"family": "orbit"}, 1), ({}, 2)])
def test_scenarios_of_one_family_are_one_world(
    family: dict[str, Any], worlds: int, tmp_path: Path
) -> None:
    for scenario, name in product(("short", "long"), ("ekf", "sir")):
        write_scenario(tmp_path / "demo", name, 1.0, scenario, family)
    made, records = decide(main_rows(frame.load_frame("demo", tmp_path)), tmp_path / "out")
    assert {r["worlds"] for r in records} == {worlds}
    new = made["planned"].query("question == 'in a new world' and metric == 'position error'")
    assert (new["decision on the pair"].item() == "not tested") == (worlds == 1)


def test_without_some_conditions_pairs_are_decided_and_complete_filters_are_ranked(
    tmp_path: Path,
) -> None:
    table = rows(worlds=("drive", "flight"))
    partial = table[(table.label != "sir") | (table.scenario != "drive")]
    made, _ = decide(partial, tmp_path / "partial")
    assert list(made["ranks"]["filter"]) == ["mcmc_rpf", "rpf"]
    assert (
        made["sentences"][-1] == "Order of the 2 filters that have all 2 conditions. Without sir."
    )
    errors = made["planned"].query("question == 'in these worlds' and metric == 'position error'")
    assert dict(zip(errors.b, errors.worlds, strict=True)) == {"sir": 1, "rpf": 2}
    complete, _ = decide(table, tmp_path / "complete")
    assert list(complete["ranks"]["filter"]) == ["mcmc_rpf", "rpf", "sir"]
    assert any("Rank of mcmc_rpf" in sentence for sentence in complete["sentences"])
    assert not any("Order of" in sentence for sentence in complete["sentences"])


def test_the_order_of_rows_does_not_change_a_byte(tmp_path: Path) -> None:
    table = rows(worlds=("drive", "flight"), regimes=("nominal", "outliers"))
    contents = []
    for name, rows_ in (("first", table), ("second", table.sample(frac=1, random_state=3))):
        decide(rows_, tmp_path / name)
        contents.append((tmp_path / name / "decisions.json").read_bytes())
    assert contents[0] == contents[1]


def test_decisions_json_has_each_number_of_the_table(tmp_path: Path) -> None:
    made, records = decide(rows(worlds=("drive", "flight")), tmp_path)
    planned = [r for r in records if r["family"].startswith("planned")]
    assert len(planned) == len(made["planned"]) == 8
    for row, record in zip(made["planned"].to_dict("records"), planned, strict=True):
        assert [row[name] for name in ("a", "b", "metric", "worlds")] == [
            record[name] for name in ("a", "b", "metric", "worlds")
        ]
        assert row["decision on the pair"] == record["pair_word"]
        assert row["decision on the metric"] == record["word"]
        for column, name, factor in (
            ("level of the interval [%]", "level", 100), ("adjusted p (Holm)", "p_corrected", 1),
            ("runs per condition", "runs", 1), ("track kept a [%]", "share_a", 100),
        ):  # fmt: skip
            assert row[column] == pytest.approx(factor * float(record[name]), nan_ok=True)
        for column, name in (("effect of a vs b", "estimate"), ("lower", "low"), ("upper", "high")):
            log = float(record[name])
            if record["scale"] == "share":
                assert row[column] == f"{0.0 - 100 * log:+.1f} points"
            elif abs(log) > np.log(10):
                assert row[column] == f"factor {np.exp(log):.3g}"
            else:
                assert float(row[column].removesuffix(" %")) == pytest.approx(
                    100 * np.expm1(log), abs=0.051
                )


def test_the_figure_shows_no_interval_of_one_world() -> None:
    figures = [
        plot_planned_pairs(
            [
                d
                for d in decide_planned_pairs(tidy_runs(rows(worlds=w)), PAIRS)
                if d.metric == "error"
            ],
            0.05,
        )
        for w in (("flight",), ("drive", "flight", "walk"))
    ]
    one, many = ([len(line.get_xdata()) for line in figure.axes[0].lines] for figure in figures)
    assert one.count(1) == 2  # two pairs, question (a) only
    assert many.count(1) == 4


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
    made = page.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    records = json.loads((made.parent / "decisions.json").read_text())
    words = {r["word"] for r in records}
    assert not words & {"better", "worse"}
    text = (made.parent / "details.md").read_text()
    sentence = {
        "one run": "ekf and ukf are not tested",
        "all lost": "ekf 12 of 12",
        "identical": "ekf and ukf give identical results",
    }[case]
    assert sentence in text or sentence.replace("ekf", "ekf lost") in text
    assert "1 planned pair: 0 decided in these worlds, 0 in a new world." in text
