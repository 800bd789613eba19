"""Commands for a person's own work: new scripts that run at once, state, dry run, completion, and the folder conf."""

import contextlib
import io
import os
import re
import runpy
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from checkout import ROOT
from command_line import environment, pfbench

from pfbench.cli import progress
from pfbench.cli.list import make_script
from pfbench.cli.new import SCRIPTS
from pfbench.cli.report import OPEN_COMMAND as OPEN
from pfbench.results import store

WALK = ("scenario=linear_walk", "scenario.steps=5", "runs=3", "particles=30")
# lines that a person writes or changes: the class with its imports, without the study
GOAL = {"filter": 30, "proposal": 32, "model": 35, "scenario": 40, "noise": 30, "log": 40}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCRIPTS)
def test_a_new_script_runs_at_once_from_an_empty_folder(tmp_path: Path, kind: str) -> None:
    """One file, no switch: the script writes a report with a row for its own part."""
    said, page = run_new_script(tmp_path, kind, run_in_a_process)
    assert "FAILS" not in said
    assert "0 failed" in said
    assert ("MyIdea" in page) or kind == "log"
    assert len(list((tmp_path / "results" / "my_idea").glob("*.npz"))) >= 3


@pytest.mark.parametrize("kind", SCRIPTS)
def test_a_new_script_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """In this process, where its start costs nothing."""
    monkeypatch.chdir(tmp_path)
    for name, value in environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    said, page = run_new_script(tmp_path, kind, run_here)
    assert "FAILS" not in said
    assert "0 failed" in said
    assert ("MyIdea" in page) or kind == "log"


def run_new_script(folder: Path, kind: str, run: Callable[[Path], str]) -> tuple[str, str]:
    """Write a script, shorten its study, run it, and return what it prints and its report."""
    with contextlib.chdir(folder):
        assert pfbench("new", kind, "my_idea", home=folder).code == 0
    script = folder / "my_idea.py"
    lines = [line for line in script.read_text().splitlines() if line.strip()]
    assert len(lines) <= GOAL[kind]
    short = re.sub("runs=(50|10)", "runs=3", script.read_text())
    script.write_text(short.replace("check(MyIdea())", "check(MyIdea(), runs=50)"))
    return run(script), (folder / "reports" / "my_idea" / "report.md").read_text()


def run_in_a_process(script: Path) -> str:
    env = os.environ | environment(script.parent) | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, script.name], cwd=script.parent, env=env, capture_output=True, text=True, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_here(script: Path) -> str:
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        runpy.run_path(str(script), run_name="__main__")
    return said.getvalue()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("new",), "new must have a kind and a name, got none"),
        (("new", "filtre", "x"), "kind must be one of filter, proposal, model, scenario, noise, log, got filtre. Similar: filter"),
        (("new", "filter", "My-Idea"), "name must be of lower-case letters"),
        (("new", "filter", "torch"), "name must not be that of an installed package"),
        (("completion", "fish"), "shell must be one of bash, zsh, got fish"),
        (("status", "study=nothing"), "study must be a study with results, got nothing"),
        (("open", "study=nothing"), "study must be a study with results, got nothing"),
    ],
)  # fmt: skip
def test_bad_words_are_refused_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    said = pfbench(*words, home=tmp_path)
    assert said.code == 2
    assert sentence in said.err
    assert not list(tmp_path.glob("*.py"))


def test_a_script_is_never_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("x = 1\n")
    assert "mine.py must not exist" in pfbench("new", "filter", "mine", home=tmp_path).err
    assert (tmp_path / "mine.py").read_text() == "x = 1\n"


