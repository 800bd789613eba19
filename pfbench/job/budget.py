"""Equal budgets: number of particles at the cost of SIR with `particles`.

The cost is time or evaluations of the likelihood. The number is solved for by trials of the filter
on the first steps of the job's own episode.

Here are also the episodes of a job, and how many of its runs are in memory at a time.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, Record
from pfbench.filter.loop import run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job import memory
from pfbench.job.filter_pass import choose_engine
from pfbench.job.memory import GIB, first_steps, memory_limit
from pfbench.job.plan import JobPlan
from pfbench.job.scoring import LikelihoodCounter, ScoreRecorder
from pfbench.kernels import dispatch
from pfbench.model.base import StateSpaceModel
from pfbench.results import store
from pfbench.results.store import SAME_TIME

MIN_PARTICLES = 10  # smallest number; a filter that costs more is reported as such [ours]
_TOLERANCE = 0.03  # relative cost; times of the same job scatter by more [ours]
_MAX_TRIALS = 8
_TRIAL_STEPS = 40
_TRIAL_RUN_STEPS = 10 * _TRIAL_STEPS  # of all runs together, whose likelihoods are counted


class BudgetAllocation(NamedTuple):
    """Number of particles that a budget allows.

    Attributes:
        particles: Particles of the filter.
        costs: Measured cost of a step with them: seconds of all runs, or evaluations per run.
        price: Target cost: that of SIR with `sir_particles`.
        sir_particles: Particles of SIR that define the target.
    """

    particles: int
    costs: float
    price: float
    sir_particles: int

    def to_metadata(self) -> dict[str, float]:
        """Return the values under the names of a result file."""
        names = ("particles", "costs", "price", "request")
        return dict(zip(names, self, strict=True))


@dataclass(frozen=True)
class CostTrial:
    """Trial of filters on the first steps of an episode.

    Attributes:
        model: Model of the filter.
        record: Measurements and inputs of the trial's runs.
        clock: Clock in seconds.
        seed: Seed of the job.
        counter: Counter of the evaluations of `model`.
        run_batch: Maps a filter to the number of runs that it steps together.
    """

    model: StateSpaceModel
    record: Record
    clock: Callable[[], float]
    seed: int
    counter: LikelihoodCounter
    run_batch: Callable[[Any], int]

    def seconds(self, method: Any) -> float:
        """Measure the seconds of a step of all runs, the smaller of two passes.

        Other programs can only lengthen a pass, so the minimum is the better estimate.
        """
        record = first_steps(self.model, self.record, _TRIAL_STEPS)
        return min(self._run(method, record) for _ in range(2)) / record.y.shape[1]

    def likelihoods(self, method: Any) -> float:
        """Count the likelihood evaluations per step and run, the mean over at least two runs.

        Moves follow a resampling, which not every step has: short records need more runs.
        """
        record = first_steps(self.model, self.record, 5 * _TRIAL_STEPS)
        record = record.select_runs(slice(0, -(-_TRIAL_RUN_STEPS // record.y.shape[1])))
        before = self.counter.count
        self._run(method, record)
        return (self.counter.count - before) / record.y[..., 0].numel()

    def _run(self, method: Any, record: Record) -> float:
        """Run the filter and return the seconds."""
        anchor = self.model.anchor
        draws = PhiloxStream(
            self.seed, torch.arange(len(record.y), device=anchor.device), anchor.dtype
        )
        start_time = self.clock()
        with torch.no_grad():
            run_filter(method, self.model, record, draws, run_batch=self.run_batch(method))
        return self.clock() - start_time


def allocate_budget(
    kind: str, method: Any, sir_particles: int, trial: CostTrial
) -> BudgetAllocation:
    """Determine the number of particles at the cost of SIR.

    Returns the allocation.
    """
    measure = trial.seconds if kind == SAME_TIME else trial.likelihoods
    sir = ParticleFilter(sir_particles)
    price = measure(sir)
    if method == sir:
        return BudgetAllocation(sir_particles, price, price, sir_particles)

    def cost(particles: int) -> float:
        return measure(replace(method, particles=particles))

    particles, costs = solve_particle_count(cost, price, max(MIN_PARTICLES, sir_particles // 4))
    return BudgetAllocation(particles, costs, price, sir_particles)


def solve_particle_count(
    cost: Callable[[int], float], price: float, first: int
) -> tuple[int, float]:
    """Solve for the number of particles at a given cost, by secants in logarithms.

    Returns the tried number whose cost is nearest to the target, and its cost.
    """
    costs = {first: cost(first)}

    def distance(n: int) -> float:
        return abs(math.log(costs[n] / price))

    while len(costs) < _MAX_TRIALS and distance(min(costs, key=distance)) > _TOLERANCE:
        n = _next_trial(costs, price)
        if n in costs:
            break
        costs[n] = cost(n)
    best = min(costs, key=distance)
    return best, costs[best]


def _next_trial(costs: dict[int, float], price: float) -> int:
    """Interpolate between the nearest trials, or extrapolate from them."""
    below, above = ([n for n in costs if (costs[n] < price) == is_low] for is_low in (True, False))
    if below and above and max(below) < min(above):
        near = [max(below), min(above)]
    else:
        near = sorted(costs, key=lambda n: abs(math.log(costs[n] / price)))[:2]
    slope = 1.0  # the first step assumes a cost proportional to the number
    if len(near) == 2:
        a, b = near
        # small numbers of particles cost nearly the same, so the slope is limited
        slope = min(2.0, max(0.2, math.log(costs[a] / costs[b]) / math.log(a / b)))
    step = math.log(price / costs[near[0]]) / slope
    return max(MIN_PARTICLES, round(near[0] * math.exp(min(math.log(16.0), step))))


log = logging.getLogger("pfbench")


class EpisodeSource:
    """Episodes of a job, drawn together where they fit into memory, else in batches.

    Batches of a joint episode are views of it. The numbers of a run are the same in both cases.

    Attributes:
        limit: Bytes that the job may use. None if unknown.
        run_bytes: Bytes of a run before it is drawn.
        seconds: Time of all draws.
        joint: Episode of all runs, or None if it is not in memory.
    """

    def __init__(self, plan: JobPlan) -> None:
        self.plan = plan
        self.limit = memory_limit(plan.values["memory_limit_gib"], plan.values["device"])
        self.seconds = 0.0
        self.joint: Episode | None = None
        self.run_bytes = memory.undrawn_bytes(plan.scenario, plan.model, self.limit)
        if memory.fits_undrawn(len(plan.runs), self.limit, self.run_bytes):
            self.draw_all()

    def draw_all(self) -> Episode:
        """Draw the episode of all runs."""
        self.joint = self._draw(self.plan.runs)
        return self.joint

    def sample(self) -> Episode:
        """Return all runs if they are in memory, else the first two, for trials."""
        return self._draw(self.plan.runs[:2]) if self.joint is None else self.joint

    def batch(self, first: int, size: int) -> Episode:
        """Return the episode of a batch."""
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

    Returns an episode with views of the tensors.
    """
    truth = {name: values[runs] for name, values in episode.truth.items()}
    track = None if episode.track is None else episode.track[runs]
    return replace(episode, record=episode.record.select_runs(runs), truth=truth, track=track)


