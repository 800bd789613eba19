"""Results of other data are never compared: of each condition those of the newest inputs are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import synthetic_results
from synthetic_results import METHODS, VERSIONS

from pfbench.results.conditions import load_conditions
from pfbench.results.inputs import describe_older, list_changed, select_newest_inputs


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
