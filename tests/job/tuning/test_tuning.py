"""Tuning: equal grids, a choice that anyone can repeat, and knobs that reach the filter."""

import math
import re
import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from checkout import ROOT
from refusals import check_refused

from pfbench import job
from pfbench.cli.compose import read_sweep
from pfbench.cli.messages import format_error
from pfbench.cli.tune import TUNE_COMMAND as TUNE
from pfbench.job import tuning
from pfbench.job.config import FILTER_SETS, TUNED_METHODS, expand_filter_sets
from pfbench.job.tuned_files import Ratio, compare_errors, decide_fit, find_best
from pfbench.job.tuned_knobs import AUTO, NOMINAL
from pfbench.job.tuning import (
    KNOBS,
    Candidate,
    CandidateSearch,
    apply_candidate,
    check_seed,
    choose_candidate,
    list_candidates,
    score_runs,
    with_candidate,
)
from pfbench.results import store
from pfbench.results.conditions import make_distinct_label
from pfbench.results.looks import (
    count_tuned,
    describe_foreign_knobs,
    describe_tuning,
    find_looks,
    find_stored_world,
)
from pfbench.results.paper_block import list_named_parts, list_tuned_worlds, read_families

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))  # scripts, not a package
import tuned_table

TUNED = sorted(read_families("tuned"))


def read_candidates(node: Mapping[str, Any]) -> tuple[list[Candidate], Candidate]:
    """Read the candidates of a filter from the file of a tuning."""
    return to_candidates(pd.read_csv(StringIO(node["candidates"]), sep=" ", na_values="-"))


def to_candidates(rows: pd.DataFrame) -> tuple[list[Candidate], Candidate]:
    """Return the candidates, and the filter without knobs, which is the last row."""
    columns = list(rows)
    knobs, regimes = (
        columns[: columns.index("log_ratio")],
        columns[columns.index("nees_ratio") + 1 :],
    )
    candidates = [
        Candidate(
            {knob: row[knob] for knob in knobs if not math.isnan(row[knob])},
            row["log_ratio"],
            row["nees_ratio"],
            {regime.removeprefix("error_"): row[regime] for regime in regimes},
        )
        for row in rows.astype(float).to_dict("records")
    ]
    return candidates[:-1], candidates[-1]


def candidate(log_ratio: float, nees_ratio: float, r: float = 1.0) -> Candidate:
    return Candidate({"r_factor": r}, log_ratio, nees_ratio, {})


def test_each_filter_has_as_many_candidates() -> None:
    assert {len(list_candidates(method)) for method in KNOBS} == {16}
    for method in KNOBS:
        tried = [tuple(candidate.values()) for candidate in list_candidates(method)]
        assert ({r for r, _ in tried}, len({*tried})) == ({1.0, 2.0, 4.0, 8.0}, 16)


def test_the_smallest_error_wins_and_calibration_decides_within_one_percent() -> None:
    best, near, far = candidate(-0.5, 0.1), candidate(-0.495, 0.9), candidate(-0.48, 1.0)
    assert choose_candidate([far, best, near]) is near
    assert choose_candidate([far, best]) is best
    # half and twice are equally far from 1
    assert choose_candidate([candidate(0.0, 0.4), candidate(0.0, 2.1)]).nees_ratio == 2.1
    check_refused(
        [("keep half of their runs", lambda: choose_candidate([candidate(float("inf"), 1.0)]))],
        remedy=False,
    )


@pytest.mark.parametrize("method", KNOBS)
def test_the_knobs_reach_the_filter(method: str) -> None:
    node = job.compose([f"filter={method}"]).values["filter"]
    values = list_candidates(method)[-1]
    changed = apply_candidate(node, values)
    built = job.instantiate({k: v for k, v in changed.items() if k != "paper"})
    assert stated_values(built, KNOBS[method][0]) == values


def stated_values(built: Any, key: str) -> dict[str, float]:
    """Read the factor on R and the knob from a built filter; the factor stands before other adaptations."""
    *path, name = key.split(".")
    guided = getattr(getattr(built, "proposal", None), "guide_filter", built)
    stages = getattr(guided, "noise_adaptations", ())
    if path[0] == "noise_adaptations" and name != "q_factor":
        path[1] = str(int(path[1]) + 1)
    part = reduce(lambda node, k: node[int(k)] if k.isdigit() else getattr(node, k), path, built)
    scaled = stages[0] if stages else built.weight_update
    return {"r_factor": scaled.r_factor, name: getattr(part, name)}


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
    return dict(yaml.safe_load(read_families("tuned")[name]))


