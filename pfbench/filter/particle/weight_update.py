"""Weight updates by the measurement."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.record import Record
from pfbench.filter.belief import add_log_weights, is_resolved
from pfbench.kernels.dispatch import is_capturing
from pfbench.model.base import StateSpaceModel

WEIGHT_UPDATE_MEMORY = "weight_update."  # start of the names of its values in the particles' memory


class WeightUpdate(Protocol):
    """Weight update by the measurement."""

    @property
    def is_exact(self) -> bool:
        """True if the weights are those of the posterior."""

    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        """Compute the weights after the measurement.

        Args:
            model: State-space model of the step.
            log_w: Log weights before the measurement, [R, N].
            x: Particles, [R, N, D].
            log_ratio: Density ratio of the proposal, log p(w) - log q(w), [R, N].
            record: Record of the step.

        Returns:
            Log weights, [R, N], not normalised.
        """


class UpdatedWeights(NamedTuple):
    """Result of a weight update with memory.

    Attributes:
        log_w: Log weights, [R, N], not normalised.
        memory: Values for the next step by name, [R, 1, ...], equal for all particles of a run.
        trace: Numbers per run for the report, {name: [R]}.
    """

    log_w: Tensor
    memory: dict[str, Tensor]
    trace: dict[str, Tensor]


class MemoryWeightUpdate(ABC):
    """Weight update that judges a measurement by the predicted particles, with a memory."""

    @abstractmethod
    def update_weights(
        self,
        model: StateSpaceModel,
        log_w: Tensor,
        x: Tensor,
        log_ratio: Tensor,
        record: Record,
        memory: dict[str, Tensor],
    ) -> UpdatedWeights:
        """Compute the weights after the measurement.

        Shapes: log_w [R, N], x [R, N, D], log_ratio [R, N].
        """


def compute_updated_weights(
    weight_update: WeightUpdate | MemoryWeightUpdate,
    model: StateSpaceModel,
    log_w: Tensor,
    x: Tensor,
    log_ratio: Tensor,
    record: Record,
    memory: dict[str, Tensor],
) -> UpdatedWeights:
    """Apply a weight update with or without memory.

    Returns weights, values for the next step and numbers for the report. Shapes: log_w [R, N], x
    [R, N, D], log_ratio [R, N].
    """
    if isinstance(weight_update, MemoryWeightUpdate):
        return weight_update.update_weights(model, log_w, x, log_ratio, record, memory)
    return UpdatedWeights(weight_update(model, log_w, x, log_ratio, record), {}, {})


@dataclass(frozen=True)
class BayesWeightUpdate(WeightUpdate):
    """Bayes' rule: log w + log p(y | x) + log p(w) - log q(w). A NaN becomes weight 0."""

    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        log_likelihood = model.log_likelihood(record.y, x, record.u).expand_as(log_w).to(log_w)
        return add_log_weights(log_likelihood, log_w, log_ratio)


@dataclass(frozen=True)
class FlooredWeightUpdate(WeightUpdate):
    """Weights as plain numbers plus a floor, as in much code, for comparison [ours].

    The smallest double is e^-745. A particle 38 standard deviations from the measurement gets
    weight 0, so only the floor remains. If all particles are that far away, all weights become
    equal. A run is lost if not even the logarithms distinguish its particles, see `is_resolved`.

    Attributes:
        weight_floor: Number added to each particle's weight before normalisation.

    Raises:
        ValueError: If the floor is not positive.
    """

    weight_floor: float = 1e-300
    is_exact = False

    def __post_init__(self) -> None:
        if not self.weight_floor > 0.0:
            raise ValueError(
                f"weight_update.weight_floor must be positive, got {self.weight_floor}. "
                "Choose a small number, or BayesWeightUpdate, which needs none."
            )

    @override
    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        log_likelihood = model.log_likelihood(record.y, x, record.u) + log_ratio
        likelihood = torch.exp(log_likelihood.double()).nan_to_num(nan=0.0)
        weight = torch.log(torch.exp(log_w.double()) * likelihood + self.weight_floor)
        comparable = torch.where(log_likelihood == log_likelihood, log_likelihood, -torch.inf)
        empty = torch.isneginf(log_w) | ~is_resolved(comparable.amax(1, keepdim=True))
        return torch.where(empty, -torch.inf, weight).to(log_w)


def deactivate_invalid_particles(
    x: Tensor, log_w: Tensor, parents: Tensor
) -> tuple[Tensor, Tensor]:
    """Set the log weight of non-finite particles to -inf and restore the parent state.

    Otherwise one NaN would spread to the estimate of its run, because 0 * NaN is NaN.

    Returns particles and log weights. Shapes: x [R, N, D], log_w [R, N], parents [R, N, D].
    """
    if is_capturing():  # the caller of the graph checks, and repeats the step
        return x, log_w
    if not x.is_cuda and math.isfinite(float(x.detach().sum())):  # this check is cheap on the CPU
        return x, log_w
    healthy = torch.isfinite(x.sum(-1))
    log_w = torch.where(healthy, log_w, -torch.inf)
    x = torch.where(healthy, x.permute(2, 0, 1), parents.permute(2, 0, 1)).permute(1, 2, 0)
    return x, log_w
