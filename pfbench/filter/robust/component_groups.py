"""Groups of measurement components that a robust update judges together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.principal_axes import (
    axes_by_group,
    compute_group_root,
    diagonal_axes,
    whitened_measurement,
)

GROUPINGS = ("all", "sensor", "component", "satellite")
DOWNWEIGHTED = 0.5  # a fix whose weight is below this counts as downweighted [ours]


@dataclass(frozen=True)
class ComponentGrouping:
    """Choice of the components that are judged together.

    Attributes:
        kind: `all` for the whole measurement, `sensor` for components of equal nominal variance,
            `component` for single components, or `satellite` for ranges followed by as many range
            rates.
        groups: Group number of each component, which replaces `kind`.

    Raises:
        ValueError: If the kind is not one of these. On use, if the groups do not fit.
    """

    kind: str = "component"
    groups: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if self.kind not in GROUPINGS:
            raise ValueError(
                f"grouping must be {', '.join(GROUPINGS[:-1])} or {GROUPINGS[-1]}, got "
                f"{self.kind}. Choose one of them."
            )
        if not all(isinstance(number, int) for number in self.groups or ()):
            raise ValueError(
                f"groups must be a whole number for each component, got {list(self.groups or ())}. "
                "Give components of one group the same number."
            )

    def numbers(self, components: int) -> Sequence[int] | None:
        """Return the group number of each component, None for groups of equal variance.

        Args:
            components: Number of measured components k.

        Raises:
            ValueError: If satellites need as many ranges as rates, and k is odd, or if `groups` has
                another number of entries.
        """
        if self.groups is not None:
            if len(self.groups) != components:
                raise ValueError(
                    f"groups must be one number for each of the {components} components of the measurement, got "
                    f"{list(self.groups)}. Give as many numbers."
                )
            return self.groups
        if self.kind == "satellite":
            if components % 2:
                raise ValueError(
                    "grouping must be component for a measurement without a range rate for each "
                    f"range, got satellite with {components} components. Choose component."
                )
            return [i % (components // 2) for i in range(components)]
        return {"all": [0] * components, "component": range(components)}.get(self.kind)

    def apply(self, innovation: Innovation, covariance: Tensor) -> GroupDistances:
        """Build the distances by group, in units of a covariance.

        Args:
            innovation: Innovation of the step.
            covariance: Covariance of the measurement, [R, k, k]. Its correlations between groups
                are ignored [ours].

        Returns:
            The distances.
        """
        group_mask, joint_mask = axes_by_group(innovation, self.numbers(innovation.r.shape[-1]))
        root = compute_group_root(covariance, joint_mask)
        observed = innovation.observed_mask.to(innovation.r)
        count = (group_mask.to(observed) @ observed.unsqueeze(-1)).squeeze(-1)
        return GroupDistances(group_mask.to(observed), joint_mask, root, observed, count)


class GroupDistances(NamedTuple):
    """Squared distances of a residual by group, in units of a covariance.

    Attributes:
        group_mask: 1 where two components belong to one group, [R, k, k].
        joint_mask: Mask of observed component pairs of one group, [R, k, k].
        root: Block-diagonal root of the covariance, [R, k, k].
        observed: 1 for observed components, [R, k].
        size: Number of observed components in the group of a component, [R, k].
    """

    group_mask: Tensor
    joint_mask: Tensor
    root: Tensor
    observed: Tensor
    size: Tensor

    def sum_groups(self, squares: Tensor) -> Tensor:
        """Sum values [R, k] over the observed components of each group, [R, k]."""
        return (self.group_mask @ (squares * self.observed).unsqueeze(-1)).squeeze(-1)

    def squared_distance(self, residual: Tensor) -> Tensor:
        """Compute d^2 of the group of each component, [R, k], of a residual [R, k]."""
        white = torch.linalg.solve_triangular(self.root, residual.unsqueeze(-1), upper=False)
        return self.sum_groups(white.squeeze(-1).square())

    def trace(self, covariance: Tensor) -> Tensor:
        """Compute the trace of C in units of the covariance, by group, [R, k]; C [R, k, k]."""
        white = whitened_measurement(self.root, covariance, self.joint_mask)
        return self.sum_groups(diagonal_axes(white).clamp(min=0.0))

    def count_groups(self, mask: Tensor) -> Tensor:
        """Count the groups whose components are marked in a mask [R, k], [R]."""
        return (mask.to(self.observed) * self.observed / self.size.clamp(min=1.0)).sum(-1)
