"""Single runs, sweeps and notes of the page, from invented results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic_results as synthetic

from pfbench.report import provenance
from pfbench.report.board.curves import select_telling_runs
from pfbench.report.board.entries import describe_uncommitted
from pfbench.report.board.pack import build_pack, join_notes, note_job, select_baselines
from pfbench.report.methods_text import write_methods
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import Condition, JobFile, load_conditions
from pfbench.results.looks import find_looks
from pfbench.results.store import JobResult


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    synthetic.study(folder / "demo", runs=12, steps=50)
    return folder


def test_telling_runs_come_in_turn() -> None:
    level = np.array([3.0, 1.0, 2.0, 8.0, 2.5, 2.2, 2.4])
    errors = np.exp([level, level])
    errors[1, 5] *= 4  # the largest disagreement
    errors[0, 0] = np.nan  # the filter is lost
    runs = select_telling_runs(errors, 4)
    assert runs[1:] == [0, 1, 5]
    assert runs[0] in (2, 4, 6)
    assert sorted(select_telling_runs(errors, 50)) == list(range(7))
    assert select_telling_runs(np.full((2, 3), np.nan), 2) == [0, 1]


def test_tracks_are_those_of_the_results(results: Path) -> None:
    (first, *_) = conditions = load_conditions("demo", results)
    pack = build_pack("demo", conditions, ReportOptions())
    entry = pack["tracks"][first.scenario, first.noise]
    assert len(entry["t"]) == 40
    assert entry["note"] == "40 of 50 instants."
    assert sorted(entry["numbers"]) == list(range(12))
    for job in first.jobs:
        data, names = job.load().data, job.meta["state"]["names"]
        steps = [int(np.argmin(np.abs(data["time"] - t))) for t in entry["t"]]
        places = [names.index(f"position_{axis}") for axis in "ENU"]
        for run in (0, 5, 11):
            if data["lost"][run]:
                assert np.isnan(entry["error"][job.label][str(run)]).all()
                continue
            error = data["error"][run][steps][:, places].astype(float)
            norm = np.linalg.norm(error, axis=-1)
            np.testing.assert_allclose(entry["error"][job.label][str(run)], norm, rtol=1e-6)
            if "plane" in entry:
                np.testing.assert_allclose(entry["plane"][job.label][str(run)], error[:, :2])


def test_a_study_of_a_setting_has_a_sweep(tmp_path: Path) -> None:
    for particles in (50, 100, 200):
        method = synthetic.Method("sir", 1 + 50 / particles, 0.9, particles)
        synthetic.write(tmp_path / "dose", method, runs=12, steps=9)
    synthetic.write(tmp_path / "dose", synthetic.METHODS[0], runs=12, steps=9)
    pack = build_pack("dose", load_conditions("dose", tmp_path), ReportOptions())
    (sweep,) = pack["sweeps"]
    lines = {line["name"]: line["points"] for line in sweep["lines"]}
    assert [point["x"] for point in lines["SIR"]] == [50, 100, 200]
    assert [point["x"] for point in lines["EKF"]] == [50, 200]
    rows = next(view for key, view in pack["views"].items() if key[:3] == ("rmse", sweep["world"], sweep["regime"]))["rows"]  # fmt: skip
    values = {row["filter"]: row["value"] for row in rows}
    assert [point["value"] for point in lines["SIR"]] == [values[f"sir[particles={n}]"] for n in (50, 100, 200)]  # fmt: skip


def test_notes_state_exactness_failures_and_choices(results: Path) -> None:
    conditions = load_conditions("demo", results)
    pack = build_pack("demo", conditions, ReportOptions())
    notes = {note["filter"]: note for note in pack["filter_notes"]}
    for label, note in notes.items():
        jobs = [job for c in conditions for job in c.jobs if job.label == label]
        assert note["runs"] == sum(job.meta["runs"] for job in jobs)
        assert note["lost"] == sum(int(job.load().data["lost"].sum()) for job in jobs)
        assert note["particles"] in ("200", "")
        assert note["is_exact"] == all(bool(job.meta.get("is_exact")) for job in jobs)
        assert note["has_bounded_weights"] is None  # results that do not state it
    (choice,) = pack["choices"]
    assert choice["text"].startswith("initial heading error")
    assert choice["filters"] == "all filters"


def test_weights_are_bounded_if_every_job_states_it(results: Path) -> None:
    job = load_conditions("demo", results)[0].jobs[0].load()
    for stated, common in (((True, True), True), ((True, False), False), ((False, None), None)):
        metas = [{**job.meta, "has_bounded_weights": value} for value in stated]
        (note,) = join_notes([note_job("sir", JobResult(meta, job.data)) for meta in metas])
        assert note["has_bounded_weights"] is common


@pytest.mark.parametrize("alpha", [0.05, 0.2])
def test_the_level_of_a_report_is_that_of_its_option(results: Path, alpha: float) -> None:
    pack = build_pack("demo", load_conditions("demo", results), ReportOptions(alpha=alpha))
    level = f"{100 * (1 - alpha):g} %"
    for view in pack["views"].values():
        assert f"with simultaneous {level} intervals" in view["small_print"]
    assert level in write_methods(pack)[0]


def test_one_baseline_measures_all_filters(results: Path) -> None:
    conditions = load_conditions("demo", results)
    labels = ["sir", "ekf", "ckf", "ekf_scaled_tuned"]
    assert select_baselines(find_looks(labels))[:2] == ["ekf_scaled_tuned", "ekf"]
    assert select_baselines(find_looks(["sir", "ckf", "ekf"]))[0] == "ekf"
    assert select_baselines(find_looks(["sir", "ckf"]))[0] == "sir"
    for baseline in ("", "ukf"):
        pack = build_pack("demo", conditions, ReportOptions(baseline=baseline))
        view = next(iter(pack["views"]))
        assert view.baseline == (baseline or "ekf")
    with pytest.raises(
        ValueError, match=r"report\.baseline must be a filter of the study, got apf"
    ):
        build_pack("demo", conditions, ReportOptions(baseline="apf"))
    missing = {entry["key"]: entry["reason_missing"] for entry in pack["budgets"]}
    assert missing["particles"] is None
    assert missing["time"] == "The study has no jobs with budget=time."


def test_the_baseline_of_a_page_does_not_depend_on_its_results(tmp_path: Path) -> None:
    """It is that of the labels, also if it is the worst filter or lost all runs."""
    others = synthetic.METHODS[1:]
    first = synthetic.METHODS[0]
    doomed = (
        first._replace(size=0.01),
        first._replace(size=500.0),
        first._replace(lost=tuple(range(12))),
    )
    for k, ekf in enumerate(doomed):
        synthetic.study(tmp_path / f"study_{k}", runs=12, steps=10, methods=(ekf, *others))
        conditions = load_conditions(f"study_{k}", tmp_path)
        pack = build_pack(f"study_{k}", conditions, ReportOptions())
        assert pack["baselines"] == ["ekf", "sir", "ukf"]
        assert {key.baseline for key in pack["views"]} == {"ekf", "sir", "ukf"}
        assert next(iter(pack["views"])).baseline == "ekf"


def test_a_page_says_that_jobs_are_of_uncommitted_code() -> None:
    metadata = [{"versions": {"commit": commit}} for commit in ("0123abc", "0123abc-dirty", "")]
    metadata[2]["versions"]["build"] = "sources 89ef"
    builds = provenance.list_builds(metadata)
    assert builds == ["0123abc", "0123abc with uncommitted changes", "sources 89ef"]
    assert provenance.name_build(builds[0]) == "commit 0123abc"
    assert provenance.name_build(builds[2]) == "sources 89ef"
    jobs = tuple(JobFile(Path("a"), "a", meta) for meta in metadata)
    condition = Condition("s", "n", "m", jobs)
    assert describe_uncommitted([condition]) == "1 of 3 jobs are of uncommitted code."
    assert describe_uncommitted([condition._replace(jobs=jobs[:1])]) == ""