def stated_knobs(words: list[str]) -> dict[str, Any]:
    """Keys of the noise adaptations of a composed filter, those of the first in front."""
    stated: dict[str, Any] = {}
    for node in job.compose(words).values["filter"]["noise_adaptations"]:
        stated = {**node, **stated}
    return stated


@pytest.mark.parametrize("name", TUNED)
def test_stored_knobs_are_the_choice_among_the_stored_candidates(name: str) -> None:
    """All filters of a file had the same number of candidates with the same factors on R."""
    content = read_tuned(name)
    assert "r_factor" in content["ekf_scaled"]  # the control
    for method in [m for m in KNOBS if "r_factor" in content.get(m, {})]:
        candidates, untuned = to_candidates(tuned_table.read_candidates(name, method))
        choice = choose_candidate(candidates)
        assert choice.values == {key: content[method][key] for key in choice.values}
        assert [c.values for c in candidates] == list_candidates(method)
        assert (untuned.values, {*untuned.errors}) == ({}, {*content["world"]["regimes"]})
        config = job.compose([f"tuned={name}", f"filter={method}_tuned"]).values
        plain = job.compose([f"filter={method}"]).values["filter"]
        stated = {**apply_candidate(plain, choice.values), "paper": config["filter"]["paper"]}
        assert config["filter"] == stated  # the filter with the chosen candidate, and nothing else
        # a key `tuned` would change that of every job with the record
        assert (config["filter"]["paper"]["tuning"], "tuned" in config) == (content["data"], False)


@pytest.mark.parametrize("name", TUNED)
def test_a_file_states_the_best_filter_of_its_world_and_whether_kalman_filters_fit(
    name: str,
) -> None:
    content = read_tuned(name)
    fit = content["fit"]
    errors = {}
    for method in TUNED_METHODS:
        if "unsupported" not in content[method]:
            candidates, _ = to_candidates(tuned_table.read_candidates(name, method))
            errors[f"{method}_tuned"] = choose_candidate(candidates)
    scenario = job.compose([f"scenario={content['world']['scenario']}"]).values["scenario"]
    limit = scenario["paper"].get("divergence_threshold") or 0.0
    for (
        method,
        choice,
    ) in errors.items():  # unless the limit is below an error, or other runs decide
        if "first_run" not in fit and max(choice.errors.values()) < limit:
            assert fit["objectives"][method] == pytest.approx(choice.log_ratio, abs=1e-5)
    assert {"ekf", *errors} <= set(fit["objectives"]) <= {"ekf", "ukf", *errors}
    assert fit["objectives"][content["best"]] == min(fit["objectives"].values())
    ratios = {key: Ratio(*values) for key, values in fit["ratios"].items()}
    assert set(ratios) == {"sir", "rpf"}
    assert content["kalman_fits"] == all(ratio.high >= 0.95 for ratio in ratios.values())
    assert all(ratio.low <= ratio.value <= ratio.high for ratio in ratios.values())


@pytest.mark.parametrize("name", TUNED)
def test_a_file_has_the_name_under_which_its_world_is_found(name: str) -> None:
    world = read_tuned(name)["world"]
    words = [f"{key}={world[key]}" for key in ("scenario", "model")]
    choice = NOMINAL if name.endswith(f"_{NOMINAL}") else AUTO
    found = job.compose([*words, f"tuned={choice}", "filter=ekf_scaled_tuned"])
    assert found.values["filter"]["paper"]["tuning"] == read_tuned(name)["data"]


def list_tuned_studies() -> list[tuple[str, str, bool]]:
    """Experiments with tuned filters, each scenario, and whether its noise is nominal alone."""
    studies = []
    for path in sorted(job.experiments_dir().glob("*.yaml")):
        sweep = dict(word.split("=", 1) for word in read_sweep(path.stem))
        if "gate_tuned" in sweep.get("filter", "").split(","):
            is_nominal = set(sweep.get("noise", NOMINAL).split(",")) == {NOMINAL}
            scenarios = sweep.get("scenario", "").split(",")
            studies += [(path.stem, scenario, is_nominal) for scenario in scenarios]
    return studies


