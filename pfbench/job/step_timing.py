"""Timing of the stored jobs of a condition: all filters are built once and take turns over some rounds."""

from __future__ import annotations

import json
import math
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.files.command_start import start_work
from pfbench.filter.loop import run_filter
from pfbench.job.budget import EpisodeSource, max_runs_in_memory
from pfbench.job.filter_pass import choose_engine, wait_for, wrap_steps
from pfbench.job.memory import first_steps
from pfbench.job.plan import JobPlan, build_plan, make_provenance
from pfbench.job.replay import stored_config
from pfbench.kernels import dispatch
from pfbench.model.base import StateSpaceModel
from pfbench.results.conditions import Condition, JobFile
from pfbench.results.step_times import read_commit

_FEWEST_STEPS = 20
_DATA = ("scenario", "noise", "seed", "first_run", "runs", "dtype", "device", "oracle_noise")


@dataclass(frozen=True, eq=False)
class TimingTask:
    """A filter that is ready to be timed.

    Attributes:
        plan: Plan of its job.
        model: Its model.
        record: First steps of the record of the runs that are in memory together.
        engine: Engine of the job: eager, kernels, tape or compiled.
        method: The filter, with steps taken as a whole where the job did so.
    """

    plan: JobPlan
    model: StateSpaceModel
    record: Record
    engine: str
    method: Any

    def measure(self) -> tuple[float, float]:
        """Run the filter over the record.

        Returns processor time and elapsed time per step of all runs of the job, s.
        """
        values, (runs, steps) = self.plan.values, self.record.y.shape[:2]
        numbers = self.plan.runs[:runs].to(values["device"])
        draws = PhiloxStream(values["seed"], numbers, self.plan.dtype)
        batch = self.plan.choose_run_batch(self.plan.method, runs)
        wall, cpu = time.perf_counter(), time.process_time()
        with torch.no_grad(), dispatch.use_kernels(self.engine != "eager"):
            run_filter(self.method, self.model, self.record, draws, run_batch=batch)
            wait_for(values["device"])
        share = len(self.plan.runs) / (runs * steps)
        return (time.process_time() - cpu) * share, (time.perf_counter() - wall) * share


def estimate_time(condition: Condition, rounds: int, seconds: float) -> float:
    """Estimate how long the rounds of a condition last at the speed of its jobs, s."""
    per_step = sum(float(job.meta["seconds"]["per_step"]) for job in condition.jobs)
    return (rounds + 1) * _count_steps(condition.jobs, seconds) * per_step


def time_condition(
    condition: Condition, changes: Mapping[str, Any], rounds: int, seconds: float
) -> dict[str, Any]:
    """Time the filters of a condition in turn.

    Each filter runs once before, so that nothing is compiled or loaded in a round. Each round has an order of its own.

    Returns measurement for `step_times.write_step_times`.
    """
    steps = _count_steps(condition.jobs, seconds)
    tasks = _build_tasks(condition.jobs, changes, steps)
    start_work()
    for task in tasks:
        task.measure()
    times: list[list[tuple[float, float]]] = [[] for _ in tasks]
    for number in range(rounds):
        # by chance, so that none follows the same filter each time, whose data it finds in the cache
        for i in random.Random(number).sample(range(len(tasks)), len(tasks)):
            times[i].append(tasks[i].measure())
    first = tasks[0].plan.values
    is_single = first["device"] == "cpu" and first["threads"] == 1
    jobs = {
        job.path.stem: {
            "label": job.label,
            "commit": read_commit(job.meta),
            "engine": task.engine,
            "cpu": [cpu for cpu, _ in pairs],
            "wall": [wall for _, wall in pairs],
        }
        for job, task, pairs in zip(condition.jobs, tasks, times, strict=True)
    }
    return {
        "scenario": condition.scenario,
        "noise": condition.noise,
        "model": condition.model,
        "clock": "cpu" if is_single else "wall",
        "device": first["device"],
        "threads": first["threads"],
        "steps": steps,
        "jobs": jobs,
        **make_provenance(),
    }


def _count_steps(jobs: Sequence[JobFile], seconds: float) -> int:
    """Return the number of steps that all filters together take in the time of a round."""
    per_step = sum(float(job.meta["seconds"]["per_step"]) for job in jobs) / len(jobs)
    target_steps = math.ceil(seconds / per_step) if per_step > 0 else _FEWEST_STEPS
    return min(int(jobs[0].meta["steps"]), max(_FEWEST_STEPS, target_steps))


def _build_tasks(
    jobs: Sequence[JobFile], changes: Mapping[str, Any], steps: int
) -> list[TimingTask]:
    """Build the filters of a condition. Jobs of the same data share its episodes."""
    sources: dict[str, EpisodeSource] = {}
    tasks = []
    for job in jobs:
        plan = build_plan(stored_config(job.meta, job.path, changes))
        data = json.dumps({name: plan.values.get(name) for name in _DATA}, sort_keys=True)
        if data not in sources:
            sources[data] = EpisodeSource(plan)
        episodes = sources[data]
        size = max_runs_in_memory(plan, episodes)
        episode = episodes.batch(0, size)
        model = plan.make_filter_model(episode)
        engine = choose_engine(plan.values["engine"], plan.method, model, size, steps)
        method = wrap_steps(engine, plan.method) or plan.method
        tasks.append(
            TimingTask(plan, model, first_steps(model, episode.record, steps), engine, method)
        )
    return tasks
