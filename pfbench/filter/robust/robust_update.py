"""Robust updates of Gaussian filters: weights of a measurement that depend on its residual.

A weight w divides the noise of its components, R_ij / sqrt(w_i w_j). It belongs to the filter, not
to the model. Since it depends on y, the evidence of the filter is not a density.
"""

from __future__ import annotations

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.robust.component_groups import (
    DOWNWEIGHTED,
    GroupDistances,
)


class RobustUpdate(NoiseAdaptation):
    """Base of the updates that judge a measurement by its residual.

    A filter takes at most one of them: a second would judge the residual again.
    """

    has_evidence = False

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        return predicted


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
