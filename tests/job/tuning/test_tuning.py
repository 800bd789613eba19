"""Tuning: equal grids, a choice that anyone can repeat, and knobs that reach the filter."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pfbench import job
from pfbench.cli.compose import read_sweep
from pfbench.cli.tune import tune_filters
from pfbench.config.named_sets import FILTER_SETS, expand_filter_sets
from pfbench.config.paper_files import list_named_parts
from pfbench.job.tuning import knobs
from pfbench.job.tuning.candidate_search import SEED_SHIFT, Candidate, choose_candidate
from pfbench.job.tuning.knobs import KNOBS, Knob, apply_candidate, list_candidates
from pfbench.report.looks import find_looks
from pfbench.report.tuning_words import count_tuned, describe_tuning
from pfbench.results import store


def candidate(log_ratio: float, nees_ratio: float, r: float = 1.0) -> Candidate:
    return Candidate({"r_factor": r}, log_ratio, nees_ratio, {})


def test_each_filter_has_as_many_candidates() -> None:
    assert {len(list_candidates(method)) for method in KNOBS} == {16}
    for method in KNOBS:
        tried = list_candidates(method)
        assert {c["r_factor"] for c in tried} == {1.0, 2.0, 4.0, 8.0}
        assert len({tuple(c.values()) for c in tried}) == 16


def test_the_smallest_error_wins_and_calibration_decides_within_one_percent() -> None:
    best, near, far = candidate(-0.5, 0.1), candidate(-0.495, 0.9), candidate(-0.48, 1.0)
    assert choose_candidate([far, best, near]) is near
    assert choose_candidate([far, best]) is best
    # half and twice are equally far from 1
    assert choose_candidate([candidate(0.0, 0.4), candidate(0.0, 2.1)]).nees_ratio == 2.1
    with pytest.raises(ValueError, match="keep half of their runs"):
        choose_candidate([candidate(float("inf"), 1.0)])


@pytest.mark.parametrize("method", KNOBS)
def test_the_knobs_reach_the_filter(method: str) -> None:
    nodes = job.compose([f"filter={method}"]).values["filter"]["noise_adaptations"]
    values = list_candidates(method)[-1]
    built = [job.instantiate(node) for node in apply_candidate(nodes, values)]
    knob = KNOBS[method].name
    assert built[0].r_factor == values["r_factor"] == 8.0
    assert getattr(built[-1], knob) == values[knob]
    assert len(built) == (1 if method == "ekf_scaled" else 2)


def test_named_sets_are_lists_of_installed_filters() -> None:
    assert set(FILTER_SETS["tuned_baselines"]) <= set(list_named_parts("filter"))
    names = ",".join(FILTER_SETS["tuned_baselines"])
    assert expand_filter_sets(["filter=ekf,tuned_baselines", "runs=2"]) == [
        f"filter=ekf,{names}", "runs=2",
    ]  # fmt: skip
    assert expand_filter_sets(["filter=gate_tuned,tuned_baselines"])[0].count("gate_tuned") == 1
    assert expand_filter_sets(["filter.particles=3", "filter=ekf"]) == [
        "filter.particles=3", "filter=ekf",
    ]  # fmt: skip


def test_the_first_study_contains_the_tuned_baselines() -> None:
    sweep = dict(word.split("=") for word in read_sweep("quickstart"))
    assert set(FILTER_SETS["tuned_baselines"]) <= set(sweep["filter"].split(","))


def test_tuned_filters_were_not_tuned_on_scored_seeds() -> None:
    record = json.loads((job.conf_dir() / "tuning" / "tuned.json").read_text())
    scored = job.compose(["+experiment=quickstart"])
    assert record["world"]["seed"] == scored.values["seed"] + SEED_SHIFT
    assert record["world"]["scenario"] == scored.choices["scenario"]
    assert record["world"]["model"] == scored.choices["model"]
    for found in record["filters"]:
        choice = choose_candidate([Candidate(**c) for c in found["candidates"]])
        assert choice == Candidate(**found["choice"])
        built = job.compose([f"filter={found['method']}_tuned"]).values["filter"]
        stated: dict[str, Any] = {}
        for node in built["noise_adaptations"]:
            stated = {**node, **stated}
        assert {k: stated[k] for k in choice.values} == choice.values


def test_reports_say_on_which_data_filters_were_tuned() -> None:
    world = json.loads((job.conf_dir() / "tuning" / "tuned.json").read_text())["world"]
    looks = find_looks(["ekf", "gate_tuned", "huber_tuned"])
    said = describe_tuning(count_tuned(looks), len(looks))
    assert said.startswith("Parameters of 2 of 3 filters were tuned on flight_500s (")
    for value in (world["model"], f"seed {world['seed']}", f"{world['runs']} runs"):
        assert str(value) in said
    assert ", ".join(world["regimes"]) in said
    assert count_tuned(find_looks(["ekf", "gate"])) == {}
    assert describe_tuning({}, 2) == ""


def test_a_search_finds_that_errors_are_larger_than_the_model_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Outliers of 10 sd in 5 % of the epochs have six times the variance: R x 4 is better than R."""
    monkeypatch.setattr(knobs, "R_FACTORS", (1.0, 4.0))
    monkeypatch.setattr(knobs, "KNOBS", {"ekf_scaled": Knob("q_factor", (1.0,))})
    monkeypatch.chdir(tmp_path)
    tune_filters([
        "scenario=linear_walk", "scenario.steps=60", "runs=20", "filter=ekf_scaled",
        "noise=outliers", "suffix=walk", "folder=lab", f"results_dir={tmp_path / 'results'}",
    ])  # fmt: skip
    written = yaml.safe_load((tmp_path / "lab/filter/ekf_scaled_walk.yaml").read_text())
    assert written["noise_adaptations"][0]["r_factor"] == 4.0
    assert written["paper"]["name"] == "Scaled EKF (tuned)"
    world = "linear_walk (model linear_walk, seed 1001, 20 runs; noise: outliers)"
    assert written["paper"]["tuning"] == world
    record = json.loads((tmp_path / "lab/tuning/walk.json").read_text())
    (found,) = record["filters"]
    assert record["world"] == {
        "scenario": "linear_walk", "model": "linear_walk", "seed": 1001, "runs": 20,
        "regimes": ["outliers"],
    }  # fmt: skip
    # the errors once more, from the stored runs
    medians = []
    for result in store.list_results(tmp_path / "results/tuning_linear_walk_linear_walk"):
        assert result.meta["seed"] == 1001
        assert result.meta["state"]["units"][0] == "m"  # of position and velocity
        error = result.data["error"][..., :1]
        medians.append(float(np.median(np.sqrt((error.astype(float) ** 2).sum(-1).mean(1)))))
    for c in found["candidates"]:
        assert min(abs(m - c["errors"]["outliers"]) for m in medians) < 1e-5
    assert "ekf_scaled: r_factor=4, q_factor=1." in capsys.readouterr().out


def test_a_filter_without_a_knob_is_refused_before_any_run() -> None:
    with pytest.raises(ValueError, match=r"filter must be of ekf_scaled, gate.*got sir"):
        tune_filters(["scenario=linear_walk", "filter=gate,sir"])
