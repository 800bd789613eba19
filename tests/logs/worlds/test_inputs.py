"""A job's key and its result name every byte that the job reads: a changed file is another job."""

import logging
import os
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from recorded_data import DATA, recorded
from refusals import check_refused
from synthetic_log import tables, write

from pfbench import job
from pfbench.files.atomic_write import hash_file
from pfbench.files.limits import LimitError
from pfbench.job.inputs import check_unchanged, describe_unnamed_files, find_inputs
from pfbench.job.plan import build_plan
from pfbench.job.replay import StoredRun, recompute_run
from pfbench.report.study_report import write_report
from pfbench.results.conditions import load_conditions
from pfbench.results.paper_block import list_named_parts, read_part
from pfbench.results.store import list_failures, read_result

OF_FILES = (
    "recorded_berlin", "recorded_boreas", "recorded_car_drive", "recorded_fixed_wing", "recorded_fixed_wing_aided",
    "recorded_quad_flights", "recorded_walk", "terrain_fixed_wing", "anshun_real_orbits",
)  # fmt: skip


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A user's log in `data`."""
    return write(tmp_path / "data" / "my_log", tables(5.0))


def compose(folder: Path, *words: str) -> job.JobConfig:
    """A job of the log, with results in the folder."""
    origin = "scenario.origin=[40.0,-105.0,1500.0]"
    places = (f"data.root={folder}/data", f"results_dir={folder}/results", f"reports_dir={folder}")
    named = ("scenario=user_log", "scenario.folder=my_log", "study=mine", "runs=3", origin)
    return job.compose([*named, "filter=ekf", *places, *words])


def mend(file: Path) -> None:
    """Change a number that leaves the log valid."""
    table = pd.read_csv(file)
    table.iloc[-1, -1] += 1e-6
    table.to_csv(file, index=False)


def spoil(source: Path, target: Path, named: set[Path]) -> None:
    """Copy data sets with nonsense in all files that are not named."""
    for file in source.glob("*/*"):
        copy = target / file.relative_to(source)
        copy.parent.mkdir(exist_ok=True)
        # no links, which may not leave the folder
        copy.write_bytes(file.read_bytes() if file in named else b"not a table")


@recorded
@pytest.mark.parametrize(
    "words", [*((f"scenario={name}",) for name in OF_FILES), ("scenario=growth", "noise=replay")]
)
def test_a_shipped_job_reads_no_file_that_it_does_not_name(
    words: tuple[str, ...], tmp_path: Path
) -> None:
    """With nonsense in every other file of all data sets the episode is the same."""
    assert DATA is not None
    simulated = words[0].endswith(("boreas", "orbits"))
    coarse = ("scenario.imu_rate_hz=2",) if simulated else ()  # seconds instead of a minute
    base = (*words, *coarse, "runs=1", "filter=ekf", "episode_cache_dir=null")
    plans = [build_plan(job.compose([*base, f"data.root={DATA}"]))]
    found = find_inputs(plans[0].values)
    names = {name for group in found.values() for name in group}
    assert names
    spoil(Path(DATA), tmp_path, {Path(DATA) / name for name in names})
    plans += [build_plan(job.compose([*base, f"data.root={tmp_path}"]))]
    assert find_inputs(plans[1].values) == found
    assert job.job_key(plans[1].values) == job.job_key(plans[0].values)  # wherever the data are
    first, second = (plan.draw_episode(torch.arange(1)).record.y for plan in plans)
    torch.testing.assert_close(first, second, rtol=0, atol=0, equal_nan=True)


def test_every_shipped_scenario_with_a_data_folder_is_among_them() -> None:
    listed = {*OF_FILES, "user_log", "user_raw_log", "user_ins_log"}
    for name in list_named_parts("scenario"):
        assert ("${data.root}" in read_part("scenario", name)) == (name in listed), name


@pytest.mark.parametrize("name", ["imu", "gnss", "reference"])
def test_a_changed_table_is_another_job_of_the_same_settings(log: Path, name: str) -> None:
    home = log.parents[1]
    key = job.job_key(compose(home).values)
    os.utime(log / f"{name}.csv")
    assert job.job_key(compose(home).values) == key
    mend(log / f"{name}.csv")
    changed = job.job_key(compose(home).values)
    assert changed != key
    assert changed[:8] == key[:8]
    simulated = job.compose(["scenario=growth", "filter=ekf"])
    assert find_inputs(simulated.values) == {}