@pytest.mark.parametrize(("study", "scenario", "is_nominal"), list_tuned_studies())
def test_studies_use_the_knobs_of_their_own_world(
    study: str, scenario: str, is_nominal: bool
) -> None:
    """Tuned on other seeds, and for a study of nominal noise in nominal noise alone."""
    chosen = [f"scenario={scenario}"] if scenario else []
    config = job.compose([f"+experiment={study}", *chosen, "filter=gate_tuned"])
    paper = config.values["filter"]["paper"]
    own = {key: config.choices[key] for key in ("scenario", "model")}
    assert list_tuned_worlds(paper["tuning"]) == {own["scenario"]: own["model"]}
    assert "tuned on" not in paper["name"] or "with other settings" in paper["name"]
    is_alone = is_nominal and config.choices["noise"] == NOMINAL  # a scenario may have its regime
    assert paper["tuning"].endswith("noise: nominal)") == is_alone
    assert f"seed {config.values['seed']}," not in paper["tuning"]


def test_reports_say_on_which_data_filters_were_tuned() -> None:
    content = read_tuned("flight_500s_with_ins_gnss_inflated")
    world, looks = content["world"], find_looks(["ekf", "gate_tuned", "huber_tuned"])
    for key in ("gate_tuned", "huber_tuned"):
        looks[key] = replace(looks[key], tuning=content["data"])
    said = describe_tuning(count_tuned(looks), len(looks))
    assert said.startswith("Parameters of 2 of 3 filters were tuned on flight_500s (")
    for value in (world["model"], f"seed {world['seed']}", f"{world['runs']} runs"):
        assert str(value) in said
    assert ", ".join(world["regimes"]) in said
    assert count_tuned(find_looks(["ekf", "gate"])) == {}
    assert describe_tuning({}, 2) == ""


def test_a_page_says_that_filters_have_the_knobs_of_another_world() -> None:
    """An early page stores the data of a tuning alone; a later one the words for the world."""
    early = {"tuning": "a (model m, seed 1001, 20 runs; noise: nominal)"}
    assert find_stored_world(early, ["a[x=1]"]) == ""
    assert find_stored_world(early, ["a", "b"]) == find_stored_world(early, ["b"]) == "a"
    assert find_stored_world({"tuning": ""}, ["b"]) == ""
    assert find_stored_world({**early, "tuned_on": ""}, ["b"]) == ""  # of another label's world
    assert describe_foreign_knobs(["", ""]) == ""
    said = describe_foreign_knobs(["a", "", "a", "c with m"])
    assert said.startswith(
        "Not tuned here: 3 filters have the knobs of another world, a, c with m. "
    )


def test_labels_of_two_tunings_differ_in_their_knobs_alone() -> None:
    def meta(r_factor: float, world: str) -> dict[str, Any]:
        block = {"name": f"Gated EKF (tuned on {world})", "tuning": world}
        config = {"filter": {"r_factor": r_factor, "paper": block}}
        return {"label": "gate_tuned", "key": "k", "config": config}

    twins = [meta(1.0, "a"), meta(2.0, "b")]
    assert make_distinct_label(twins[0], twins) == "gate_tuned[r_factor=1.0]"


