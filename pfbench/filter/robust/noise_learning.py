"""Measurement noise learned by the filter, per component."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, diagonal_axes
from pfbench.filter.robust.robust_update import RobustUpdate, updated_residual

_FORGETTING = "(0, 1) Use 0.98."
_BOUNDS = {"min_factor": "(0, 1] Use 0.5.", "max_factor": "[1, inf] Use 100."}
_VARIATIONAL = {
    "forgetting_factor": _FORGETTING,
    "prior_count": "(0, inf) Use 10.",
    "iterations": "whole [1, inf) Use 4.",
}

# Learned noise suits noise that changes slowly. After a single outlier the learned variance stays too large for
# the length of the memory. Missing components do not change the memory.


@dataclass(frozen=True)
class SageHusaAdaptation(RobustUpdate):
    """Sage and Husa's estimate of R, with safeguards.

    R_t = (1 - g) R_t-1 + g (r r' - H P- H'), g = (1 - b) / (1 - b^(t+1)), for the diagonal of R only
    [Sage and Husa 1969]. Three safeguards: g is at most `max_gain`, since g = 1 at the first step would
    discard the model's R. The variance stays between two multiples of the model's. Q is not estimated,
    since R and Q together diverge [ours].

    Attributes:
        forgetting_factor: b. The memory is 1 / (1 - b) measurements.
        max_gain: Largest g.
        min_factor: Smallest factor on the model's variance.
        max_factor: Largest factor on the model's variance.

    Raises:
        ValueError: If an argument is outside its range.
    """

    forgetting_factor: float = 0.98
    max_gain: float = 0.05
    min_factor: float = 0.5
    max_factor: float = 100.0

    def __post_init__(self) -> None:
        rules = {"forgetting_factor": _FORGETTING, "max_gain": "(0, 1] Use 0.05."}
        require_ranges("SageHusaAdaptation", self, **rules, **_BOUNDS)

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        nominal, mask = diagonal_axes(innovation.noise), innovation.observed_mask
        factor = belief.memory.get("noise_factor", torch.ones_like(nominal))
        count = belief.memory.get("noise_count", torch.zeros_like(nominal))
        b = self.forgetting_factor
        gain = ((1.0 - b) / (1.0 - b ** (count + 1.0))).clamp(max=self.max_gain)
        newest = (innovation.r.square() - diagonal_axes(innovation.predicted_covariance)) / nominal
        learned = ((1.0 - gain) * factor + gain * newest).clamp(self.min_factor, self.max_factor)
        factor = torch.where(mask & torch.isfinite(learned), learned, factor)
        return innovation.with_noise(scale_variances(innovation.noise, factor)), {
            "noise_factor": factor,
            "noise_count": count + mask.to(count),
        }


@dataclass(frozen=True)
class VariationalNoiseAdaptation(RobustUpdate):
    """Variational Bayes for a diagonal R [Sarkka and Nummenmaa 2009].

    sigma_i^2 ~ IG(alpha_i, beta_i). Before a measurement both are multiplied by rho, then alpha grows
    by 1/2. In turn, x is updated with R = diag(beta / alpha), and beta = beta- + (e_i^2 +
    [H P+ H']_ii) / 2. At the start the model's variance counts as `prior_count` measurements [ours].

    Attributes:
        forgetting_factor: rho. The memory is 1 / (1 - rho) measurements.
        prior_count: Measurements that the model's variance is worth. A large number gives no adaptation.
        iterations: Number of updates of beta, equal for all runs.

    Raises:
        ValueError: If an argument is outside its range.
    """

    forgetting_factor: float = 0.98
    prior_count: float = 10.0
    iterations: int = 4

    def __post_init__(self) -> None:
        require_ranges(type(self).__name__, self, **_VARIATIONAL)

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        nominal, mask = diagonal_axes(innovation.noise), innovation.observed_mask
        start = torch.full_like(nominal, 0.5 * self.prior_count)
        before = belief.memory.get("noise_alpha", start), belief.memory.get("noise_beta", start)
        alpha, prior_beta = (self.forgetting_factor * a for a in before)
        alpha, beta = alpha + 0.5, prior_beta  # per component, in units of the model's variance
        factor = before[1] / before[0]
        for _ in range(self.iterations):
            adapted = innovation.with_noise(scale_variances(innovation.noise, factor))
            residual, covariance = updated_residual(adapted)
            square = residual.square() + diagonal_axes(covariance).clamp(min=0.0)
            beta = prior_beta + 0.5 * square / nominal
            factor = torch.where(mask & torch.isfinite(beta), beta / alpha, factor)
        return innovation.with_noise(scale_variances(innovation.noise, factor)), {
            "noise_alpha": torch.where(mask, alpha, before[0]),
            "noise_beta": torch.where(mask & torch.isfinite(beta), beta, before[1]),
            "noise_factor": factor,
        }


def scale_variances(noise: Tensor, factor: Tensor) -> Tensor:
    """Multiply variances by factors; correlations do not change.

    Shapes: noise [R, k, k], factor [R, k].
    """
    root = factor.sqrt()
    return noise * root.unsqueeze(-1) * root.unsqueeze(-2)
