"""Swarm state, and velocity updates of its particles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream


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
    figure shows an increase.

    Attributes:
        inertia_weight: w.
        cognitive_coefficient: c1, not specified in the paper. Mean-square stability requires
            c1 + c2 < 24 (1 - w^2) / (7 - 5 w) [Poli 2009], 2.88 for w = 0.8. The usual value 2 for
            both is unstable. [ours]
        social_coefficient: c2.
        escape_coefficient: Coefficient of escape. 0 gives the plain swarm.

    Raises:
        ValueError: If the inertia weight is outside [0, 1) or a coefficient is negative.
    """

    inertia_weight: float = 0.8
    cognitive_coefficient: float = 1.2
    social_coefficient: float = 1.2
    escape_coefficient: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.inertia_weight < 1.0:
            raise ValueError(
                f"proposal.velocity.inertia_weight must be in [0, 1), got {self.inertia_weight}. "
                "Reduce it."
            )
        for name in ("cognitive_coefficient", "social_coefficient", "escape_coefficient"):
            if getattr(self, name) < 0.0:
                raise ValueError(
                    f"proposal.velocity.{name} must be at least 0, got {getattr(self, name)}. "
                    "Set 0 or more."
                )

    def compute_escape_factor(self, phase: float) -> float:
        """Return c3 = c4 for a phase from 0 to 1."""
        return self.escape_coefficient * (1.0 - math.cos(math.pi * phase))

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


def match_memory_layout(a: Tensor, template: Tensor) -> Tensor:
    """Copy a tensor into the memory layout of another one, for faster loops.

    Args:
        a: Tensor to copy.
        template: Tensor of the same shape and the new layout.

    Returns:
        Copy of the tensor.
    """
    return torch.empty_like(template, dtype=a.dtype).copy_(a)


def select_particle(q: Tensor, i: Tensor) -> Tensor:
    """Select one particle per run.

    Args:
        q: Positions, [R, N, k].
        i: Slot of each run, [R].

    Returns:
        Positions, [R, 1, k].
    """
    return q.gather(1, i[:, None, None].expand(-1, 1, q.shape[-1]))


def select_swarm_by_run(active: Tensor, new: SwarmState, old: SwarmState) -> SwarmState:
    """Select the swarm of each run.

    Args:
        active: Mask of the runs that take `new`, [R].
        new: Swarm of active runs.
        old: Swarm of other runs.

    Returns:
        Swarm.
    """
    return SwarmState(
        *(
            torch.where(active.reshape(-1, *[1] * (a.dim() - 1)), a, b)
            for a, b in zip(new, old, strict=True)
        )
    )
