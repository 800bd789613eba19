"""Steps of a job: their batches, and their times after what a process loads once."""

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from config_cases import truncated

from pfbench.filter.loop import run_filter
from pfbench.filter.particle import compiled_filter
from pfbench.job import build_plan, compose, filter_pass, resolve_config

JOB = ["scenario=growth", "filter=sir", "runs=3", "particles=50"]


def settings(tmp_path: Path, *words: str) -> Any:
    """A job with results and episodes of its own."""
    return compose([*JOB, f"results_dir={tmp_path}/results", "episode_cache_dir=null", *words])


@pytest.mark.parametrize("engine", ["auto", "compiled"])
def test_a_job_takes_its_batches_in_every_engine(
    engine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By default no step is compiled."""
    passes: list[tuple[int, int | None]] = []

    def spy(method: Any, model: Any, record: Any, draws: Any, *more: Any) -> Any:
        passes.append((record.y.shape[1], more[2] if more else None))
        return run_filter(method, model, record, draws, *more)

    monkeypatch.setattr(filter_pass, "run_filter", spy)
    compiled: list[Any] = []
    monkeypatch.setattr(
        compiled_filter, "compile_step", lambda *parts: compiled.append(parts)
    )  # no step of any kind
    words = ["scenario=flight_300s", "runs=4", "particles=8000", f"engine={engine}"]
    plan = build_plan(resolve_config(settings(tmp_path, *words)))
    episode = truncated(plan.draw_episode(plan.runs), 3)
    result = filter_pass.pass_filter(plan, episode, plan.runs, "")
    assert passes == [(2, None), (3, 4)]
    assert bool(compiled) == (engine == "compiled")
    assert result.cost["likelihoods_per_step"] == 8000.0


@pytest.mark.parametrize(("threads", "batch"), [(1, 4), (2, 2)])
def test_a_job_with_a_tape_gives_the_results_of_one_with_kernels(
    threads: int, batch: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the batches of kernels, which threads share. By default a bootstrap filter has a tape, in double precision."""
    batches: list[int | None] = []

    def spy(method: Any, model: Any, record: Any, draws: Any, *more: Any) -> Any:
        batches.append(more[2] if more else None)
        return run_filter(method, model, record, draws, *more)

    monkeypatch.setattr(filter_pass, "run_filter", spy)
    found: dict[str, dict[str, Any]] = {}
    for engine in ("kernels", "tape", "auto"):
        words = ["runs=4", "particles=300", f"engine={engine}", f"threads={threads}"]
        plan = build_plan(resolve_config(settings(tmp_path, *words)))
        episode = truncated(plan.draw_episode(plan.runs), 8)
        result = filter_pass.pass_filter(plan, episode, plan.runs, "")
        assert result.cost["engine"] == ("tape" if engine == "auto" else engine)
        assert result.cost["likelihoods_per_step"] == 300.0
        assert batches[-1] == (4 if engine == "kernels" else batch)
        found[engine] = result.arrays(episode, None)
    for engine in ("tape", "auto"):
        assert found[engine].keys() == found["kernels"].keys()
        for name, values in found[engine].items():  # in single precision, as they are stored
            np.testing.assert_allclose(values, found["kernels"][name], rtol=1e-5, atol=1e-6)
    single = build_plan(resolve_config(settings(tmp_path, "engine=auto", "dtype=float32")))
    episode = truncated(single.draw_episode(single.runs), 3)
    assert filter_pass.pass_filter(single, episode, single.runs, "").cost["engine"] == "kernels"


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


@pytest.mark.parametrize(
    ("world", "method", "is_still"),
    [
        ("lorenz63_twin", "sir", True),
        ("lorenz63_twin", "rpf_copies", False),  # which moves copies
        ("lorenz63_twin", "ekf", False),
        ("lorenz63", "sir", False),  # with process noise
        ("flight_300s", "sir", False),
    ],
)
def test_copies_that_nothing_moves_apart_are_named(
    world: str, method: str, is_still: bool, tmp_path: Path
) -> None:
    plan = build_plan(settings(tmp_path, f"scenario={world}", f"filter={method}"))
    episode = truncated(plan.draw_episode(plan.runs), 3)
    notes = filter_pass.describe_unmoved_copies(
        plan, plan.make_filter_model(episode), episode.record
    )
    assert ["filter=rpf_copies" in note for note in notes] == [True] * is_still


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
