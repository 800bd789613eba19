"""Weighted observation likelihood: the power of the likelihood depends on the innovation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.robust.component_groups import ComponentGrouping, GroupDistances
from pfbench.filter.robust.robust_update import (
    InnovationWeight,
    check_efficiency,
    check_threshold,
    count_downweighted,
    finite_weight,
)
from pfbench.filter.robust.weight_functions import (
    cauchy_weight,
    threshold_table,
)


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

    def __post_init__(self) -> None:
        name = "WeightedLikelihoodUpdate"
        ComponentGrouping(self.grouping, self.groups)
        check_threshold(name, self.threshold)
        if self.distance not in ("mahalanobis", "plain"):
            raise ValueError(
                f"{name}.distance must be mahalanobis or plain, got {self.distance}. Use "
                "mahalanobis."
            )
        check_efficiency(name, self.efficiency)
        if self.distance == "plain" and self.threshold is None:
            raise ValueError(
                f"{name}.threshold must be a number in the unit of the measurement with "
                "distance=plain, got None. Set it, or use distance=mahalanobis."
            )
        if self.distance == "plain" and self.groups is None and self.grouping == "all":
            raise ValueError(
                f"{name}.grouping must be sensor or component with distance=plain, which adds "
                "squares of one unit, got all. Set groups=[0, ...] if all units are equal."
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
