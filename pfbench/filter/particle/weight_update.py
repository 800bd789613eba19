"""Weight updates by the measurement, and normalisation of the weights."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.record import Record
from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable, is_capturing
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

        Args:
            model: State-space model of the step.
            log_w: Log weights before the measurement, [R, N].
            x: Particles, [R, N, D].
            log_ratio: Density ratio of the proposal, [R, N].
            record: Record of the step.
            memory: Memory of the particles at t-1, with the values of this update.

        Returns:
            Weights, values for the next step and numbers for the report.
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

    Args:
        weight_update: Weight update of the filter.
        model: State-space model of the step.
        log_w: Log weights before the measurement, [R, N].
        x: Particles, [R, N, D].
        log_ratio: Density ratio of the proposal, [R, N].
        record: Record of the step.
        memory: Memory of the particles at t-1.

    Returns:
        Weights, values for the next step and numbers for the report.
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
        return _summed(log_likelihood, _narrow(log_w), _narrow(log_ratio))


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


def is_resolved(maximum: Tensor) -> Tensor:
    """Return whether log weights differ by more than rounding, from their maximum.

    Below -1 / eps neighbouring numbers differ by 1 or more, so that the weights are noise: in double
    precision at 1e8 standard deviations from the measurement.
    """
    return maximum > -1.0 / torch.finfo(maximum.dtype).eps


def deactivate_invalid_particles(
    x: Tensor, log_w: Tensor, parents: Tensor
) -> tuple[Tensor, Tensor]:
    """Set the log weight of non-finite particles to -inf and restore the parent state.

    Otherwise one NaN would spread to the estimate of its run, because 0 * NaN is NaN.

    Args:
        x: Particles, [R, N, D].
        log_w: Log weights, [R, N].
        parents: Particles before the step, [R, N, D].

    Returns:
        Particles and log weights.
    """
    if is_capturing():  # the caller of the graph checks, and repeats the step
        return x, log_w
    if not x.is_cuda and math.isfinite(float(x.detach().sum())):  # this check is cheap on the CPU
        return x, log_w
    healthy = torch.isfinite(x.sum(-1))
    log_w = torch.where(healthy, log_w, -torch.inf)
    x = torch.where(healthy, x.permute(2, 0, 1), parents.permute(2, 0, 1)).permute(1, 2, 0)
    return x, log_w


def is_equal_for_all(a: Tensor) -> bool:
    """Return whether numbers [R, N] are stored once for all particles of a run."""
    return a.stride(1) == 0


def _narrow(a: Tensor) -> Tensor:
    """Return numbers [R, N] as [R, 1] if they are stored once for all particles of a run."""
    return a[:, :1] if is_equal_for_all(a) else a


def _separate_sum(log_likelihood: Tensor, log_w: Tensor, log_ratio: Tensor) -> Tensor:
    """Return the sum [R, N] of terms [R, N] or [R, 1], -inf in place of NaN."""
    value = log_likelihood + log_w + log_ratio
    return torch.where(value == value, value, -torch.inf)  # isnan does not compile


def _separate_normalise(log_w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalise the log weights of a step.

    A run without a finite weight gets equal weights, as one whose log weights are not resolved.

    Args:
        log_w: Log weights, [R, N].

    Returns:
        Normalised log weights [R, N], their logsumexp before [R] (-inf if none is finite), weights
        [R, N] and effective sample size [R].
    """
    # one exponential per particle, because exponentials dominate the cost of a small step
    maximum = log_w.detach().amax(1, keepdim=True)
    resolved = is_resolved(maximum)
    maximum = torch.where(torch.isfinite(maximum), maximum, 0.0)
    scaled_w = torch.exp(log_w - maximum)
    total, square_total = _totals(scaled_w)
    lost = ~(torch.isfinite(total) & (total > 0.0) & resolved)
    total, slots = torch.where(lost, 1.0, total), log_w.shape[1]
    log_total = maximum + torch.log(total)
    log_w = torch.where(lost, -math.log(slots), log_w - log_total)
    w = torch.where(lost, 1.0 / slots, scaled_w * (1.0 / total))
    ess = torch.where(lost, slots, total * total / square_total).squeeze(1)
    return log_w, torch.where(lost, -torch.inf, log_total).squeeze(1), w, ess


def _separate_totals(a: Tensor) -> tuple[Tensor, Tensor]:
    """Return sums of rows [R, N] and of their squares, [R, 1] each."""
    return a.sum(1, keepdim=True), a.square().sum(1, keepdim=True)


def has_long_rows(a: Tensor, *_: Tensor) -> bool:
    """Return whether the compiler cannot sum rows [R, N, ...] in registers."""
    return a.shape[1] > 4096


_summed = compilable(
    _separate_sum, operator=cpp.sum_log_weights, keep_in_graph=False, use_torch_compiler=False
)
_totals = compilable(_separate_totals, operator=cpp.sum_and_squares, keep_in_graph=has_long_rows)
normalise_updated_weights = compilable(
    _separate_normalise,
    operator=cpp.normalise_weights,
    keep_in_graph=False,
    use_torch_compiler=False,
)
