"""Recorded data by three units: each p-value holds its level for its own question, and no other; pages say which."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import synthetic_results
from scipy.signal import lfilter

from pfbench.report.board.recorded_units import (
    _describe_regime,
    _describe_source,
    _list_losses,
    decide_records,
)
from pfbench.report.study_report import rebuild_page, write_report
from pfbench.results import store
from pfbench.stats.court import Court
from pfbench.stats.study_runs import StudyRuns, arrange_runs

Array = np.ndarray
STUDIES, RUNS, STEPS, MEMORY = 400, 12, 600, 0.9  # correlation of neighbouring seconds, 10 s
LEVEL = 0.05


def markov(rng: np.random.Generator, *shape: int) -> Array:
    """First-order Markov errors of variance 1 along the last axis but one, [..., T, K]."""
    white = rng.normal(size=shape) * math.sqrt(1 - MEMORY**2)
    start = rng.normal(size=(*shape[:-2], 1, shape[-1])) * MEMORY
    return lfilter([1.0], [1.0, -MEMORY], white, axis=-2, zi=start)[0]


def decide_pair(errors: dict[str, Array], drives: int = 1, lost: dict[str, int] | None = None) -> dict[str, Any]:  # fmt: skip
    """Decide the pair a, b of one recorded condition from its errors [R, T, K]."""
    number = np.arange(len(errors["a"]))
    losses = _list_losses(errors, np.arange(STEPS, dtype=float), number % drives)
    record = {"world": "own", "regime": "nominal", "noise": "nominal", "added": "", "simulated": "", "drives": drives, "recorded": drives, "runs": len(number), **losses}  # fmt: skip
    decided = decide_records([record], Court(study_runs(errors, lost or {}), [("a", "b")]), ["b"])
    return dict(decided[0]["rows"][0])


def study_runs(errors: dict[str, Array], lost: dict[str, int]) -> StudyRuns:
    rows = [
        pd.DataFrame({
            "filter": name, "family": "own", "scenario": "own", "regime": "nominal", "seed": 1, "run": np.arange(len(e)),
            "rmse": np.sqrt((e**2).sum(-1).mean(-1)), "keeps_track": np.arange(len(e)) >= lost.get(name, 0),
        })
        for name, e in errors.items()
    ]  # fmt: skip
    return arrange_runs(pd.concat(rows), tuple(errors))


def alarm_rates(record_part: float) -> dict[str, float]:
    """Share of studies of two equal filters in which a unit says better or worse, and in which its p-value is below the level.

    The errors of a filter have a part that all runs of the record share, and a part of each run.
    """
    rng, alarms = np.random.default_rng(7), {"starts": 0, "blocks": 0, "starts p": 0, "blocks p": 0}
    for _ in range(STUDIES):
        errors = {
            name: record_part * markov(rng, 1, STEPS, 2) + 0.5 * markov(rng, RUNS, STEPS, 2)
            for name in "ab"
        }
        row = decide_pair(errors)
        for unit in ("starts", "blocks"):
            alarms[unit] += row[unit]["word"] in ("better", "worse")
            alarms[f"{unit} p"] += row[unit]["p"] < LEVEL
    return {unit: count / STUDIES for unit, count in alarms.items()}


HIGHEST = LEVEL + 2 * math.sqrt(LEVEL * (1 - LEVEL) / STUDIES)


@pytest.mark.slow
def test_blocks_hold_their_level_where_starts_answer_another_question() -> None:
    """Two equal filters whose errors are those of one record: other starts would confirm the order, other stretches not."""
    rates = alarm_rates(record_part=1.0)
    assert max(rates["blocks"], rates["blocks p"]) <= HIGHEST
    assert min(rates["starts"], rates["starts p"]) > 0.5  # true of this record, and of no other


@pytest.mark.slow
def test_starts_hold_their_level_where_nothing_is_of_the_record() -> None:
    rates = alarm_rates(record_part=0.0)
    assert max(rates.values()) <= HIGHEST


def test_all_units_find_a_filter_of_half_the_error() -> None:
    rng = np.random.default_rng(1)
    errors = {
        n: s * (markov(rng, 1, STEPS, 2) + markov(rng, RUNS, STEPS, 2))
        for n, s in (("a", 0.5), ("b", 1.0))
    }
    row = decide_pair(errors, drives=RUNS)
    assert {unit: row[unit]["word"] for unit in ("starts", "blocks", "drives")} == dict.fromkeys(
        ("starts", "blocks", "drives"), "better"
    )
    assert row["drives"]["n"] == RUNS


def test_drives_are_the_units_and_not_their_runs() -> None:
    """40 runs of 2 drives are 2 drives; 40 of 10 are 10, with the p-value of their means."""
    rng = np.random.default_rng(2)
    errors = {n: markov(rng, 40, STEPS, 2) for n in "ab"}
    few, many = (decide_pair(errors, drives)["drives"] for drives in (2, 10))
    assert (few["n"], few["reason"]) == (2, "2 drives, 10 are required")
    assert many["n"] == 10
    assert "drives" not in decide_pair(errors)


def test_a_lost_run_is_one_event_whatever_its_blocks() -> None:
    rng = np.random.default_rng(3)
    errors = {n: s * markov(rng, RUNS, STEPS, 2) for n, s in (("a", 0.5), ("b", 1.0))}
    blocks = decide_pair(errors, lost={"b": 3})["blocks"]
    assert (blocks["word"], blocks["reason"]) == ("not decided", "b loses track in 3 of 12 runs")


def test_steps_without_a_truth_do_not_count() -> None:
    """Held-out fixes: each run has a truth at every fifth step of its own; blocks are those of all runs."""
    error = markov(np.random.default_rng(4), 5, STEPS, 2)
    for run in range(5):
        error[run, np.arange(STEPS) % 5 != run] = np.nan
    losses = _list_losses({"a": error}, np.arange(STEPS, dtype=float), np.zeros(5, int))
    size = np.nansum(error**2, axis=(0, 2)).reshape(30, -1).mean(1)
    np.testing.assert_allclose(losses["filters"]["a"]["blocks"], np.log(size) / 2, rtol=1e-5)


# --------------------------------------------------------------------------------------------------
# Page of a study.


def recorded_study(folder: Path, scenario: dict[str, Any]) -> Path:
    """A study of equal filters whose scenario reads recorded data."""
    methods = (synthetic_results.Method("ekf", 1.0), synthetic_results.Method("ukf", 0.7))
    for path in [synthetic_results.write(folder / "own", m, runs=RUNS) for m in methods]:
        result = store.read_result(path)
        config = {**result.meta["config"], "scenario": {"root": "data", **scenario}}
        store.write_result(path, {**result.meta, "config": config}, result.data)
    return folder


def test_no_word_of_one_record_stands_without_its_reach(tmp_path: Path) -> None:
    results = recorded_study(tmp_path / "results", {"receiver": {"position_sd": [1.5, 1.5, 3.0]}})
    page = write_report("own", results, tmp_path / "reports")
    text = (page.parent / "report.md").read_text()
    first = text.split("\n\n")[1]
    assert re.search(
        r"On one recorded drive; by blocks of time 1 (better|worse|equal|not decided)\.", first
    )
    assert "would the order hold on other stretches" in text
    assert "recorded, plus simulated" in text
    assert "position_sd 1.5, 1.5, 3" in text
    assert "not asked: one drive" in text
    row = next(line for line in text.splitlines() if line.startswith("| UKF | better (p ="))
    assert row.count("p = ") == 2
    html = page.read_text()
    assert "one recorded drive" in html
    assert '<section id="recorded">' in html


def test_drives_without_a_run_do_not_count(tmp_path: Path) -> None:
    results = recorded_study(tmp_path / "results", {"flights": list(range(RUNS + 8))})
    page = write_report("own", results, tmp_path / "reports")
    text = (page.parent / "report.md").read_text()
    assert f"On {RUNS} recorded drives" in text
    assert f"{RUNS + 8} drives" not in text


def test_a_stored_page_is_decided_again_with_its_blocks(tmp_path: Path) -> None:
    page = write_report("own", recorded_study(tmp_path / "results", {}), tmp_path / "reports")
    before = (page.parent / "report.md").read_text()
    rebuild_page(page.parent)
    assert (page.parent / "report.md").read_text() == before


def test_simulated_data_have_no_such_section(tmp_path: Path) -> None:
    synthetic_results.study(tmp_path / "results" / "flight")
    page = write_report("flight", tmp_path / "results", tmp_path / "reports")
    assert "recorded drive" not in page.read_text() + (page.parent / "report.md").read_text()


def test_the_source_names_numbers_of_its_regime_and_of_the_receiver() -> None:
    noise = {"_target_": "a.B", "sd_m": 7.0, "probability": 0.0, "bias_m": [1.0, 2.0], "windows_s": [[5.0, 9.0]], "paper": {"words": "white errors"}}  # fmt: skip
    record = {"noise": "added_white", "simulated": _describe_regime(noise), "added": "range_sd 1", "drives": 2, "seconds": 10.0, "runs": 2}  # fmt: skip
    text = _describe_source(record, "outages")
    assert text == "Measurements: recorded, plus simulated outages (sd_m 7; bias_m 1, 2; windows_s 5, 9) and white errors (range_sd 1). 2 drives of 10 s, 2 runs."  # fmt: skip
