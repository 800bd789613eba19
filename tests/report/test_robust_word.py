"""The word "robust" needs two proofs beside the tuned control, and Holm's correction over the filters."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from page_packs import build_pack
from scipy import stats

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.job.config import FILTER_SETS
from pfbench.report.board.robust_word import (
    CONTROL,
    RobustnessEvidence,
    describe_robust_filters,
    describe_robustness,
    find_robust_filters,
)
from pfbench.report.options import ReportOptions
from pfbench.report.study_page import write_page
from pfbench.results.looks import find_looks
from pfbench.stats.effects import EffectEstimate


def effect(differences: np.ndarray) -> EffectEstimate:
    n = len(differences)
    error = differences.std(ddof=1) / math.sqrt(n)
    return EffectEstimate(np.asarray(differences.mean()), np.asarray(error), np.asarray(n - 1.0))


def sample(centre: float, sd: float = 0.05, n: int = 40, seed: int = 0) -> np.ndarray:
    z = np.random.default_rng(seed).standard_normal(n)
    return centre + sd * (z - z.mean()) / z.std(ddof=1)


def judge(**pairs: tuple[float, float]) -> tuple[str, ...]:
    """Filters by (log ratio in outliers, log ratio in nominal noise), each with the sd of `sample`."""
    return find_robust_filters(
        {k: RobustnessEvidence(effect(sample(a)), effect(sample(b))) for k, (a, b) in pairs.items()}
    )


def test_both_halves_are_needed() -> None:
    assert judge(both=(-0.5, 0.0), greedy=(-0.5, 0.2), idle=(0.0, 0.0)) == ("both",)
    assert judge(better=(-0.5, -0.2)) == ("better",)


def test_the_published_numbers_of_a_flight_are_not_robust() -> None:
    """Half of the error of R x 4 in outliers, but 1.15 times it in nominal noise."""
    assert judge(wolf=(math.log(0.48), math.log(1.15))) == ()


def test_the_limits_are_those_of_two_one_sided_tests() -> None:
    """Against scipy: just below and just above the p-value of the worse half."""
    nominal, outliers = sample(0.03, 0.05), sample(-0.012, 0.05)
    p = max(
        stats.ttest_1samp(outliers, 0.0, alternative="less").pvalue,
        stats.ttest_1samp(nominal, math.log(1.05), alternative="less").pvalue,
    )
    one = {"a": RobustnessEvidence(effect(outliers), effect(nominal))}
    assert 0.001 < p < 0.2
    assert find_robust_filters(one, p * 1.001) == ("a",)
    assert find_robust_filters(one, p * 0.999) == ()
    # with nine idle filters beside it Holm asks for a tenth
    idle = RobustnessEvidence(effect(sample(0.5)), effect(sample(0.5)))
    many = one | {f"idle{k}": idle for k in range(9)}
    assert find_robust_filters(many, 10 * p * 0.999) == ()
    assert find_robust_filters(many, 10 * p * 1.001) == ("a",)


def test_lost_runs_and_identical_filters_prove_nothing() -> None:
    none = EffectEstimate(np.asarray(np.inf), np.asarray(np.nan), np.asarray(np.nan))
    same = EffectEstimate(np.asarray(0.0), np.asarray(0.0), np.asarray(39.0))
    assert find_robust_filters({"lost": RobustnessEvidence(none, none)}) == ()
    assert find_robust_filters({"same": RobustnessEvidence(same, same)}) == ()
    assert find_robust_filters({}) == ()


def test_sentences_name_the_rule() -> None:
    assert CONTROL in FILTER_SETS["tuned_baselines"]
    names = {"gate": "Gated EKF", "wolf": "WoLF EKF"}
    assert describe_robust_filters(names, ("gate", "wolf")).startswith(
        "Robust: [[Gated EKF]] and [[WoLF EKF]] (better than the EKF with tuned"
    )
    assert describe_robust_filters(names, ()).startswith("No filter is shown to be robust")
    assert describe_robust_filters({}, ()) == ""


def study(effects: dict[str, tuple[float, float]], runs: int = 20, worlds: int = 2) -> pd.DataFrame:
    """Runs whose log errors differ by (outliers, nominal) from the difficulty that they share."""
    rng = np.random.default_rng(3)
    rows = []
    for w in range(worlds):
        for k, noise in enumerate(("outliers", "nominal")):
            hard = rng.normal(0, 0.5, runs)
            rows += [pd.DataFrame({
                "filter": label, "scenario": f"w{w}", "family": f"w{w}", "regime": noise, "seed": 1,
                "run": np.arange(runs), "keeps_track": True,
                "rmse": np.exp(hard + effect[k] + 0.02 * rng.normal(size=runs)),
            }) for label, effect in effects.items()]  # fmt: skip
    return pd.concat(rows, ignore_index=True)


def describe(data: pd.DataFrame, alpha: float = 0.05) -> str:
    looks = find_looks(sorted(data["filter"].unique()))
    if CONTROL in looks:
        looks[CONTROL] = replace(looks[CONTROL], tuning="flight_500s (model ins_gnss18, seed 1001)")
    return describe_robustness(data, looks, ReportOptions(alpha=alpha))


EFFECTS = {CONTROL: (0.0, 0.0), "gate": (-0.4, 0.0), "wolf": (-0.4, 0.2), "ekf": (0.1, 0.0)}


def test_a_study_names_its_robust_filters() -> None:
    text = describe(study(EFFECTS))
    assert text.startswith(f"Robust: [[{find_looks(['gate'])['gate'].name}]] (better than")
    assert "The control was tuned in another world, flight_500s" in text
    assert describe(study(EFFECTS), alpha=1e-30).startswith("No filter is shown to be robust")
    home = study(EFFECTS, worlds=1).assign(scenario="flight_500s")
    assert "another world" not in describe(home)


def test_a_study_says_what_it_lacks_for_the_word() -> None:
    data = study(EFFECTS)
    control = find_looks([CONTROL])[CONTROL].name
    without = data[data["filter"] != CONTROL]
    assert describe(without).endswith(f"the study lacks the control {control}.")
    regime = data["regime"] == "outliers"
    assert "lacks nominal noise in the worlds with outliers" in describe(data[regime])
    assert describe(data[~regime]) == ""
    assert "fewer than 10 runs" in describe(study(EFFECTS, runs=4))
    data = study(EFFECTS | {"gate": (-2.0, -2.0)})
    assert describe(data).startswith("Robust")
    few = data[(data["filter"] != "gate") | (data["run"] < 8)]
    assert describe(few).startswith("No filter is shown to be robust")
    half = data[(data["filter"] != "gate") | (data["run"] < 8) | (data["regime"] == "outliers")]
    assert describe(half).startswith("No filter is shown to be robust")  # few in nominal noise


@pytest.mark.parametrize("text", ["", "Robust: [[A & B]] (better)."])
def test_page_and_markdown_say_it(text: str, tmp_path: Path) -> None:
    pack = build_pack(3, 1, 1) | {"robustness": text}
    with RecordedFolder(tmp_path / "report") as folder:
        write_page(pack, folder)
    html = (tmp_path / "report" / "index.html").read_text()
    assert ("Robust: <b>A &amp; B</b> (better)." in html) == bool(text)
    markdown = (tmp_path / "report" / "report.md").read_text()
    assert ("Robust: A & B (better)." in markdown) == bool(text)
