"""Builds of steps in the background: where they repay, one at a time, and a job that no fault of theirs reaches."""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from compiled_cases import agree, compiler, record_of, run
from config_cases import truncated

from pfbench.filter.loop import run_filter
from pfbench.filter.particle import compiled_filter, step_store
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter, StepParts
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job import compose, filter_pass, run as run_job, step_builds
from pfbench.job.config import resolve_config
from pfbench.job.plan import build_plan
from pfbench.job.scoring import LikelihoodCounter
from pfbench.kernels.cpp_library import code_folder
from pfbench.model.linear_gaussian import linear_walk

idle = step_builds._has_idle_core


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the empty cache of a user with an idle core."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    monkeypatch.delenv(step_builds.SWITCH)
    monkeypatch.setattr(step_builds, "_has_idle_core", lambda: True)
    step_builds.say_once.cache_clear()
    return folder / "pfbench"


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Return the builds that are started. None of them runs."""
    started: list[Any] = []
    monkeypatch.setattr(
        step_builds.subprocess, "Popen", lambda *words, **more: started.append(more)
    )
    yield started
    step_builds._started.clear()


@pytest.fixture(scope="module")
def wanted() -> tuple[str, StepParts]:
    """Name and parts of the step that a filter wanted."""
    return want()


def want() -> Any:
    """Filter a record; return name and parts of the step if it is not stored, else the filter's step."""
    model, method = linear_walk(1.0, 0.3, 1.0), ParticleFilter(30)
    record, missing = record_of(model), []
    counter = LikelihoodCounter(model)
    step = CompiledParticleFilter(
        method, counter, on_missing=lambda *missed: missing.append(missed)
    )
    agree(run(step, model, record), run(method, model, record))
    (graph,) = step.graphs.values()
    return graph or missing[0]


def ledger(home: Path) -> dict[str, Any]:
    """What is noted, by step."""
    wishes: dict[str, Any] = json.loads((home / "wishes.json").read_text())
    return wishes


# --------------------------------------------------------------------------------------------------
# When a build starts


def test_a_build_starts_once_the_noted_savings_repay_it(
    wanted: Any, builds: list[Any], home: Path
) -> None:
    """And again after as many, if nothing came of it."""
    share = 0.4 * step_builds.BUILD_SECONDS
    counts = []
    for _ in range(6):
        step_builds.want_step(wanted[0], share, wanted[1])
        step_builds.want_step("another", 0.3 * share, wanted[1])
        counts.append(len(builds))
    assert counts == [0, 0, 1, 1, 1, 2]
    assert ledger(home)["another"]["saving"] == pytest.approx(1.8 * share)


def test_a_job_that_saves_less_than_the_name_costs_leaves_no_note(wanted: Any, home: Path) -> None:
    step_builds.want_step(wanted[0], 0.01, wanted[1])
    assert not (home / "wishes.json").exists()


def test_a_stored_step_is_not_built(wanted: Any, builds: list[Any], home: Path) -> None:
    (home / "steps" / wanted[0]).mkdir(parents=True)
    step_builds.want_step(wanted[0], 100.0, wanted[1])
    assert not builds


