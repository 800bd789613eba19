"""The best proposed method by condition: its verdicts are counted where it has no error in all conditions."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd

from pfbench.report.board.entries import ViewKey
from pfbench.report.board.pack import StudyFacts, decide_parts
from pfbench.report.options import ReportOptions
from pfbench.results.looks import PartName, find_looks

LEVELS = {  # of each condition, logarithmic; None where all runs diverge
    "ekf": (0.0, 0.0, 0.0, 0.0),
    "mcmc_rpf": (0.4, 0.4, None, None),
    "cpso_escape": (-0.4, 0.4, 0.4, None),
}
CONDITIONS = (("w0", "nominal"), ("w0", "outliers"), ("w1", "nominal"), ("w1", "outliers"))


def make_table(levels: dict[str, tuple[float | None, ...]]) -> pd.DataFrame:
    """Errors of a study of 30 runs in each condition."""
    rng = np.random.default_rng(3)
    rows = []
    for k, (world, regime) in enumerate(CONDITIONS):
        hard = rng.normal(0, 0.5, 30)
        for label, of_condition in levels.items():
            level = of_condition[k]
            error = np.exp((level or 0.0) + hard + 0.05 * rng.normal(size=30))
            rows.append(pd.DataFrame({
                "filter": label, "scenario": world, "family": world, "regime": regime, "model": "m",
                "particles": 100.0, "seed": 1, "run": np.arange(30), "lost": False, "keeps_track": level is not None,
                "unit": "m", "group": "position", "rmse": error, "coverage_50": 0.5, "coverage_90": 0.9,
                "nees_ratio": 1.0, "ms": 2.0,
            }))  # fmt: skip
    return pd.concat(rows, ignore_index=True)


def decide(data: pd.DataFrame) -> dict[ViewKey, dict[str, str]]:
    """Views of a study."""
    looks = find_looks(list(data["filter"].unique()))
    worlds = {key: PartName(key, key, key) for key in ("w0", "w1")}
    regimes = {key: PartName(key, key, key) for key in ("nominal", "outliers")}
    facts = StudyFacts(looks, worlds, regimes, ReportOptions(), {})
    views: dict[ViewKey, dict[str, str]] = decide_parts(data, facts)["views"]
    return views


def sentence(views: dict[ViewKey, dict[str, str]], world: str, regime: str) -> str:
    return views[ViewKey("rmse", world, regime, "ekf")]["sentence"]


def test_verdicts_of_single_conditions_are_counted() -> None:
    views = decide(make_table(LEVELS))
    name = find_looks(["cpso_escape"])["cpso_escape"].name
    text = (
        f"Best proposed method in single conditions, each decided alone: [[{name}]]. "
        "Of 4 conditions: smallest error in 1, worse in 2, track not kept in 1."
    )
    assert sentence(views, "all", "all").endswith(text)
    assert sentence(views, "all", "outliers").endswith("Of 2 conditions: worse in 1, track not kept in 1.")  # fmt: skip
    for world, regime in CONDITIONS:
        assert "single conditions" not in sentence(views, world, regime)


def test_no_count_where_a_proposed_method_has_an_error_in_all_conditions() -> None:
    views = decide(make_table(LEVELS | {"mcmc_rpf": (0.4, 0.4, 0.4, 0.4)}))
    assert all("single conditions" not in view["sentence"] for view in views.values())
    assert "Best proposed method: " in sentence(views, "all", "all")
    views = decide(make_table({"ekf": LEVELS["ekf"], "ukf": LEVELS["mcmc_rpf"]}))
    assert all("single conditions" not in view["sentence"] for view in views.values())


def test_runs_are_counted_by_condition_and_the_next_filter_has_a_cost() -> None:
    """One condition has 30 runs and the others 12; the next filter takes twice the time of the baseline."""
    data = make_table({"ekf": LEVELS["ekf"], "ukf": (0.3, 0.3, 0.3, 0.3)})
    is_first = data["scenario"].eq("w0") & data["regime"].eq("nominal")
    data = data[is_first | (data["run"] < 12)]
    views = decide(data.assign(ms=np.where(data["filter"] == "ukf", 4.0, 2.0)))
    assert (
        "30 paired runs per condition"
        in views[ViewKey("rmse", "w0", "nominal", "ekf")]["small_print"]
    )
    assert (
        "12 to 30 paired runs per condition"
        in views[ViewKey("rmse", "all", "all", "ekf")]["small_print"]
    )
    assert re.search(r"The next, \[\[UKF\]\], is .* above it \(.*\), at about 2 times its cost\.", sentence(views, "all", "all"))  # fmt: skip
