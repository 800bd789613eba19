"""Robust updates by name: M-estimation, Student's t, weighted likelihood, gate, and constant factors as their control."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.gaussian.noise_adaptation import scale_columns
from pfbench.filter.robust.robust_update import (
    THRESHOLD_RULES,
    GroupDistances,
    InnovationWeight,
    ResidualLoss,
    cauchy_weight,
    count_downweighted,
    finite_weight,
    huber_log_density,
    huber_weight,
    quantile_table,
    student_log_density,
    threshold_table,
    welsch_log_loss,
    welsch_weight,
)

_ITERATIONS = {"iterations": "whole [1, inf) Use 4."}


@dataclass(frozen=True)
class MEstimationUpdate(ResidualLoss):
    """Iterated reweighting by the residual after the update.

    It minimises |xi|^2 / 2 + sum rho(d) over the groups of components, with d the distance of the
    residual in units of R, rho'(d) / d = w(d). The first weights are 1. With grouping `component`
    and the weight of Huber this is [Karlgaard and Schaub 2007] without weights of the prior.

    Attributes:
        threshold: c. None takes the threshold of `efficiency` for the size of each group.
        efficiency: Asymptotic efficiency at normal errors.
        iterations: Number of reweightings, equal for all runs.
        grouping: Components with a common weight, see ComponentGrouping.
        groups: Group number of each component, instead of `grouping`.
    """

    threshold: float | None = None
    efficiency: float = 0.95
    iterations: int = 4
    grouping: str = "component"
    groups: Sequence[int] | None = None

    rules = THRESHOLD_RULES | _ITERATIONS

    @staticmethod
    @abstractmethod
    def weight(squared: Tensor, threshold: Tensor) -> Tensor:
        """Compute the weights of squared distances."""

    def table(self, size: Tensor) -> Tensor:
        """Return the threshold of each group.

        Shapes: size [R, k].
        """
        return threshold_table(self.weight, self.threshold, self.efficiency, size)

    @override
    def weight_of(self, size: Tensor) -> Callable[[Tensor], Tensor]:
        threshold = self.table(size)
        return lambda squared: self.weight(squared, threshold)


@dataclass(frozen=True)
class HuberUpdate(MEstimationUpdate):
    """Huber's weight min(1, c / d): bounded influence [Huber 1964; Gandhi and Mili 2010]."""

    is_density = True
    weight = staticmethod(huber_weight)

    @override
    def log_density(self, squared: Tensor, size: Tensor) -> Tensor:
        return huber_log_density(squared, size, self.table(size))


@dataclass(frozen=True)
class CorrentropyUpdate(MEstimationUpdate):
    """Welsch's weight exp(-d^2 / (2 sigma^2)): maximum correntropy [Chen et al. 2017].

    The threshold is sigma. By default the prior is not weighted, since its weights depend on the
    coordinates of the state [ours]. The covariance is that of the reweighted measurement,
    (I + M' R~^-1 M)^-1; the paper prints Joseph's form with the nominal R.

    Attributes:
        weight_prior: Whether the whitened state is weighted as well, as published.
    """

    weight_prior: bool = False
    weight = staticmethod(welsch_weight)

    @override
    def log_density(self, squared: Tensor, size: Tensor) -> Tensor:
        return welsch_log_loss(squared, size, self.table(size))

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        if not self.weight_prior:
            return super().noise_adapt(innovation, belief)
        groups = self.component_grouping.apply(innovation, innovation.noise)
        w, scale = torch.ones_like(innovation.r), torch.ones_like(innovation.m[:, 0])
        weight, weight_of_prior = self.weight_of(groups.size), self.weight_of(scale)
        for _ in range(self.iterations):
            weighted = _scale_prior(innovation.reweight(w, groups.group_mask), scale)
            shift, *_ = kalman_gain_update(weighted)
            residual = innovation.r - (weighted.m @ shift.unsqueeze(-1)).squeeze(-1)
            w = finite_weight(weight(groups.squared_distance(residual)))
            prior_weight = finite_weight(weight_of_prior((scale * shift).square()))
            scale = prior_weight.clamp(min=1e-4).rsqrt()
        return _scale_prior(innovation.reweight(w, groups.group_mask), scale), count_downweighted(
            groups, w
        )


def _scale_prior(innovation: Innovation, scale: Tensor) -> Innovation:
    """Multiply the standard deviation of each whitened coordinate by `scale` [R, d]."""
    columns = scale.unsqueeze(-2)
    return innovation._replace(m=innovation.m * columns, root=innovation.root * columns)


@dataclass(frozen=True)
class StudentUpdate(ResidualLoss):
    """Student's t errors by a variational scale [Piche, Sarkka and Hartikainen 2012].

    y ~ N(H x, R / lambda), lambda ~ Gamma(nu / 2, nu / 2), and q(x) q(lambda) is optimised in
    turn: lambda = (nu + k) / (nu + tr R^-1 (e e' + H P+ H')), with e the residual after the update.
    R is the scale of the distribution; its covariance R nu / (nu - 2) exists for nu > 2. The belief
    is too narrow: in one dimension with nu = 3, P+ is 0.76 of the true variance.

    Attributes:
        dof: nu. Infinity gives the plain update.
        iterations: Number of updates of the scale, equal for all runs.
        grouping: Components with a common scale, see ComponentGrouping.
        groups: Group number of each component, instead of `grouping`.

    Raises:
        ValueError: If an argument is outside its range.
    """

    dof: float = 6.0
    iterations: int = 4
    grouping: str = "component"
    groups: Sequence[int] | None = None
    is_density = True
    adds_spread = True
    rules: ClassVar = {"dof": "(0, inf] Use 4 to 8.", **_ITERATIONS}

    @override
    def weight_of(self, size: Tensor) -> Callable[[Tensor], Tensor]:
        if math.isinf(self.dof):
            return torch.ones_like
        return lambda squared: (self.dof + size) / (self.dof + squared)

    @override
    def log_density(self, squared: Tensor, size: Tensor) -> Tensor:
        return student_log_density(squared, size, self.dof)


