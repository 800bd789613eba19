"""Random numbers that are correlated between iterations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeAlias

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import BatchRandomStream, RandomStream
from pfbench.filter.belief import ParticleBelief, gather_ancestors
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.particle.resampling import Resampler
from pfbench.model.base import StateSpaceModel

StoredNumbers: TypeAlias = dict[tuple[int, str, int, int], Tensor]
"""Numbers [R, n, w] by (step, purpose, n, w)."""


@dataclass(frozen=True, eq=False)
class CorrelatedStream(BatchRandomStream):
    """A random stream correlated with the one of the last accepted iteration.

    A proposed normal number is rho u + sqrt(1 - rho^2) e, which leaves N(0, I) invariant. The two
    estimates of the likelihood are then correlated, and their ratio is less noisy [Deligiannidis,
    Doucet and Pitt 2018]. A uniform number is Phi of a normal one.

    Attributes:
        independent_stream: Random stream e of this iteration.
        correlation: Correlation rho, 0 for the plain algorithm.
        stored: Numbers u of the last accepted iteration of each chain.
        proposed: Numbers of this iteration, filled as they are drawn.
        step: Time step.
    """

    independent_stream: RandomStream
    correlation: float
    stored: StoredNumbers
    proposed: StoredNumbers = field(default_factory=dict)
    step: int = 0

    @property
    @override
    def dtype(self) -> torch.dtype:
        return self.independent_stream.dtype

    @override
    def at_step(self, step: int) -> CorrelatedStream:
        return replace(self, independent_stream=self.independent_stream.at_step(step), step=step)

    @override
    def select_runs(self, runs: slice) -> RandomStream:
        raise ValueError(
            "pmmh.rho must be 0 for a filter that splits the runs, got a correlated stream, whose "
            "numbers belong to all of them. Set rho=0."
        )

    @override
    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        key, e = (self.step, purpose, n, w), self.independent_stream.normal(purpose, n, w)
        u = self.stored.get(key)
        self.proposed[key] = (
            e if u is None else self.correlation * u + (1.0 - self.correlation**2) ** 0.5 * e
        )
        return self.proposed[key]

    @override
    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        z = self.normal("uniform." + purpose, n, w).double()
        return torch.special.ndtr(z).clamp(1e-12, 1.0 - 1e-12)

    def accept(self, is_accepted: Tensor) -> None:
        """Store the proposed numbers of accepted runs, bool [R]."""
        mask = is_accepted[:, None, None]
        for key, new in self.proposed.items():
            old = self.stored.get(key)
            self.stored[key] = new if old is None else torch.where(mask, new, old)


@dataclass(frozen=True)
class SortedResampler(Resampler):
    """A resampler that sorts the particles by one component first.

    With correlated random numbers neighbours then stay neighbours. Without sorting the first
    resampling removes the correlation. The distribution of the filter does not change.

    Attributes:
        resampler: Resampler of the filter.
        component: Component of the state.
    """

    resampler: Resampler
    component: int = 0

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.resampler": self.resampler})

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        active_mask = torch.isfinite(belief.log_w)
        order = torch.where(active_mask, belief.x[..., self.component], torch.inf).argsort(1)
        sorted_belief = gather_ancestors(belief, order)
        log_a = sorted_belief.log_w if log_a is belief.log_w else log_a.gather(1, order)
        return self.resampler(model, sorted_belief, log_a, n, draws)
