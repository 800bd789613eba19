"""`runs=until-decided`: the decisions of the joined table, resumed after a stop, ended by its caps."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command_line import Said, pfbench

import pfbench as package
from pfbench.report.board.entries import build_run_table
from pfbench.results import store
from pfbench.results.conditions import load_conditions
from pfbench.stats.pair_states import LookSchedule, decide_at_looks, describe_pair
from pfbench.stats.study_runs import arrange_runs

STUDY = ("scenario=linear_walk", "scenario.steps=12", "particles=60", "pcrb=false", "score_steps=0")
SWEEP = ("run", "-m", *STUDY, "filter=ekf,sir,rpf")
GROWING = (*SWEEP, "study=growing", "runs=until-decided", "until_decided.max_runs=40")
PAIRS = [("ekf", "rpf"), ("ekf", "sir"), ("rpf", "sir")]


def results(home: Path, study: str = "growing") -> dict[Path, int]:
    return {file: file.stat().st_mtime_ns for file in (home / "results" / study).glob("*.npz")}


def lines(said: Said) -> list[str]:
    assert said.code == 0, said.err
    return [line for line in said.out.splitlines() if re.match("look|study|stopped|plan", line)]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("until_decided")


@pytest.fixture(scope="module")
def said(home: Path) -> Said:
    return pfbench(*GROWING, home=home)


def test_looks_decide_as_one_study_of_all_runs(home: Path, said: Said) -> None:
    """The frame of the parts is that of one job, and each look has the decisions of its first runs."""
    first, second, end = lines(said)
    assert first.startswith("look 1, 20 runs: ")
    assert second.startswith("look 2, 40 runs: ")
    assert re.match(r"study growing is finished: \d of 3 pairs are open after max_runs=40", end)
    assert len(results(home)) == 6
    assert pfbench(*SWEEP, "study=fixed", "runs=40", home=home).code == 0
    grown, fixed = (package.load(name, home / "results") for name in ("growing", "fixed"))
    columns = ["label", "run", "group", "component", "metric", "value"]
    left, right = (
        frame[frame.metric == "rmse"][columns].sort_values(columns[:-1]).reset_index(drop=True)
        for frame in (grown, fixed)
    )
    assert left[columns[:-1]].equals(right[columns[:-1]])
    np.testing.assert_allclose(left["value"], right["value"], rtol=1e-9)
    table = build_run_table(load_conditions("fixed", home / "results"))
    runs = arrange_runs(table, sorted(set(table["filter"])))
    for line, count in ((first, 20), (second, 40)):
        early = runs._replace(
            present=runs.present[..., :count], keeps=runs.keeps[..., :count],
            values={name: value[..., :count] for name, value in runs.values.items()},
        )  # fmt: skip
        states = decide_at_looks(early, PAIRS, LookSchedule(40))
        open_pairs = [state for state in states if state.word == "not decided"]
        assert f"{3 - len(open_pairs)} of 3 pairs decided" in line
        for state in open_pairs:
            assert describe_pair(state) in line


def test_the_metric_of_the_report_is_fixed_at_the_first_look(home: Path, said: Said) -> None:
    refused = pfbench(*GROWING, "report.metric=max_error", home=home)
    assert refused.code == 2
    assert "report.metric must be rmse, as at the first look of this study" in refused.err


def test_a_finished_study_says_so(home: Path, said: Said) -> None:
    before = results(home)
    again = pfbench(*GROWING, home=home)
    assert lines(again) == lines(said)
    assert "skipped" not in again.out
    assert results(home) == before


def test_a_stopped_study_goes_on_at_its_look(tmp_path: Path, home: Path, said: Said) -> None:
    """The cap in time ends it after look 1; then a part is lost as by a kill, and the rest remains."""
    stopped = lines(pfbench(*GROWING, "until_decided.max_hours=1e-9", home=tmp_path))
    assert stopped[0] == lines(said)[0]
    assert stopped[1].startswith("stopped before look 2: 40 runs would need ")
    before = results(tmp_path)
    assert len(before) == 3
    lost, *others = before
    lost.unlink()
    assert lines(pfbench(*GROWING, home=tmp_path)) == lines(said)
    after = results(tmp_path)
    assert {file: after[file] for file in others} == {file: before[file] for file in others}
    assert [file.name for file in sorted(after)] == [file.name for file in sorted(results(home))]


def test_a_damaged_part_is_computed_again(home: Path, said: Said) -> None:
    broken = min(results(home))
    error = store.read_result(broken).data["error"]
    broken.write_bytes(broken.read_bytes()[:-200])
    (home / "results" / "growing" / "looks.json").unlink()
    assert lines(pfbench(*GROWING, home=home)) == lines(said)
    np.testing.assert_array_equal(store.read_result(broken).data["error"], error)


def copy_runs(folder: Path, target: int) -> None:
    """Write the arrays of the first runs of each filter over those of its part that begins at a run."""
    parts = {}
    for file in folder.glob("*.npz"):
        result = store.read_result(file)
        parts[result.meta["label"], result.meta["first_run"]] = file, result
    for (label, first), (file, result) in parts.items():
        if first == target:
            file.unlink()
            store.write_result(file, result.meta, parts[label, 0][1].data)


def test_copies_of_runs_are_not_counted(
    home: Path, said: Said, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Twenty runs that are stored twice decide as twenty, in the look and in a loaded table."""
    shutil.copytree(home / "results", tmp_path / "results")
    folder = tmp_path / "results" / "growing"
    (folder / "looks.json").unlink()
    copy_runs(folder, 20)
    sentence = "20 runs have the errors of another run (run 1 20 is equal to run 1 0)"
    first, second, _ = lines(pfbench(*GROWING, home=tmp_path))
    assert first == lines(said)[0]
    assert sentence in second
    assert [re.findall(r"ratio [^)]+", line) for line in (first, second)] == [
        re.findall(r"ratio [^)]+", first)
    ] * 2
    table = package.load("growing", tmp_path / "results")
    assert sentence in caplog.text
    assert sorted(table.run.unique()) == list(range(20))
    full = package.load("growing", home / "results")
    columns = ["label", "run", "group", "component", "metric"]
    expected = full[full.run < 20].sort_values(columns).reset_index(drop=True)
    found = table.sort_values(columns).reset_index(drop=True)
    assert found.equals(expected)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("until_decided.max_runs=80",), "until_decided.max_runs must be 40, as at the first look"),
        (("particles=61",), "jobs must be "),
        (("until_decided.max_hours=0",), "until_decided.max_hours must be positive or null, got 0"),
        (("budget=time",), "budget must be particles with runs=until-decided"),
        (("study=one", "filter=ekf"), "filter must be at least two filters"),
    ],
)
def test_invalid_requests(home: Path, said: Said, words: tuple[str, ...], message: str) -> None:
    refused = pfbench(*GROWING, *words, home=home)
    assert refused.code == 2
    assert message in refused.err


def test_one_job_cannot_be_decided(tmp_path: Path) -> None:
    refused = pfbench("run", *STUDY, "filter=ekf", "runs=until-decided", home=tmp_path)
    assert refused.code == 2
    assert "must be a sweep over at least two filters" in refused.err


def test_a_study_says_before_it_runs_what_it_can_show(tmp_path: Path) -> None:
    few = pfbench("run", *STUDY, "filter=ekf", "runs=5", home=tmp_path)
    assert few.out.startswith("plan: 5 runs can show nothing")
    more = pfbench(*SWEEP, "runs=10", "scenario=linear_walk,growth", home=tmp_path)
    assert re.match(r"plan: 10 runs and 2 worlds can show .* \(3 pairs of filters", more.out)