def test_a_search_finds_that_errors_are_larger_than_the_model_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Outliers of 10 sd in 5 % of the epochs have six times the variance: R x 4 is better than R."""
    monkeypatch.setattr(tuning, "KNOBS", {"ekf_scaled": ("noise_adaptations.0.q_factor", (1.0,))})
    monkeypatch.chdir(tmp_path)
    TUNE([
        "scenario=linear_walk", "scenario.steps=60", "runs=20", "filter=ekf_scaled",
        "noise=outliers", "name=walk", "folder=lab", "r_factors=1,4", "report.start_time_s=5",
        "fit_runs=10", "fit_particles=200",
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
    best, fit = written["best"], written["fit"]  # the EKF and the UKF without knobs believe R
    assert (best, written["kalman_fits"]) == ("ekf_scaled_tuned", True)
    numbers = {key: fit[key] for key in ("noise", "runs", "first_run", "particles")}
    assert numbers == {"noise": "outliers", "runs": 10, "first_run": 20, "particles": 200}
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


def test_a_filter_is_added_to_the_file_of_its_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second search replaces its own part; errors of another world or other runs are never mixed."""
    monkeypatch.setattr(
        tuning,
        "KNOBS",
        {
            "ekf_scaled": ("noise_adaptations.0.q_factor", (1.0,)),
            "rpf": ("resampler.scale", (0.5, 1.0)),
        },
    )
    monkeypatch.chdir(tmp_path)
    world = [
        "scenario=linear_walk",
        "scenario.steps=30",
        "noise=nominal",
        "name=walk",
        "folder=lab",
    ]
    world += ["r_factors=1,4", "fit_runs=2", "fit_particles=50"]
    TUNE([*world, "runs=4", "filter=ekf_scaled"])
    path = tmp_path / "lab/tuned/walk.yaml"
    first = path.read_text()
    assert "\n  first_run: 4\n" in first  # the best filter is chosen by other runs
    for _ in range(2):
        TUNE([*world, "runs=4", "filter=rpf"])
        assert path.read_text().startswith(first)
    node = yaml.safe_load(path.read_text())["rpf"]
    candidates, _ = read_candidates(node)
    monkeypatch.setattr(tuned_table, "TUNED", path.parent)
    monkeypatch.setattr(tuned_table, "TABLE", tmp_path / "families" / "worlds.yaml")
    monkeypatch.setattr(tuned_table, "CANDIDATES", tmp_path / "candidates.parquet")
    written = path.read_text()
    for scenario in ("linear_walk", "benes"):  # a second time the entry is replaced
        path.write_text(written.replace('scenario: "linear_walk', f'scenario: "{scenario}'))
        tuned_table.add_files()
        assert not path.exists()
    (entry,) = yaml.safe_load(tuned_table.TABLE.read_text()).values()
    assert entry["world"]["scenario"] == "benes"
    assert entry["rpf"] == {key: value for key, value in node.items() if key != "candidates"}
    assert to_candidates(tuned_table.read_candidates("walk", "rpf"))[0] == candidates
    path.write_text(written)
    assert node["particles"] == 500
    assert choose_candidate(candidates).values == {key: node[key] for key in ("r_factor", "scale")}
    assert (
        len(candidates) == len({c.log_ratio for c in candidates}) == 4
    )  # each knob changes the filter
    check_refused(
        [
            (
                r"runs must be 4 as in .*walk\.yaml.*got 6",
                lambda: TUNE([*world, "runs=6", "filter=rpf"]),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scenario=linear_walk", "filter=gate,sir"], r"filter must be of .*ekf_scaled, .*gate.*got sir.*state a knob in their file"),
        (["scenario=linear_walk", "filter="], r"filter must be a list of distinct entries.*got ''. Default: "),
        (["scenario=linear_walk", "noise="], r"noise must be a list.*got ''"),
        (["scenario=linear_walk", "r_factors="], r"r_factors must be a list.*got ''. Default: r_factors=1,2,4,8"),
        (["scenario=linear_walk", "r_factors=1,1"], r"r_factors must be a list of distinct.*got '1,1'"),
        (["scenario=linear_walk", "r_factors=1,-2"], r"r_factors must be positive numbers, got 1,-2"),
        (["scenario=linear_walk", "r_factors=1,many"], r"r_factors must be positive numbers, got 1,many"),
        (["scenario=linear_walk", "name=../x"], r"name must consist of letters.*got '../x'\. It"),
        (["scenario=linear_walk", "name=auto"], r"name must.*not be auto or nominal, got 'auto'\. It"),
        (["scenario=linear_walk", "fit_runs=1"], r"fit_runs must be a whole number of at least 2, got 1\. Use fit_runs="),
        (["scenario=linear_walk", "fit_particles=1"], r"fit_particles must be a whole number of at least 2, got 1\. Default"),
        (["scenario=linear_walk", "runs=1"], r"runs must be a whole number of at least 2, got 1\. Default: runs=20"),
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
        TUNE(words)
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
    check_refused(
        [
            (
                r"seed must not be that of the tuning of the filter in passive_1, got 1001\. Set",
                lambda: job.compose([*words, "seed=1001"]),
            )
        ],
        remedy=False,
    )
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
    check_refused(
        [(r"got 1001, which mine scores. Set another seed", lambda: check_seed(world, 1001))],
        remedy=False,
    )
    check_seed(world, 1002)
    check_seed(job.compose(["scenario=linear_walk", "scenario.steps=6"]), 1001)


OWN_SCENARIO = """\
defaults:
  - linear_walk
  - _self_
steps: 12
"""


def test_a_tuned_filter_takes_the_knobs_of_its_world_or_prints_the_command_that_makes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The printed command is tried, in the folder of the user's own scenario."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab" / "scenario").mkdir(parents=True)
    (tmp_path / "lab" / "scenario" / "stroll.yaml").write_text(OWN_SCENARIO)
    words = [f"hydra.searchpath=[file://{tmp_path}/lab]", "scenario=stroll"]
    assert job.compose([*words, "filter=sir"]).values["runs"] == 100  # has no knobs
    with pytest.raises(
        ValueError, match=r"tuned=auto must find the knobs of filter=gate_tuned"
    ) as e:
        job.compose([*words, "filter=gate_tuned"])
    command = re.search(r"make them: (pfbench tune .*)$", str(e.value))
    assert command is not None
    made = shlex.split(command[1])[2:]
    assert made == ["scenario=stroll", "model=linear_walk", words[0]]
    small = ["filter=gate", "runs=3", "fit_particles=20", "r_factors=1", "noise=nominal,outliers"]
    TUNE([*made, *small])
    assert "hydra.searchpath" not in capsys.readouterr().out.splitlines()[-1]  # it is found
    named = job.compose([*words, "filter=gate_tuned"]).values["filter"]["paper"]
    assert named["name"] == "Gated EKF (tuned)"
    assert named["tuning"].startswith("stroll (model linear_walk, seed 1001, 3 runs")


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["scenario=passive_1"], "Gated EKF (tuned)"),
        (["scenario=passive_1", "tuned=flight_300s"], "Gated EKF (tuned on flight_300s)"),
        (["scenario=passive_1", "tuned=nominal"], "Gated EKF (tuned)"),
        (["scenario=passive_1", "scenario.steps=50"], "Gated EKF (tuned on passive_1 with other settings)"),
        (["scenario=flight_500s", "model=ins_gnss_inflated"], "Gated EKF (tuned)"),
        (["scenario=flight_500s", "tuned=flight_500s_with_ins_gnss_inflated"], "Gated EKF (tuned on flight_500s with ins_gnss_inflated)"),
        (["scenario=recorded_berlin"], "Gated EKF (tuned)"),  # on another part of the drive
        (["scenario=terrain_fixed_wing", "filter=ekf_scaled_terrain"], "Scaled EKF (terrain)"),
    ],
)  # fmt: skip
def test_the_name_says_on_which_other_world_a_filter_was_tuned(words: list[str], name: str) -> None:
    assert job.compose(["filter=gate_tuned", *words]).values["filter"]["paper"]["name"] == name


