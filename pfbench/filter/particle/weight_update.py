"""Weight updates by the measurement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.core.record import Record
from pfbench.model.base import StateSpaceModel


class WeightUpdate(Protocol):
    """Compute log weights [R, N], not normalised, from those before, the particles and the record."""

    @property
    def is_exact(self) -> bool:
        """Whether the weights are those of the posterior."""

    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor: ...


@dataclass(frozen=True)
class BayesWeightUpdate:
    """Bayes' rule: log w + log p(y | x) + log p(w) - log q(w). A NaN becomes weight 0."""

    is_exact = True

    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        value = log_w + model.log_likelihood(record.y, x, record.u) + log_ratio
        return torch.where(value == value, value, -torch.inf)  # isnan would not compile


@dataclass(frozen=True)
class FlooredWeightUpdate:
    """Weights multiplied as plain numbers with a floor added, as common code does, for comparison [ours].

    The smallest double is e^-745. A particle 38 standard deviations from the measurement gets weight
    0, so the floor decides. If all particles are that far away, the measurement has no effect.

    Attributes:
        weight_floor: Added to each particle's weight before normalisation.

    Raises:
        ValueError: If the floor is not positive.
    """

    weight_floor: float = 1e-300
    is_exact = False

    def __post_init__(self) -> None:
        if not self.weight_floor > 0.0:
            raise ValueError(
                f"weight_update.weight_floor must be positive, got {self.weight_floor}. Choose a small number, or BayesWeightUpdate, which needs none"
            )

    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        likelihood = torch.exp(
            (model.log_likelihood(record.y, x, record.u) + log_ratio).double()
        ).nan_to_num(nan=0.0)
        weight = torch.log(torch.exp(log_w.double()) * likelihood + self.weight_floor)
        return torch.where(torch.isneginf(log_w), -torch.inf, weight).to(log_w)
