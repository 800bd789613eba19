"""Episodes of a job, particles under a budget, runs under a memory limit."""

from __future__ import annotations

import logging
import time
from dataclasses import replace

from torch import Tensor

from pfbench.core.record import Episode
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job import memory
from pfbench.job.budget import BudgetAllocation, CostTrial, allocate_budget
from pfbench.job.filter_pass import choose_engine
from pfbench.job.plan import JobPlan
from pfbench.job.scoring import LikelihoodCounter, ScoreRecorder
from pfbench.job.system_memory import GIB, memory_limit
from pfbench.kernels import compilation
from pfbench.results import store

log = logging.getLogger("pfbench")


class EpisodeSource:
    """Episodes of a job, drawn together where they fit into memory, else in batches.

    Batches of a joint episode are views of it. The numbers of a run are the same in both cases.

    Attributes:
        limit: Bytes that the job may use. None if unknown.
        seconds: Time of all draws.
        joint: Episode of all runs, or None if it is not in memory.
    """

    def __init__(self, plan: JobPlan) -> None:
        self.plan = plan
        self.limit = memory_limit(plan.values["memory_limit_gib"], plan.values["device"])
        self.seconds = 0.0
        self.joint: Episode | None = None
        if memory.fits_undrawn(len(plan.runs), self.limit):
            self.draw_all()

    def draw_all(self) -> Episode:
        """Draw the episode of all runs."""
        self.joint = self._draw(self.plan.runs)
        return self.joint

    def sample(self) -> Episode:
        """Return all runs if they are in memory, else the first two, for trials."""
        return self._draw(self.plan.runs[:2]) if self.joint is None else self.joint

    def batch(self, first: int, size: int) -> Episode:
        """Return the episode of a batch.

        Args:
            first: Index of the first run in the job.
            size: Number of runs.
        """
        if self.joint is None:
            return self._draw(self.plan.runs[first : first + size])
        return slice_runs(self.joint, slice(first, first + size))

    def _draw(self, runs: Tensor) -> Episode:
        """Draw the episode of some runs and add the time."""
        start_time = time.perf_counter()
        episode = self.plan.draw_episode(runs)
        self.seconds += time.perf_counter() - start_time
        return episode


def slice_runs(episode: Episode, runs: slice) -> Episode:
    """Select some runs of an episode.

    Args:
        episode: Episode of all runs. A feedback process stays that of all of them.
        runs: Selection.

    Returns:
        An episode with views of the tensors.
    """
    truth = {name: values[runs] for name, values in episode.truth.items()}
    track = None if episode.track is None else episode.track[runs]
    return replace(episode, record=episode.record.select_runs(runs), truth=truth, track=track)


def apply_budget(plan: JobPlan, episodes: EpisodeSource) -> tuple[JobPlan, BudgetAllocation | None]:
    """Give the filter as many particles as its budget allows.

    A filter without particles, and one with its own number (filter.particles=...), are unchanged.
    A trial of time uses all runs where their episode is in memory, else two.

    Args:
        plan: Plan of the job.
        episodes: Its episodes.

    Returns:
        The plan with the new filter, and the allocation, None if the filter is unchanged.

    Raises:
        ValueError: If the whole step is compiled, whose cost is unknown before.
    """
    values = plan.values
    if values["budget"] == store.SAME_N or not plan.config.uses_shared_particles:
        return plan, None
    if values["engine"] == "compiled":
        raise ValueError(
            f"engine must be auto, eager or kernels with budget={values['budget']}, got compiled. "
            f"Use engine=auto or budget={store.SAME_N}: trials are not compiled."
        )
    episode = episodes.sample()
    model = plan.make_filter_model(episode)
    runs, steps = episode.record.y.shape[:2]
    trial = CostTrial(
        model,
        episode.record,
        plan.choose_timer(),
        values["seed"],
        LikelihoodCounter(model),
        lambda method: plan.choose_run_batch(method, runs),
    )
    sir = ParticleFilter(values["particles"])
    engine = "kernels" if values["engine"] == "auto" else values["engine"]
    job_engine = choose_engine(engine, sir, model, len(plan.runs), steps)
    with compilation.use_compiled(job_engine != "eager"):
        allocation = allocate_budget(values["budget"], plan.method, values["particles"], trial)
    log.info(
        "budget=%s: %d particles cost as much as %d of sir",
        values["budget"],
        allocation.particles,
        values["particles"],
    )
    method = replace(plan.method, particles=allocation.particles)
    return replace(plan, method=method), allocation


def max_runs_in_memory(plan: JobPlan, episodes: EpisodeSource) -> int:
    """Determine the runs that fit into memory at a time, and draw all if they fit.

    Args:
        plan: Plan of the job, with the number of particles of the budget.
        episodes: Its episodes.

    Returns:
        Runs per batch, at most all.

    Raises:
        ValueError: If a single run does not fit.
    """
    runs, limit = len(plan.runs), episodes.limit
    if limit is None or not memory.needs_memory_trial(plan.method, plan.model, runs, limit):
        if episodes.joint is None:
            episodes.draw_all()
        return runs
    episode = slice_runs(episodes.sample(), slice(0, 2))
    estimate = _estimate(plan, episode)
    size = memory.runs_within_limit(estimate, runs, limit)
    is_sliceable = episode.record.feedback is None  # a feedback process is that of all its runs
    if size == runs or (is_sliceable and memory.fits_drawn(estimate, runs, limit)):
        try:
            size = memory.runs_within_limit(estimate, runs, limit, is_whole=True)
            if episodes.joint is None:
                episodes.draw_all()
        except ValueError:  # does not fit in addition to the episodes of all runs
            episodes.joint = None
    else:
        episodes.joint = None
    if size < runs:
        log.info(
            "memory: %d runs at once need about %.3g GiB, limit %.3g GiB (memory_limit_gib=...). "
            "Running %d at a time, with the same results",
            runs,
            estimate.peak(runs) / GIB,
            limit / GIB,
            size,
        )
    return size


def _estimate(plan: JobPlan, episode: Episode) -> memory.MemoryEstimate:
    """Estimate the bytes of a job from the episode of two runs."""
    model = plan.make_filter_model(episode)
    truth = model.assemble(episode.truth).to(model.anchor)
    score_steps = min(plan.values["score_steps"], 1)

    def watch(runs: int, steps: int) -> ScoreRecorder:
        return ScoreRecorder(model, truth[:runs, :steps], score_steps)

    def run_batch(runs: int) -> int:
        return plan.choose_run_batch(plan.method, runs)

    return memory.estimate_memory(plan.method, model, episode, run_batch, watch)
