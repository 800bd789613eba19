"""Gain adaptations: adaptive factor, and a bound on the ratio of error to noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.gaussian.innovation import GainAdaptation, Innovation
from pfbench.filter.gaussian.principal_axes import (
    axes_by_group,
    check_weight,
    compute_group_root,
    diagonal_axes,
    measurement_precision,
    whitened_measurement,
)


@dataclass(frozen=True)
class AdaptiveFactorGain(GainAdaptation):
    """Scale the predicted covariance by 1 / alpha if the innovation is large.

    P- / alpha [Yang, He and Xu 2001] with dV = sqrt(v' W v / tr(W (C_zz + R))). The factor is
    alpha = 1 while dV <= c0, then c0 / dV, and at least `min_factor`. It cannot distinguish a wrong
    state from a noisy measurement. A noise burst therefore inflates all states, step after step.
    Combine it with BoundedRatioGain.

    Attributes:
        threshold: c0. Infinity switches the factor off.
        min_factor: Smallest alpha.
        weight_by_noise: W = diag(R)^-1 of the model's noise [ours]. False is W = I as printed in the
            literature, which adds m^2 to (m/s)^2.

    Raises:
        ValueError: If an argument is outside its range.
    """

    threshold: float = 1.5
    min_factor: float = 0.1
    weight_by_noise: bool = True

    def __post_init__(self) -> None:
        check_weight("AdaptiveFactorGain.min_factor", self.min_factor)
        if not self.threshold > 0.0:
            raise ValueError(
                f"AdaptiveFactorGain.threshold must be positive, got {self.threshold}. "
                "Use .inf for no factor."
            )

    @override
    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor:
        w = (
            measurement_precision(innovation)
            if self.weight_by_noise
            else innovation.observed_mask.to(innovation.r.dtype)
        )
        expected = (w * diagonal_axes(innovation.predicted_covariance + innovation.noise)).sum(-1)
        normalised_innovation = torch.sqrt(
            (w * innovation.r.square()).sum(-1) / torch.where(expected > 0.0, expected, 1.0)
        )
        return factor / torch.where(
            normalised_innovation > self.threshold, self.threshold / normalised_innovation, 1.0
        ).clamp(min=self.min_factor)


@dataclass(frozen=True)
class BoundedRatioGain(GainAdaptation):
    """Bound the ratio rho of predicted error to noise [ours, after the paper].

    The gain is rho / (1 + rho). rho is the largest eigenvalue of C_zz in units of the current R
    of a sensor group. A factor f above 1 is reduced until f rho is at most `max_ratio`, but not
    below 1, so the model's own prediction is never narrowed. If f rho is below `min_ratio`, f grows.

    Attributes:
        max_ratio: Upper bound. Infinity switches it off.
        min_ratio: Lower bound. 0 switches it off.
        groups: Group number of each component, as in ConstrainedNoiseAdaptation.

    Raises:
        ValueError: If a bound is negative or `min_ratio` exceeds `max_ratio`.
    """

    max_ratio: float = 1.0
    min_ratio: float = 0.0
    groups: Sequence[int] | None = None
    has_evidence = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_ratio <= self.max_ratio:
            raise ValueError(
                "BoundedRatioGain.min_ratio must be from 0 to max_ratio, "
                f"got min_ratio={self.min_ratio}, max_ratio={self.max_ratio}. Choose 0 <= min_ratio <= max_ratio."
            )

    @override
    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor:
        _, joint_mask = axes_by_group(innovation, self.groups)
        white = whitened_measurement(
            compute_group_root(innovation.noise, joint_mask),
            innovation.predicted_covariance,
            joint_mask,
        )
        rho = torch.linalg.eigvalsh(white).amax(-1).clamp(min=0.0)
        positive_rho = torch.where(rho > 0.0, rho, 1.0)
        factor = torch.where(
            factor * rho > self.max_ratio, (self.max_ratio / positive_rho).clamp(min=1.0), factor
        )
        return torch.where(
            (factor * rho < self.min_ratio) & (rho > 0.0), self.min_ratio / positive_rho, factor
        )
