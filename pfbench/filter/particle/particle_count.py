"""Adaptive numbers of particles."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.filter.belief import ParticleBelief, ess
from pfbench.filter.particle.stages import (
    ParticleCount,
)


@dataclass(frozen=True)
class CountLimits:
    """Limits of the number of particles.

    Attributes:
        minimum: Smallest number.
        maximum: Largest number.
        initial: Initial number.

    Raises:
        ValueError: If the numbers are out of order.
    """

    minimum: int
    maximum: int
    initial: int

    def __post_init__(self) -> None:
        require(
            2 <= self.minimum <= self.initial <= self.maximum,
            "particle_count.limits",
            "satisfy 2 <= minimum <= initial <= maximum",
            f"minimum={self.minimum}, initial={self.initial}, maximum={self.maximum}",
            "Put them in order.",
        )

    def initial_count(self, slots: int) -> int:
        """Return the initial number.

        Raises:
            ValueError: If there are fewer slots than `maximum`.
        """
        require(
            not self.maximum > slots,
            "particle_count.limits.maximum",
            f"be at most filter.particles={slots}",
            self.maximum,
            "Raise filter.particles or lower maximum and initial.",
        )
        return self.initial


@dataclass(frozen=True)
class EssStepCount(ParticleCount):
    """More particles if ESS < threshold N, otherwise fewer.

    See [COFM-AMSSRCPF 2024, Measurement and Control]. ESS is that of the weights at t-1, and
    decides the number at t, so the evidence stays unbiased. The source computes it before the new
    weights, where it is always N and N could only fall. ESS / N hardly depends on N, so the number
    settles at one of its limits.

    Attributes:
        increment: Increment. 0 keeps the number at `limits.initial`.
        ess_threshold: Ratio of ESS to N.
        limits: Limits, which the source does not state [ours].
        before_weights: ESS before the new weights, as printed. The particles are copies of equal
            weight there, so ESS is N, and the number falls to its minimum.

    Raises:
        ValueError: If the step is negative or the threshold is outside [0, 1].
    """

    increment: int = 10
    ess_threshold: float = 0.5
    limits: CountLimits = field(default_factory=lambda: CountLimits(100, 200, 150))
    before_weights: bool = False
    is_exact = True

    def __post_init__(self) -> None:
        require_ranges("particle_count", self, increment="[0, inf]", ess_threshold="[0, 1]")

    @override
    def initial_count(self, slots: int) -> int:
        return self.limits.initial_count(slots)

    @override
    def __call__(self, belief: ParticleBelief) -> Tensor:
        n = (belief.log_w > -torch.inf).sum(1, keepdim=True).to(belief.log_w)  # active particles
        if self.increment == 0:
            return torch.full_like(n, self.limits.initial)
        effective = n if self.before_weights else ess(belief.log_w).unsqueeze(1)
        number = torch.where(
            effective < self.ess_threshold * n,
            n + self.increment,
            n - self.increment,
        )
        return number.clamp(self.limits.minimum, self.limits.maximum)