@dataclass(frozen=True)
class WeightedLikelihoodUpdate(InnovationWeight):
    """Weighted observation likelihood, WoLF [Duran-Martin et al. 2024].

    The power W^2 of the likelihood divides R: W^2 = 1 / (1 + d^2 / c^2), in one step without
    iteration. `mahalanobis` has d^2 = r' R^-1 r of the innovation r. `plain` (IMQ) has d^2 = r' r, so
    that c is a length and the components of a group must have one unit.

    Attributes:
        distance: `mahalanobis` (MD) or `plain` (IMQ).
        threshold: c. None takes the threshold of `efficiency`, with `mahalanobis` only.
        efficiency: Asymptotic efficiency at normal errors.
        grouping: Components with a common weight. The published form has `all`.
        groups: Group number of each component, instead of `grouping`.

    Raises:
        ValueError: If an argument is outside its range, or if the plain distance adds components of
            different units.
    """

    distance: str = "mahalanobis"
    threshold: float | None = None
    efficiency: float = 0.95
    grouping: str = "all"
    groups: Sequence[int] | None = None

    rules = THRESHOLD_RULES

    def __post_init__(self) -> None:
        super().__post_init__()
        name = type(self).__name__
        is_known = self.distance in ("mahalanobis", "plain")
        require(is_known, f"{name}.distance", "be mahalanobis or plain", self.distance)
        require(
            self.distance != "plain" or self.threshold is not None,
            f"{name}.threshold",
            "be a number in the unit of the measurement with distance=plain",
            "None",
            "Set it, or use distance=mahalanobis.",
        )
        require(
            self.distance != "plain" or self.groups is not None or self.grouping != "all",
            f"{name}.grouping",
            "be sensor or component with distance=plain, which adds squares of one unit",
            "all",
            "Set groups=[0, ...] if all units are equal.",
        )

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        w, groups, counts = self.innovation_weight(innovation, {})
        return innovation.reweight(w, groups.group_mask), counts

    @override
    def innovation_weight(
        self, innovation: Innovation, memory: Mapping[str, Tensor]
    ) -> tuple[Tensor, GroupDistances, dict[str, Tensor]]:
        groups = self.component_grouping.apply(innovation, innovation.noise)
        threshold = threshold_table(cauchy_weight, self.threshold, self.efficiency, groups.size)
        squared = (
            groups.sum_groups(innovation.r.square())
            if self.distance == "plain"
            else groups.squared_distance(innovation.r)
        )
        w = finite_weight(cauchy_weight(squared, threshold))
        return w, groups, count_downweighted(groups, w)


_STREAK = "rejected_streak"


@dataclass(frozen=True)
class InnovationGate(InnovationWeight):
    """Reject groups of components whose innovation is improbable [Mehra and Peschon 1971].

    A group is rejected if r' S^-1 r exceeds the quantile of chi-square. S is the block of the
    innovation covariance, and the degrees of freedom are the observed components. Rejected
    components count as missing. A filter that is wrong and confident would reject all measurements for
    ever, so a group is accepted again after `patience` rejections in a row [ours].

    Attributes:
        probability: Probability that a group with nominal errors is accepted. 1 switches it off.
        patience: Number of rejections in a row after which a group is accepted. 0 for no limit.
        grouping: Components that are rejected together, see ComponentGrouping.
        groups: Group number of each component, instead of `grouping`.

    Raises:
        ValueError: If an argument is outside its range.
    """

    probability: float = 0.999
    patience: int = 10
    grouping: str = "sensor"
    groups: Sequence[int] | None = None

    rules: ClassVar = {
        "probability": "(0, 1] Use 0.999, or 1 for no gate.",
        "patience": "whole [0, inf) Use 0 for no limit.",
    }

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        weight, _, counts = self.innovation_weight(innovation, belief.memory)
        return innovation.reject(weight == 0.0), counts

    @override
    def innovation_weight(
        self, innovation: Innovation, memory: Mapping[str, Tensor]
    ) -> tuple[Tensor, GroupDistances, dict[str, Tensor]]:
        s = innovation.m @ innovation.m.mT + innovation.omega
        groups = self.component_grouping.apply(innovation, s)
        rejected_mask = innovation.observed_mask & (
            groups.squared_distance(innovation.r) > quantile_table(self.probability, groups.size)
        )
        counts = {}
        if self.patience:
            streak = memory.get(_STREAK, torch.zeros_like(innovation.r))
            rejected_mask = rejected_mask & (streak < self.patience)
            counts[_STREAK] = torch.where(
                innovation.observed_mask, (streak + 1.0) * rejected_mask, streak
            )
        counts["rejected"] = groups.count_groups(rejected_mask)
        return (~rejected_mask).to(innovation.r), groups, counts


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
        require_ranges(
            "ScaledNoise",
            self,
            r_factor="(0, inf] Use 1 for the model's noise.",
            q_factor="(0, inf] Use 1 for the model's noise.",
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

    Returns the prediction. Shapes: factor [R or 1].
    """
    f = factor[:, None, None]
    omega = predicted.omega + (f - 1.0) * predicted.noise
    return predicted._replace(
        m=scale_columns(predicted.m, 1.0, torch.sqrt(f)), omega=omega, noise=predicted.noise * f
    )
