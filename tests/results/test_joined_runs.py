"""Jobs of consecutive runs are one result; jobs with gaps, overlaps or other settings are not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_results
from refusals import check_refused
from synthetic_results import METHODS, VERSIONS

from pfbench.results import store
from pfbench.results.conditions import load_conditions
from pfbench.results.inputs import describe_older, list_changed, select_newest_inputs
from pfbench.results.joined_runs import find_consecutive_parts, read_joined


def write(folder: Path, key: str, first: int, runs: int, **changes: Any) -> Path:
    rng = np.random.default_rng(0)
    steps, error = 6, rng.normal(size=(100, 6, 1))[first : first + runs]
    state = {"names": ["x"], "units": ["m"], "groups": {"state": [0]}}
    config = {"runs": runs, "first_run": first, "filter": {"particles": 5}, **changes}
    meta = {
        "key": key, "study": folder.name, "label": "sir", "seed": 1, "steps": steps, "state": state,
        "choices": {"scenario": "walk", "noise": "nominal", "filter": "sir", "model": "walk"},
        "first_run": first, "runs": runs, "config": config, "memory": None,
        "versions": {"pfbench": "1", "commit": "a"}, "likelihoods_per_step": float(first),
        "seconds": {"world": 1.0, "filter": 2.0, "per_step": 0.5},
    }  # fmt: skip
    data = {
        "time": np.arange(steps, dtype=float), "error": error, "sd": np.ones_like(error),
        "nees": error**2, "log_evidence": error[:, 0, 0], "lost": error[:, 0, 0] > 2,
        "pcrb": np.full((steps, 1), 1.0 + first),
    }  # fmt: skip
    return store.write_result(folder / f"{key}.npz", meta, data)


def test_parts_give_the_result_of_one_job(tmp_path: Path) -> None:
    write(tmp_path / "one", "c" * 16, 0, 60)
    for key, first, runs in (("b", 20, 40), ("a", 0, 20)):
        write(tmp_path / "parts", key * 16, first, runs)
    (whole,), (parts,) = (load_conditions(name, tmp_path) for name in ("one", "parts"))
    (job,), (joined,) = whole.jobs, parts.jobs
    assert (joined.label, joined.meta["runs"], joined.meta["first_run"]) == ("sir", 60, 0)
    assert [path.stem[0] for path in joined.parts] == ["a", "b"]
    first, second = job.load(), joined.load()
    assert second.meta == joined.meta
    for name in ("time", "error", "sd", "nees", "log_evidence", "lost"):
        np.testing.assert_array_equal(first.data[name], second.data[name])
    assert second.data["pcrb"][0, 0] == pytest.approx(np.sqrt((20 * 1 + 40 * 21**2) / 60))
    assert joined.meta["seconds"] == {"world": 2.0, "filter": 4.0, "per_step": 1.0}
    assert joined.meta["likelihoods_per_step"] == pytest.approx(40 * 20 / 60)
    assert joined.meta["config"]["runs"] == 60


@pytest.mark.parametrize(
    ("first", "changes"),
    [(21, {}), (10, {}), (20, {"filter": {"particles": 6}}), (20, {"dtype": "float32"})],
)
def test_gaps_overlaps_and_other_settings_are_not_joined(
    tmp_path: Path, first: int, changes: dict[str, Any]
) -> None:
    write(tmp_path / "parts", "a" * 16, 0, 20)
    write(tmp_path / "parts", "b" * 16, first, 20, **changes)
    check_refused(
        [("must be equal in the condition", lambda: load_conditions("parts", tmp_path))],
        remedy=False,
    )
    (condition,) = load_conditions("parts", tmp_path, allow_mixed_versions=True)
    assert [job.meta["runs"] for job in condition.jobs] == [20, 20]


def test_settings_of_the_place_do_not_matter_and_keys_select(tmp_path: Path) -> None:
    write(tmp_path / "parts", "a" * 16, 0, 20, threads=1, until_decided={"max_hours": 1})
    write(tmp_path / "parts", "b" * 16, 20, 20, threads=2, until_decided={"max_hours": 2})
    (condition,) = load_conditions("parts", tmp_path)
    assert condition.jobs[0].meta["runs"] == 40
    (condition,) = load_conditions("parts", tmp_path, keys={"a" * 16})
    assert condition.jobs[0].meta["runs"] == 20
    items = [(job.path, job.meta) for job in condition.jobs]
    assert find_consecutive_parts(items) == [items]


def test_parts_with_other_times_are_refused(tmp_path: Path) -> None:
    paths = [write(tmp_path, "a" * 16, 0, 20), write(tmp_path, "b" * 16, 20, 20)]
    result = store.read_result(paths[1])
    store.write_result(paths[1], result.meta, {**result.data, "time": result.data["time"] + 1})
    check_refused(
        [(r"time must be equal in all parts of sir, got .* bbbb", lambda: read_joined(paths))],
        remedy=False,
    )


def result(
    label: str, day: int, files: dict[str, str] | None, folder: str = "a", **groups: dict[str, str]
) -> tuple[Path, dict[str, Any]]:
    """Metadata of a result of a day; None for files that an early version did not state."""
    inputs = {} if files is None else {"inputs": {"scenario": files, **groups}}
    config = {"scenario": {"folder": folder}, "noise": {}, "filter": label}
    choices = {"scenario": "user_log", "noise": "nominal", "model": "m", "filter": label}
    head = {"seed": 1, "first_run": 0, "runs": 4, "created": f"2026-01-{day:02d}"}
    meta = {"choices": choices, "config": config, "label": label, **head, **inputs}
    return Path(f"{label}{day}.npz"), meta


OLD, NEW = {"a/imu.csv": "1", "a/gnss.csv": "1"}, {"a/imu.csv": "2", "a/gnss.csv": "1"}
PARQUET = {"a/imu.parquet": "3", "a/gnss.csv": "1"}
OTHER = {"b/imu.csv": "9", "b/gnss.csv": "9"}


@pytest.mark.parametrize(
    ("items", "kept", "lacking"),
    [
        ([result("ekf", 1, OLD), result("ckf", 2, OLD)], ["ekf1", "ckf2"], []),
        ([result("ekf", 1, OLD), result("ckf", 2, NEW)], ["ckf2"], ["ekf"]),
        ([result("ckf", 2, NEW), result("ekf", 1, OLD)], ["ckf2"], ["ekf"]),
        # run again: nothing is lacking
        ([result("ekf", 1, OLD), result("ckf", 2, NEW), result("ekf", 3, NEW)], ["ckf2", "ekf3"], []),
        # a table of another kind
        ([result("ekf", 1, OLD), result("ckf", 2, PARQUET)], ["ckf2"], ["ekf"]),
        # another folder is another condition
        ([result("ekf", 1, OLD), result("ckf", 2, OTHER, "b")], ["ekf1", "ckf2"], []),
        # inputs were not stated
        ([result("ekf", 1, None), result("ckf", 2, NEW)], ["ckf2"], ["ekf"]),
        # code of a filter
        (
            [result("own", 1, OLD, filter={"code of f": "1"}), result("own", 2, OLD, filter={"code of f": "2"})],
            ["own2"],
            [],
        ),
        # code of a model, which all filters have
        (
            [result("own", 1, OLD, model={"code of m": "1"}), result("ekf", 2, OLD, model={"code of m": "2"})],
            ["ekf2"],
            ["own"],
        ),
    ],
)  # fmt: skip
def test_the_newest_inputs_of_a_condition_are_compared(
    items: list[tuple[Path, dict[str, Any]]], kept: list[str], lacking: list[str]
) -> None:
    compared, older = select_newest_inputs(items)
    assert [path.stem for path, _ in compared] == kept
    assert [one.label for one in older] == lacking


def test_changes_are_named_for_people() -> None:
    assert list_changed({"scenario": OLD}, {"scenario": NEW}) == ["imu.csv of a"]
    assert list_changed({}, {"filter": {"code of f": "1"}}) == ["code of f"]
    assert list_changed({"scenario": OLD}, {"scenario": OLD}) == []
    _, older = select_newest_inputs([result("ekf", 1, OLD), result("ckf", 2, PARQUET)])
    assert describe_older(older).startswith(
        "1 result is not compared, since imu.csv of a and imu.parquet of a have changed: ekf."
    )


def test_results_of_two_builds_of_one_version_are_refused(tmp_path: Path) -> None:
    """As of two wheels, which have no commit."""
    for method, build in zip(METHODS, ("sources 1", "sources 2"), strict=False):
        versions = {**VERSIONS, "commit": "", "build": build}
        synthetic_results.write(tmp_path / "s", method, runs=12, steps=10, versions=versions)
    with pytest.raises(ValueError, match=r"versions.build must be equal in the study"):
        load_conditions("s", tmp_path)
    assert load_conditions("s", tmp_path, allow_mixed_versions=True)
