"""Constant factors on the noise covariances: the control of every study of robustness."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.gaussian.noise_adaptation import scale_columns


@dataclass(frozen=True)
class ScaledNoise(NoiseAdaptation):
    """Constant factors on R and Q.

    If the process noise passes through the rule, its columns of the slope are scaled, and the error
    of the linearisation is that of the nominal noise.

    Attributes:
        r_factor: Factor on the measurement noise covariance.
        q_factor: Factor on the process noise covariance.

    Raises:
        ValueError: If a factor is not positive.
    """

    r_factor: float = 1.0
    q_factor: float = 1.0
    has_evidence = True

    def __post_init__(self) -> None:
        for name in ("r_factor", "q_factor"):
            if not getattr(self, name) > 0.0:
                raise ValueError(
                    f"ScaledNoise.{name} must be positive, got {getattr(self, name)}. Use 1 for "
                    "the model's noise."
                )

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        return scale_process_noise(predicted, belief.mean.new_full((1,), self.q_factor))

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        return innovation.with_noise(innovation.noise * self.r_factor), {}


def scale_process_noise(predicted: AffineApproximation, factor: Tensor) -> AffineApproximation:
    """Multiply the process noise in a prediction by a factor.

    Args:
        predicted: Linearised prediction.
        factor: Factor, [R or 1].

    Returns:
        The prediction.
    """
    f = factor[:, None, None]
    omega = predicted.omega + (f - 1.0) * predicted.noise
    return predicted._replace(
        m=scale_columns(predicted.m, 1.0, torch.sqrt(f)), omega=omega, noise=predicted.noise * f
    )
