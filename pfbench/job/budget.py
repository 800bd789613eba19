"""Equal budgets: number of particles at the cost of SIR with `particles`.

The cost is time or evaluations of the likelihood. The number is solved for by trials of the filter
on the first steps of the job's own episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.loop import run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job.memory import first_steps
from pfbench.job.scoring import LikelihoodCounter
from pfbench.model.base import StateSpaceModel
from pfbench.results.store import SAME_TIME

MIN_PARTICLES = 10  # smallest number; a filter that costs more is reported as such [ours]
_TOLERANCE = 0.03  # relative cost; times of the same job scatter by more [ours]
_MAX_TRIALS = 8
_TRIAL_STEPS = 40


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
        record = first_steps(self.record, _TRIAL_STEPS)
        return min(self._run(method, record) for _ in range(2)) / record.y.shape[1]

    def likelihoods(self, method: Any) -> float:
        """Count the likelihood evaluations per step and run, the mean over two runs."""
        record = first_steps(self.record.select_runs(slice(0, 2)), 5 * _TRIAL_STEPS)
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

    Args:
        kind: Unit of cost, one of `store.BUDGETS` except the first.
        method: Filter, a dataclass with the field `particles`.
        sir_particles: Particles of SIR that define the cost.
        trial: Trial on the job's episode.

    Returns:
        The allocation.
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

    Args:
        cost: Measured cost of a number of particles. It grows with the number, up to scatter.
        price: Target cost.
        first: Number of the first trial.

    Returns:
        The tried number whose cost is nearest to the target, and its cost.
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
