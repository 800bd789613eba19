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
        return torch.where(value == value, value, -torch.inf)  # not isnan: a compiler has no instruction for it


@dataclass(frozen=True)
class Floored:
    """Weights multiplied as plain numbers, and a floor added: what copied code does. A handicap, for comparison [ours].

    e^-745 is the smallest number there is in double precision, so that a particle some 38 deviations from what was seen weighs
    nothing by itself, and by the floor as much as all others like it: where the whole cloud lies that far off, nothing is learnt.

    Args:
        floor: added to each particle's weight before they are normalised.

    Raises:
        ValueError: a floor that is not positive.
    """

    floor: float = 1e-300
    exact = False

    def __post_init__(self) -> None:
        if not self.floor > 0.0:
            raise ValueError(f"weigh.floor={self.floor}: give a small positive number; Bayes needs none")

    def __call__(self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, seen: Record) -> Tensor:
        likelihood = torch.exp((model.log_likelihood(seen.y, x, seen.u) + log_ratio).double()).nan_to_num(nan=0.0)
        weight = torch.log(torch.exp(log_w.double()) * likelihood + self.floor)
        return torch.where(torch.isneginf(log_w), -torch.inf, weight).to(log_w)