def test_a_dry_run_counts_jobs_and_stores_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = pfbench("run", "--dry-run", "-m", *WALK, "study=s", "filter=ekf,sir", home=tmp_path)
    assert said.code == 0, said.err
    assert re.search(r"dry run: 2 jobs, 2 new, 0 skipped, 0 refused; about \d+ s", said.out)
    assert re.search(r"new +about +\d+ s +0\.\d+ GiB +linear_walk / nominal / sir", said.out)
    assert not list(tmp_path.iterdir())
    assert pfbench("run", *WALK, "study=s", "filter=ekf", home=tmp_path).code == 0
    again = pfbench("run", "--dry-run", "-m", *WALK, "study=s", "filter=ekf,sir", home=tmp_path)
    assert "2 jobs, 1 new, 1 skipped" in again.out
    refused = pfbench(
        "run", "--dry-run", "-m", *WALK, "study=s", "filter=sir", "scenario.steps=0,9", home=tmp_path
    )  # fmt: skip
    assert "1 refused" in refused.out
    assert "scenario.steps must be a whole number of at least 1" in refused.out


def test_the_estimate_grows_with_the_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pfbench.cli.dry_run import DrawnWorlds, estimate_job
    from pfbench.job import build_plan, compose

    monkeypatch.chdir(tmp_path)
    words = ["scenario=growth", "filter=sir", "particles=1000"]
    small, large = (
        estimate_job(compose([*words, f"runs={runs}"]), DrawnWorlds()) for runs in (2, 200)
    )
    worlds = DrawnWorlds()
    first, again, other = (
        worlds.draw(build_plan(compose([*words[:2], f"seed={seed}"])))[1] for seed in (1, 1, 2)
    )
    assert again == 0.0  # filters share the draw of a world
    assert min(first, other) > 0.0
    assert large.seconds > 3 * small.seconds  # 100 times the runs, and a constant part
    assert large.bytes > small.bytes


def test_the_state_of_a_study_lists_failed_jobs_with_the_words_that_repeat_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sweep = pfbench("run", "-m", *WALK, "study=s", "filter=sir", "scenario.steps=0,9", home=tmp_path)  # fmt: skip
    assert sweep.code == 1
    said = pfbench("status", "study=s", home=tmp_path)
    assert said.out.startswith("s: 1 finished, 1 failed\n")
    assert re.search(r"mended it: remove \S+results/s/\w+\.failed\.json\n", said.out)
    for text in (sweep.out, said.out):
        (repeat,) = re.findall(r"repeat: pfbench (run .*)", text)
        assert {"scenario.steps=0", "study=s"} <= set(repeat.split())
    assert (
        "scenario.steps must be a whole number of at least 1"
        in pfbench(*repeat.split(), home=tmp_path).err
    )
    assert pfbench("status", home=tmp_path).out == "s: 1 finished, 1 failed\n"
    empty = pfbench("status", f"results_dir={tmp_path / 'none'}", home=tmp_path)
    assert "No study has results" in empty.out


def test_time_left_is_that_of_the_jobs_that_were_computed(tmp_path: Path) -> None:
    """200 s for two computed jobs of five, and one that was skipped: two more take 200 s."""
    sweep = progress.Sweep(tmp_path / "s", 5, start_time=time.time() - 200)
    for number, status in enumerate(("finished", "skipped", "finished")):
        sweep.note(number, status)
    left = sweep.estimate_time_left()
    np.testing.assert_allclose(left, 200.0, rtol=0.05)
    counter = progress.SweepCounter(2, progress.Sweep.from_file(sweep.file))
    assert re.fullmatch(r"\[3/5, 3 min left\] ", str(counter))
    state = progress.read_state(tmp_path / "s")
    assert state.running == ((3, 5),)
    assert "running 3 of 5, 3 min left" in repr(state)
    assert sweep.count() == "2 finished, 1 skipped, 0 failed, 2 not run"
    assert progress.read_state(tmp_path / "s").running == ()
    dead = tmp_path / "s" / f".sweep-{2**22 + 1}-1.0-4"
    dead.parent.mkdir(exist_ok=True)
    dead.touch()
    assert progress.read_state(tmp_path / "s").running == ()


