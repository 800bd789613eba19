"""Tuning: equal grids, a choice that anyone can repeat, and knobs that reach the filter."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pfbench import job
from pfbench.cli.compose import read_sweep
from pfbench.cli.messages import format_error
from pfbench.cli.tune import tune_filters
from pfbench.config.named_sets import FILTER_SETS, expand_filter_sets
from pfbench.config.paper_files import list_named_parts
from pfbench.job.tuning import knobs
from pfbench.job.tuning.candidate_search import (
    SEED_SHIFT,
    Candidate,
    CandidateSearch,
    choose_candidate,
    score_runs,
)
from pfbench.job.tuning.knobs import KNOBS, Knob, apply_candidate, list_candidates
from pfbench.job.tuning.scored_seeds import check_seed
from pfbench.job.tuning.tuned_files import read_candidates
from pfbench.report.looks import find_looks
from pfbench.report.tuning_words import count_tuned, describe_tuning
from pfbench.results import store

TUNED = sorted(path.stem for path in (job.conf_dir() / "tuned").glob("*.yaml"))


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


def read_tuned(name: str) -> dict[str, Any]:
    """Content of the file of a tuning."""
    return dict(yaml.safe_load((job.conf_dir() / "tuned" / f"{name}.yaml").read_text()))


def stated_knobs(words: list[str]) -> dict[str, Any]:
    """Keys of the noise adaptations of a composed filter, those of the first in front."""
    stated: dict[str, Any] = {}
    for node in job.compose(words).values["filter"]["noise_adaptations"]:
        stated = {**node, **stated}
    return stated


def test_tuned_filters_were_not_tuned_on_scored_seeds() -> None:
    scored = job.compose(["+experiment=quickstart"])
    world = read_tuned(scored.choices["tuned"])["world"]
    assert world["seed"] == scored.values["seed"] + SEED_SHIFT
    assert world["scenario"] == scored.choices["scenario"]
    assert world["model"] == scored.choices["model"]


@pytest.mark.parametrize("name", TUNED)
def test_stored_knobs_are_the_choice_among_the_stored_candidates(name: str) -> None:
    """All filters of a file had the same number of candidates with the same factors on R."""
    content = read_tuned(name)
    methods = sorted(set(content) & set(KNOBS))
    assert "ekf_scaled" in methods  # the control
    for method in methods:
        candidates, untuned = read_candidates(content[method])
        choice = choose_candidate(candidates)
        assert choice.values == {key: content[method][key] for key in choice.values}
        assert [c.values for c in candidates] == list_candidates(method)
        assert untuned.values == {}
        assert set(untuned.errors) == set(content["world"]["regimes"])
        words = [f"tuned={name}", f"filter={method}_tuned"]
        stated = stated_knobs(words)
        assert {key: stated[key] for key in choice.values} == choice.values
        config = job.compose(words).values
        assert config["filter"]["paper"]["tuning"] == content["data"]
        assert "tuned" not in config  # else the key of every job would change with the record


def test_robust_studies_use_the_knobs_of_their_own_world() -> None:
    studies = [path.stem for path in job.experiments_dir().glob("robust_*.yaml")]
    assert len(studies) >= 5
    for study in studies:
        sweep = dict(word.split("=") for word in read_sweep(study))
        for scenario in sweep.get("scenario", "").split(","):
            chosen = [f"scenario={scenario}"] if scenario else []
            config = job.compose([f"+experiment={study}", *chosen, "filter=gate_tuned"])
            world = read_tuned(config.choices["tuned"])["world"]
            assert world["scenario"] == config.choices["scenario"]
            assert world["model"] == config.choices["model"]
            # no run of the study, and of a recording no scored step or another draw of the errors
            assert world["seed"] != config.values["seed"]


def test_reports_say_on_which_data_filters_were_tuned() -> None:
    world = read_tuned("flight_500s")["world"]
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
    monkeypatch.setattr(knobs, "KNOBS", {"ekf_scaled": Knob("q_factor", (1.0,))})
    monkeypatch.chdir(tmp_path)
    tune_filters([
        "scenario=linear_walk", "scenario.steps=60", "runs=20", "filter=ekf_scaled",
        "noise=outliers", "name=walk", "folder=lab", "r_factors=1,4", "report.start_time_s=5",
    ])  # fmt: skip
    written = yaml.safe_load((tmp_path / "lab/tuned/walk.yaml").read_text())
    assert written["ekf_scaled"]["r_factor"] == 4.0
    data = "linear_walk (model linear_walk, steps=60, seed 1001, scored from 5 s, 20 runs; noise: outliers)"
    assert written["data"] == data
    candidates, untuned = read_candidates(written["ekf_scaled"])
    assert [c.values["r_factor"] for c in candidates] == [1.0, 4.0]
    assert written["world"] == {
        "scenario": "linear_walk", "model": "linear_walk", "settings": ["scenario.steps=60"],
        "seed": 1001, "runs": 20, "start_time_s": 5.0, "regimes": ["outliers"],
    }  # fmt: skip
    words = [f"hydra.searchpath=[file://{tmp_path}/lab]", "tuned=walk", "filter=ekf_scaled_tuned"]
    assert stated_knobs(words)["r_factor"] == 4.0
    # the errors once more, from a job of its own for each filter
    errors = []
    for name in ("ekf", "ekf_scaled"):  # factors on R of 1 and 4
        words = [
            "scenario=linear_walk",
            "scenario.steps=60",
            "runs=20",
            "seed=1001",
            "noise=outliers",
        ]
        outcome = job.run(job.compose([*words, f"filter={name}", "study=check"]))
        result = store.read_result(outcome.path)
        assert result.meta["state"]["units"][0] == "m"  # of position and velocity
        error = result.data["error"][:, result.data["time"] >= 5.0, :1].astype(float)
        errors.append(float(np.median(np.sqrt((error**2).sum(-1).mean(1)))))
    assert [c.errors["outliers"] for c in candidates] == pytest.approx(errors, rel=1e-5)
    assert untuned.errors["outliers"] == pytest.approx(errors[1], rel=1e-5)
    assert "ekf_scaled: r_factor=4, q_factor=1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scenario=linear_walk", "filter=gate,sir"], r"filter must be of ekf_scaled, gate.*got sir"),
        (["scenario=linear_walk", "filter="], r"filter must be a list of distinct entries.*got ''. Default: "),
        (["scenario=linear_walk", "noise="], r"noise must be a list.*got ''"),
        (["scenario=linear_walk", "r_factors="], r"r_factors must be a list.*got ''. Default: r_factors=1,2,4,8"),
        (["scenario=linear_walk", "r_factors=1,1"], r"r_factors must be a list of distinct.*got '1,1'"),
        (["scenario=linear_walk", "r_factors=1,-2"], r"r_factors must be positive numbers, got 1,-2"),
        (["scenario=linear_walk", "r_factors=1,many"], r"r_factors must be positive numbers, got 1,many"),
        (["scenario=linear_walk", "name=../x"], r"name must consist of letters.*got '../x'\. It"),
        (["scenario=linear_walk", "runs=1"], r"runs must be at least 2 for a tuning, got 1\. Default"),
        (["scenario=passiv_1"], r"scenario=passiv_1 does not exist. Similar: passive_1"),
        (["scenario=flight_500s", "seed=-999"], r"a seed that no study scores in flight_500s, got 1, which \w+ scores"),
        (["scenario=flight_500s", "seed=-1001"], r"seed must be at least -1000, got -1001"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_before_any_run(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Exception, match=r".") as caught:
        tune_filters(words)
    assert re.search(message, format_error(caught.value, words))
    assert list(tmp_path.rglob("*.npz")) == []


@pytest.mark.parametrize("words", [[], ["oracle_noise=true"]])
def test_regimes_in_one_batch_have_the_numbers_of_separate_jobs(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shared inputs are repeated, and a model that knows the noise is passed alone."""
    monkeypatch.chdir(tmp_path)
    cruise = "scenario.trajectory.segments=[{_target_:pfbench.nav.cruise,duration_s:60}]"
    world = ["scenario=flight_300s", "scenario.imu_rate_hz=20", cruise, "runs=3", "seed=1001"]
    world += words
    regimes = ("nominal", "outliers", "variance_r")
    search = CandidateSearch([*world, "episode_cache_dir=null"], regimes)
    assert len(search.batches) == (3 if words else 1)
    for regime in regimes:
        path = job.run(job.compose([*world, f"noise={regime}", "filter=ekf", "study=check"])).path
        result = store.read_result(path)
        alone = score_runs(result.data, search.batches[0].plan.model, slice(None))
        assert search.reference[regime] == pytest.approx(alone, rel=1e-5)
    assert len({score.error for score in search.reference.values()}) == 3


