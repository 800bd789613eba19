"""Robust updates of Gaussian filters: weights of a measurement that depend on its residual.

A weight w divides the noise of its components, R_ij / sqrt(w_i w_j). It belongs to the filter, not
to the model. Since it depends on y, the evidence of the filter is not a density.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.robust.component_groups import (
    DOWNWEIGHTED,
    ComponentGrouping,
    GroupDistances,
)


class RobustUpdate(NoiseAdaptation):
    """Base of the updates that judge a measurement by its residual.

    A filter takes at most one of them: a second would judge the residual again.

    Attributes:
        grouping: Components with a common weight, see ComponentGrouping.
        groups: Group number of each component, instead of `grouping`.
    """

    has_evidence = False
    grouping: str
    groups: Sequence[int] | None

    @property
    def component_grouping(self) -> ComponentGrouping:
        """The groups of components that are judged together."""
        return ComponentGrouping(self.grouping, self.groups)

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        return predicted


class ResidualLoss(RobustUpdate, ABC):
    """Base of the updates that follow from a loss of the residual, a function of its distance.

    Attributes:
        is_density: True if exp(-loss) is a density of the measurement given the state.
    """

    is_density: bool = False

    @abstractmethod
    def residual_weight(self, squared: Tensor, size: Tensor) -> Tensor:
        """Compute the weight of groups.

        Args:
            squared: Squared distances d^2 of the residual by group.
            size: Observed components of the group.
        """

    @abstractmethod
    def log_density(self, squared: Tensor, size: Tensor) -> Tensor:
        """Compute minus the loss of groups in whitened coordinates, with its constant.

        Args:
            squared: Squared distances d^2 of the residual by group.
            size: Observed components of the group.
        """


class InnovationWeight(RobustUpdate, ABC):
    """Base of the updates that weigh a measurement by the innovation, in one step."""

    @abstractmethod
    def innovation_weight(
        self, innovation: Innovation, memory: Mapping[str, Tensor]
    ) -> tuple[Tensor, GroupDistances, dict[str, Tensor]]:
        """Compute the weight of each component.

        Args:
            innovation: Innovation of the step.
            memory: Values of this update from the step before, by name.

        Returns:
            Weights [R, k], 0 for a rejected component, the groups, and values by name, [R, ...].
        """


def updated_residual(innovation: Innovation) -> tuple[Tensor, Tensor]:
    """Compute the residual after the update, and the covariance of its prediction.

    Args:
        innovation: Innovation of the step, with the noise in use.

    Returns:
        e = r - M xi+ [R, k], and M P+ M' with the error of the linearisation [R, k, k].
    """
    shift, root, _ = kalman_gain_update(innovation)
    half = innovation.m @ root
    residual = innovation.r - (innovation.m @ shift.unsqueeze(-1)).squeeze(-1)
    return residual, half @ half.mT + (innovation.omega - innovation.noise)


def finite_weight(weight: Tensor) -> Tensor:
    """Return weights, 1 in place of NaN: a run without a root is lost in the update itself."""
    return torch.where(weight == weight, weight, 1.0)


def count_downweighted(groups: GroupDistances, weight: Tensor) -> dict[str, Tensor]:
    """Count the fixes of the step whose weight is below 1/2.

    Args:
        groups: Groups of components.
        weight: Weights, [R, k].

    Returns:
        The count [R] by the name of its trace.
    """
    return {"downweighted": groups.count_groups(weight < DOWNWEIGHTED)}


def check_efficiency(name: str, efficiency: float) -> None:
    """Check that an efficiency is between 0 and 1.

    Args:
        name: Class for the message.
        efficiency: Value to check.

    Raises:
        ValueError: If it is not.
    """
    if not 0.0 < efficiency < 1.0:
        raise ValueError(f"{name}.efficiency must be in (0, 1), got {efficiency}. Use 0.95.")


def check_threshold(name: str, threshold: float | None) -> None:
    """Check that a threshold is positive.

    Args:
        name: Class for the message.
        threshold: Value to check, None for a threshold by efficiency.

    Raises:
        ValueError: If it is not positive.
    """
    if threshold is not None and not threshold > 0.0:
        raise ValueError(
            f"{name}.threshold must be positive, got {threshold}. Use null for the threshold of "
            "95 % efficiency."
        )
