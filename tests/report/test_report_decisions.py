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
from pfbench.stats.decision import Decision

from pfbench.report import study_report
from pfbench.report.options import ReportOptions
from pfbench.report.study_report import decide_study
from pfbench.results import frame, store
from pfbench.results.paper_block import plan_installed_pairs

EFFECTS = {"sir": 0.4, "rpf": 0.2, "mcmc_rpf": 0.0}
PAIRS = [("mcmc_rpf", "sir"), ("mcmc_rpf", "rpf")]


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


def decide(table: pd.DataFrame) -> list[Decision]:
    return decide_study(table, "position", ReportOptions())


def planned(decisions: list[Decision], question: str, metric: str) -> list[Decision]:
    return [
        d
        for d in decisions
        if d.family.startswith("planned") and (d.question, d.metric) == (question, metric)
    ]


def ordered(decisions: list[Decision]) -> set[str]:
    """Filters of the pairs that only the order of all filters has."""
    others = [d for d in decisions if not d.family.startswith("planned")]
    return {label for d in others for label in (d.a, d.b)}


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
def test_planned_pairs_of_one_and_many_conditions_are_decided(worlds: tuple[str, ...]) -> None:
    regimes = ("nominal", "outliers") if len(worlds) > 1 else ("nominal",)
    decisions = decide(rows(worlds=worlds, regimes=regimes))
    for question, metric in product("ab", ("keeps track", "position error")):
        part = planned(decisions, question, metric)
        assert [(d.a, d.b) for d in part] == PAIRS
        assert {d.worlds for d in part} == {len(worlds)}
    assert [d.pair_word for d in planned(decisions, "a", "position error")] == ["better"] * 2
    for d in planned(decisions, "b", "position error"):
        assert (d.pair_word == "not tested") == (len(worlds) == 1)


def test_another_filter_changes_neither_p_nor_interval_of_a_pair() -> None:
    worlds = ("drive", "flight", "walk")
    more = {"gpf": 0.0, "qmc_polymerised": -3.0, **EFFECTS}
    few, many = (decide(rows(effects, worlds)) for effects in (EFFECTS, more))
    other = {(d.question, d.a, d.b, d.metric, d.family): d for d in many}
    records = [d for d in few if d.family.startswith("planned")]
    assert len(records) == 8
    for d in records:
        same = other[d.question, d.a, d.b, d.metric, d.family]
        for name in ("p", "plain_low", "plain_high", "estimate"):
            assert getattr(same, name) == pytest.approx(getattr(d, name), rel=0, nan_ok=True)
    assert {d.family_size for d in records if d.question == "a"} == {2}
    assert min(d.family_size for d in many if d.question == "a" and d.a == "mcmc_rpf") > 2


def test_a_filter_that_gives_up_in_its_worst_runs_is_not_better() -> None:
    """Without the runs that it lost, the filter would be called better."""
    table = rows({"rpf": 0.0, "sir": 0.0}, runs=60)
    value = table.set_index(["label", "run"])["value"]
    ratio = value["rpf"] / value["sir"]
    worst = ratio.index[ratio >= ratio.quantile(0.8)]
    gives_up = (table.label == "rpf") & table.run.isin(worst)
    assert gives_up.sum() == 12
    left_out = decide(table[~table.run.isin(worst)])
    assert planned(left_out, "a", "position error")[0].pair_word == "better"
    lost = table.assign(
        value=table.value.where(~gives_up, np.inf), lost=gives_up, keeps_track=~gives_up
    )
    decisions = decide(lost)
    assert "better" not in {d.pair_word for d in decisions}
    assert "better" not in {d.word for d in decisions if d.a == "rpf"}
    assert planned(decisions, "a", "keeps track")[0].share_a == pytest.approx(0.8)


def test_track_is_kept_below_the_divergence_threshold_of_the_scenario(tmp_path: Path) -> None:
    for name, size in (("ekf", 1.0), ("sir", 1000.0)):
        for scenario, paper in (("free", {}), ("bounded", {"divergence_threshold": 500.0})):
            write_scenario(tmp_path / scenario, name, size, scenario, paper)
    tracks = {}
    for scenario in ("free", "bounded"):
        decisions = decide(main_rows(frame.load_frame(scenario, tmp_path)))
        (tracks[scenario],) = planned(decisions, "a", "keeps track")
    assert (tracks["free"].share_a, tracks["free"].share_b) == (1, 1)
    bounded = tracks["bounded"]
    assert (bounded.share_a, bounded.share_b, bounded.word) == (1, 0, "better")


@pytest.mark.parametrize(("family", "worlds"), [({"family": "orbit"}, 1), ({}, 2)])
def test_scenarios_of_one_family_are_one_world(
    family: dict[str, Any], worlds: int, tmp_path: Path
) -> None:
    for scenario, name in product(("short", "long"), ("ekf", "sir")):
        write_scenario(tmp_path / "demo", name, 1.0, scenario, family)
    decisions = decide(main_rows(frame.load_frame("demo", tmp_path)))
    assert {d.worlds for d in decisions} == {worlds}
    (new,) = planned(decisions, "b", "position error")
    assert (new.pair_word == "not tested") == (worlds == 1)


def test_without_some_conditions_pairs_are_decided_and_complete_filters_are_ordered() -> None:
    table = rows({**EFFECTS, "qmc_gpf": 0.1}, worlds=("drive", "flight"))
    partial = table[(table.label != "sir") | (table.scenario != "drive")]
    decisions = decide(partial)
    errors = planned(decisions, "a", "position error")
    worlds = {(d.a, d.b): d.worlds for d in errors}
    assert (worlds["mcmc_rpf", "sir"], worlds["mcmc_rpf", "rpf"]) == (1, 2)
    # sir lacks a condition, so that it has no place in the order
    assert ordered(decisions) == {"mcmc_rpf", "rpf", "qmc_gpf"}
    assert ordered(decide(table)) == {"mcmc_rpf", "rpf", "qmc_gpf", "sir"}


def test_the_order_of_rows_does_not_change_a_decision() -> None:
    table = rows(worlds=("drive", "flight"), regimes=("nominal", "outliers"))
    assert repr(decide(table)) == repr(decide(table.sample(frac=1, random_state=3)))


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
    made = study_report.write_report("demo", tmp_path, tmp_path / "reports")
    records = json.loads((made.parent / "decisions.json").read_text())
    words = {r["word"] for r in records}
    assert not words & {"better", "worse"}
    text = (made.parent / "report.md").read_text()
    sentence = {
        "one run": "| not tested |",
        "all lost": "No filter has an error to compare",
        "identical": "identical",
    }[case]
    assert sentence in made.read_text() + text
