"""How particles are weighed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


class Weighing(Protocol):
    """Log weights before, new particles, the proposal's ratio and what was seen -> log weights [R, N], not normalised."""

    @property
    def exact(self) -> bool: ...

    def __call__(self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, seen: Record) -> Tensor: ...


@dataclass(frozen=True)
class Bayes:
    """log w + log p(y | x) + log p(w) - log q(w); a particle that has become NaN weighs nothing."""

    exact = True

    def __call__(self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, seen: Record) -> Tensor:
        value = log_w + model.log_likelihood(seen.y, x, seen.u) + log_ratio
        return torch.where(torch.isnan(value), -torch.inf, value)
