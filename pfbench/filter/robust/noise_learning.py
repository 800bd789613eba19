"""Measurement noise learned by the filter: per component, as a whole matrix, or from a window of innovations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require_ranges
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, diagonal_axes
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.robust.robust_update import RobustUpdate, updated_residual

_FORGETTING = "(0, 1) Use 0.98."
_BOUNDS = {"min_factor": "(0, 1] Use 0.5.", "max_factor": "[1, inf] Use 100."}
_VARIATIONAL = {
    "forgetting_factor": _FORGETTING,
    "prior_count": "(0, inf) Use 10.",
    "iterations": "whole [1, inf) Use 4.",
}

# --------------------------------------------------------------------------------------------------
# Adaptive measurement noise: the variance of each component is learned from the measurements.
#
# Suited to noise that changes slowly. After a single outlier the learned variance stays too large for
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


# --------------------------------------------------------------------------------------------------
# Variational Bayes for the whole measurement noise covariance and the predicted covariance.


@dataclass(frozen=True)
class VariationalCovarianceAdaptation(RobustUpdate):
    """Variational Bayes for R and P- [Huang, Zhang, Wu, Li and Chambers 2018].

    R and P- have inverse Wishart distributions, written by their means and weights. In turn, x is
    updated with both means, and both are updated by x:

        P = (tau P- + E (x - x-)(x - x-)') / (tau + 1)
        R = (n R' + E (y - H x)(y - H x)') / (n + 1),  n = rho n of the last step

    At the start the model's R counts as `prior_count` measurements [ours]. The square of a missing
    component has its expectation given the others [ours].

    An outlier is taken for an error of the prediction: it raises P-, so that the measurement is
    trusted more.

    Attributes:
        forgetting_factor: rho.
        prior_count: Measurements that the model's R is worth.
        prediction_count: tau, weight of the predicted covariance. Infinity leaves it unchanged.
        iterations: Number of updates, equal for all runs.

    Raises:
        ValueError: If an argument is outside its range.
    """

    forgetting_factor: float = 0.98
    prior_count: float = 10.0
    prediction_count: float = 5.0
    iterations: int = 4

    rules: ClassVar = {**_VARIATIONAL, "prediction_count": "(0, inf] Use 5."}

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        unit, _ = factor(innovation.nominal.expand_as(innovation.noise))
        eye = torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device).expand_as(unit)
        before = belief.memory.get("noise_mean", eye)  # in units of the model's root
        start = torch.full_like(innovation.r[:, 0], self.prior_count)
        count = self.forgetting_factor * belief.memory.get("noise_weight", start)
        adapted, mean = innovation.with_noise(unit @ before @ unit.mT), before
        columns = torch.eye(innovation.m.shape[-1], dtype=unit.dtype, device=unit.device)
        for _ in range(self.iterations):
            shift, root, _ = kalman_gain_update(adapted)
            residual = innovation.r - (adapted.m @ shift.unsqueeze(-1)).squeeze(-1)
            second = _complete_moment(
                _second_moment(residual, adapted.m @ root),
                unit @ before @ unit.mT,
                innovation.observed_mask,
            )
            white = torch.linalg.solve_triangular(unit, second, upper=False)
            white = torch.linalg.solve_triangular(unit, white.mT, upper=False)
            weight = count[:, None, None]
            mean = (weight * before + white) / (weight + 1.0)
            mean = torch.where(_usable(innovation, mean), mean, before)
            state = (columns @ shift.unsqueeze(-1)).squeeze(-1)
            columns = self._predicted_root(_second_moment(state, columns @ root))
            adapted = innovation._replace(
                m=innovation.m @ columns, root=innovation.root @ columns
            ).with_noise(unit @ mean @ unit.mT)
        usable = _usable(innovation, mean)[:, 0, 0]
        count = torch.where(usable, count + 1.0, count / self.forgetting_factor)
        return adapted, {"noise_mean": mean, "noise_weight": count}

    def _predicted_root(self, moment: Tensor) -> Tensor:
        """Return a root of the mean of P- in whitened coordinates, where the prediction has I."""
        eye = torch.eye(moment.shape[-1], dtype=moment.dtype, device=moment.device)
        if math.isinf(self.prediction_count):
            return eye
        tau = self.prediction_count
        root, is_positive = factor((tau * eye + moment) / (tau + 1.0))
        return torch.where(is_positive[:, None, None], root, eye)


def _second_moment(mean: Tensor, root: Tensor) -> Tensor:
    """Return mean mean' + root root', [R, n, n]."""
    return mean.unsqueeze(-1) * mean.unsqueeze(-2) + root @ root.mT


def _complete_moment(second: Tensor, covariance: Tensor, observed_mask: Tensor) -> Tensor:
    """Return E e e' of all components, from that of the observed ones and the covariance of e."""
    pair_mask = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    columns = torch.where(observed_mask.unsqueeze(-2), covariance, 0.0)
    gain = torch.linalg.solve_ex(torch.where(pair_mask, covariance, eye), columns.mT)[0].mT
    explained = torch.where(pair_mask, covariance, 0.0)
    return covariance + gain @ (second - explained) @ gain.mT


def _usable(innovation: Innovation, mean: Tensor) -> Tensor:
    """Return runs with a measurement whose estimate is finite, bool [R, 1, 1]."""
    is_usable = innovation.observed_mask.any(-1) & torch.isfinite(mean).flatten(1).all(-1)
    return is_usable[:, None, None]


# --------------------------------------------------------------------------------------------------
# Adaptive measurement noise from a window of innovations.

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
        require_ranges("WindowedNoiseAdaptation", self, window="whole [2, inf) Use 20.", **_BOUNDS)

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
