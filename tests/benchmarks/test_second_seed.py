"""A second seed confirms or contradicts verdicts, and newer jobs enter a published study only on the same data."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT

from pfbench.report import RUNS_FILE, format_runs, read_stored_study

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))  # scripts, not a package
import merge_study
import robustness
import second_seed
import tuned_worlds

BEST = ("gate", "best")


@pytest.mark.parametrize(
    ("first", "second", "outcome"),
    [
        ((BEST, ("ekf", "worse")), (BEST, ("ekf", "not decided")), second_seed.SAME),
        ((BEST, ("ekf", "not decided")), (("ekf", "best"), ("gate", "equal")), second_seed.OPEN),
        ((BEST, ("ekf", "not decided")), (("ekf", "best"), ("gate", "worse")), second_seed.CHANGED),
        ((BEST, ("ekf", "worse")), (("ekf", "best"), ("gate", "not decided")), second_seed.CHANGED),
    ],
)
def test_the_best_filter_changes_only_by_a_verdict(first: Any, second: Any, outcome: str) -> None:
    assert second_seed.compare_rankings(first, second).outcome == outcome


def test_the_rank_correlation_is_that_of_the_orders() -> None:
    """One swap of neighbours among n filters leaves all pairs but one: 1 - 2 / (n (n - 1) / 2)."""
    names = ["a", "b", "c", "d"]
    ranking = [(name, "not decided") for name in names]
    swapped = [ranking[k] for k in (0, 2, 1, 3)]
    assert second_seed.compare_rankings(ranking, ranking).agreement == pytest.approx(1.0)
    assert second_seed.compare_rankings(ranking, ranking[::-1]).agreement == pytest.approx(-1.0)
    assert second_seed.compare_rankings(ranking, swapped).agreement == pytest.approx(1 - 2 / 6)


@pytest.mark.parametrize("study", ["robust_quad", "robust_canyon"])
def test_rankings_follow_the_order_of_the_report(study: str) -> None:
    """The best filter has rank 1 on the page, and ranks do not fall along the ranking."""
    stored = robustness.read_study(study)
    rankings = second_seed.rank_filters(stored.runs, stored.facts)
    for (world, regime), ranking in rankings.items():
        ranks = {
            row["filter"]: row["rank"] for row in stored.list_rows(world) if row["regime"] == regime
        }
        order = [ranks[label] for label, _ in ranking if label in ranks]
        assert order == sorted(order)
        assert (order[0], ranking[0][1]) == (1, "best")
        assert {word for _, word in ranking[1:]} <= {
            "equal",
            "worse",
            "not decided",
            "identical",
            "better",
        }
    assert len(rankings) == len(stored.runs[["scenario", "regime"]].drop_duplicates())


def test_verdicts_that_differ_are_counted() -> None:
    runs = pd.DataFrame(
        {"scenario": "w", "regime": "outliers", "filter": ["a", "b", "c", "control"]}
    )
    sets = iter([("a", "b"), ("b", "c")])
    text = second_seed.compare_better({"study": (runs, runs)}, lambda *_: next(sets), "outliers")
    assert "| `w` | `b` | `a` | `c` |" in text
    assert (
        "Of 3 pairs of a filter and a world, 1 are better than the control with both seeds" in text
    )
    assert "2 with one of them and 0 with none." in text
    text = second_seed.compare_better({"study": (runs, runs)}, lambda *_: next(sets), "nominal")
    assert "Of 0 pairs" in text  # no world has this regime


def test_a_study_without_a_new_report_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(second_seed, "RUNS", tmp_path / "runs.parquet")
    for study, values in (("a", [1.0]), ("b", [2.0]), ("b", [3.0])):
        folder = tmp_path / f"{study}{values[0]}" / study
        folder.mkdir(parents=True)
        pd.DataFrame({"rmse": values}).to_parquet(folder / "runs.parquet")
        second_seed.store_runs(folder.parent, ("a", "b"))
    stored = pd.read_parquet(second_seed.RUNS)
    assert dict(zip(stored["study"], stored["rmse"], strict=True)) == {"a": 1.0, "b": 3.0}


def test_both_seeds_are_decided_for_the_same_filters_and_conditions() -> None:
    studies = [study for study in robustness.STUDIES if len(second_seed.read_runs(study))]
    assert len(studies) >= 3
    for study in studies:
        first = robustness.read_study(study).runs
        pair = second_seed.select_common(first, second_seed.read_runs(study))
        keys = ["scenario", "regime", "filter", "run"]
        assert len(pair[0]) == len(pair[1]) == len(pair[0].merge(pair[1], on=keys)) > 0
        assert set(pair[0]["seed"]) == {1}
        assert set(pair[1]["seed"]) == {2}
        same = pair[0].merge(pair[1], on=keys)
        assert (same["rmse_x"] != same["rmse_y"]).mean() > 0.99  # other errors


def test_tier_b_of_each_world_is_tuned_on_it() -> None:
    text = tuned_worlds.tuned_table({
        world: robustness.read_study(study).facts.looks[robustness.CONTROL].tuning
        for study in robustness.STUDIES for world in robustness.read_study(study).facts.worlds
    })  # fmt: skip
    assert "not tuned here" not in text
    foreign = tuned_worlds.tuned_table({"passive_3": tuned_worlds.read_tuning("flight_500s", "flight_500s (model ins_gnss_inflated, seed 1001, 20 runs; noise: nominal, outliers, student)")["data"]})  # fmt: skip
    assert "| `passive_3` | not tuned here: flight_500s (" in foreign
    with pytest.raises(ValueError, match=r"must have a file of the tuning on moon, got none"):
        tuned_worlds.read_tuning("moon", "moon")


# newer jobs of a published study


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """A published study, and a newer report of two of its filters, one with another tuning and other errors."""
    for name in ("published", "newer"):
        (tmp_path / name / "robust_canyon").mkdir(parents=True)
        shutil.copy(
            ROOT / "reports" / "robust_canyon" / RUNS_FILE, tmp_path / name / "robust_canyon"
        )
    folder = tmp_path / "newer" / "robust_canyon"
    pack, runs = read_stored_study(folder)
    runs = runs[runs["filter"].isin(["ekf", "gate_tuned"])]
    runs.loc[runs["filter"] == "gate_tuned", "rmse"] *= 0.5
    runs["ms"] *= 9.0  # on a busy machine
    pack["facts"]["looks"] = [
        {**look, "tuning": "recorded_berlin (new)" if look["key"] == "gate_tuned" else look["tuning"]}
        for look in pack["facts"]["looks"] if look["key"] in ("ekf", "gate_tuned")
    ]  # fmt: skip
    (folder / RUNS_FILE).write_bytes(format_runs(runs, pack))
    return tmp_path / "published", tmp_path / "newer"


def test_newer_jobs_replace_a_filter_and_the_page_is_decided_again(
    folders: tuple[Path, Path],
) -> None:
    published, newer = folders
    before = pd.read_parquet(published / "robust_canyon" / "runs.parquet")
    assert merge_study.merge_study("robust_canyon", newer, published) == ["gate_tuned"]
    after = pd.read_parquet(published / "robust_canyon" / "runs.parquet")
    keys = ["scenario", "regime", "filter", "run"]
    pairs = before.merge(after, on=keys)
    ratio = (pairs["rmse_y"] / pairs["rmse_x"]).to_numpy()
    expected = np.where(pairs["filter"] == "gate_tuned", 0.5, 1.0)
    assert len(pairs) == len(before) == len(after)
    np.testing.assert_allclose(ratio, expected)
    np.testing.assert_array_equal(pairs["ms_x"], pairs["ms_y"])
    pack = read_stored_study(published / "robust_canyon").pack
    assert next(iter(pack["views"].values()))["rows"][0]["filter"] == "gate_tuned"
    assert pack["methods"]["tuned"]["recorded_berlin (new)"] == 1
    page = (published / "robust_canyon" / "report.md").read_text()
    assert "recorded_berlin (new)" in page


def test_other_data_are_refused(folders: tuple[Path, Path]) -> None:
    published, newer = folders
    path = newer / "robust_canyon" / RUNS_FILE
    pack, runs = read_stored_study(path.parent)

    def write(table: pd.DataFrame) -> None:
        looks = [look for look in pack["facts"]["looks"] if look["key"] in set(table["filter"])]
        path.write_bytes(format_runs(table, {**pack, "facts": {**pack["facts"], "looks": looks}}))

    is_control = runs["filter"] == "ekf"
    write(runs.assign(rmse=np.where(is_control, 1.01, 1.0) * runs["rmse"]))
    with pytest.raises(ValueError, match=r"errors of ekf must be those of the published study"):
        merge_study.merge_study("robust_canyon", newer, published)
    write(runs[~is_control])
    with pytest.raises(ValueError, match=r"must have a filter of the published study on the same"):
        merge_study.merge_study("robust_canyon", newer, published)
    write(runs[is_control | (runs["run"] < 40)])
    with pytest.raises(ValueError, match=r"all runs of gate_tuned .* got 10 missing"):
        merge_study.merge_study("robust_canyon", newer, published)
