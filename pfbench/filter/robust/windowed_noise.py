"""Adaptive measurement noise from a window of innovations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.principal_axes import diagonal_axes
from pfbench.filter.robust.noise_learning import check_factor_bounds, scale_variances
from pfbench.filter.robust.robust_update import RobustUpdate

_WINDOW = "innovation_window"


@dataclass(frozen=True)
class WindowedNoiseAdaptation(RobustUpdate):
    """Innovation-based adaptive estimation of R, IAE [Mehra 1970; Mohamed and Schwarz 1999].

    R_t is the mean of r^2 over the last N measurements minus H P- H', for the diagonal of R only. The
    difference may be negative, so the variance stays between two multiples of the model's. Until a
    component has N measurements, the model's R is used [ours].

    Attributes:
        window: N, number of measurements.
        min_factor: Smallest factor on the model's variance.
        max_factor: Largest factor on the model's variance.

    Raises:
        ValueError: If an argument is outside its range.
    """

    window: int = 20
    min_factor: float = 0.5
    max_factor: float = 100.0

    def __post_init__(self) -> None:
        if type(self.window) is not int or self.window < 2:
            raise ValueError(
                "WindowedNoiseAdaptation.window must be a whole number of at least 2, got "
                f"{self.window}. Use 20."
            )
        check_factor_bounds("WindowedNoiseAdaptation", self.min_factor, self.max_factor)

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        nominal, mask = diagonal_axes(innovation.noise), innovation.observed_mask
        empty = torch.full_like(nominal, torch.nan).unsqueeze(1).repeat(1, self.window, 1)
        squares = belief.memory.get(_WINDOW, empty)
        shifted = torch.cat([squares[:, 1:], innovation.r.square().unsqueeze(1)], 1)
        squares = torch.where(mask.unsqueeze(1), shifted, squares)
        newest = (squares.mean(1) - diagonal_axes(innovation.predicted_covariance)) / nominal
        factor = newest.clamp(self.min_factor, self.max_factor)
        factor = torch.where(mask & torch.isfinite(factor), factor, 1.0)
        adapted = innovation.with_noise(scale_variances(innovation.noise, factor))
        return adapted, {_WINDOW: squares, "noise_factor": factor}
