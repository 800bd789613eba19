"""Swarm state, and velocity updates of its particles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import DerivedStream, RandomStream
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.filter.particle.stages import PointSet
from pfbench.model.base import StateSpaceModel


class SwarmState(NamedTuple):
    """State of a particle swarm.

    Attributes:
        q: Positions, [R, N, k].
        v: Velocities, [R, N, k].
        fitness: Fitness, [R, N].
        best: Best position of each particle, [R, N, k].
        best_fitness: Its fitness, [R, N].
        worst: Worst position of each particle, [R, N, k].
        worst_fitness: Its fitness, [R, N].
        chaos: Chaotic values, [R, N, k].
    """

    q: Tensor
    v: Tensor
    fitness: Tensor
    best: Tensor
    best_fitness: Tensor
    worst: Tensor
    worst_fitness: Tensor
    chaos: Tensor

    def best_position(self) -> Tensor:
        """Return the best position of all iterations [R, 1, k]."""
        return select_particle(self.best, self.best_fitness.argmax(1))

    def worst_position(self, active_mask: Tensor) -> Tensor:
        """Return the worst position of this iteration [R, 1, k] among active slots [R, N]."""
        return select_particle(self.q, torch.where(active_mask, self.fitness, torch.inf).argmin(1))


class VelocityUpdate(Protocol):
    """Velocity update of a swarm."""

    def __call__(
        self, swarm: SwarmState, active: Tensor, phase: float, draws: RandomStream, purpose: str
    ) -> Tensor:
        """Compute the next velocities.

        Args:
            swarm: State of the swarm.
            active: Mask of active slots, [R, N].
            phase: Progress over the iterations, from 0 to 1.
            draws: Random stream of the step.
            purpose: Label of the random numbers.

        Returns:
            Velocities, [R, N, k].
        """


@dataclass(frozen=True)
class GaussianVelocity(VelocityUpdate):
    """Gaussian attraction |n1| (pbest - x) + |n2| (gbest - x), n ~ N(0, 1).

    See [Krohling 2004; Tian et al., eq. 29].
    """

    @override
    def __call__(
        self, swarm: SwarmState, active: Tensor, phase: float, draws: RandomStream, purpose: str
    ) -> Tensor:
        n, k = swarm.q.shape[1:]
        cognitive, social = draws.normal(purpose, n, 2 * k).abs().unflatten(-1, (2, k)).unbind(-2)
        return cognitive * (swarm.best - swarm.q) + social * (swarm.best_position() - swarm.q)


@dataclass(frozen=True)
class InertiaVelocity(VelocityUpdate):
    """Velocity update with inertia, attraction and escape.

    Velocity [Tian et al., eqs. 27 and 34] with r ~ U(0, 1):
    w v + c1 r1 (pb - x) + c2 r2 (pg - x) - c3 (r3 (pw - x) + r4 (gw - x)).

    The factor c3 = escape (1 - cos(pi it / iterations)) increases from 0 to twice
    `escape_coefficient`, the meaning of eq. 35. As printed c3 is almost constant, but the paper's
    figure shows an increase: e - e cos(k pi) / iterations at iteration k, 0.12 +- 0.0008 for 150.

    Attributes:
        inertia_weight: w.
        cognitive_coefficient: c1, not specified in the paper. Mean-square stability requires
            c1 + c2 < 24 (1 - w^2) / (7 - 5 w) [Poli 2009], 2.88 for w = 0.8. The usual value 2 for
            both is unstable. [ours]
        social_coefficient: c2.
        escape_coefficient: Coefficient of escape. 0 gives the plain swarm.
        printed_iterations: Largest number of iterations in eq. 35 as printed. None for its meaning.
        escape_schedule: "cosine", or "linear" from 0 to the same end, the schedule that eq. 35
            replaces, whatever `printed_iterations` is.

    Raises:
        ValueError: If the inertia weight is outside [0, 1), a coefficient is negative, the number of
            iterations is below 1, or the schedule is another.
    """

    inertia_weight: float = 0.8
    cognitive_coefficient: float = 1.2
    social_coefficient: float = 1.2
    escape_coefficient: float = 0.0
    printed_iterations: int | None = None
    escape_schedule: str = "cosine"

    def __post_init__(self) -> None:
        require(
            self.printed_iterations is None or not self.printed_iterations < 1,
            "proposal.velocity.printed_iterations",
            "be at least 1",
            self.printed_iterations,
            "Use null for the meaning of eq. 35.",
        )
        require(
            self.escape_schedule in ("cosine", "linear"),
            "proposal.velocity.escape_schedule",
            "be cosine or linear",
            f"{self.escape_schedule!r}",
            "Use cosine for eq. 35.",
        )
        require_ranges(
            "proposal.velocity",
            self,
            inertia_weight="[0, 1)",
            cognitive_coefficient="[0, inf]",
            social_coefficient="[0, inf]",
            escape_coefficient="[0, inf]",
        )

    def compute_escape_factor(self, phase: float) -> float:
        """Return c3 = c4 for a phase from 0 to 1."""
        total = self.printed_iterations
        if self.escape_schedule == "linear":
            return self.escape_coefficient * 2.0 * phase
        if total is None:
            return self.escape_coefficient * (1.0 - math.cos(math.pi * phase))
        return self.escape_coefficient * (1.0 - math.cos(math.pi * round(phase * total)) / total)

    @override
    def __call__(
        self, swarm: SwarmState, active: Tensor, phase: float, draws: RandomStream, purpose: str
    ) -> Tensor:
        n, k = swarm.q.shape[1:]
        terms = 4 if self.escape_coefficient else 2
        u = draws.uniform(purpose, n, terms * k).to(swarm.q.dtype)
        r = u.unflatten(-1, (terms, k)).unbind(-2)
        v = (
            self.inertia_weight * swarm.v
            + self.cognitive_coefficient * r[0] * (swarm.best - swarm.q)
            + self.social_coefficient * r[1] * (swarm.best_position() - swarm.q)
        )
        if self.escape_coefficient:
            from_worst = r[2] * (swarm.worst - swarm.q)
            from_worst = from_worst + r[3] * (swarm.worst_position(active) - swarm.q)
            v = v - self.compute_escape_factor(phase) * from_worst
        return v


def select_particle(q: Tensor, i: Tensor) -> Tensor:
    """Select one particle per run.

    Returns positions, [R, 1, k]. Shapes: q [R, N, k], i [R].
    """
    return q.gather(1, i[:, None, None].expand(-1, 1, q.shape[-1]))


# --------------------------------------------------------------------------------------------------
# Chaotic sequences for particle swarms: the logistic map and initial particles.
#
# z' = 4 z (1 - z) [Tian et al., eq. 31]. The invariant distribution is the arcsine distribution
# on (0, 1), with mean 1/2 and variance 1/8. Each coordinate of each particle has its own
# sequence, since successive values depend on each other. Always float64: in single precision 1
# sequence in 100 stays at 0 after 100 iterations, and 1 in 5 after 3000.

_QUARTERS = 4  # 0, 1/4, 1/2, 3/4 and 1 lead to a fixed point
_SEED_MARGIN = 1e-3
_STUCK = 1e-12  # distance from 0, 3/4 and 1, which rounding can reach
_IN_CACHE, _IN_CACHE_CUDA = 2**14, 2**27  # sequences that are iterated together
_BURN_IN = 50  # iterations to the invariant distribution, each halves the difference


def safe_seeds(u: Tensor) -> Tensor:
    """Map uniforms on (0, 1) to uniforms at least 1e-3 from 0, 1/4, 1/2, 3/4 and 1."""
    start = torch.floor(_QUARTERS * u.double()).clamp(max=_QUARTERS - 1) / _QUARTERS
    return start + _SEED_MARGIN + (u - start) * (1.0 - 2.0 * _QUARTERS * _SEED_MARGIN)


def logistic_map(z: Tensor, spare: Tensor) -> Tensor:
    """Compute the next values, and restart sequences at a fixed point.

    Returns next values, [R, N, k]. Shapes: z [R, N, k], spare [R, N, k].
    """
    z = 4.0 * z * (1.0 - z)
    stuck = (z < _STUCK) | (z > 1.0 - _STUCK) | ((z - 0.75).abs() < _STUCK)
    return torch.where(stuck, spare, z)


def iterate_logistic(u: Tensor) -> Tensor:
    """Map uniforms on (0, 1) to chaotic values after the burn-in."""
    first = safe_seeds(u)
    parts = []
    for seeds in first.flatten().split(_IN_CACHE_CUDA if u.is_cuda else _IN_CACHE):
        z = seeds
        for _ in range(_BURN_IN):
            z = logistic_map(z, seeds)
        parts.append(z)
    return torch.cat(parts).view_as(first)


def follow_logistic(u: Tensor, n: int, d: int) -> Tensor:
    """Follow one sequence from z_0 = u [R, 1, 1]: value k of n in d equal coordinates, [R, n, d]."""
    first = safe_seeds(u)
    values = [logistic_map(first, first)]
    for _ in range(n - 1):
        values.append(logistic_map(values[-1], first))
    return torch.cat(values, 1).expand(-1, -1, d)


def arcsine_cdf(z: Tensor) -> Tensor:
    """Map chaotic values to uniform ones by the arcsine cdf (2 / pi) asin sqrt z."""
    return 2.0 / torch.pi * torch.asin(torch.sqrt(z))


class SwarmStart(Protocol):
    """Start of a swarm: its particles before the first step."""

    @property
    def is_exact(self) -> bool:
        """True if the particles have the initial distribution."""

    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, z: Tensor) -> Tensor:
        """Return the particles of the first step.

        Args:
            model: State-space model.
            belief: Initial particles.
            z: Chaotic values, [R, N, d].

        Returns:
            Particles, [R, N, D].
        """


@dataclass(frozen=True)
class PriorStart(SwarmStart):
    """Initial particles without change."""

    is_exact = True

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, z: Tensor) -> Tensor:
        return belief.x


@dataclass(frozen=True)
class IntervalStart(SwarmStart):
    """a + (b - a) z, [a, b] the range of the initial particles [Tian et al., eq. 39].

    Not the initial distribution: for 100 normal draws the interval is 5 sigma wide. The particles
    have a standard deviation of 1.76 sigma, are uncorrelated, and most are close to its ends.
    """

    is_exact = False

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, z: Tensor) -> Tensor:
        mean = weighted_mean_cov(model.chart, belief)[0].unsqueeze(1)
        d = model.chart.subtract(belief.x, mean)
        active_mask = torch.isfinite(belief.log_w).unsqueeze(-1)
        a = torch.where(active_mask, d, torch.inf).amin(1, keepdim=True)
        b = torch.where(active_mask, d, -torch.inf).amax(1, keepdim=True)
        return model.chart.add(mean, a + (b - a) * z.to(d.dtype))


@dataclass(frozen=True)
class ChaoticPerturbation:
    """Dx = reach (2 z - 1), applied if fitter [Tian et al., eqs. 40 and 42].

    Attributes:
        beta: Reach as a fraction of a coordinate's range, which is six scales. Not specified in
            the paper [ours].

    Raises:
        ValueError: If beta is not positive.
    """

    beta: float = 0.05

    def __post_init__(self) -> None:
        require_ranges(
            "proposal.perturbation",
            self,
            beta="(0, inf] Use perturbation=null for no perturbation.",
        )

    def __call__(self, z: Tensor, scale: Tensor) -> Tensor:
        """Compute a perturbation.

        Args:
            z: Chaotic values, [R, N, k].
            scale: Scale of each coordinate, [R, 1, k].

        Returns:
            Perturbation Dx, [R, N, k].
        """
        return 6.0 * self.beta * scale * (2.0 * z.to(scale.dtype) - 1.0)


@dataclass(frozen=True)
class ChaoticPoints(PointSet):
    """Point set for the initial distribution from chaotic values made uniform [ours].

    The distribution is exactly the initial one.
    """

    is_exact = True

    @override
    def __call__(self, draws: RandomStream, first: int = 0) -> RandomStream:
        return DerivedStream(
            draws, lambda d, p, n, w: arcsine_cdf(iterate_logistic(d.uniform(p, n, w)))
        )
