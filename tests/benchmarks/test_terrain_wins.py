"""Sentences on terrain navigation follow from paired runs: decisions, Holm's correction, lost runs, doses."""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from scipy import stats

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))  # scripts, not a package
import paired_errors
import terrain_wins

RUNS = 40
FAMILIES = {"rpf": "particle", "ekf": "kalman", "ekf_bank": "kalman", "ekf_bank_dense": "kalman"}


def make_runs(
    ratios: dict[float, tuple[float, float, float]], scatter: float = 0.1
) -> pd.DataFrame:
    """Errors of Kalman filters that are those of rpf times a ratio by dose, with scatter."""
    random, tables = np.random.default_rng(5), []
    for dose, row in ratios.items():
        level = 20.0 * np.exp(0.5 * random.standard_normal(RUNS))
        for label, ratio in zip(FAMILIES, (1.0, *row), strict=True):
            errors = ratio * level * np.exp(scatter * random.standard_normal(RUNS))
            tables.append(pd.DataFrame({
                "filter": label, "scenario": f"terrain[initial_sd={dose}]", "run": range(RUNS), "rmse": errors,
                "keeps_track": True, "ms": 1.0,
            }))  # fmt: skip
    return pd.concat(tables)


def test_a_win_is_a_decision_of_paired_runs() -> None:
    runs = make_runs({50.0: (1.0, 1.0, 1.0), 400.0: (2.0, 1.0, 0.8)})
    pairs = terrain_wins.compare_pairs(terrain_wins.arrange_errors(runs), list(FAMILIES)[1:])
    assert [pairs[400.0][label].word for label in list(FAMILIES)[1:]] == ["better", "open", "worse"]
    assert all(pair.word == "open" for pair in pairs[50.0].values())
    # four standard errors of a median of normal differences
    error = 4.0 * 1.2533 * 0.1 * np.sqrt(2.0 / RUNS)
    assert np.log(pairs[400.0]["ekf"].ratio) == pytest.approx(np.log(0.5), abs=error)
    assert pairs[400.0]["ekf"].low < pairs[400.0]["ekf"].ratio < pairs[400.0]["ekf"].high
    errors = terrain_wins.arrange_errors(runs)[400.0]
    p = [
        stats.wilcoxon(np.log(table["rpf"] / table[label])).pvalue
        for table in terrain_wins.arrange_errors(runs).values()
        for label in list(FAMILIES)[1:]
    ]
    assert pairs[400.0]["ekf"].p == pytest.approx(len(p) * min(p), rel=1e-6)  # the smallest of all
    assert errors.shape == (RUNS, 4)


def test_the_answer_names_the_doses_and_the_joint_verdicts(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = {"terrain_rough": make_runs({20.0: (2.0, 1.5, 1.4), 500.0: (1.5, 1.0, 0.5)})}
    monkeypatch.setattr(terrain_wins, "read_runs", lambda name: seeds.get(name, pd.DataFrame()))
    monkeypatch.setattr(
        terrain_wins, "describe_joint", lambda name, scenario: f"Joint of {name}, {scenario}."
    )
    start = make_runs({50.0: (1.0, 1.0, 1.0), 400.0: (2.0, 1.0, 0.8)})
    rough = make_runs({20.0: (2.0, 1.5, 1.4), 500.0: (1.5, 1.0, 1.0)})
    text = terrain_wins.describe_answer({"terrain_start": start, "terrain_rough": rough}, FAMILIES)
    assert "| 400 m | none | none |" in text
    assert "| 20, 500 m | 20 m | 20 m |" in text
    assert (
        "both banks included, in `terrain_rough` at 20 m. Track is kept there by `rpf` in 100 %,"
        in text
    )
    assert "Joint of terrain_rough, terrain[initial_sd=20.0]." in text
    assert (
        "With a second seed and 40 runs, which decide this one statement, it is shown to be" in text
    )
    assert "of `ekf_bank_dense`. In root mean square over runs its error is 0.6" in text
    seeds["terrain_rough"] = make_runs({20.0: (2.0, 1.5, 1.0), 500.0: (1.5, 1.0, 0.5)})
    text = terrain_wins.describe_answer({"terrain_rough": rough}, FAMILIES)
    assert "which decide this one statement, it is not shown to be better" in text
    seeds.clear()
    text = terrain_wins.describe_answer({"terrain_rough": rough}, FAMILIES)
    assert "The condition was not repeated with a second seed." in text
    text = terrain_wins.describe_answer({"terrain_start": start}, FAMILIES)
    assert "in no condition better than every Kalman filter" in text


def test_a_lost_run_counts_against_its_filter() -> None:
    runs = make_runs({50.0: (1.0, 1.0, 1.0)}, scatter=0.01)
    for label in ("ekf", "ekf_bank"):
        runs.loc[(runs["filter"] == label) & (runs["run"] < 30), "rmse"] = np.nan
    runs.loc[(runs["filter"] == "rpf") & (runs["run"] < 5), "rmse"] = np.nan
    (pairs,) = terrain_wins.compare_pairs(
        terrain_wins.arrange_errors(runs), list(FAMILIES)[1:]
    ).values()
    assert pairs["ekf"].ratio < 1e-4
    assert pairs["ekf_bank_dense"].ratio == pytest.approx(1.0, abs=0.05)


def test_the_interval_covers_the_centre_and_agrees_with_the_test() -> None:
    """Coverage of 95 % over 500 samples within four standard errors; zero outside where p < 5 %."""
    random, covered, agreed = np.random.default_rng(2), 0, 0
    for _ in range(500):
        d = 0.3 + random.standard_normal(25)
        _, low, high = paired_errors.signed_rank_interval(d)
        covered += low <= 0.3 <= high
        agreed += (stats.wilcoxon(d).pvalue < 0.05) == (not low <= 0.0 <= high)
    assert covered / 500 == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / 500))
    assert agreed / 500 > 0.98  # the rank sum is taken as normal


def test_a_condition_without_a_dose_is_refused() -> None:
    assert terrain_wins.find_dose("terrain[shortest_m=20.0]") == 20.0
    with pytest.raises(ValueError, match=r"must end in \[key=value\], got terrain\. Sweep one key"):
        terrain_wins.find_dose("terrain")