def test_a_job_does_not_score_the_seed_of_its_tuning() -> None:
    """In the same world; another seed and another world are scored."""
    words = ["scenario=passive_1", "tuned=passive_1", "filter=gate_tuned", "runs=2"]
    with pytest.raises(
        ValueError,
        match=r"seed must not be that of the tuning of the filter in passive_1, got 1001\. Set",
    ):
        job.compose([*words, "seed=1001"])
    for free in ([*words, "seed=1"], [*words, "seed=1001", "filter=gate"], ["scenario=passive_2", *words[1:], "seed=1001"]):  # fmt: skip
        assert job.compose(free).values["runs"] == 2


def test_a_seed_of_a_stored_study_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another window of the same recording or length of a simulation has other data."""
    monkeypatch.chdir(tmp_path)
    study = ["scenario=linear_walk", "scenario.steps=5", "runs=2", "filter=ekf", "seed=1001"]
    job.run(job.compose([*study, "study=mine"]))
    world = job.compose(["scenario=linear_walk", "scenario.steps=5"])
    with pytest.raises(ValueError, match=r"got 1001, which mine scores. Set another seed"):
        check_seed(world, 1001)
    check_seed(world, 1002)
    check_seed(job.compose(["scenario=linear_walk", "scenario.steps=6"]), 1001)