def test_a_composed_name_reads_nothing_outside_the_data(log: Path) -> None:
    """A file of a stranger must not write `..`, but it may compose it: the reader refuses it."""
    home = log.parents[1]
    folder = home / "conf" / "experiment"
    folder.mkdir(parents=True)
    for name, said in (("${d}${d}/secret", r"\.\./secret"), ("${d}${d}/${d}${d}/secret", r"\.\./\.\./secret")):  # fmt: skip
        text = f"# @package _global_\nd: .\nscenario: {{files: {{imu: '{name}'}}}}\n"
        (folder / "a.yaml").write_text(text)
        words = (f"hydra.searchpath=[file://{folder.parent}]", "+experiment=a")
        with pytest.raises(LimitError, match=said):
            job.job_key(compose(home, *words).values)


def test_a_digest_sees_a_change_that_keeps_size_and_time(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("t,x\n1,2\n")
    before, state = hash_file(file), file.stat()
    file.write_text("t,x\n1,3\n")
    os.utime(file, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert hash_file(file) != before


def test_results_of_a_mended_log_are_not_compared_with_those_before(
    log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    home = log.parents[1]
    caplog.set_level(logging.INFO, "pfbench")
    ekf = compose(home)
    first = job.run(ekf).path
    assert read_result(first).meta["inputs"]["scenario"].keys() == {
        f"my_log/{name}.csv" for name in ("imu", "gnss", "reference")
    }
    assert job.run(ekf).status == "skipped"
    mend(log / "imu.csv")
    job.run(compose(home, "filter=ckf"))
    page = write_report("mine", home / "results", home / "reports")
    said = "1 result is not compared, since imu.csv of my_log has changed: ekf. Run the jobs again"
    assert said in caplog.text
    text = (page.parent / "report.md").read_text().replace("\\", "")
    assert said in text
    assert "| EKF |" not in text
    caplog.clear()
    assert job.run(ekf).status == "finished"
    assert "imu.csv of my_log has changed since the result of 2" in caplog.text
    (condition,) = load_conditions("mine", home / "results")
    assert [one.label for one in condition.jobs] == ["ckf", "ekf"]
    assert condition.older == ""
    assert first.exists()
    (stored,) = (one for one in condition.jobs if one.label == "ekf")
    mend(log / "gnss.csv")
    run = StoredRun(condition, stored, 0, stored.load())
    check_refused(
        [(r"gnss.csv of my_log must be as it was when the result", lambda: recompute_run(run, {}))],
        remedy=False,
    )


def test_a_failure_of_earlier_inputs_is_forgotten_when_the_job_finishes(log: Path) -> None:
    home, whole = log.parents[1], (log / "gnss.csv").read_text()
    (log / "gnss.csv").write_text("t\n1\n")
    check_refused([(r"gnss.csv", lambda: job.run(compose(home), counter="[1/2] "))], remedy=False)
    assert len(list_failures(home / "results" / "mine")) == 1
    (log / "gnss.csv").write_text(whole)
    job.run(compose(home), counter="[1/2] ")
    assert list_failures(home / "results" / "mine") == []


def test_a_file_that_changes_while_the_job_reads_it_is_refused(log: Path) -> None:
    config = compose(log.parents[1])
    before = find_inputs(config.values)
    check_unchanged(before, config.values)
    mend(log / "imu.csv")
    check_refused(
        [
            (
                r"imu.csv of my_log must not change while a job reads it",
                lambda: check_unchanged(before, config.values),
            )
        ],
        remedy=False,
    )


# a user's own classes

OWN = """
class World:
    def __init__(self, file):
        self.file = file
{method}
"""
METHOD = """
    def input_files(self):
        return [self.file]
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module of a user, and a file that it reads."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "map.txt").write_text("a map")
    (tmp_path / "inputlab.py").write_text(OWN.format(method=METHOD))
    (tmp_path / "inputlab_bare.py").write_text(OWN.format(method=""))
    return tmp_path


def test_a_users_class_names_its_files_and_its_code_is_an_input(own: Path) -> None:
    node: dict[str, Any] = {"_target_": "inputlab.World", "file": str(own / "map.txt")}
    assert find_inputs({"scenario": node}).keys() == {"scenario"}  # its code, which is not run
    found = find_inputs({"scenario": node}, ["inputlab"])["scenario"]
    assert found.keys() == {f"{own.name}/map.txt", "code of inputlab", "values of inputlab.World"}
    assert describe_unnamed_files(node, ["inputlab"]) == ()
    bare = {**node, "_target_": "inputlab_bare.World"}
    (note,) = describe_unnamed_files(bare, ["inputlab_bare"])
    assert note.startswith("inputlab_bare.World has no method input_files")
    check_refused(
        [
            (
                r"input_files of inputlab.World must return files, got",
                lambda: find_inputs({"scenario": {**node, "file": str(own)}}, ["inputlab"]),
            )
        ],
        remedy=False,
    )