def apply_budget(plan: JobPlan, episodes: EpisodeSource) -> tuple[JobPlan, BudgetAllocation | None]:
    """Give the filter as many particles as its budget allows.

    A filter without particles, and one with its own number (filter.particles=...), are unchanged.
    A trial of time uses all runs where their episode is in memory, else two.

    Returns the plan with the new filter, and the allocation, None if the filter is unchanged.
    """
    values = plan.values
    if values["budget"] == store.SAME_N or not plan.config.uses_shared_particles:
        return plan, None
    if values["engine"] in ("tape", "compiled"):
        raise ValueError(
            f"engine must be auto, eager or kernels with budget={values['budget']}, got "
            f"{values['engine']}. Use engine=auto or budget={store.SAME_N}: trials take kernels."
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
    with dispatch.use_kernels(job_engine != "eager"):
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

    Returns runs per batch, at most all.
    """
    runs, limit = len(plan.runs), episodes.limit
    if limit is None or not memory.needs_memory_trial(
        plan.method, plan.model, runs, limit, episodes.run_bytes
    ):
        if episodes.joint is None:
            episodes.draw_all()
        return runs
    episode = slice_runs(episodes.sample(), slice(0, 2))
    estimate = estimate_job_memory(plan, episode)
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


def estimate_job_memory(plan: JobPlan, episode: Episode) -> memory.MemoryEstimate:
    """Estimate the bytes of a job from the episode of two runs."""
    model = plan.make_filter_model(episode)
    truth = model.assemble(episode.truth).to(model.anchor)
    score_steps = min(plan.values["score_steps"], 1)

    def watch(runs: int, steps: int) -> ScoreRecorder:
        return ScoreRecorder(model, truth[:runs, :steps], score_steps)

    def run_batch(runs: int) -> int:
        return plan.choose_run_batch(plan.method, runs)

    return memory.estimate_memory(plan.method, model, episode, run_batch, watch)
