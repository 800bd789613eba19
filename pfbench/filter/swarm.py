"""Particle swarms: after the prediction, particles fly towards what has been seen, and are then weighed.

A swarm remembers the best place of each particle and of all, and a velocity. Gaussian attraction [Krohling 2004] makes the
swarm-optimised particle filter (PSO-PF); inertia, chaotic perturbation and the flight from the worst places are those of
[Tian et al., "Improved adaptive particle filter for integrated navigation system"].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import torch
from scipy import stats
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, weights
from pfbench.filter.chaos import Perturbation, Prior, Start, logistic, seeds, settled
from pfbench.filter.coordinates import Coordinates, Fitness, Frame, Observed, Posterior
from pfbench.filter.flock import Flock, Inertia, Velocity, laid, pick, where
from pfbench.filter.particle import bury
from pfbench.filter.proposals import Proposed, draw_noise
from pfbench.filter.swarm_weights import Mixture, Weights
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


@dataclass(frozen=True)
class Limits:
    """What keeps a swarm from flying apart, in scales of each coordinate; the paper only names v_max [ours].

    Never taken from the swarm in flight: its shrinking and growing would feed back.

    Args:
        prior: the scale is the initial cloud's standard deviation, the paper's recorded interval; else the predicted cloud's.
        speed: v_max over six scales.
        box: places stay within so many standard deviations of the predicted cloud about its mean; None for anywhere.

    Raises:
        ValueError: a speed or box that is not positive.
    """

    prior: bool = False
    speed: float = 0.5
    box: float | None = 3.0

    def __post_init__(self) -> None:
        if not self.speed > 0.0 or (self.box is not None and not self.box > 0.0):
            raise ValueError(f"limits: speed={self.speed}, box={self.box}; give positive numbers (or box=null for none)")


@dataclass(frozen=True)
class ChiSquare:
    """Stops a run whose best particle is as close to the measurement as the truth would be [ours].

    Its distance, -2 ln p(y | x) + 2 ln p(y_hat | x), is to be at most this quantile of chi-square with as many degrees of freedom
    as components were seen: 5.35 for six and the median. The paper does not give its epsilon.
    """

    quantile: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.quantile < 1.0:
            raise ValueError(f"stop.quantile={self.quantile}: give a probability between 0 and 1")

    def __call__(self, model: StateSpaceModel, best: Tensor, seen: Record) -> Tensor:
        """Best states [R, 1, D] -> which runs stop [R]."""
        y_hat: Tensor = model.observation(best, seen.u).mean[:, 0]
        there = ~torch.isnan(seen.y)
        nearest = model.log_likelihood(torch.where(there, y_hat, torch.nan), best, seen.u)
        distance = 2.0 * (nearest - model.log_likelihood(seen.y, best, seen.u))[:, 0]
        bounds = distance.new_tensor(_quantiles(self.quantile, there.shape[-1]))
        return distance <= bounds[there.sum(-1)]


@dataclass(frozen=True)
class Swarm:
    """Predicts as the bootstrap filter does, then lets the particles fly [Tian et al., steps a to f].

    A run in which nothing is seen does not fly, nor does it from where it has met `stop`. Chaotic sequences belong to slots: were
    they gathered with the particles, siblings would have the same one [ours].

    Args:
        velocity: how they fly.
        perturbation: chaotic, or None.
        fitness: what they seek.
        coordinates: in which coordinates.
        limits: of speed and place.
        stop: when a run stops before the last iteration, or None.
        iterations: at most.
        start: the particles of the very first step.
        weights: what becomes of their weights.

    Raises:
        ValueError: fewer than 1 iteration; limits by the initial cloud in whitened coordinates.
    """

    velocity: Velocity = field(default_factory=lambda: Inertia(escape=0.12))
    perturbation: Perturbation | None = field(default_factory=Perturbation)
    fitness: Fitness = field(default_factory=Posterior)
    coordinates: Coordinates = field(default_factory=lambda: Observed(white=True))
    limits: Limits = field(default_factory=Limits)
    stop: ChiSquare | None = None
    iterations: int = 5
    start: Start = field(default_factory=Prior)
    weights: Weights = field(default_factory=Mixture)

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"proposal.iterations={self.iterations}: give at least 1")
        if self.limits.prior and self.coordinates.white:
            raise ValueError("proposal.limits.prior=true: whitened coordinates have no scale at first; make one of them false")

    @property
    def exact(self) -> bool:
        return self.start.exact and self.weights.exact

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        parents, memory = self._begun(model, cloud, draws)
        w = draw_noise(model, parents.shape[1], draws)
        x, log_w = bury(model.propagate(parents, seen.u, w), cloud.log_w, parents)
        frame = self.coordinates(model, x, weights(log_w), seen.u)
        flock, flown = self.fly(model, frame, torch.isfinite(log_w), memory, seen, draws)
        here = model.log_likelihood(seen.y, frame.place(flock.q), seen.u)
        q, log_ratio = self.weights(frame, flock.q, here, log_w, draws)
        if self.perturbation:
            chaos = memory["swarm.chaos"].index_copy(-1, frame.components, flock.chaos.unsqueeze(1))
            memory = memory | {"swarm.chaos": chaos}
        log_ratio = torch.where(torch.isfinite(log_w), log_ratio, -torch.inf)
        return Proposed(frame.place(q), log_ratio, memory, trace={"iterations": flown})

    def fly(
        self, model: StateSpaceModel, frame: Frame, live: Tensor, memory: dict[str, Tensor], seen: Record, draws: Draws
    ) -> tuple[Flock, Tensor]:
        """The finished swarm, and after how many iterations each run stopped [R].

        Args:
            frame: the predicted cloud.
            live: which slots hold a particle [R, N].
            memory: the initial cloud's scale [R, 1, d] and chaotic values [R, 1, N, d], where they are needed.
        """
        penalty = self.fitness(frame)

        def fitness(q: Tensor) -> Tensor:
            value = model.log_likelihood(seen.y, frame.place(q), seen.u) + penalty(q)
            return torch.where(live & ~torch.isnan(value), value, -torch.inf)

        flock = begun = self._gathered(frame, fitness(frame.q), memory)
        spread = frame.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt().unsqueeze(1)
        scale = memory["swarm.scale"][..., frame.components] if self.limits.prior else spread
        spare = laid(seeds(draws.uniform("swarm.spare", *frame.q.shape[1:])), frame.q) if self.perturbation else None
        active = sighted = ~torch.isnan(seen.y).all(1)
        flown = torch.zeros_like(active, dtype=torch.long)
        for i in range(1, self.iterations + 1):
            if not active.is_cuda and not bool(active.any()):
                break
            v = self.velocity(flock, live, i / self.iterations, draws, f"swarm.velocity.{i}")
            flown = flown + active
            moved = self._moved(flock, v, fitness, scale, spread, spare)
            flock = where(active, moved, flock) if self.stop else moved
            if self.stop:
                best = flock.best_fitness.argmax(1)
                active = active & ~self.stop(model, pick(frame.place(flock.best), best), seen)
        return where(sighted, flock, begun), flown

    def _moved(
        self, flock: Flock, v: Tensor, fitness: Callable[[Tensor], Tensor], scale: Tensor, spread: Tensor, spare: Tensor | None
    ) -> Flock:
        """One iteration: x + v or, if it is fitter, x + v + Dx; and what is to be remembered of it."""
        fastest, chaos = 6.0 * self.limits.speed * scale, flock.chaos
        edge = torch.full_like(spread, torch.inf) if self.limits.box is None else self.limits.box * spread
        v = torch.clamp(v, -fastest, fastest)
        q = torch.clamp(flock.q + v, -edge, edge)
        value = fitness(q)
        if self.perturbation and spare is not None:
            chaos = logistic(chaos, spare)
            other = torch.clamp(flock.q + v + self.perturbation(chaos, scale), -edge, edge)
            there = fitness(other)
            q = torch.where((there > value).unsqueeze(-1), other, q)
            value = torch.maximum(there, value)
        better, worse = value > flock.best_fitness, value < flock.worst_fitness
        best, worst = (torch.where(a.unsqueeze(-1), q, b) for a, b in ((better, flock.best), (worse, flock.worst)))
        best_fitness, worst_fitness = torch.maximum(value, flock.best_fitness), torch.minimum(value, flock.worst_fitness)
        return Flock(q, v, value, best, best_fitness, worst, worst_fitness, chaos)

    def _gathered(self, frame: Frame, fitness: Tensor, memory: dict[str, Tensor]) -> Flock:
        """The swarm before its first iteration: what the step before remembered is forgotten, but for the chaotic values."""
        q = frame.q
        chaos = laid(memory["swarm.chaos"][:, 0, :, frame.components], q) if self.perturbation else q.new_zeros(len(q), 1, 1)
        return Flock(q, torch.zeros_like(q), fitness, q, fitness, q, fitness, chaos)

    def _begun(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """Parents [R, N, D] and memory; at the very first step, the particles that the filter starts from."""
        if "swarm.scale" in cloud.memory:
            return cloud.x, cloud.memory
        chart = model.chart
        z = settled(draws.uniform("swarm.chaos", cloud.x.shape[1], chart.dimension))
        w = weights(cloud.log_w)
        c = chart.subtract(cloud.x, chart.mean(cloud.x, w).unsqueeze(1))
        memory = cloud.memory | {"swarm.scale": (w.unsqueeze(-1) * c * c).sum(1, keepdim=True).sqrt()}
        if self.perturbation:
            memory = memory | {"swarm.chaos": z.unsqueeze(1)}
        return self.start(model, cloud, z), memory


@cache
def _quantiles(p: float, most: int) -> list[float]:
    """Of chi-square with 0 to `most` degrees of freedom."""
    return [0.0, *(float(stats.chi2.ppf(p, k)) for k in range(1, most + 1))]