def test_surprising_commands_say_so_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pfbench.cli.run._run_alone", lambda *a: None)
    alone = pfbench("run", "runs=2", home=tmp_path)
    assert "note: one job of the defaults runs: scenario=flight_300s noise=nominal filter=sir runs=2" in alone.err  # fmt: skip
    without = pfbench("run", "+experiment=quickstart", home=tmp_path)
    assert re.search(r"note: \d+ jobs belong to the experiment, and without -m one of them runs", without.err)  # fmt: skip
    assert pfbench("run", *WALK, "filter=ekf", home=tmp_path).err == ""


def test_files_of_the_current_folder_are_chosen_by_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "conf" / "filter"
    folder.mkdir(parents=True)
    (folder / "small.yaml").write_text("# SIR with few particles.\ndefaults:\n  - sir\n  - _self_\nparticles: 20\n")  # fmt: skip
    said = pfbench("run", "-m", *WALK, "study=s", "filter=ekf,small", home=tmp_path)
    assert said.code == 0, said.err
    metas = [store.read_metadata(path) for path in (tmp_path / "results" / "s").glob("*.npz")]
    assert {meta["label"]: meta["particles"] for meta in metas} == {"ekf": None, "small": 20}
    assert "small " in pfbench("list", "filter", home=tmp_path).out
    assert pfbench("run", *WALK, "filter=smallish", home=tmp_path).code == 2
    (folder / "evil.yaml").write_text("_target_: os.system\n")
    evil = pfbench("run", *WALK, "filter=evil", home=tmp_path)
    assert evil.code == 2
    assert "filter._target_ must be a public class of pfbench" in evil.err
    (folder / "ekf.yaml").write_text("defaults:\n  - sir\n  - _self_\n")
    message = "conf/filter/ekf.yaml must have another name than pfbench's own filter ekf"
    assert message in pfbench("run", "-m", *WALK, "filter=ckf,ekf", home=tmp_path).err
    for group in ("model", "scenario"):
        (tmp_path / "conf" / group).mkdir()
        (tmp_path / "conf" / group / "mine.yaml").write_text("defaults:\n  - linear_walk\n  - _self_\n")  # fmt: skip
    for words in (("model", "scenario=mine"), ("scenario", "model=mine")):
        assert "mine " in pfbench("list", *words, home=tmp_path).out


def test_completion_offers_commands_and_names(tmp_path: Path) -> None:
    script = make_script("bash")
    ask = """
COMP_LINE="$1"; COMP_POINT=${#COMP_LINE}; COMP_CWORD="$2"; _pfbench; echo "${COMPREPLY[@]}"
"""
    (tmp_path / "conf" / "filter").mkdir(parents=True)
    (tmp_path / "conf" / "filter" / "mcmc_mine.yaml").touch()

    def complete(line: str, word: int) -> list[str]:
        command = ["bash", "-c", script + ask, "bash", line, str(word)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
        return done.stdout.split()

    assert complete("pfbench sta", 1) == ["status"]
    assert "scenario=" in complete("pfbench run s", 2)
    assert set(complete("pfbench run -m filter=ekf,mcmc_", 3)) >= {"mcmc_rpf", "mcmc_mine"}
    assert complete("pfbench run +experiment=quick", 2) == ["quickstart", "quickstart_bearings"]
    assert make_script("zsh").startswith("autoload -U +X bashcompinit")


def test_open_writes_the_report_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: bool(shown.append(address)) or True)
    assert pfbench("run", "-m", *WALK, "study=s", "filter=ekf,sir", home=tmp_path).code == 0
    words = [
        "study=s",
        f"results_dir={tmp_path / 'results'}",
        f"reports_dir={tmp_path / 'reports'}",
    ]
    OPEN(words)
    page = tmp_path / "reports" / "s" / "index.html"
    written = page.stat().st_mtime_ns
    OPEN(words)
    assert page.stat().st_mtime_ns == written
    assert shown == [page.resolve().as_uri()] * 2
