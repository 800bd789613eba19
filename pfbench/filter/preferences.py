"""Which particles a resampler prefers. Weights carry the correction, so any preference is honest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.filter.belief import Cloud
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


class Preference(Protocol):
    """The cloud at t-1 and what is seen at t -> log resampling probabilities [R, N], logsumexp 0."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Tensor: ...


@dataclass(frozen=True)
class Weights:
    """The weights themselves: the plain particle filter."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Tensor:
        return cloud.log_w


@dataclass(frozen=True)
class LookAhead:
    """First-stage weights of the auxiliary particle filter: w p(y | x propagated without noise) [Pitt and Shephard 1999].

    Args:
        power: exponent on the look-ahead likelihood. 1 is as published; less guards against a look-ahead that is more certain
            than the particles deserve, which makes the second-stage weights heavy-tailed.
    """

    power: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.power <= 1.0:
            raise ValueError(f"preference.power={self.power}: give an exponent in (0, 1]; 1 is the published filter")

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Tensor:
        quiet = model.noise.mean.expand(*cloud.x.shape[:2], model.noise_dim)
        ahead = model.log_likelihood(seen.y, model.propagate(cloud.x, seen.u, quiet), seen.u)
        log_a = cloud.log_w + self.power * torch.where(torch.isnan(ahead), -torch.inf, ahead)
        total = log_a.logsumexp(1, keepdim=True)
        return torch.where(torch.isfinite(total), log_a - total, cloud.log_w)
