"""Student's t errors by a variational scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import check_whole_number
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.robust.component_groups import (
    ComponentGrouping,
)
from pfbench.filter.robust.robust_update import (
    ResidualLoss,
    count_downweighted,
    finite_weight,
    updated_residual,
)
from pfbench.filter.robust.weight_functions import student_log_density


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

    def __post_init__(self) -> None:
        ComponentGrouping(self.grouping, self.groups)
        if not self.dof > 0.0:
            raise ValueError(f"StudentUpdate.dof must be positive, got {self.dof}. Use 4 to 8.")
        check_whole_number("StudentUpdate.iterations", self.iterations, 1, "Use 4.")

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        groups = self.component_grouping.apply(innovation, innovation.noise)
        w = torch.ones_like(innovation.r)
        for _ in range(self.iterations if math.isfinite(self.dof) else 0):
            residual, covariance = updated_residual(innovation.reweight(w, groups.group_mask))
            gamma = groups.squared_distance(residual) + groups.trace(covariance)
            w = finite_weight(self.residual_weight(gamma, groups.size))
        return innovation.reweight(w, groups.group_mask), count_downweighted(groups, w)

    @override
    def residual_weight(self, squared: Tensor, size: Tensor) -> Tensor:
        if math.isinf(self.dof):
            return torch.ones_like(squared)
        return (self.dof + size) / (self.dof + squared)

    @override
    def log_density(self, squared: Tensor, size: Tensor) -> Tensor:
        return student_log_density(squared, size, self.dof)