def test_a_world_without_knobs_refuses_tuned_filters_alone(tmp_path: Path) -> None:
    assert job.compose(["scenario=benes", "filter=ekf"]).choices["tuned"] == AUTO
    check_refused(
        [
            (
                r"pfbench tune scenario=benes model=benes noise=nominal$",
                lambda: job.compose(["scenario=benes", "filter=gate_tuned", "tuned=nominal"]),
            )
        ],
        remedy=False,
    )
    folder = tmp_path / "tuned"
    folder.mkdir()
    world = "world: {scenario: benes, model: benes, regimes: [nominal]}\n"
    (folder / "benes.yaml").write_text(f"{world}gate: {{unsupported: The model has no R.}}\n")
    words = [f"hydra.searchpath=[file://{tmp_path}]", "scenario=benes", "filter=gate_tuned"]
    check_refused(
        [
            (
                r"knobs of benes, got none, since The model has no R\. Choose",
                lambda: job.compose(words),
            )
        ],
        remedy=False,
    )


def test_knobs_beside_those_of_a_file_are_refused_and_a_file_by_hand_is_named(
    tmp_path: Path,
) -> None:
    words = ["scenario=passive_1", "filter=gate_tuned"]
    check_refused(
        [
            (
                r"tuned\.gate must be in a file, got a value with tuned=auto",
                lambda: job.compose([*words, "+tuned.gate.r_factor=3.0"]),
            )
        ],
        remedy=False,
    )
    changed = job.compose([*words, "tuned=passive_1", "tuned.gate.r_factor=3.0"])
    assert changed.values["filter"]["noise_adaptations"][0]["r_factor"] == 3.0
    (tmp_path / "tuned").mkdir()
    (tmp_path / "tuned" / "mine.yaml").write_text("gate: {r_factor: 3.0, probability: 0.9}\n")
    path = f"hydra.searchpath=[file://{tmp_path}]"
    paper = job.compose([*words, path, "tuned=mine"]).values["filter"]["paper"]
    assert (paper["name"], paper["tuning"]) == ("Gated EKF (tuned on mine)", "mine")


