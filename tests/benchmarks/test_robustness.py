"""The page of robust filters is that of the stored reports, and its sentences follow from their verdicts."""

import math
import sys
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from scipy import stats

from pfbench import job
from pfbench.cli.compose import read_sweep
from pfbench.report import ReportOptions, StudyFacts
from pfbench.results.looks import find_looks

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))  # scripts, not a package
import recorded_wins
import robustness

WORLD, RUNS = "flight_300s", 40


def make_study(ratios: dict[str, tuple[float, float]], rows: pd.DataFrame | None = None) -> Any:
    """Runs of filters whose errors are those of the EKF times a ratio, in nominal noise and in outliers."""
    random = np.random.default_rng(3)
    parts = []
    for k, regime in enumerate(("nominal", "outliers")):
        level = 5.0 * np.exp(0.3 * random.standard_normal(RUNS))
        for label, ratio in ratios.items():
            errors = ratio[k] * level * np.exp(0.02 * random.standard_normal(RUNS))
            parts.append(pd.DataFrame({
                "filter": label, "scenario": WORLD, "family": WORLD, "regime": regime, "model": "", "particles": np.nan,
                "seed": 1, "run": range(RUNS), "lost": False, "keeps_track": True, "unit": "m", "rmse": errors,
            }))  # fmt: skip
    facts = StudyFacts(find_looks(list(ratios)), {}, {}, ReportOptions(), {})
    return robustness.Study(pd.concat(parts), rows if rows is not None else pd.DataFrame(), facts)


