"""Chi-square gate of the innovation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import check_whole_number
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.robust.component_groups import ComponentGrouping, GroupDistances
from pfbench.filter.robust.robust_update import InnovationWeight
from pfbench.filter.robust.weight_functions import quantile_table

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

    def __post_init__(self) -> None:
        ComponentGrouping(self.grouping, self.groups)
        if not 0.0 < self.probability <= 1.0:
            raise ValueError(
                f"InnovationGate.probability must be in (0, 1], got {self.probability}. Use 0.999, "
                "or 1 for no gate."
            )
        check_whole_number("InnovationGate.patience", self.patience, 0, "Use 0 for no limit.")

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