@pytest.mark.parametrize("method", KNOBS)
def test_candidates_side_by_side_have_the_numbers_of_each_alone(method: str) -> None:
    """Bit for bit: a knob never reaches the runs of another candidate."""
    words = ["scenario=linear_walk", "scenario.steps=30", "runs=3", "seed=1001", "engine=kernels"]
    search = CandidateSearch(words, ("nominal", "outliers"))
    grid = list_candidates(method)
    result = search.tune(method, grid)
    config = search.compose(method, "nominal")
    for values, joint in zip(grid[::5], result.candidates[::5], strict=True):
        (scores,) = search._score([with_candidate(config, values)])
        assert joint.errors == {regime: score.error for regime, score in scores.items()}
    assert (
        len({c.log_ratio for c in result.candidates}) >= 4
    )  # equal weights have no entropy to add


def test_kalman_filters_that_fit_are_not_called_unfit_beyond_the_level() -> None:
    """At the limit itself: both particle filters have 0.95 of the error, with heavy tails and a common reference."""
    rng, studies = np.random.default_rng(3), 2000
    false = 0
    for _ in range(studies):
        reference = np.exp(0.3 * rng.standard_t(3, 20))
        errors = [0.95 * np.exp(0.3 * rng.standard_t(3, 20)) for _ in range(2)]
        ratios = [compare_errors(e, reference, 1e9, filters=2) for e in errors]
        false += not decide_fit(dict(zip(("sir", "rpf"), ratios, strict=True)))
    assert false / studies <= 0.025 + 3 * np.sqrt(0.025 * 0.975 / studies)


def test_a_particle_filter_that_halves_the_error_shows_that_kalman_filters_do_not_fit() -> None:
    rng = np.random.default_rng(4)
    reference = np.exp(rng.normal(size=20))
    ratio = compare_errors(0.5 * reference * np.exp(0.2 * rng.normal(size=20)), reference, 1e9, 2)
    assert not decide_fit({"sir": Ratio(1.0, 0.9, 1.1), "rpf": ratio})
    assert decide_fit({"sir": Ratio(0.9, 0.8, 0.95)})  # the interval has 0.95
    lost = np.where(np.arange(20) < 15, np.inf, 0.5 * reference)
    assert compare_errors(lost, reference, 10.0).value > 1.0  # a lost run has the cap
    assert np.isfinite(compare_errors(lost, reference, 10.0))[0]


def test_the_best_filter_has_the_smallest_objective_with_capped_errors() -> None:
    errors = {
        "ekf": {"a": 2.0, "b": 4.0},
        "ukf": {"a": 1.0, "b": float("inf")},
        "gate_tuned": {"a": 2.0, "b": 2.0},
    }
    best, objectives = find_best(errors, cap=4.0)
    assert objectives == pytest.approx(
        {"ekf": 0.0, "ukf": np.log(0.5) / 2, "gate_tuned": np.log(0.5) / 2}
    )
    assert best == "ukf"  # the first of equal ones
    assert find_best(errors, cap=8.0)[0] == "gate_tuned"
    lost = {"ekf": {"a": float("inf")}, "ukf": {"a": 1.0}}
    assert find_best(lost, cap=2.0) == ("ukf", {"ekf": 0.0, "ukf": np.log(0.5)})
