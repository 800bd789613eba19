"""What filters that are compared have alike: the number of particles, or what a step costs.

A step's price is what SIR takes for it with the number of particles that was asked for, in time or in evaluations of the
likelihood; every other particle filter gets as many particles as come nearest to it, found by trial on the job's own worlds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch

from pfbench.draws import MonteCarlo
from pfbench.filter.loop import run_filter
from pfbench.filter.particle import ParticleFilter
from pfbench.judge import Tally
from pfbench.memory import cut
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record
from pfbench.store import SAME_TIME

LEAST = 10  # particles: no filter gets fewer, and then costs more than the others, which reports say [ours]
_WITHIN = 0.03  # of the price is near enough: times scatter by more from job to job [ours]
_TRIALS = 8
_STEPS = 40  # of a trial


class Bought(NamedTuple):
    """What a budget buys.

    Attributes:
        particles: of the filter.
        costs: what a step costs with them, in the trial: seconds of all runs together, or evaluations of a run.
        price: what it was to cost.
        asked: particles of SIR that set the price.
    """

    particles: int
    costs: float
    price: float
    asked: int


@dataclass(frozen=True)
class Trial:
    """Some steps of a job, to see what filters cost there.

    Args:
        model, record, clock, seed: of the job.
        tally: of what that model is asked.
        at_once: filter -> how many runs a step of it takes together.
    """

    model: StateSpaceModel
    record: Record
    clock: Callable[[], float]
    seed: int
    tally: Tally
    at_once: Callable[[Any], int]

    def seconds(self, method: Any) -> float:
        """Of a step of all runs; the quicker of two passes, since what else happens on a machine only ever takes longer."""
        part = cut(self.record, _STEPS)
        return min(self._run(method, part) for _ in range(2)) / part.y.shape[1]

    def likelihoods(self, method: Any) -> float:
        """Evaluations of a step of one run, on average over two runs."""
        part = cut(self.record.of(slice(0, 2)), 5 * _STEPS)
        before = self.tally.count
        self._run(method, part)
        return (self.tally.count - before) / part.y[..., 0].numel()

    def _run(self, method: Any, part: Record) -> float:
        anchor = self.model.anchor
        draws = MonteCarlo(self.seed, torch.arange(len(part.y), device=anchor.device), anchor.dtype)
        begun = self.clock()
        with torch.no_grad():
            run_filter(method, self.model, part, draws, at_once=self.at_once(method))
        return self.clock() - begun


def bought(kind: str, method: Any, asked: int, trial: Trial) -> Bought:
    """How many particles a filter may have.

    Args:
        kind: what filters have alike, of `store.BUDGETS` but the first.
        method: the filter, a dataclass with `particles`.
        asked: particles of SIR that set the price.
        trial: of the job.
    """
    measure = trial.seconds if kind == SAME_TIME else trial.likelihoods
    sir = ParticleFilter(asked)
    price = measure(sir)
    if method == sir:
        return Bought(asked, price, price, asked)

    def cost(particles: int) -> float:
        return measure(replace(method, particles=particles))

    particles, costs = afforded(cost, price, max(LEAST, asked // 4))
    return Bought(particles, costs, price, asked)


def afforded(cost: Callable[[int], float], price: float, first: int) -> tuple[int, float]:
    """The number whose cost comes nearest to the price, and that cost; by secants in logarithms.

    Args:
        cost: of a number of particles; grows with it, but for what measuring scatters.
        price: what it should be.
        first: the number to begin with.
    """
    known = {first: cost(first)}

    def off(n: int) -> float:
        return abs(math.log(known[n] / price))

    while len(known) < _TRIALS and off(min(known, key=off)) > _WITHIN:
        n = _next(known, price)
        if n in known:
            break
        known[n] = cost(n)
    best = min(known, key=off)
    return best, known[best]


def _next(known: dict[int, float], price: float) -> int:
    """Where a line meets the price: through the two trials around it, or else through the two nearest to it.

    The first step takes the cost for proportional to the number.
    """
    under, over = ([n for n in known if (known[n] < price) == low] for low in (True, False))
    if under and over and max(under) < min(over):
        near = [max(under), min(over)]
    else:
        near = sorted(known, key=lambda n: abs(math.log(known[n] / price)))[:2]
    slope = 1.0
    if len(near) == 2:
        a, b = near
        slope = min(2.0, max(0.2, math.log(known[a] / known[b]) / math.log(a / b)))  # small numbers cost hardly less
    step = math.log(price / known[near[0]]) / slope
    return max(LEAST, round(near[0] * math.exp(min(math.log(16.0), step))))
