"""Variational Bayes for the whole measurement noise covariance and the predicted covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.core.parameter_checks import check_whole_number
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.robust.noise_learning import check_forgetting
from pfbench.filter.robust.robust_update import RobustUpdate

_NAME = "VariationalCovarianceAdaptation"


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

    def __post_init__(self) -> None:
        check_forgetting(_NAME, self.forgetting_factor)
        if not 0.0 < self.prior_count < math.inf:
            raise ValueError(
                f"{_NAME}.prior_count must be positive and finite, got {self.prior_count}. Use 10."
            )
        if not self.prediction_count > 0.0:
            raise ValueError(
                f"{_NAME}.prediction_count must be positive, got {self.prediction_count}. Use 5."
            )
        check_whole_number(f"{_NAME}.iterations", self.iterations, 1, "Use 4.")

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
