"""Resampling by copies: choice of ancestors, and the weights of their copies.

A resampler returns particles, not indices, because some (regularised, aggregating) do not copy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, gather_ancestors
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.log_weights import exponentiate
from pfbench.model.base import StateSpaceModel


class ResamplingScheme(Protocol):
    """Resampling scheme: the distribution of the ancestors, given their probabilities."""

    @property
    def is_exact(self) -> bool:
        """True if every particle gets n a copies on average."""

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        """Draw ancestors.

        Args:
            a: Probabilities, [R, N].
            n: Number of particles to draw, [R, 1]. Later slots are ignored.
            draws: Random stream of the step.

        Returns:
            Slot that each new particle copies, [R, N].
        """


class Resampler(Protocol):
    """Stage that replaces particles by others of the same target."""

    @property
    def is_exact(self) -> bool:
        """True if resampling does not change the target of the particles as N grows."""

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        """Resample particles.

        Args:
            model: State-space model of the step.
            belief: Weighted particles.
            log_a: Log resampling probabilities, [R, N]. The same object as the log weights of the
                belief if the probabilities are the weights.
            n: Number of new particles, [R, 1].
            draws: Random stream of the step.

        Returns:
            New particles and a mask of the resampled runs, [R].
        """


@dataclass(frozen=True)
class EssResampler(Resampler):
    """Resample the runs with a small effective sample size.

    Attributes:
        scheme: Resampling scheme.
        ess_threshold: Resample if ESS < threshold n. 1 resamples at every step, 0 never.

    Raises:
        ValueError: If the threshold is outside [0, 1].
    """

    scheme: ResamplingScheme
    ess_threshold: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 <= self.ess_threshold <= 1.0:
            raise ValueError(
                "resampler.ess_threshold must be from 0 (never) to 1 (at every step), got "
                f"{self.ess_threshold}. Choose a ratio of ESS to N."
            )

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.scheme": self.scheme})

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        a = exponentiate(log_a, belief.weights)
        resampled_mask = torch.ones_like(belief.log_evidence, dtype=torch.bool)
        ancestors = self.scheme(a, n, draws)
        slots = torch.arange(a.shape[1], device=a.device)
        if self.ess_threshold < 1.0:
            resampled_mask = 1.0 / a.square().sum(-1) < self.ess_threshold * n.squeeze(1)
            ancestors = torch.where(resampled_mask.unsqueeze(1), ancestors, slots)
        log_w = -torch.log(n.to(a.dtype))
        if log_a is not belief.log_w:  # other probabilities than the weights: correct for them
            log_w = log_w + (belief.log_w - log_a).gather(1, ancestors)
        log_w = torch.where(slots < n, log_w, -torch.inf)
        if self.ess_threshold < 1.0:
            log_w = torch.where(resampled_mask.unsqueeze(1), log_w, belief.log_w)
        return gather_ancestors(belief, ancestors, log_w), resampled_mask