def test_the_page_is_that_of_the_published_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each block is computed once, though two pages are filled: it depends on no text, and takes seconds."""
    blocks = {name: cache(block) for name, block in robustness.BLOCKS.items()}
    monkeypatch.setattr(robustness, "BLOCKS", blocks)
    monkeypatch.setattr(robustness, "_study_tables", cache(robustness._study_tables))
    text = robustness.PAGE.read_text()
    assert robustness.fill_page(text) == text, "run: python experiments/analyses/robustness.py"
    number = text.partition("| `gate` | ")[2].partition(" ")[0]
    assert float(number) > 0
    changed = text.replace(f"| `gate` | {number} ", "| `gate` | 99.9 ", 1)
    assert changed != text
    assert robustness.fill_page(changed) == text


def test_the_interval_of_a_median_has_its_level() -> None:
    """Ranks by the binomial distribution. A lost run is the largest error."""
    errors = np.arange(1.0, 21.0)
    errors[[3, 11]] = np.nan
    ordered = np.sort(np.nan_to_num(errors, nan=np.inf))
    k = next(k for k in range(10) if stats.binom.cdf(k, 20, 0.5) > 0.025)
    expected = [(ordered[9] + ordered[10]) / 2, ordered[k - 1], ordered[20 - k]]
    text = robustness.format_median(errors)
    assert [float(word.strip("[],")) for word in text.split()] == pytest.approx(expected, rel=5e-3)
    assert robustness.format_median(np.full(20, np.nan)) == "– [–, –]"


def test_a_filter_is_better_than_the_control_by_a_test_in_one_regime() -> None:
    ratios = {
        "ekf": (1.0, 1.0),
        robustness.CONTROL: (1.0, 1.0),
        "huber": (1.1, 0.8),
        "wolf": (0.9, 1.0),
    }
    study = make_study(ratios)
    words = {
        regime: {v.a: v.word for v in robustness.compare_with_control(study.runs, study.facts, WORLD, regime)}
        for regime in ("nominal", "outliers")
    }  # fmt: skip
    assert words["outliers"] == {"ekf": "equal", "huber": "better", "wolf": "equal"}
    assert words["nominal"] == {"ekf": "equal", "huber": "worse", "wolf": "better"}
    without = study.runs[study.runs["filter"] != robustness.CONTROL]
    assert robustness.compare_with_control(without, study.facts, WORLD, "outliers") == []


def make_condition(ratios: dict[str, float], seed: int = 5) -> recorded_wins.Condition:
    """Runs of filters whose errors are those of the EKF times a ratio."""
    random = np.random.default_rng(seed)
    level = 5.0 * np.exp(0.3 * random.standard_normal(RUNS))
    errors = pd.DataFrame({
        label: ratio * level * np.exp(0.05 * random.standard_normal(RUNS)) for label, ratio in ratios.items()
    })  # fmt: skip
    kinds = {label: recorded_wins.KALMAN for label in ratios}
    kinds |= {"rpf": recorded_wins.KINDS[0], robustness.SAMPLED_HYPOTHESES: recorded_wins.KINDS[1]}
    return recorded_wins.Condition("s", "nominal", errors, kinds, dict.fromkeys(ratios, 0.9))


@pytest.mark.parametrize(
    ("ratios", "words"),
    [
        ({"rpf": 0.8, "ekf": 1.0, "gate": 0.9}, "`rpf` is better than every Kalman filter in `s`, nominal: `rpf` 0.8"),
        ({"rpf": 0.8, "ekf": 1.0, "gate": 0.7}, "No filter with particles of the state"),
        ({"rpf": 0.8, "ekf": 1.0, "gate": 0.8}, "No filter with particles of the state"),
        ({"rbpf_discrete": 0.8, "rpf": 1.2, "ekf": 1.0}, "`rbpf_discrete` is better than every Kalman filter"),
    ],
)  # fmt: skip
def test_a_particle_filter_is_better_than_every_kalman_filter_only_by_a_test(
    ratios: dict[str, float], words: str
) -> None:
    condition = make_condition(ratios)
    assert words in recorded_wins.recorded_table([condition], {})
    repeated = {"s nominal": make_condition({**ratios, "ekf": 0.5}, seed=6)}
    text = recorded_wins.recorded_table([condition], repeated)
    assert ("With a second seed it is not shown to be better" in text) == ("is better" in words)


def test_conditions_are_counted_together() -> None:
    """Thirty equal filters: one alone is decided wrongly more often than all together."""
    equal = [make_condition({"rpf": 1.0, "ekf": 1.0}, seed) for seed in range(30)]
    alone = sum("is better" in recorded_wins.recorded_table([c], {}) for c in equal)
    assert alone > 0
    assert "is better" not in recorded_wins.recorded_table(equal, {})


def test_the_limit_of_a_scenario_is_that_of_the_page_of_limits() -> None:
    text = (ROOT / "docs" / "ceiling.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| `flight_500s` "))
    bound = float(row.split("|")[10])
    stated = robustness._describe_limit("flight_500s").partition(": ")[2].partition(" ")[0]
    assert math.isclose(float(stated), bound, rel_tol=5e-3)
    assert robustness._describe_limit("recorded_car_drive").startswith("No limit holds")


def test_each_world_whose_model_has_an_invariant_chart_has_the_invariant_filter() -> None:
    """Also the page, beside every other filter of the sweep and the limit."""
    with_chart = set()
    for name in robustness.STUDIES:
        sweep = dict(word.split("=") for word in read_sweep(name))
        scenarios = sweep["scenario"].split(",") if "scenario" in sweep else [""]
        for scenario in scenarios:
            words = [f"+experiment={name}", *([f"scenario={scenario}"] if scenario else [])]
            config = job.compose(words)
            has_chart = hasattr(job.instantiate(config.values["model"]), "group_chart")
            assert has_chart == ("invariant_ekf" in sweep["filter"].split(","))
            world = config.choices["scenario"]
            text = robustness._world_table(robustness.read_study(name), world)
            assert all(f"| `{label}`" in text for label in sweep["filter"].split(","))
            assert "imit" in text.splitlines()[-1]
            with_chart |= {world} if has_chart else set()
    assert with_chart == {"recorded_quad_flights", "recorded_car_drive"}
