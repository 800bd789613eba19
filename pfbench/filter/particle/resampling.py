"""Resampling by copies: choice of ancestors, and the weights of their copies.

A resampler returns particles, not indices, because some (regularised, aggregating) do not copy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, gather_ancestors
from pfbench.filter.exactness import is_every_part_exact
from pfbench.model.base import StateSpaceModel


class ResamplingScheme(Protocol):
    """Draw ancestors [R, N] by probabilities a [R, N]. Slots from n [R, 1] on are ignored."""

    @property
    def is_exact(self) -> bool:
        """Whether every particle gets n a copies on average."""

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor: ...


class Resampler(Protocol):
    """Resample n [R, 1] particles by log probabilities log_a [R, N].

    It returns the new belief and a mask of the resampled runs, [R].
    """

    @property
    def is_exact(self) -> bool:
        """Whether the weighted particles keep their target as N grows."""

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]: ...


@dataclass(frozen=True)
class EssResampler:
    """Resample the runs with a small effective sample size.

    Attributes:
        scheme: How ancestors are drawn.
        ess_threshold: Resample if ESS < threshold n. 1 resamples always, 0 never.

    Raises:
        ValueError: If the threshold is outside [0, 1].
    """

    scheme: ResamplingScheme
    ess_threshold: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 <= self.ess_threshold <= 1.0:
            raise ValueError(
                f"resampler.ess_threshold must be from 0 (never) to 1 (always), got {self.ess_threshold}. "
                "Choose a ratio of ESS to N"
            )

    @property
    def is_exact(self) -> bool:
        """Whether the scheme is unbiased."""
        return is_every_part_exact(**{"resampler.scheme": self.scheme})

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        a = torch.exp(log_a)
        hit = torch.ones_like(belief.log_evidence, dtype=torch.bool)
        if self.ess_threshold < 1.0:
            hit = 1.0 / a.square().sum(-1) < self.ess_threshold * n.squeeze(1)
        ancestors = self.scheme(a, n, draws)
        slots = torch.arange(a.shape[1], device=a.device)
        if self.ess_threshold < 1.0:
            ancestors = torch.where(hit.unsqueeze(1), ancestors, slots)
        fresh = gather_ancestors(belief, ancestors)
        log_w = -torch.log(n.to(a.dtype))
        if log_a is not belief.log_w:  # other probabilities than the weights: correct for them
            log_w = log_w + (belief.log_w - log_a).gather(1, ancestors)
        log_w = torch.where(slots < n, log_w, -torch.inf)
        return fresh._replace(
            log_w=log_w
            if self.ess_threshold == 1.0
            else torch.where(hit.unsqueeze(1), log_w, belief.log_w)
        ), hit