@pytest.mark.parametrize(
    ("part", "value", "expected"),
    [
        ("none", None, True), ("cores", 1, False), ("quota", "100000 100000", False), ("quota", "250000 100000", True),
        ("quota", "max 100000", True), ("load", 3.8, False), ("load", 3.2, True), ("memory", 3 << 30, False),
    ],
)  # fmt: skip
def test_a_build_needs_an_idle_core_and_memory(
    part: str, value: Any, expected: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quota = tmp_path / "cpu.max"
    state = {"cores": 4, "load": 1.0, "memory": 8 << 30, part: value}
    if part == "quota":
        quota.write_text(value)
    monkeypatch.setattr(step_builds, "_QUOTA", quota)
    monkeypatch.setattr(step_builds, "available_memory", lambda: state["memory"])
    monkeypatch.setattr(
        os, "sched_getaffinity", lambda _: set(range(state["cores"])), raising=False
    )
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(os, "getloadavg", lambda: (state["load"], 0.0, 0.0))
    assert idle() is expected


def test_a_busy_machine_only_notes(
    wanted: Any, builds: list[Any], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_builds, "_has_idle_core", lambda: False)
    step_builds.want_step(wanted[0], 100.0, wanted[1])
    assert not builds
    assert ledger(home)[wanted[0]]["saving"] == 100.0


# --------------------------------------------------------------------------------------------------
# Faults: one line, and the job goes on


@pytest.mark.parametrize("fault", ["file", "others", "full"])
def test_a_home_that_cannot_be_used_is_said_once(
    fault: str, wanted: Any, builds: list[Any], home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:  # fmt: skip
    """A file in place of the folder, a folder that others can write, and a limit of the size of files."""
    caplog.set_level("INFO", "pfbench")
    if fault == "file":
        home.parent.write_text("")
    elif fault == "others":
        home.mkdir(parents=True)
        home.chmod(0o777)
    else:
        monkeypatch.setattr(os, "fsync", full)
    for _ in range(2):
        assert want()[0] == wanted[0]
        step_builds.want_step(wanted[0], 100.0, wanted[1])
    (said,) = [r.getMessage() for r in caplog.records]
    assert said.startswith("engine=auto: no compiled step, since none can be stored (")
    assert not builds
    assert fault != "full" or not list(home.iterdir())


def full(_: int) -> None:
    """Fail as on a full disk."""
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"a": 1}', '{"a": {"time": 0}}', "\x00"])
def test_a_damaged_note_is_replaced(text: str, wanted: Any, home: Path) -> None:
    code_folder().joinpath("wishes.json").write_text(text)
    step_builds.want_step(wanted[0], 1.0, wanted[1])
    assert set(ledger(home)) == {wanted[0]}


def test_a_failure_is_remembered_for_a_week(
    wanted: Any, builds: list[Any], home: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A part that no other process can receive."""
    caplog.set_level("INFO", "pfbench")
    name, parts = wanted
    broken = parts._replace(counter=SimpleNamespace(count=lambda: 0))
    for k in range(3):
        step_builds.want_step(name, 100.0, broken if k == 0 else parts)
    assert not builds
    assert [r.getMessage()[:66] for r in caplog.records] == [
        "engine=auto: its compiled step cannot be built (another process ca"
    ]
    wishes = ledger(home)
    wishes[name]["tried"] -= 8 * 86400.0
    (home / "wishes.json").write_text(json.dumps(wishes))
    step_builds.want_step(name, 100.0, parts)
    assert len(builds) == 1


def test_old_and_many_notes_are_dropped(wanted: Any, home: Path) -> None:
    now = time.time()
    old = {"saving": 1.0, "reason": "", "tried": now, "time": now - 31 * 86400.0}
    many = {f"step {k}": {**old, "time": now} for k in range(step_builds._LARGEST_LEDGER)}
    code_folder().joinpath("wishes.json").write_text(json.dumps({"old": old, **many}))
    step_builds.want_step(wanted[0], 1.0, wanted[1])
    names = list(ledger(home))
    assert names[-1] == wanted[0]
    assert len(names) == step_builds._LARGEST_LEDGER
    assert "old" not in names


# --------------------------------------------------------------------------------------------------
# The process of a build


def sleep_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a build sleep."""
    monkeypatch.setattr(step_builds, "_PROGRAM", "import time; time.sleep(60)")


def stop(process: Any) -> None:
    """Kill a build as the system does when memory is short."""
    process.send_signal(signal.SIGKILL)
    process.wait()


def test_the_process_holds_the_lock_until_it_ends_however_it_ends(
    wanted: Any, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sleep_in_place(monkeypatch)
    for count in (1, 2):
        step_builds.want_step(wanted[0], 100.0, wanted[1])
        step_builds.want_step("another", 100.0, wanted[1])  # waits for its turn
        assert len(step_builds._started) == count
        build = step_builds._started[-1]
        assert build.poll() is None
        (step_store.workshop()).mkdir()  # what a killed build leaves, the next start removes
        stop(build)
        with step_builds._lock() as lock:
            assert lock is not None
    step_builds.want_step(wanted[0], 100.0, wanted[1])
    assert not step_store.workshop().exists()
    stop(step_builds._started.pop())
    step_builds._started.clear()
    assert sorted(file.name for file in home.iterdir()) == ["build.lock", "wishes.json"]


JOB = ["scenario=growth", "filter=sir", "runs=3", "particles=50"]


def settings(tmp_path: Path, *words: str) -> Any:
    """A job with results and episodes of its own."""
    return compose([*JOB, f"results_dir={tmp_path}/results", "episode_cache_dir=null", *words])


def test_a_job_notes_its_step_unless_the_switch_or_its_engine_says_no(
    tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for words in (["engine=kernels"], ["dtype=float32"], ["budget=time"]):
        run_job(settings(tmp_path, *words))
    monkeypatch.setenv(step_builds.SWITCH, "0")
    run_job(settings(tmp_path))
    assert not (home / "wishes.json").exists()
    monkeypatch.setenv(step_builds.SWITCH, "1")
    for seed in (1, 2):
        run_job(settings(tmp_path, f"seed={seed}", "overwrite=true"))
    (wish,) = ledger(home).values()
    assert wish["saving"] == pytest.approx(2 * 100 * (3e-4 + 0.6e-8 * 150))


@pytest.mark.parametrize("is_stored", [False, True])
def test_a_job_without_its_step_takes_the_batches_of_kernels(
    is_stored: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a compiled step are smaller where the state has many components, and slower without it."""
    passes: list[tuple[int, int | None]] = []

    def spy(method: Any, model: Any, record: Any, draws: Any, *more: Any) -> Any:
        passes.append((record.y.shape[1], more[2] if more else None))
        return run_filter(method, model, record, draws, *more)

    monkeypatch.setattr(filter_pass, "run_filter", spy)
    monkeypatch.setattr(CompiledParticleFilter, "is_active", is_stored)
    words = ["scenario=flight_300s", "runs=4", "particles=8000", "engine=auto"]
    plan = build_plan(resolve_config(settings(tmp_path, *words)))
    episode = truncated(plan.draw_episode(plan.runs), 3)
    result = filter_pass.pass_filter(plan, episode, plan.runs, "")
    assert passes == [(2, None), (3, 2 if is_stored else 4)]
    assert result.cost["likelihoods_per_step"] == 8000.0
    # 15 components: the overhead of calls alone, in one batch
    assert filter_pass._predict_saving(plan.method, plan.model, 4, 1000) == pytest.approx(0.3)


def test_what_a_process_loads_once_is_not_in_the_time_of_a_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[float] = []

    def load_first(*arguments: Any) -> Any:
        end = time.process_time() + (0.0 if calls else 0.5)
        while time.process_time() < end:
            pass
        calls.append(end)
        return run_filter(*arguments)

    monkeypatch.setattr(filter_pass, "run_filter", load_first)
    plan = build_plan(
        resolve_config(settings(tmp_path, "scenario=growth", "runs=2", "particles=10"))
    )
    result = filter_pass.pass_filter(
        plan, truncated(plan.draw_episode(plan.runs), 3), plan.runs, ""
    )
    assert result.seconds["warm_up"] >= 0.5
    assert result.seconds["filter"] < 0.4


def test_both_orders_of_two_jobs_have_equal_times(tmp_path: Path) -> None:
    """One filter in two jobs of a process, in several processes: the first is no dearer than the second."""
    code = (
        "import json; from pfbench import job; from pfbench.results import store; "
        "words = ['scenario=growth', 'filter=sir', 'runs=50', 'episode_cache_dir=null']; "
        "paths = [job.run(job.compose([*words, f'study={name}'])).path for name in 'ab']; "
        "print(json.dumps([store.read_metadata(p)['seconds']['per_step'] for p in paths]))"
    )
    ratios = []
    for k in range(9):
        (tmp_path / f"{k}").mkdir()
        said = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path / f"{k}", capture_output=True, text=True
        )
        first, second = json.loads(said.stdout.splitlines()[-1])
        ratios.append(first / second)
    assert 0.95 <= statistics.median(ratios) <= 1.05, ratios


def test_a_command_ends_while_its_build_runs(tmp_path: Path) -> None:
    """Whoever reads its output must not wait for the build."""
    number = tmp_path / "number"
    sleeps = f"import os, time; open({str(number)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    code = (
        "from pfbench.job import step_builds as b; b._has_idle_core = lambda: True; b.BUILD_SECONDS = 0.025; "
        f"b._PROGRAM = {sleeps!r}; from pfbench.cli import main; main()"
    )
    words = [*JOB, f"results_dir={tmp_path}/results", "episode_cache_dir=null"]
    done = subprocess.run(
        [sys.executable, "-c", code, "run", *words], capture_output=True, text=True, timeout=50
    )
    assert "a background process compiles the step" in done.stdout + done.stderr
    while not number.exists() or not number.read_text():
        time.sleep(0.02)
    os.kill(int(number.read_text()), signal.SIGKILL)  # it was alive


def wait_for(condition: Callable[[], bool], build: Any) -> None:
    """Wait until a running build has come to a point."""
    while not condition():
        assert build.poll() is None
        time.sleep(0.02)


@pytest.mark.slow
@compiler
class TestBuild:
    """Builds of a step by torch's compiler."""

    @pytest.fixture
    def build(self, wanted: Any) -> Iterator[Callable[[], Any]]:
        """Return a function that starts the build."""

        def start() -> Any:
            step_builds.want_step(wanted[0], 100.0, wanted[1])
            return step_builds._started[-1]

        yield start
        for process in step_builds._started:
            stop(process)
        step_builds._started.clear()

    def test_a_build_stores_the_step_that_the_next_job_loads(
        self, wanted: Any, build: Callable[[], Any], home: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert build().wait() == 0
        assert ledger(home)[wanted[0]]["reason"] == ""
        assert sorted(file.name for file in home.iterdir()) == [
            "build.lock",
            "steps",
            "wishes.json",
        ]
        monkeypatch.setattr(compiled_filter, "compile_function", None)
        assert want().is_stored

    def test_a_killed_build_leaves_no_step_and_frees_the_lock(
        self, wanted: Any, build: Callable[[], Any], home: Path
    ) -> None:
        process = build()
        wait_for(step_store.workshop().is_dir, process)
        stop(process)
        assert not step_store.has_steps()
        step_builds.want_step(wanted[0], 1.0, wanted[1])
        assert len(step_builds._started) == 1
        assert ledger(home)[wanted[0]]["saving"] == 1.0

    @pytest.mark.parametrize(
        ("fault", "reason"), [("compiler", "C++ compiler"), ("name", "its name must be the same"), ("disk", "not stored")]
    )  # fmt: skip
    def test_a_failed_build_states_its_reason(
        self, fault: str, reason: str, wanted: Any, build: Callable[[], Any], home: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:  # fmt: skip
        parts = wanted[1]
        if fault == "compiler":
            monkeypatch.setenv("CXX", "/nowhere/c++")
        elif fault == "disk":
            code_folder().joinpath("steps").write_text("a file in place of the folder")
        else:
            wanted = "0" * 40, parts
        step_builds.want_step(wanted[0], 100.0, parts)
        process = step_builds._started[-1]
        assert process.wait() == 0
        assert reason in ledger(home)[wanted[0]]["reason"]
        assert not step_store.workshop().exists()
