"""The harness of faults in a short form, its power against planted faults, and the page of its counts."""

import errno
import importlib
import json
import os
import random
import re
import signal
import stat
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any

import pytest
import torch
import yaml
from checkout import ROOT

from faults import (
    clock,
    damage,
    folders,
    hostile,
    kills,
    main,
    numeric_cases,
    numerics,
    page,
    parallel,
    readers,
    storage,
)
from faults.sweeps import new_home, run_jobs, undisturbed
from faults.tally import BAD, FINE, Tally
from pfbench.filter.loop import FilterResult
from pfbench.job import shared_loader
from pfbench.results import store

SHORT = 25  # files of each kind


def assert_fine(tally: Tally, trials: int) -> None:
    if tally.skipped:
        pytest.skip(tally.skipped)
    assert tally.bad == {}, tally.examples
    assert tally.trials >= trials


# short form


def test_killed_sweeps_lose_nothing() -> None:
    assert_fine(kills.run(2, 3), 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", storage.FAULTS)
def test_storage_that_refuses_is_named_and_costs_nothing(name: str) -> None:
    assert_fine(storage.run(name, 1, 2), 1)


@pytest.mark.slow
def test_clocks_that_jump_change_nothing() -> None:
    assert_fine(clock.run(1, 1), 1)


@pytest.mark.slow
def test_sweeps_at_the_same_time_agree() -> None:
    assert_fine(parallel.run(1, 1), 1)


@pytest.mark.parametrize("kind", damage.KINDS)
def test_damaged_files_are_not_read_as_others(kind: str) -> None:
    assert_fine(damage.run(kind, SHORT, 7), SHORT)


def test_hostile_files_run_no_code() -> None:
    undisturbed()
    assert_fine(hostile.run(1, 0), 1)


def test_hostile_folders_are_checked_by_what_hydra_loads() -> None:
    assert_fine(folders.run(2 * len(folders.KINDS), 0), 2 * len(folders.KINDS))


def test_a_kalman_filter_survives_extreme_numbers() -> None:
    number = numerics.filters_of("eager").index("ckf")
    assert_fine(numerics.run("eager", 0, number), len(numeric_cases.CASES) * numeric_cases.RUNS)
    assert len(numeric_cases.CASES) >= 30


# planted faults


def write_in_place(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    with path.open("xb") as file:
        fill(file)


def test_a_writer_that_is_not_atomic_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    undisturbed()
    monkeypatch.setattr(store, "write_atomically", write_in_place)
    monkeypatch.setattr(kills, "MODES", ("byte",))
    rng, outcomes = random.Random(1), []
    while "lost" not in outcomes and len(outcomes) < 6:
        with new_home() as home:
            outcomes.append(kills.try_kills(home, run_jobs, 1, 3.0, rng)[1][0])
    assert outcomes[-1] == "lost"


def test_a_missing_digest_check_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pfbench.experiments.study_parts.has_valid_digest", lambda _: True)
    assert damage.run("resumable parts", 4 * SHORT, 7).counts["false"] > 0


def test_a_raw_message_of_the_system_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("pfbench.cli.main")  # the door has a function of this name
    monkeypatch.setattr(module, "format_error", lambda error, words: f"{error}")
    tally = storage.run("limit of the file size", 3, 2)
    assert tally.counts["unclear"] > 0


def test_a_file_that_a_configuration_makes_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_code(words: Sequence[str]) -> None:
        (folder,) = (re.search("file://(.*)/conf", word) for word in words if "searchpath" in word)
        Path(folder[1] if folder else "", "new").touch()

    monkeypatch.setattr("pfbench.cli.run.check_words", run_code)
    words = ("noise", hostile.text_of(hostile.NODES["path_write"]), "run")
    assert hostile.attempt(*words)[0] == "code run"


def plant_no_check(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("check_content", "check_defaults", "check_group", "check_place", "check_composed"):
        monkeypatch.setattr(f"pfbench.job.shared_loader.{name}", lambda *_, **__: None)
    monkeypatch.setattr(folders, "LIMIT_S", 2)  # of a sweep that has no end


def plant_follows_links(monkeypatch: pytest.MonkeyPatch) -> None:
    def is_kind(root: Path, name: str, kind: int) -> bool:
        return (root / name).exists() and stat.S_IFMT((root / name).stat().st_mode) == kind

    monkeypatch.setattr("pfbench.job.search_folders._is_kind", is_kind)
    monkeypatch.setattr("os.O_NOFOLLOW", 0)


def plant_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folders, "LIMIT_S", 0.001)


def plant_shadows(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(self: Any, config_path: str) -> Any:
        return next((s for s in self.delegate.sources if s.is_config(config_path)), None)

    monkeypatch.setattr("pfbench.job.shared_loader._SharedRepository._find_source", find)


def plant_python_tags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omegaconf._utils.get_yaml_loader", lambda: yaml.UnsafeLoader)


HOLES: dict[Callable[[pytest.MonkeyPatch], None], tuple[str, ...]] = {
    plant_no_check: (
        "headers", "several_headers", "late_headers", "defaults", "packages", "interpolations", "config_dir", "search_path",
        "sweeps", "aliases", "names", "experiments", "groups_of_hydra", "data",
    ),
    plant_follows_links: ("links",),
    plant_waits: ("large", "pipes"),
    plant_shadows: ("same_names",),
    plant_python_tags: ("tags",),
}  # fmt: skip


def test_each_kind_of_folder_finds_a_planted_hole(monkeypatch: pytest.MonkeyPatch) -> None:
    assert sorted(kind for kinds in HOLES.values() for kind in kinds) == sorted(folders.KINDS)
    for plant, kinds in HOLES.items():
        for kind in kinds:
            with monkeypatch.context() as patch:
                plant(patch)
                shared_loader._kept.clear()
                found = (folders.attempt(kind, seed)[0] for seed in range(60))
                assert any(outcome in BAD for outcome in found), kind
    shared_loader._kept.clear()


def test_a_crash_is_counted_and_the_next_case_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    def die() -> Any:
        os.kill(os.getpid(), signal.SIGKILL)

    names = ("outlier of 1e6 sd", "H of zero")
    cases = {"dies": numeric_cases.Extreme(die)} | {n: numeric_cases.CASES[n] for n in names}
    monkeypatch.setattr(numerics, "CASES", cases)
    tally = Tally("planted")
    numerics.run_filter_cases("ckf", "eager", tally)
    assert tally.counts == {"crash": numeric_cases.RUNS, FINE: 2 * numeric_cases.RUNS}


def test_false_estimates_are_told_from_sane_ones() -> None:
    case, bound = numeric_cases.CASES["dead sensor"], -3.0
    mean, variance = torch.zeros(1, 2, 2), torch.ones(1, 2, 2)
    evidence = torch.tensor([-4.0])

    def outcome(marked: bool = False, certain: bool = False, **changes: torch.Tensor) -> str:
        result = FilterResult(
            mean, variance, evidence, {}, torch.zeros(1, dtype=torch.int8), torch.zeros(1)
        )._replace(**changes)
        return numerics.class_of(result, 0, marked, bound, case._replace(is_certain=certain))[0]

    assert outcome() == FINE
    assert outcome(variance=0.0 * variance) == "false"
    assert outcome(variance=0.0 * variance, marked=True) == FINE
    assert outcome(variance=0.0 * variance, certain=True) == FINE
    assert outcome(mean=mean * torch.nan) == "false"
    assert outcome(log_evidence=evidence + 2.0) == "false"
    assert numerics.classify_error(ValueError("r must be positive"))[0] == FINE
    assert numerics.classify_error(RuntimeError("r must be positive"))[0] == "unclear"
    assert numerics.classify_error(ValueError("bad"))[0] == "unclear"


def test_marks_are_those_of_the_health_where_the_result_has_one() -> None:
    class Health:
        lost = torch.tensor([True, False, False])
        health = torch.tensor([1, 0, 4])

    assert numerics.marked_runs(Health()) == [True, False, True]  # type: ignore[arg-type]


# the table


def test_batches_are_run_once_and_joined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def run(count: int, seed: int) -> Tally:
        calls.append((count, seed))
        tally = Tally("planted")
        for number in range(count):
            tally.add("lost" if (seed, number) == (1, 0) else FINE, "tried", "why")
        return tally

    monkeypatch.setattr(main, "STORE", tmp_path)
    monkeypatch.setattr(main, "CLASSES", {"planted": main.FaultClass(run, 5, 2)})
    main.run_class("planted")
    main.run_class("planted")
    assert calls == [(2, 0), (2, 1), (1, 2)]
    row = main.collect("planted")
    assert row["counts"] == {FINE: 4, "lost": 1}
    cells = page.format_row(row)
    assert cells[:3] == ["planted", "5", "1"]
    assert page.format_row({**row, "required": 9})[1] == "5 of 9"
    empty = {**row, "counts": {}, "skipped": "not installed"}
    assert page.format_row(empty)[1:3] == ["not installed", "–"]


def test_the_page_states_the_stored_counts() -> None:
    rows = json.loads(page.DATA.read_text())
    assert [row["name"] for row in rows] == list(main.CLASSES)
    text = page.PAGE.read_text()
    assert page.fill_page(text, rows) == text
    assert all(f"**{name}**" in text for name in BAD)


def git(*words: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else ""


@pytest.mark.skipif(
    git("rev-parse", "--is-shallow-repository") != "false", reason="needs the history of git"
)
def test_each_commit_of_the_page_is_in_the_history() -> None:
    commits = {commit for row in json.loads(page.DATA.read_text()) for commit in row["commits"]}
    assert commits
    assert [commit for commit in sorted(commits) if not page.is_in_history(commit)] == []
    assert set(re.findall(r"`([0-9a-f]{10}\+?)`", page.PAGE.read_text())) == commits
    assert not page.is_in_history("0123456789")


def test_a_commit_that_is_not_in_the_history_is_not_written(tmp_path: Path) -> None:
    rows = [planted_row("planted", "tried") | {"commits": ["0123456789", "0123456789+"]}]
    (tmp_path / "page.md").write_text(page.format_block([]))
    page.write_table(rows, tmp_path / "page.md", tmp_path / "data.json")
    assert json.loads((tmp_path / "data.json").read_text())[0]["commits"] == []
    assert "| 2026-01-01 | – |" in (tmp_path / "page.md").read_text()


def planted_row(name: str, remark: str) -> dict[str, Any]:
    tally = Tally(name)
    tally.add("false", remark)
    return tally.to_dict() | {"required": 1, "date": "2026-01-01", "commits": []}


def test_false_trials_of_a_reader_have_a_reason_or_say_that_there_is_none() -> None:
    every_row = readers.load_mutations().EVERY_ROW
    block = page.format_block(
        [
            planted_row("damaged logs: trajectory", f"{every_row}: pd"),
            planted_row("damaged logs: urban", f"{every_row}: v_fwd"),
        ]
    )
    assert "- damaged logs: trajectory, `pd` changed in all rows: 1. The drive is level" in block
    assert "`v_fwd` changed in all rows: 1. The cause is not known." in block


def test_the_short_form_runs_each_class_and_fails_with_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(outcome: str, count: int, seed: int) -> Tally:
        tally = Tally(outcome)
        for _ in range(count):
            tally.add(outcome, "tried", "why")
        return tally

    good = main.FaultClass(partial(run, FINE), 5, 2, 3)
    monkeypatch.setattr(main, "CLASSES", {"good": good})
    monkeypatch.setattr(sys, "argv", ["faults", "--short"])
    monkeypatch.setattr(main.page, "write_table", lambda rows: pytest.fail("must not write"))
    assert main.main() == 0
    monkeypatch.setattr(
        main, "CLASSES", {"good": good, "bad": good._replace(run=partial(run, "lost"))}
    )
    assert main.main() == 1
    text = capsys.readouterr().out
    assert "good: 3 trials, nothing bad" in text
    assert "bad: 3 trials, {'lost': 3} bad" in text


# what the harness found


def test_the_error_of_a_full_disk_names_the_file(tmp_path: Path) -> None:
    from pfbench.cli.messages import format_error
    from pfbench.files.atomic_write import write_atomically

    def fill(file: IO[bytes]) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left") as caught:
        write_atomically(tmp_path / "a.npz", fill)
    text = format_error(caught.value)
    assert text.startswith(f"{tmp_path / 'a.npz'} must be accessible")
    assert "Free space, then repeat the command" in text
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_another_process_has_set_aside_is_no_error(tmp_path: Path) -> None:
    from pfbench.files.atomic_write import set_aside

    assert set_aside(tmp_path / "a.npz").name == "a.npz.damaged"
    assert list(tmp_path.iterdir()) == []


def test_a_class_without_trials_keeps_its_published_row(tmp_path: Path) -> None:
    data = tmp_path / "reliability.json"
    empty = Tally("kills").to_dict() | {"required": 2, "date": "", "commits": []}
    counted = Tally("kills")
    counted.add("fine", "finished")
    published = counted.to_dict() | {"required": 2, "date": "2026-01-01", "commits": ["abc"]}
    assert page.keep_published([empty], data) == [empty]
    data.write_text(json.dumps([published]))
    assert page.keep_published([empty], data) == [published]
    assert page.keep_published([published | {"date": "new"}], data)[0]["date"] == "new"


@pytest.mark.parametrize(
    ("text", "outcome"),
    [("error", FINE), ("within tolerance", FINE), ("noted", FINE),
     ("silently wrong: 3 position", "false"), ("silently wrong in every row: e", "false"), ("other exception: 3 KeyError", "unclear")],
)  # fmt: skip
def test_outcomes_of_the_mutations_are_classes_of_the_table(text: str, outcome: str) -> None:
    module = readers.load_mutations()
    assert set(module.READERS) <= set(readers.READERS)
    remark = text if "every row" in text else text.split(":")[0]
    assert readers.class_of(module, text) == (outcome, remark)


def test_a_class_that_could_not_run_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = [Tally("demo", skipped="no data"), Tally("demo", Counter({FINE: 3}))]
    fault = main.FaultClass(lambda _size, _seed: answers.pop(0), 3, 3)
    monkeypatch.setattr(main, "STORE", tmp_path)
    monkeypatch.setitem(main.CLASSES, "demo", fault)
    main.run_class("demo")
    assert main.collect("demo")["skipped"] == "no data"
    main.run_class("demo")
    assert main.collect("demo")["skipped"] == ""
    main.run_class("demo")  # nothing is left to do
    assert answers == []
