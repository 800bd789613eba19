"""Line of a job: error with unit, and the status of its runs."""

import re
from typing import Any

import numpy as np
import pytest

from pfbench.results.paper_block import list_planned_pairs
from pfbench.results.status import describe_runs

RUNS, STEPS = 10, 20


def job_result(threshold: float | None = 50.0) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays = {
        "error": np.full((RUNS, STEPS, 3), 3.0),
        "nees": np.full((RUNS, STEPS, 1), 3.0),
        "lost": np.zeros(RUNS, dtype=bool),
        "health": np.zeros(RUNS, dtype=np.int8),
    }
    state = {
        "names": ["north", "east", "up"],
        "units": ["m"] * 3,
        "groups": {"position": [0, 1, 2]},
    }
    paper = {} if threshold is None else {"paper": {"divergence_threshold": threshold}}
    return arrays, {"state": state, "config": {"scenario": paper}}


@pytest.mark.parametrize(("limit", "end"), [(50.0, "track kept in 10 of 10 runs"), (None, "10 of 10 runs valid")])  # fmt: skip
def test_healthy_runs_keep_the_track(limit: float | None, end: str) -> None:
    assert describe_runs(*job_result(limit)) == f"position: median RMS error 5.196 m; {end}"


def test_a_job_that_diverged_says_so_with_the_limit() -> None:
    arrays, meta = job_result()
    arrays["error"][:] = 480.0
    assert re.match(r"position: no finite median RMS error; 10 of 10 runs diverged \(.*error above 50 m", describe_runs(arrays, meta))  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("lost", {"lost": np.arange(RUNS) < 2}),
        ("without truth", {"error": np.where(np.arange(RUNS) < 2, np.nan, 3.0)[:, None, None]}),
        ("collapsed", {"health": np.where(np.arange(RUNS) < 2, 2, 0)}),
        ("heavy-tailed", {"health": np.where(np.arange(RUNS) < 2, 5, 0)}),
        ("implausible", {"health": np.where(np.arange(RUNS) < 2, 6, 0)}),
        ("undefined", {"health": np.where(np.arange(RUNS) < 2, 7, 0)}),
        ("overconfident", {"nees": np.where(np.arange(RUNS) < 2, 40.0, 3.0)[:, None, None]}),
    ],
)
def test_each_kind_is_counted(kind: str, change: dict[str, np.ndarray]) -> None:
    arrays, meta = job_result()
    arrays |= {name: np.broadcast_to(value, arrays[name].shape) for name, value in change.items()}
    assert f"; 2 of 10 runs {kind}" in describe_runs(arrays, meta)


@pytest.mark.parametrize(
    ("value", "remedy"),
    [
        (5, "Unbounded weights: k-hat 0.93, at most 0.7 is reliable. Set a defensive_fraction"),
        (6, "more than 1000 standard deviations from every prediction. Check its unit"),
        (7, "is NaN for valid states, which count as impossible. Return -inf"),
    ],
)
def test_marks_of_the_filter_say_what_to_do(value: int, remedy: str) -> None:
    arrays, meta = job_result()
    arrays["health"][3] = value
    arrays["pareto_k"] = np.where(np.arange(RUNS) < 5, 0.93, np.nan)
    assert remedy in describe_runs(arrays, meta)
    arrays["lost"][3] = True
    assert remedy not in describe_runs(arrays, meta)


def test_several_kinds_are_listed_and_a_job_without_valid_runs_has_no_finite_error() -> None:
    arrays, meta = job_result()
    arrays["lost"][:3], arrays["error"][5] = True, 1e4
    assert "; 3 lost, 1 diverged of 10 runs" in describe_runs(arrays, meta)
    arrays["lost"][:] = True
    assert describe_runs(arrays, meta) == "position: no finite median RMS error; 10 of 10 runs lost"


BASELINES = {"new": ("sir", "ukf"), "sir": (), "ukf": ()}


def test_a_swept_setting_stays_the_same_within_a_pair() -> None:
    labels = [f"{name}[model.q={q}]" for name in ("new", "sir", "ukf") for q in (1.0, 5.0)]
    assert list_planned_pairs(labels, BASELINES) == [
        ("new[model.q=1.0]", "sir[model.q=1.0]"),
        ("new[model.q=1.0]", "ukf[model.q=1.0]"),
        ("new[model.q=5.0]", "sir[model.q=5.0]"),
        ("new[model.q=5.0]", "ukf[model.q=5.0]"),
    ]


def test_a_filter_without_the_setting_meets_each_value() -> None:
    labels = ["new[particles=100]", "new[particles=400]", "sir[particles=100]", "ukf"]
    assert list_planned_pairs(labels, BASELINES) == [
        ("new[particles=100]", "sir[particles=100]"),
        ("new[particles=100]", "ukf"),
        ("new[particles=400]", "ukf"),
    ]


def test_variants_of_a_proposed_method_meet_the_baseline() -> None:
    labels = ["new[stages.1.gain=2,mode=a]", "new[stages.1.gain=2,mode=b]", "sir"]
    assert list_planned_pairs(labels, BASELINES) == [(labels[0], "sir"), (labels[1], "sir")]


def test_each_proposed_method_meets_the_tuned_baselines_once() -> None:
    labels = ["new", "other", "sir", "ekf_tuned", "gate_tuned", "absent_tuned"]
    baselines = {"new": ("sir", "ekf_tuned"), "other": ("ukf",)}
    assert list_planned_pairs(labels, baselines, ["ekf_tuned", "gate_tuned"]) == [
        ("new", "sir"), ("new", "ekf_tuned"), ("new", "gate_tuned"), ("other", "ekf_tuned"), ("other", "gate_tuned"),
    ]  # fmt: skip
    assert list_planned_pairs(["sir", "ekf_tuned"], {}, ["ekf_tuned"]) == [("ekf_tuned", "sir")]


def test_without_a_proposed_method_the_reference_has_the_same_setting() -> None:
    labels = [f"{name}[q={q}]" for name in ("ckf", "sir", "ekf") for q in (1, 2)]
    assert list_planned_pairs(labels, {}) == [
        (f"{name}[q={q}]", f"ekf[q={q}]") for name in ("ckf", "sir") for q in (1, 2)
    ]
    assert len(list_planned_pairs(labels[:5], {})) == 10
    assert list_planned_pairs([f"mine[q={q}]" for q in range(6)], {}) == []
