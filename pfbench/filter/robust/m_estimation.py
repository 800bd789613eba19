"""M-estimation of the whitened state by iterated reweighting: Huber and maximum correntropy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import check_whole_number
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.robust.component_groups import (
    ComponentGrouping,
)
from pfbench.filter.robust.robust_update import (
    ResidualLoss,
    check_efficiency,
    check_threshold,
    count_downweighted,
    finite_weight,
    updated_residual,
)
from pfbench.filter.robust.weight_functions import (
    WeightFunction,
    huber_log_density,
    huber_weight,
    threshold_table,
    welsch_log_loss,
    welsch_weight,
)


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

    Raises:
        ValueError: If an argument is outside its range. On use, if every threshold of a group has a
            larger efficiency.
    """

    threshold: float | None = None
    efficiency: float = 0.95
    iterations: int = 4
    grouping: str = "component"
    groups: Sequence[int] | None = None

    def __post_init__(self) -> None:
        name = type(self).__name__
        check_threshold(name, self.threshold)
        ComponentGrouping(self.grouping, self.groups)
        check_efficiency(name, self.efficiency)
        check_whole_number(f"{name}.iterations", self.iterations, 1, "Use 4.")

    @property
    @abstractmethod
    def weight(self) -> WeightFunction:
        """Weight as a function of squared distances and thresholds."""

    def table(self, size: Tensor) -> Tensor:
        """Return the threshold of each group.

        Args:
            size: Observed components of the group, [R, k].
        """
        return threshold_table(self.weight, self.threshold, self.efficiency, size)

    @override
    def residual_weight(self, squared: Tensor, size: Tensor) -> Tensor:
        return self.weight(squared, self.table(size))

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        groups = self.component_grouping.apply(innovation, innovation.noise)
        threshold = self.table(groups.size)
        w = torch.ones_like(innovation.r)
        for _ in range(self.iterations):
            residual, _ = updated_residual(innovation.reweight(w, groups.group_mask))
            w = finite_weight(self.weight(groups.squared_distance(residual), threshold))
        return innovation.reweight(w, groups.group_mask), count_downweighted(groups, w)


@dataclass(frozen=True)
class HuberUpdate(MEstimationUpdate):
    """Huber's weight min(1, c / d): bounded influence [Huber 1964; Gandhi and Mili 2010]."""

    is_density = True

    @property
    @override
    def weight(self) -> WeightFunction:
        return huber_weight

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

    @property
    @override
    def weight(self) -> WeightFunction:
        return welsch_weight

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
        threshold = self.table(groups.size)
        prior_threshold = self.table(torch.ones_like(innovation.m[:, 0]))
        w, scale = torch.ones_like(innovation.r), torch.ones_like(innovation.m[:, 0])
        for _ in range(self.iterations):
            weighted = _scale_prior(innovation.reweight(w, groups.group_mask), scale)
            shift, *_ = kalman_gain_update(weighted)
            residual = innovation.r - (weighted.m @ shift.unsqueeze(-1)).squeeze(-1)
            w = finite_weight(self.weight(groups.squared_distance(residual), threshold))
            prior_weight = finite_weight(self.weight((scale * shift).square(), prior_threshold))
            scale = prior_weight.clamp(min=1e-4).rsqrt()
        return _scale_prior(innovation.reweight(w, groups.group_mask), scale), count_downweighted(
            groups, w
        )


def _scale_prior(innovation: Innovation, scale: Tensor) -> Innovation:
    """Multiply the standard deviation of each whitened coordinate by `scale` [R, d]."""
    columns = scale.unsqueeze(-2)
    return innovation._replace(m=innovation.m * columns, root=innovation.root * columns)
