"""Adaptive measurement noise: the variance of each component is learned from the measurements.

Suited to noise that changes slowly. After a single outlier the learned variance stays too large for
the length of the memory. Missing components do not change the memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import check_whole_number
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.principal_axes import diagonal_axes
from pfbench.filter.robust.robust_update import RobustUpdate, updated_residual


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
        check_forgetting("SageHusaAdaptation", self.forgetting_factor)
        if not 0.0 < self.max_gain <= 1.0:
            raise ValueError(
                f"SageHusaAdaptation.max_gain must be in (0, 1], got {self.max_gain}. Use 0.05."
            )
        check_factor_bounds("SageHusaAdaptation", self.min_factor, self.max_factor)

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
        check_forgetting("VariationalNoiseAdaptation", self.forgetting_factor)
        if not 0.0 < self.prior_count < math.inf:
            raise ValueError(
                "VariationalNoiseAdaptation.prior_count must be positive and finite, got "
                f"{self.prior_count}. Use 10."
            )
        check_whole_number("VariationalNoiseAdaptation.iterations", self.iterations, 1, "Use 4.")

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

    Args:
        noise: Covariance, [R, k, k].
        factor: Factors, [R, k].
    """
    root = factor.sqrt()
    return noise * root.unsqueeze(-1) * root.unsqueeze(-2)


def check_factor_bounds(name: str, lowest: float, largest: float) -> None:
    """Check the bounds of a factor on the model's variance.

    Args:
        name: Class for the message.
        lowest: Smallest factor.
        largest: Largest factor.

    Raises:
        ValueError: If 1 does not lie between them, or the smallest is not positive.
    """
    if not 0.0 < lowest <= 1.0 <= largest:
        raise ValueError(
            f"{name}.min_factor must be in (0, 1] and max_factor at least 1, got "
            f"min_factor={lowest}, max_factor={largest}. Use 0.5 and 100."
        )


def check_forgetting(name: str, value: float) -> None:
    """Check that a forgetting factor lies in (0, 1).

    Args:
        name: Class for the message.
        value: Value to check.

    Raises:
        ValueError: If it does not.
    """
    if not 0.0 < value < 1.0:
        raise ValueError(f"{name}.forgetting_factor must be in (0, 1), got {value}. Use 0.98.")
